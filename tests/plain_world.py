"""The world in which a test plays that names no preset: exact poses, common phases, a sensor that looks ahead.

Most figures of tests were derived by hand in it. A test of the default world asks for `modern`. What developers run
beside the tests (`tests.bench`, `tests.verification`) plays in the default world.
"""

from cosim.config import preset

PRESET = "v0.2"


def enter() -> None:
    """From now on, a config of this process that names no preset is of the plain world."""
    preset.DEFAULT = PRESET
