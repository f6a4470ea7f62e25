"""Redundancy mitigation: a vehicle leaves out objects that it need not report, because others have reported them.

Every rule uses the messages that the vehicle itself received within a window before it generates its own.

Notes
-----
The rules are those of ETSI TR 103 562 V2.1.1, "Analysis of the Collective Perception Service". We could not obtain its
text. We follow the rules as a fork of Artery implements them (`src/artery/application/cp/RedundancyMitigationRule.cc`),
which says that it implements the report. Annex E of TS 103 324 orders objects by such values instead of leaving them
out. Its values by angle and by confidence are not built.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.ragged import differs_from_last, rows_of
from cosim.messages.cpm_params import CpmParams

SAME_M = 4.0
"""A report and a detection of the same class that are at most this far apart concern the same object."""
_FAR_M = 1000.0
"""Distance between objects of different classes on an extra axis; larger than `SAME_M`."""
_SLACK_S = 1e-9


@dataclass(frozen=True, slots=True)
class ReportedObjects:
    """O objects in M messages, as they were sent."""

    time_s: Float[ndarray, "m"]
    """When the message's objects were sensed."""
    sender: Int[ndarray, "m"]
    """Actor number and identity in one number."""
    sender_xy_m: Float[ndarray, "m 2"]
    message: Int[ndarray, "o"]
    """Row of the message, ascending."""
    label: Int[ndarray, "o"]
    xy_m: Float[ndarray, "o 2"]
    velocity_mps: Float[ndarray, "o 2"]
    """NaN where it is unknown."""
    is_self: Bool[ndarray, "o"]
    """Whether the object is the sender itself."""

    @staticmethod
    def none() -> "ReportedObjects":
        """No messages."""
        row, real = np.zeros(0, np.int64), np.zeros(0)
        pair, flag = np.zeros((0, 2)), np.zeros(0, bool)
        return ReportedObjects(real, row, pair, row, row, pair, pair, flag)


@dataclass(frozen=True, slots=True)
class Heard:
    """Reports that vehicles received within the last window, with their R receptions.

    Every message is held once, however many vehicles received it. Messages whose receptions are all too old are
    dropped, so the memory does not grow with time.
    """

    reports: ReportedObjects
    receiver: Int[ndarray, "r"]
    """Actor number; receptions are sorted by receiver, then message."""
    message: Int[ndarray, "r"]
    """Row of the message."""
    received_s: Float[ndarray, "r"]

    @staticmethod
    def start() -> "Heard":
        """Nothing yet."""
        row = np.zeros(0, np.int64)
        return Heard(ReportedObjects.none(), row, row, np.zeros(0))

    def next(
        self,
        reports: ReportedObjects,
        receiver: Int[ndarray, "n"],
        message: Int[ndarray, "n"],
        received_s: Float[ndarray, "n"],
        window_s: float,
    ) -> "Heard":
        """What vehicles have heard after one more round of messages.

        Parameters
        ----------
        reports
            Messages of the round.
        receiver, message, received_s
            Actor number of each receiver, row of `reports`, and time of reception.
        window_s
            Receptions longer ago than this before the latest one are dropped.
        """
        if not len(receiver) and not len(self.receiver):
            return self
        old, n_old = self.reports, len(self.reports.time_s)
        of = np.concatenate([self.receiver, np.asarray(receiver, np.int64)])
        row = np.concatenate([self.message, n_old + np.asarray(message, np.int64)])
        at_s = np.concatenate([self.received_s, received_s])
        latest_s = reports.time_s.max(initial=old.time_s.max(initial=-np.inf))
        fresh = at_s >= latest_s - window_s - _SLACK_S
        of, row, at_s = of[fresh], row[fresh], at_s[fresh]
        kept, row = np.unique(row, return_inverse=True)
        order = np.lexsort((row, of))
        known = _joined(old, reports, kept)
        return Heard(known, of[order], row[order], at_s[order])


def _joined(old: ReportedObjects, new: ReportedObjects, kept: Int[ndarray, "k"]) -> ReportedObjects:
    """These messages of both, `new` behind `old`, with their objects."""
    n_old = len(old.time_s)
    place = np.full(n_old + len(new.time_s), -1)
    place[kept] = np.arange(len(kept))
    message = place[np.concatenate([old.message, n_old + new.message])]
    there = message >= 0

    def both(name: str) -> ndarray:
        return np.concatenate([getattr(old, name), getattr(new, name)])

    return ReportedObjects(
        time_s=both("time_s")[kept],
        sender=both("sender")[kept],
        sender_xy_m=both("sender_xy_m")[kept],
        message=message[there],
        label=both("label")[there],
        xy_m=both("xy_m")[there],
        velocity_mps=both("velocity_mps")[there],
        is_self=both("is_self")[there],
    )


@dataclass(frozen=True, slots=True)
class Candidates:
    """N objects that vehicles are about to report."""

    receiver: Int[ndarray, "n"]
    """Actor number of the vehicle that is about to report the object."""
    own_xy_m: Float[ndarray, "n 2"]
    """Its own position."""
    label: Int[ndarray, "n"]
    xy_m: Float[ndarray, "n 2"]
    speed_mps: Float[ndarray, "n"]
    """NaN where it is unknown."""


