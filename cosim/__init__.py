"""Co-simulation of traffic, LiDAR, V2X messages and trust at city scale.

A notebook needs three names: `Simulation` (a run step by step in memory), `run` (a whole one into a folder) and
`open_run` (the tables of a folder). They are imported when they are first used, so that `import cosim` is quick.
"""

from importlib import import_module
from typing import Any

__version__ = "0.3.0.dev0"

_MODULES = {
    "Simulation": "cosim.runs.simulation",
    "run": "cosim.runs.simulation",
    "open_run": "results.archive",
}
"""Where each public name is defined."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
