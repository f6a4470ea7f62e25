"""Runs the benchmarks of the components."""

import os
import platform
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any

import numba
import numpy as np

from cosim.base.threads import n_threads
from tests.bench.scale import Row
from tests.bench.scale import bench as grown

BENCHES: dict[str, str] = {
    "sensors": "tests.bench.sensors",
    "trust": "tests.bench.trust",
    "models": "tests.bench.models",
    "radio": "tests.bench.radio",
    "mobility": "tests.bench.mobility",
    "cycle": "tests.bench.cycle",
    "studies": "tests.bench.studies",
}
"""Modules whose `bench()` measures a component."""


def run(names: Sequence[str]) -> list[dict[str, Any]]:
    """The figures of these benchmarks, or of all without a name.

    Raises
    ------
    ValueError
        If there is no such benchmark.
    """
    if unknown := set(names) - set(BENCHES):
        raise ValueError(f"{' '.join(unknown)}: no such benchmark. There are {', '.join(BENCHES)}.")
    return [row for name in names or BENCHES for row in _rows(name, import_module(BENCHES[name]).bench())]


def run_scale(
    scenario: str,
    trace: str | None,
    vehicles: str,
    seconds: int,
    overrides: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """The figures of `tests.bench.scale`.

    Raises
    ------
    ValueError
        If `vehicles` is not a list of whole numbers.
    """
    try:
        sizes = tuple(int(size) for size in vehicles.split(","))
    except ValueError:
        sizes = ()
    if not sizes or min(sizes) < 1:
        raise ValueError(f"--vehicles {vehicles}: whole numbers from 1, with commas between them, are wanted.")
    return _rows("scale", grown(scenario, trace, sizes, seconds, tuple(overrides)))


def _rows(name: str, figures: Iterable[Row]) -> list[dict[str, Any]]:
    """Figures of a benchmark as rows of a table of metrics."""
    return [
        {"metric": f"{name}.{figure}", "group": "", "value": value, "unit": unit, "label": ""}
        for figure, value, unit in figures
    ]


def machine() -> str:
    """A description of this machine."""
    return (
        f"{platform.machine()}, {os.cpu_count()} cores, {n_threads()} threads, "
        f"Python {platform.python_version()}, NumPy {np.__version__}, Numba {numba.__version__}"
    )