@dataclass(frozen=True, slots=True)
class _Known:
    """P pairs of a candidate and a report of the same object that its vehicle received; each message counts once.

    Sorted by candidate, then by time of reception, then by sender.
    """

    candidate: Int[ndarray, "p"]
    message: Int[ndarray, "p"]
    object: Int[ndarray, "p"]


def redundant(heard: Heard, mine: Candidates, time_s: float, params: CpmParams) -> Bool[ndarray, "n"]:
    """Which objects a vehicle leaves out of its message.

    Parameters
    ----------
    heard
        What vehicles have received.
    mine
        Objects that vehicles are about to report.
    time_s
        Time of the messages that are about to be generated.
    params
        The rule and its limits.

    Notes
    -----
    A report concerns the same object as a detection if it has the same class and is the nearest one in its message, at
    most 4 m away. For this, the place in the report is extrapolated to `time_s` with the velocity in the report, if
    there is one. Reports of a vehicle about itself count for `self_announcement` only, all others for the other rules
    only.
    Deviations from Artery's implementation of the rules: Artery knows which object a report concerns. It has no window
    for `dynamics` and `self_announcement`; ours is that of the other rules. Where a speed is unknown, `dynamics`
    compares places alone.
    """
    if params.redundancy == "none" or not len(mine.label) or not len(heard.receiver):
        return np.zeros(len(mine.label), bool)
    known = _known(heard, mine, time_s, params.redundancy_window_s, params.redundancy == "self_announcement")
    counts = _RULES[params.redundancy](heard.reports, mine, known, params)
    left_out = np.zeros(len(mine.label), bool)
    left_out[known.candidate[counts]] = True
    return left_out


def _known(heard: Heard, mine: Candidates, time_s: float, window_s: float, of_self: bool) -> _Known:
    """The nearest report of each candidate in each message that its vehicle has received within the window."""
    reports = heard.reports
    there = np.flatnonzero(reports.is_self == of_self)
    elapsed_s = time_s - reports.time_s[reports.message[there]]
    ahead_m = np.nan_to_num(reports.velocity_mps[there]) * elapsed_s[:, None]
    of_reports = _by_class(reports.xy_m[there] + ahead_m, reports.label[there])
    of_candidates = _by_class(mine.xy_m, mine.label)
    near = of_candidates.sparse_distance_matrix(of_reports, SAME_M, output_type="ndarray")
    candidate, found, apart_m = near["i"], there[near["j"]], near["v"]
    message = reports.message[found]
    n = len(reports.time_s)
    asked = mine.receiver[candidate] * n + message
    reception, is_received = rows_of(asked, heard.receiver * n + heard.message)
    received_s = heard.received_s[reception]
    fresh = np.flatnonzero(is_received & (received_s >= time_s - window_s - _SLACK_S))
    candidate, message = candidate[fresh], message[fresh]
    found, apart_m, received_s = found[fresh], apart_m[fresh], received_s[fresh]
    order = np.lexsort((found, apart_m, message, reports.sender[message], received_s, candidate))
    first = differs_from_last(candidate[order]) | differs_from_last(message[order])
    order = order[first]
    return _Known(candidate[order], message[order], found[order])


def _by_class(xy_m: Float[ndarray, "n 2"], label: Int[ndarray, "n"]) -> scipy.spatial.cKDTree:
    """Tree of objects. Those of different classes lie on different floors, far from each other."""
    return scipy.spatial.cKDTree(np.column_stack([xy_m, _FAR_M * label]))


def _often(reports: ReportedObjects, mine: Candidates, known: _Known, params: CpmParams) -> Bool[ndarray, "p"]:
    """More reports than the limit."""
    n = np.bincount(known.candidate, minlength=len(mine.label))
    return n[known.candidate] > params.redundancy_reports


def _unchanged(reports: ReportedObjects, mine: Candidates, known: _Known, params: CpmParams) -> Bool[ndarray, "p"]:
    """The latest report, if place and speed have changed little since."""
    latest = np.ones(len(known.candidate), bool)
    latest[:-1] = np.diff(known.candidate) != 0
    at, i = known.object, known.candidate
    dx, dy = (reports.xy_m[at] - mine.xy_m[i]).T
    vx, vy = reports.velocity_mps[at].T
    moved_m = np.hypot(dx, dy)
    change_mps = np.abs(np.hypot(vx, vy) - mine.speed_mps[i])
    return latest & (moved_m <= params.redundancy_moved_m) & ~(change_mps > params.redundancy_speed_mps)


def _from_nearby(reports: ReportedObjects, mine: Candidates, known: _Known, params: CpmParams) -> Bool[ndarray, "p"]:
    """Reports of senders nearby."""
    sender_xy_m = reports.sender_xy_m[known.message]
    dx, dy = (sender_xy_m - mine.own_xy_m[known.candidate]).T
    apart_m = np.hypot(dx, dy)
    return apart_m <= params.redundancy_sender_m


def _any(reports: ReportedObjects, mine: Candidates, known: _Known, params: CpmParams) -> Bool[ndarray, "p"]:
    """All reports."""
    return np.ones(len(known.candidate), bool)


_Rule = Callable[[ReportedObjects, Candidates, _Known, CpmParams], Bool[ndarray, "p"]]
_RULES: dict[str, _Rule] = {
    "frequency": _often,
    "dynamics": _unchanged,
    "distance": _from_nearby,
    "self_announcement": _any,
}
"""The reports because of which an object is left out, by `CpmParams.redundancy`."""
