"""Starts the cells of a run."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

from cosim.config.config import chosen
from cosim.execution.cells.crew import Crew
from cosim.execution.cells.nursery import Nursery
from cosim.execution.cells.perception import CellPerception
from cosim.mobility.scenario import Scenario
from cosim.step.mixed_perception import MixedPerception
from cosim.step.parts import Parts
from cosim.step.perception import Perception

MOST = 256
"""Workers of a run."""


AUTO = "auto"
"""As many cells as this machine has use for."""
_FEWEST_CORES = 4
"""With fewer cores than this, threads of one process serve as well."""


def number_of(text: str) -> int | str:
    """The value of `--cells`: a number, or `AUTO`. A ValueError of one line is raised for anything else."""
    if text == AUTO:
        return AUTO
    if not (text.removeprefix("-").isascii() and text.removeprefix("-").isdecimal()) or not 0 <= int(text) <= MOST:
        raise ValueError(f"--cells {text}: give a number from 1 to {MOST}, {AUTO}, or 0 for none.")
    return int(text)


@contextmanager
def nursery_for(wanted: int | str) -> Iterator[Nursery | None]:
    """The process that forks the workers of so many cells, which starts while the city is read; None for no cells."""
    nursery = None
    if wanted != 0 and (wanted != AUTO or _n_cores() >= _FEWEST_CORES):
        with suppress(OSError):  # the crew tries again, and says what is missing
            nursery = Nursery()
    try:
        yield nursery
    finally:
        if nursery is not None:
            nursery.close()


@contextmanager
def in_cells(
    parts: Parts, scenario: Scenario, wanted: int | str, nursery: Nursery | None = None
) -> Iterator[Parts]:  # fmt: skip
    """The components of a run whose vehicles sense in this number of cells; 0 for none. The workers end with it.

    `nursery` is what `nursery_for` has started. `AUTO` takes a core for the process of the run and each other core for
    a cell, as far as the city has room for them.

    Raises
    ------
    ValueError
        In one line, if the city cannot be cut into so many cells.
    """
    n_cells = _fitting(parts, scenario) if isinstance(wanted, str) else wanted
    if not n_cells:
        yield parts
        return
    check(parts, scenario, n_cells)
    inside, choice = parts.perception, chosen(parts.config, "detector")[0]
    assert isinstance(inside, Perception | MixedPerception)
    with Crew(n_cells, inside, [choice.source.name] if choice.is_own else (), nursery) as crew:
        cells = CellPerception(inside, crew, parts.config.lidar.max_range_m)
        yield replace(parts, perception=cells, compare=cells.compare)


def check(parts: Parts, scenario: Scenario, n_cells: int) -> None:
    """Raise ValueError, in one line, if the city cannot be cut into so many cells.

    Cells narrower than a LiDAR reaches to both sides would mostly hold what their neighbours hold too.
    """
    if not 1 <= n_cells <= MOST:
        raise ValueError(f"--cells {n_cells}: give a number from 1 to {MOST}.")
    if not parts.config.sensing:
        raise ValueError(f"--cells {n_cells}: with sensing = false there is nothing to compute in cells. Leave it out.")
    if n_cells > (most := _most(parts, scenario)):
        assert scenario.bounds_m is not None
        west, south, east, north = scenario.bounds_m
        raise ValueError(
            f"--cells {n_cells}: {scenario.name} is too small: {east - west:.0f} m x {north - south:.0f} m, and a "
            f"LiDAR reaches {parts.config.lidar.max_range_m:g} m to each side. Give {most} cells or fewer."
        )


def _most(parts: Parts, scenario: Scenario) -> int:
    """The most cells that a city has room for."""
    if scenario.bounds_m is None:
        return MOST
    west, south, east, north = scenario.bounds_m
    return max(1, min(MOST, int((east - west) * (north - south) / (2 * parts.config.lidar.max_range_m) ** 2)))


def _fitting(parts: Parts, scenario: Scenario) -> int:
    """Cells for this machine and city; 0 where they gain nothing."""
    cores = _n_cores()
    if cores < _FEWEST_CORES or not parts.config.sensing:
        return 0
    return min(cores - 1, _most(parts, scenario))


def _n_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
