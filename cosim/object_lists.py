"""From what was sent and received to the lists that vehicles evaluate, and to the messages that carry evaluations."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.adversary.adversary import Adversary
from cosim.adversary.attack import EvaluationRows
from cosim.radio.message_round import Receptions
from cosim.ragged import expand, ptr_of
from cosim.v2x.messages import SELF, Detections
from cosim.world import World
from sensors import evidence
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from sensors.lidar import Sweeps
from trust import tables
from trust.tables import EvaluationMessages, Evaluations, ObjectLists


def for_trust(listed: Detections, observers: Int[ndarray, "e"]) -> tuple[tables.Detections, Int[ndarray, "e+1"]]:
    """The detections as trust sees them, and where those of each equipped vehicle begin."""
    message = np.searchsorted(observers, listed.observer)
    detections = tables.Detections(message, listed.detection_index, listed.label, listed.score, listed.origin == SELF)
    return detections, ptr_of(message, len(observers))


def received_lists(
    received: Receptions, ptr: Int[ndarray, "e+1"], transmitted: Bool[ndarray, "d"], n: int
) -> ObjectLists:
    """What each vehicle knows of: all its own detections, then those it received, by (message, detection index)."""
    owners = np.arange(n)
    receiver = np.concatenate([owners, received.receiver])
    message = np.concatenate([owners, received.message])
    order = np.lexsort((message, receiver != message, receiver))
    receiver, message = receiver[order], message[order]
    member, which = expand(ptr[message], ptr[message + 1])
    of_list, own = receiver[which], (receiver == message)[which]
    keep = own | transmitted[member]
    return ObjectLists(ptr_of(of_list[keep], n), member[keep], owners)


def subset(lists: ObjectLists, keep: Bool[ndarray, "m"]) -> ObjectLists:
    """The lists with these members only."""
    return ObjectLists(ptr_of(lists.of_member()[keep], len(lists.owner)), lists.member[keep], lists.owner)


def sweep_evidence(
    sweeps: Sweeps, lists: ObjectLists, evaluated: Bool[ndarray, "m"], foreign: Bool[ndarray, "m"], boxes: Boxes,
    detections: tables.Detections, area: AreaParams,
) -> tuple[Int[ndarray, "m"], Bool[ndarray, "m"]]:  # fmt: skip
    """What each vehicle's own sweep says of the boxes in its list: returns inside, and whether free space allows them.

    Asked of all that it evaluates and of what is foreign; else 0 and True. A vehicle has no returns from itself.
    """
    o, b = lists.of_member(), lists.member
    n_points, plausible = np.zeros(len(b), np.int32), np.ones(len(b), bool)
    asked = np.flatnonzero((evaluated | foreign) & ~(detections.is_self[b] & (detections.message[b] == o)))
    n_points[asked] = evidence.points_in_boxes(sweeps, o[asked], boxes, b[asked])
    asked = np.flatnonzero(foreign)
    plausible[asked] = evidence.plausible(sweeps, o[asked], boxes, b[asked], area)
    return n_points, plausible


def as_reported(
    adversary: Adversary, evaluated: Evaluations, lists: ObjectLists, listed: Detections, observers: ndarray,
    world: World, time_s: float,
) -> Evaluations:  # fmt: skip
    """Evaluations as they will be sent."""
    rows = EvaluationRows(observers[lists.of_member()], lists.member, evaluated.evaluation, evaluated.visibility)
    evaluation, visibility = adversary.evaluations(rows, listed, world, time_s)
    if evaluation is rows.evaluation and visibility is rows.visibility:
        return evaluated
    return Evaluations(evaluation, visibility)


def messages_of(
    step: int, pseudonyms: Int[ndarray, "e"], lists: ObjectLists, detections: tables.Detections,
    evaluations: Evaluations, transmitted: Bool[ndarray, "d"],
) -> EvaluationMessages:  # fmt: skip
    """The evaluations as messages: one per evaluator, on everything that was transmitted."""
    keep = transmitted[lists.member]
    kept = Evaluations(evaluations.evaluation[keep], evaluations.visibility[keep])
    return tables.as_messages(step, pseudonyms, subset(lists, keep), detections, kept)
