"""The objects that a vehicle includes in its next message: all, or those that the generation rules select.

References
----------
.. [1] ETSI TS 103 324 V2.1.1, "Collective Perception Service", clause 6.1: generation rules.
.. [2] ETSI EN 302 637-2 V1.4.1, "Cooperative Awareness Basic Service": the same rules for the vehicle itself.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.v2x.messages import Detections
from cosim.world import LABELS

MOVED_M, TURNED_RAD, INTERVAL_S = 4.0, np.radians(4.0), 1.0
"""A vehicle is included again if it has moved or turned by more than this, or after this time."""
VULNERABLE_INTERVAL_S = 0.5
"""All people are included if one of them is new, or was last included this long ago."""

_VULNERABLE = np.isin(np.arange(len(LABELS)), [LABELS.index(name) for name in ("pedestrian", "cyclist")])
_FAR_M = 1000.0
"""Distance between objects of different senders or classes on an extra axis; larger than `MOVED_M`."""


@dataclass(slots=True)
class InclusionMemory:
    """The objects that each sender last included, with pose and time."""

    of: Int[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Sender (as in `select_objects`) and class in one number, ascending."""
    xy_m: Float[ndarray, "n 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    yaw_rad: Float[ndarray, "n"] = field(default_factory=lambda: np.zeros(0))
    time_s: Float[ndarray, "n"] = field(default_factory=lambda: np.zeros(0))


def select_objects(
    memory: InclusionMemory, seen: Detections, sender: Int[ndarray, "d"], time_s: float
) -> tuple[Bool[ndarray, "d"], InclusionMemory]:
    """Select the detections that are included in messages.

    Parameters
    ----------
    memory
        The objects that each vehicle last included.
    seen
        The available detections.
    sender
        Actor number and identity of the sender of each detection in one number, as in `Exchange.sender`.
    time_s
        Time of the messages.

    Returns
    -------
    Whether each detection is included, and the memory after this step.

    Notes
    -----
    An object within 4 m of the position at which one of its class was last included counts as the same object. An
    object farther away is new or has moved by more than 4 m, which has the same effect [1]_. Self reports follow the
    same rules [2]_.
    Deviations: there is no rule on speed, because a detection contains none. There is no threshold of quality. The
    length is not limited, because a message is segmented. There is no sensor container, and without objects no message
    is sent.
    """
    rows = np.flatnonzero(seen.transmitted)
    of = sender[rows].astype(np.int64) * len(LABELS) + seen.label[rows]
    xy, yaw = seen.boxes.xyz_m[rows, :2], seen.boxes.yaw_rad[rows]
    near = _nearest(memory, of, xy)
    known = near >= 0
    turned, elapsed_s = np.full(len(rows), np.inf), np.full(len(rows), np.inf)
    turned[known] = np.abs(_wrapped(yaw[known] - memory.yaw_rad[near[known]]))
    elapsed_s[known] = time_s - memory.time_s[near[known]]
    person = _VULNERABLE[seen.label[rows]]
    wants = np.where(
        person, elapsed_s >= VULNERABLE_INTERVAL_S - 1e-9, (turned > TURNED_RAD) | (elapsed_s >= INTERVAL_S - 1e-9)
    )
    senders, at = np.unique(sender[rows], return_inverse=True)
    of_group = np.bincount(at[person & wants], minlength=len(senders)) > 0
    wants |= person & of_group[at]

    chosen = np.zeros(len(seen), bool)
    chosen[rows[wants]] = True
    old = time_s - memory.time_s < INTERVAL_S - 1e-9  # older entries have no effect
    old[near[known & wants]] = False
    parts = (
        np.concatenate([memory.of[old], of[wants]]), np.concatenate([memory.xy_m[old], xy[wants]]),
        np.concatenate([memory.yaw_rad[old], yaw[wants]]),
        np.concatenate([memory.time_s[old], np.full(int(wants.sum()), time_s)]),
    )  # fmt: skip
    order = np.lexsort((parts[3], parts[1][:, 1], parts[1][:, 0], parts[0]))
    return chosen, InclusionMemory(*(part[order] for part in parts))


def _nearest(memory: InclusionMemory, of: Int[ndarray, "r"], xy_m: Float[ndarray, "r 2"]) -> Int[ndarray, "r"]:
    """Row of the nearest object of the same sender and class within `MOVED_M`; -1 if there is none."""
    if not len(memory.of) or not len(of):
        return np.full(len(of), -1)
    kinds = np.unique(memory.of)
    floor = np.searchsorted(kinds, of)
    there = np.isin(of, kinds)
    tree = cKDTree(np.column_stack([memory.xy_m, _FAR_M * np.searchsorted(kinds, memory.of)]))
    _, near = tree.query(np.column_stack([xy_m, _FAR_M * floor]), distance_upper_bound=MOVED_M + 1e-9)
    return np.where(there & (near < len(memory.of)), near, -1)


def _wrapped(angle_rad: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    return np.pi - np.mod(np.pi - angle_rad, 2 * np.pi)
