"""Values of a step that are computed before it begins."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cosim.step.perception import Observed
from cosim.step.trackers.encounters import NearPairs


@dataclass(frozen=True, slots=True)
class Precomputed:
    """Values of one step that another thread computes before the step needs them.

    They depend on the world only, so they equal those that the step would compute. Each function waits for its value.
    If a function is None, the step computes the value itself.
    """

    near_pairs: Callable[[], NearPairs] | None = None
    """As `Parts.near_pairs` returns them for the world of the step."""
    observed: Callable[[], Observed] | None = None
    """As `Parts.perception` returns it for all equipped vehicles of the world."""
    with_links: Callable[[Any], Any] | None = None
    """Takes the medium's state and returns it with the radio links between the stations of the step."""
    sweeps_are_read: Callable[[], None] | None = None
    """The step calls it when it has read its range images for the last time. Their memory may then be overwritten."""


NOTHING_PRECOMPUTED = Precomputed()
"""The step computes everything itself."""
