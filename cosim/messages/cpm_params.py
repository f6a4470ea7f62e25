"""Parameters of detection messages, which are sent as collective perception messages."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from cosim.base.bounds import NotNegative100, NotNegative1000

MOST_OBJECTS = 255
"""Largest number of objects in one message: ETSI TS 103 324, `PerceivedObjects`."""

Redundancy = Literal["none", "frequency", "dynamics", "distance", "self_announcement"]


@dataclass(frozen=True, kw_only=True, slots=True)
class CpmParams:
    """Which objects a detection message contains, when it is generated, and how long it is."""

    rules: Literal["all", "etsi"] = "all"
    """Objects in a detection message. `all`: all detections. `etsi`: those that the rules of ETSI TS 103 324 select."""
    interval_s: Annotated[float, Ge(0.1), Le(1)] = 0.1
    """With `etsi`: least time between two messages of a vehicle [s]. Where congestion control (`radio.dcc`) asks for a
    longer time, that time counts instead, but no more than 1 s."""
    max_objects: Annotated[int, Ge(1), Le(MOST_OBJECTS)] = MOST_OBJECTS
    """Largest number of objects in one message, without the self report. Objects of the largest utility come first.
    The others count as not included, so they are candidates for the next message."""
    length: Literal["linear", "uper"] = "linear"
    """Length of a detection message. `linear`: 186 + 29 n bytes for n objects. `uper`: the length of its encoding
    (TS 103 324 v2.1.1, unaligned PER), with headers of the network and the signature."""
    accuracy: Literal["exact", "etsi"] = "exact"
    """What a detection message can say of accuracy. `exact`: any number. `etsi`: confidence values of TS 103 324, which
    are rounded up and end at 1.25 m/s and 12.5 degrees. What is beyond counts as not known."""
    redundancy: Redundancy = "none"
    """Rule by which a vehicle leaves out objects that others report. `frequency`: an object of which it received more
    than `redundancy_reports` reports within `redundancy_window_s`. `dynamics`: an object that has moved and changed its
    speed little since the latest report received. `distance`: an object that a vehicle nearby reports.
    `self_announcement`: an object that reports itself."""
    redundancy_window_s: Annotated[float, Gt(0), Le(10)] = 1.0
    """Reports that were received longer ago than this are not used [s]."""
    redundancy_reports: Annotated[int, Ge(0), Le(10_000)] = 5
    """With `frequency`: largest number of reports with which an object is still included."""
    redundancy_moved_m: NotNegative1000 = 4.0
    """With `dynamics`: an object is left out only if it is at most this far from its place in the latest report [m]."""
    redundancy_speed_mps: NotNegative100 = 0.5
    """With `dynamics`: an object is left out only if its speed differs by at most this from the latest report [m/s].
    The rule on speed has no effect where one of the two speeds is unknown."""
    redundancy_sender_m: Annotated[float, Ge(0), Le(100_000)] = 10.0
    """With `distance`: largest distance of the other vehicle, at the time of its report, at which the object is left
    out [m]."""

    def longest_gap_s(self, interval_s: float) -> float:
        """Longest time between two messages of a vehicle that senses in such intervals and reports itself.

        By the rules, a self report is due a second after the last one.
        """
        if self.rules == "all":
            return interval_s
        return interval_s * math.ceil(1.0 / interval_s - 1e-9)
