"""Starts the cells of a run."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from cosim.config.config import chosen
from cosim.execution.cells.crew import Crew
from cosim.execution.cells.perception import CellPerception
from cosim.mobility.scenario import Scenario
from cosim.step.mixed_perception import MixedPerception
from cosim.step.parts import Parts
from cosim.step.perception import Perception

MOST = 256
"""Workers of a run."""


@contextmanager
def in_cells(parts: Parts, scenario: Scenario, n_cells: int) -> Iterator[Parts]:
    """The components of a run whose vehicles sense in this number of cells; 0 for none. The workers end with it.

    Raises
    ------
    ValueError
        In one line, if the city cannot be cut into so many cells.
    """
    if not n_cells:
        yield parts
        return
    check(parts, scenario, n_cells)
    inside, choice = parts.perception, chosen(parts.config, "detector")[0]
    assert isinstance(inside, Perception | MixedPerception)
    with Crew(n_cells, inside, [choice.source.name] if choice.is_own else ()) as crew:
        yield replace(parts, perception=CellPerception(inside, crew, parts.config.lidar.max_range_m))


def check(parts: Parts, scenario: Scenario, n_cells: int) -> None:
    """Raise ValueError, in one line, if the city cannot be cut into so many cells.

    Cells narrower than a LiDAR reaches to both sides would mostly hold what their neighbours hold too.
    """
    if not 1 <= n_cells <= MOST:
        raise ValueError(f"--cells {n_cells}: give a number from 1 to {MOST}.")
    if not parts.config.sensing:
        raise ValueError(f"--cells {n_cells}: with sensing = false there is nothing to compute in cells. Leave it out.")
    if scenario.bounds_m is None:
        return
    west, south, east, north = scenario.bounds_m
    reach_m = parts.config.lidar.max_range_m
    most = max(1, int((east - west) * (north - south) / (2 * reach_m) ** 2))
    if n_cells > most:
        raise ValueError(
            f"--cells {n_cells}: {scenario.name} is too small: {east - west:.0f} m x {north - south:.0f} m, and a "
            f"LiDAR reaches {reach_m:g} m to each side. Give {most} cells or fewer."
        )
