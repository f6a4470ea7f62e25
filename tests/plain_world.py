"""The world in which a test plays that names no preset: exact poses, common phases, a sensor that looks ahead.

Most figures of tests were derived by hand in it. A test of the default world asks for `modern`. What developers run
beside the tests (`tests.bench`, `tests.verification`) plays in the default world.

No second process compiles kernels during a run. It would begin anew with each of hundreds of short runs, none of which
lasts until it is done, and would take the core of the other worker.
"""

from cosim.config import preset
from cosim.runs.speed import kernels

PRESET = "v0.2"


def enter() -> None:
    """From now on, a config of this process that names no preset is of the plain world."""
    preset.DEFAULT = PRESET
    kernels._start = lambda path: None
