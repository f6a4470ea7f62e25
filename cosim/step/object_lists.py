"""The list of the detections that each vehicle knows, and what it asks its own sweep about them."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.ragged import offsets, ptr_of, ranges
from cosim.step.known import Uses
from cosim.step.perception import BoxQuestions
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from trust import tables
from trust.tables import ObjectLists


def received_lists(
    received: Uses,
    ptr: Int[ndarray, "m+1"],
    transmitted: Bool[ndarray, "d"],
    own: Int[ndarray, "s"],
) -> ObjectLists:
    """The detections that each vehicle knows: its own ones, then the received ones, by (message, detection index).

    Parameters
    ----------
    received
        Detection messages that the vehicles use beside their own ones, in any order.
    ptr
        Row at which the detections of each message begin.
    transmitted
        Whether each detection is transmitted.
    own
        Each vehicle's message under its own identity.
    """
    of = np.concatenate([np.arange(len(own)), received.receiver])
    message = np.concatenate([own, received.message])
    is_own = np.arange(len(of)) < len(own)
    number = np.where(is_own, 0, message + 1)
    order = np.argsort(of * len(ptr) + number, kind="stable")
    of, message, is_own = of[order], message[order], is_own[order]
    # The detections of a message: all of them for its sender, those that are transmitted for others.
    sent = np.flatnonzero(transmitted)
    known = np.concatenate([sent, np.arange(len(transmitted))])
    ptr_of_sent = np.searchsorted(sent, ptr)
    ptr_of_all = len(sent) + ptr
    start = np.where(is_own, ptr_of_all[message], ptr_of_sent[message])
    stop = np.where(is_own, ptr_of_all[message + 1], ptr_of_sent[message + 1])
    begins = offsets(stop - start)[ptr_of(of, len(own))]
    return ObjectLists(begins, known[ranges(start, stop - start)], own)


def questions_of(
    lists: ObjectLists,
    evaluated: Bool[ndarray, "m"],
    foreign: Bool[ndarray, "m"],
    detections: tables.SentDetections,
    boxes: Boxes,
    velocity_mps: Float[ndarray, "d 2"],
    area: AreaParams,
) -> tuple[BoxQuestions, Int[ndarray, "p"], Int[ndarray, "t"]]:
    """The questions of each vehicle to its own sweep about the boxes in its list.

    A vehicle counts the returns in every box that it evaluates, and in every foreign box. For foreign boxes it also
    tests whether free space contradicts them. A vehicle has no returns from itself.

    Parameters
    ----------
    lists
        What each vehicle knows.
    evaluated
        Members that the vehicle evaluates.
    foreign
        Members that the vehicle did not detect itself.
    detections, boxes, velocity_mps
        All detections in the step, their boxes and velocities.
    area
        Where vehicles evaluate.

    Returns
    -------
    The questions, the members whose returns are counted, and the members that are tested.
    """
    b, o = lists.member, lists.of_member().astype(np.int32)
    is_own = detections.message[b] == lists.owner[o]
    is_self = detections.is_self[b] & is_own
    is_counted = (evaluated | foreign) & ~is_self
    counted, tested = np.flatnonzero(is_counted), np.flatnonzero(foreign)
    asked = BoxQuestions(
        boxes=boxes,
        velocity_mps=velocity_mps,
        area=area,
        counting=o[counted],
        counted=b[counted],
        testing=o[tested],
        tested=b[tested],
    )
    return asked, counted, tested
