"""Stages of a step in the shipped city with every vehicle equipped and a driver that reacts to what it believes."""

from collections.abc import Iterator

from tests.bench.scale import Row
from tests.bench.scale import bench as grown

SECONDS = 60


def bench() -> Iterator[Row]:
    """Measure the whole city with one thread and with all threads. The drivers' commands are computed, not obeyed."""
    return grown(
        vehicles=(),
        seconds=SECONDS,
        overrides=("driver.model=cautious", "attacks.0.start_s=0", "attacks.1.start_s=0"),
    )
