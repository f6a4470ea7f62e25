"""Starts the cells of a run."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace

from cosim.addons.cells.crew import Crew, Workers
from cosim.addons.cells.nursery import MOST, Forked, n_cores
from cosim.addons.cells.perception import CellPerception
from cosim.config.config import chosen
from cosim.step.mixed_perception import MixedPerception
from cosim.step.parts import Parts
from cosim.step.perception import Perception
from cosim.traffic.scenario import Scenario

AUTO = "auto"
"""As many cells as this machine has use for."""
_FEWEST_CORES = 4
"""With fewer cores than this, threads of one process serve as well."""


@dataclass(frozen=True, slots=True)
class Cells:
    """The cells that a user wants."""

    number: int | str = 0
    """`AUTO`, or a number; 0 for none."""
    scheduler: str | None = None
    """Address of the Dask scheduler that places them; None for this machine."""

    @staticmethod
    def of(text: str, scheduler: str | None = None) -> "Cells":
        """From the values of `--cells` and `--scheduler`. A ValueError of one line is raised for wrong ones."""
        if text != AUTO and (
            not (text.removeprefix("-").isascii() and text.removeprefix("-").isdecimal()) or not 0 <= int(text) <= MOST
        ):
            raise ValueError(f"--cells {text}: give a number from 1 to {MOST}, {AUTO}, or 0 for none.")
        cells = Cells(AUTO if text == AUTO else int(text), scheduler)
        if scheduler is not None and cells.number == 0:
            raise ValueError(f"--scheduler {scheduler} is for cells: give --cells N, or --cells {AUTO}.")
        return cells


NO_CELLS = Cells()


@contextmanager
def workers_for(wanted: Cells) -> Iterator[Workers | None]:
    """Workers of cells, which start while the city is read; None for no cells.

    Raises
    ------
    ValueError
        In one line, if the scheduler cannot place them.
    """
    if wanted.scheduler is not None:
        from cosim.addons.cells.placed import placed  # imports Dask, which takes a second

        with placed(wanted.scheduler, None if isinstance(wanted.number, str) else wanted.number) as workers:
            yield workers
    elif wanted.number == 0 or (wanted.number == AUTO and n_cores() < _FEWEST_CORES):
        yield None
    else:
        with closing(Forked()) as forked:
            yield forked


@contextmanager
def in_cells(
    parts: Parts, scenario: Scenario, wanted: Cells, workers: Workers | None = None
) -> Iterator[Parts]:  # fmt: skip
    """The components of a run whose vehicles sense in cells. The workers end with it.

    `workers` is what `workers_for` has yielded. `AUTO` takes a core of this machine for the process of the run and each
    other core for a cell; with a scheduler, each thread of its workers for a cell; as far as the city has room.

    Raises
    ------
    ValueError
        In one line, if the city cannot be cut into so many cells.
    """
    n_cells = _fitting(parts, scenario, workers) if isinstance(wanted.number, str) else wanted.number
    if not n_cells:
        yield parts
        return
    check(parts, scenario, n_cells)
    inside, choice = parts.perception, chosen(parts.config, "detector")[0]
    assert isinstance(inside, Perception | MixedPerception)
    with Crew(n_cells, inside, [choice.source.name] if choice.is_own else (), workers) as crew:
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


def _fitting(parts: Parts, scenario: Scenario, workers: Workers | None) -> int:
    """Cells for these workers and this city; 0 where they gain nothing."""
    if workers is None or not parts.config.sensing:
        return 0
    return min(workers.room, _most(parts, scenario))
