"""Tests. One that names no preset runs in a plain world: exact poses, common phases, a sensor that looks ahead.

Most figures of tests were derived by hand in it. A test of the default world asks for `modern`.
"""

from cosim.config import preset

preset.DEFAULT = "v0.2"
