"""Processes of this program: what they take from the current folder, and how one starts another.

The user may work in a folder of somebody else, who must not choose code by it. `python -P -m cosim.runs.process
MODULE WORDS` runs a module of this program as its main module.
"""

import gc
import os
import runpy
import sys
import threading
from pathlib import Path

from cosim.runs.speed.allocator import share_one_arena

_ROOT = Path(__file__).parents[2]


def command(module: str, *words: str) -> list[str]:
    """Words that start a module of this program, with the code of this process.

    With `-P`, the process does not look for modules in the current folder.
    """
    return [sys.executable, "-P", "-m", "cosim.runs.process", module, *words]


def environment(**more: str) -> dict[str, str]:
    """Environment of such a process. It finds this program where this process has found it.

    A checkout may be used through PYTHONPATH, or from its own folder without being installed. An empty entry of
    PYTHONPATH would be the current folder.
    """
    places = [place for place in os.environ.get("PYTHONPATH", "").split(os.pathsep) if place]
    if _ROOT.name not in ("site-packages", "dist-packages"):  # whose other packages must not come before Python's own
        places.insert(0, str(_ROOT))
    return os.environ | {"PYTHONPATH": os.pathsep.join(places)} | more


def end_with_parent() -> None:
    """End this process when the one that started it closes its standard input, or ends."""
    threading.Thread(target=_read_to_end, daemon=True).start()


def _read_to_end() -> None:
    while os.read(0, 4096):
        pass
    os._exit(3)


def ignore_settings_here() -> None:
    """Let no library read settings from the current folder.

    Numba's can name a folder of compiled functions, which are pickles, and Matplotlib's a program that writes movies.
    """
    if os.path.lexists(".numba_config.yaml"):
        from numba.core import config

        config._config_fname = os.devnull  # it has no other switch
        config.reload_config()
    if os.path.lexists("matplotlibrc"):
        from results.figures.style import forget_settings

        forget_settings()


if __name__ == "__main__":
    gc.set_threshold(100_000, 50, 100)  # as in `cosim.__main__`
    share_one_arena()
    ignore_settings_here()
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
