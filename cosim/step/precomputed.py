"""What is known of a step before it begins."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cosim.step.perception import Observed
from cosim.step.trackers.encounters import NearPairs


@dataclass(frozen=True, slots=True)
class Precomputed:
    """Values of one step that another thread computes before the step asks for them, handed to the step.

    They depend on the world alone, so they are those that the step would compute itself. Each function waits until its
    value is there; where it is None, the step computes the value.
    """

    near_pairs: Callable[[], NearPairs] | None = None
    """As `Parts.near_pairs` finds them in the world of the step."""
    observed: Callable[[], Observed] | None = None
    """As `Parts.perception` returns it for all equipped vehicles of the world."""
    with_links: Callable[[Any], Any] | None = None
    """From the medium's state to the same state with the radio links between the stations of the step."""
    sweeps_are_read: Callable[[], None] | None = None
    """Called when the step has read its range images for the last time: their memory may be written over."""


NOTHING_PRECOMPUTED = Precomputed()
"""The step computes everything itself."""
