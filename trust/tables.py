"""What the functions of this room hand to each other: one step's detections, views, groups and verdicts."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray


def int64(a: ndarray) -> Int[ndarray, "..."]:
    """The same whole numbers as the kernels take them; one compiled version of each is enough."""
    return np.ascontiguousarray(a, np.int64)


@dataclass(frozen=True, slots=True)
class Detections:
    """One step's detections as sent, sorted by (sender, k)."""

    sender: Int[ndarray, "d"]  # row of the observing vehicle among the step's vehicles
    k: Int[ndarray, "d"]  # number within the sender's message; 0 is the self report
    label: UInt8[ndarray, "d"]  # 0 car, 1 pedestrian, 2 cyclist, 3 truck
    score: Float[ndarray, "d"]  # in [0, 1]
    is_self: Bool[ndarray, "d"]  # the sender itself
    is_fabricated: Bool[ndarray, "d"]  # added by a lying sender

    def __len__(self) -> int:
        return self.sender.size


@dataclass(frozen=True, slots=True)
class Views:
    """Which detections each of E vehicles considers, its own first, then the others by (sender, k)."""

    ptr: Int[ndarray, "e+1"]  # view v is member[ptr[v]:ptr[v + 1]]
    member: Int[ndarray, "m"]  # row in the detections
    owner: Int[ndarray, "e"]  # row of the considering vehicle among the step's vehicles, ascending

    def of_member(self) -> Int[ndarray, "m"]:
        """View to which each position belongs."""
        return np.repeat(np.arange(self.owner.size), np.diff(self.ptr))


@dataclass(frozen=True, slots=True)
class Groups:
    """Positions of the views bound into groups, each a star around its seed."""

    seed: Int[ndarray, "m"]  # position of the group's seed; its own position for a seed
    local: Bool[ndarray, "m"]  # the seed was made by the view's owner

    def seeds(self) -> Int[ndarray, "g"]:
        """Positions of the seeds, ascending: the canonical order of groups."""
        return np.flatnonzero(self.seed == np.arange(self.seed.size))


@dataclass(frozen=True, slots=True)
class Verdicts:
    """What each view's owner says about each detection it considers."""

    e: Float[ndarray, "m"]  # evaluation in [-1, 1]
    phi: Float[ndarray, "m"]  # visibility in [0, 1]


@dataclass(frozen=True, slots=True)
class Told:
    """Verdicts about the detections of one step, a message per evaluator; names instead of rows."""

    step: int  # of the detections
    evaluator: Int[ndarray, "v"]  # vehicle id
    ptr: Int[ndarray, "v+1"]  # message i is rows ptr[i]:ptr[i + 1]
    sender: Int[ndarray, "n"]  # vehicle id of the detector
    k: Int[ndarray, "n"]  # its detection
    e: Float[ndarray, "n"]  # evaluation
    phi: Float[ndarray, "n"]  # visibility


def told(step: int, ids: Int[ndarray, "vehicles"], views: Views, detections: Detections, verdicts: Verdicts) -> Told:
    """The step's verdicts as messages that outlive the step; `ids` maps vehicle rows to ids."""
    return Told(
        step,
        ids[views.owner],
        views.ptr,
        ids[detections.sender[views.member]],
        detections.k[views.member],
        verdicts.e,
        verdicts.phi,
    )


def told_from_rows(step: int, evaluator, sender, k, e, phi) -> Told:
    """Verdict rows in any order, one column each, as messages in canonical order."""
    evaluator, sender, k = (np.asarray(a, np.int64) for a in (evaluator, sender, k))
    e, phi = (np.asarray(a, float) for a in (e, phi))
    order = np.lexsort((phi, e, k, sender, evaluator))
    who, n = np.unique(evaluator, return_counts=True)
    ptr = np.concatenate([[0], np.cumsum(n)])
    return Told(step, who, ptr, sender[order], k[order], e[order], phi[order])
