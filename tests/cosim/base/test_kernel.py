"""Compiled functions lie in a cache, from which a process can load all of them at once."""

import subprocess
import sys

MINE = """
from numba import prange

from cosim.base.kernel import kernel, parallel


@kernel
def doubled(x):
    return 2 * x


@parallel
def filled(x):
    for i in prange(len(x)):
        x[i] = i
"""
COMPILES = "import mine, numpy as np; mine.doubled(1); mine.doubled(1.5); mine.filled(np.zeros(3))"
LOADS = """
import mine, numba
from cosim.base.kernel import load_cached
before = load_cached()
mine.doubled.disable_compile()
assert before >= 2 and mine.doubled(3) == 6 and mine.doubled(0.25) == 0.5
assert not mine.filled.signatures
try:
    numba.threading_layer()
except ValueError:
    print("no threads")
"""


def test_loads_what_is_cached_and_starts_no_threads(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)

    def run(code):
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {code}"
        return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout

    run(COMPILES)
    assert run(LOADS) == "no threads\n"
