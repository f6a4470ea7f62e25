"""What the hooks of an attack return, if it can be: content that no message can hold is dropped, all else is an error.

An attack may be a user's own. Values in the detections that it makes up are what a hostile sender may send: they are
counted and dropped. Arrays of another shape, rows of no vehicle, and numbers of messages that no station can send
are mistakes of the attack: `AttackError` names it in one line.
"""

from dataclasses import fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.adversary.attack import LOUDEST_DBM, Attack, AttackContext, EvaluationRows, Sending
from cosim.v2x.messages import Detections, faults
from results.codes import DetectionFault, Origin
from sensors.boxes import Boxes

MOST_IDENTITIES = 255
"""Identities of a vehicle beside its own."""
LONGEST_DELAY_S = 3600.0
MOST_COPIES, MOST_REPORTS = 1000, 100_000
SENDING_RANGES = {
    "delay_s": ("f", 0.0, LONGEST_DELAY_S),
    "n_copies": ("iu", 0, MOST_COPIES),
    "n_reports": ("iu", 0, MOST_REPORTS),
    "jam_dbm": ("f", -np.inf, LOUDEST_DBM),
    "react_dbm": ("f", -np.inf, LOUDEST_DBM),
    "ignores_dcc": ("b", False, True),
}
"""Kinds of numbers, smallest and largest value of each column of `Sending`."""


class AttackError(ValueError):
    """What an attack returned cannot be; the message is one line."""


def _where(attack: Attack, context: AttackContext, hook: str) -> str:
    return f"attacks.{context.number}.attack ({type(attack).__name__}): {hook}()"


def _check_column(where: str, name: str, column: Any, shape: tuple[int, ...], kinds: str) -> None:
    if not isinstance(column, ndarray) or column.shape != shape or column.dtype.kind not in kinds:
        what = f"{column.dtype} {column.shape}" if isinstance(column, ndarray) else type(column).__name__
        raise AttackError(f"{where} returned {name} of {what}; an array of numbers of shape {shape} is due.")


def _check_range(where: str, name: str, column: ndarray, low: float, high: float) -> None:
    with np.errstate(invalid="ignore"):
        wrong = ~((column >= low) & (column <= high))
    if wrong.any():
        raise AttackError(f"{where} returned {name} = {column[wrong][0]}: {low:g} to {high:g} can be.")


def checked_detections(
    attack: Attack, context: AttackContext, before: Detections, after: Any, n_identities: Int[ndarray, "n"]
) -> tuple[Detections, Int[ndarray, "f"]]:
    """The lists that `detections` returned, sorted by key, without what cannot be sent; how many, by `DetectionFault`.

    Parameters
    ----------
    n_identities
        Identities of each actor beside its own.
    """
    where, n_world = _where(attack, context, "detections"), len(context.world)
    if not isinstance(after, Detections) or not isinstance(after.boxes, Boxes):
        raise AttackError(f"{where} returned {type(after).__name__}, not Detections with Boxes.")
    n = len(after)
    for field in fields(Detections):
        if field.name != "boxes":
            kinds = "f" if field.name in ("score", "speed_mps", "acceleration_mps2") else "iub"
            _check_column(where, field.name, getattr(after, field.name), (n,), kinds)
    for name, shape in (("xyz_m", (n, 3)), ("lwh_m", (n, 3)), ("yaw_rad", (n,))):
        _check_column(where, f"boxes.{name}", getattr(after.boxes, name), shape, "f")
    _check_range(where, "observer", after.observer, 0, n_world - 1)
    _check_range(where, "target", after.target, 0, n_world - 1)
    _check_range(where, "origin", after.origin, 0, len(Origin) - 1)
    _check_range(where, "identity", after.identity, 0, MOST_IDENTITIES)
    if (late := after.identity > n_identities[after.observer]).any():
        raise AttackError(
            f"{where} returned identity = {after.identity[late][0]} of a vehicle with "
            f"{n_identities[after.observer[late][0]]} beside its own. Say how many there are in identities()."
        )
    rows = [np.bincount(listed.observer, minlength=n_world) for listed in (before, after)]
    if (rows[1] < rows[0]).any() or (rows[1] > rows[0])[~context.attacker].any():
        raise AttackError(f"{where} returned lists with rows missing, or with rows added to those of others.")
    return without_faults(after, context.world.boxes.xyz_m)


def without_faults(listed: Detections, xyz_m: Float[ndarray, "w 3"]) -> tuple[Detections, Int[ndarray, "f"]]:
    """The lists, sorted by key, without what cannot be sent; how many, by `DetectionFault`."""
    fault = faults(listed, xyz_m)
    n_dropped = np.bincount(fault[fault >= 0], minlength=len(DetectionFault))
    key = (listed.observer, listed.identity, listed.detection_index)
    if n_dropped.any():
        rows = np.flatnonzero(fault < 0)
        return listed.take(rows[np.lexsort([column[rows] for column in key[::-1]])]), n_dropped
    tied, is_sorted = np.ones(max(len(listed) - 1, 0), bool), True
    for column in key:
        is_sorted &= not (tied & (column[1:] < column[:-1])).any()
        tied &= column[1:] == column[:-1]
    return listed if is_sorted else listed.take(np.lexsort(key[::-1])), n_dropped


def checked_evaluations(
    attack: Attack, context: AttackContext, rows: EvaluationRows, returned: Any
) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
    """What `evaluations` returned."""
    where = _where(attack, context, "evaluations")
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise AttackError(f"{where} returned {type(returned).__name__}, not (evaluation, visibility).")
    for name, column, low in zip(("evaluation", "visibility"), returned, (-1, 0), strict=True):
        _check_column(where, name, column, rows.evaluation.shape, "f")
        _check_range(where, name, column, low, 1)
    return returned


def checked_identities(attack: Attack, context: AttackContext, returned: Any) -> Int[ndarray, "n"]:
    """What `identities` returned."""
    where = _where(attack, context, "identities")
    _check_column(where, "numbers", returned, (len(context.world),), "iu")
    _check_range(where, "a number", returned, 0, MOST_IDENTITIES)
    return returned


def checked_sending(attack: Attack, context: AttackContext, returned: Any) -> Sending:
    """What `sending` returned."""
    where = _where(attack, context, "sending")
    if not isinstance(returned, Sending):
        raise AttackError(f"{where} returned {type(returned).__name__}, not Sending.")
    for name, (kinds, low, high) in SENDING_RANGES.items():
        _check_column(where, name, getattr(returned, name), (len(context.world),), kinds)
        _check_range(where, name, getattr(returned, name), low, high)
    return returned
