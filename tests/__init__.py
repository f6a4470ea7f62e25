"""Tests. One that names no preset runs in the world of version 0.2.

It is the fastest world, and most figures of tests were derived in it. A test of the real default asks for `modern`.
"""

from cosim.config import preset

preset.DEFAULT = "v0.2"
