"""Builds the lists that vehicles evaluate from sent and received detections, and the evaluation messages."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.attacks.adversary import ActiveAttacks
from cosim.attacks.attack import EvaluationRows
from cosim.base.ragged import offsets, ptr_of, ranges
from cosim.messages.content import SELF, Detections
from cosim.step.known import Known, Uses
from cosim.step.perception import BoxQuestions
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from trust import tables
from trust.tables import EvaluationMessages, Evaluations, ObjectLists


def for_trust(
    listed: Detections, message: Int[ndarray, "d"], n_messages: int
) -> tuple[tables.SentDetections, Int[ndarray, "m+1"]]:
    """Detections in the form that `trust` uses, and the row at which the detections of each message begin.

    Parameters
    ----------
    listed
        Detections as vehicles list them.
    message
        Row of `Senders` of each detection, ascending.
    n_messages
        Number of messages.
    """
    is_self = (listed.origin == SELF) | ((listed.identity > 0) & (listed.detection_index == 0))  # as messages claim
    detections = tables.SentDetections(message, listed.detection_index, listed.label, listed.score, is_self)
    return detections, ptr_of(message, n_messages)


def received_lists(
    received: Uses, ptr: Int[ndarray, "m+1"], transmitted: Bool[ndarray, "d"], own: Int[ndarray, "s"]
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
    order = np.argsort(of * len(ptr) + np.where(is_own, 0, message + 1), kind="stable")
    of, message, is_own = of[order], message[order], is_own[order]
    # The detections of a message: all of them for its sender, those that are transmitted for others.
    sent = np.flatnonzero(transmitted)
    known = np.concatenate([sent, np.arange(len(transmitted))])
    start, stop = (
        np.where(is_own, len(sent) + ptr[message + k], np.searchsorted(sent, ptr)[message + k]) for k in (0, 1)
    )
    begins = offsets(stop - start)[ptr_of(of, len(own))]
    return ObjectLists(begins, known[ranges(start, stop - start)], own)


def subset(lists: ObjectLists, keep: Bool[ndarray, "m"]) -> ObjectLists:
    """The lists with only the members where `keep` is true."""
    rows = np.flatnonzero(keep)
    return ObjectLists(np.searchsorted(rows, lists.ptr), lists.member[rows], lists.owner)


def questions_of(
    lists: ObjectLists,
    evaluated: Bool[ndarray, "m"],
    foreign: Bool[ndarray, "m"],
    boxes: Boxes,
    detections: tables.SentDetections,
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
    boxes, detections
        Of all detections in the step.
    area
        Where vehicles evaluate.

    Returns
    -------
    The questions, the members whose returns are counted, and the members that are tested.
    """
    b, o = lists.member, lists.of_member().astype(np.int32)
    is_self = detections.is_self[b] & (detections.message[b] == lists.owner[o])
    is_counted = (evaluated | foreign) & ~is_self
    counted, tested = np.flatnonzero(is_counted), np.flatnonzero(foreign)
    return BoxQuestions(boxes, area, o[counted], b[counted], o[tested], b[tested]), counted, tested


def as_reported(
    active: ActiveAttacks,
    evaluated: Evaluations,
    lists: ObjectLists,
    listed: Detections,
    observers: ndarray,
    number: Int[ndarray, "m"] | None = None,
) -> Evaluations:
    """Evaluations as they will be sent.

    Parameters
    ----------
    active
        Attacks of this step.
    evaluated
        Evaluations as vehicles make them, one per member of `lists`.
    listed
        Detections of this step.
    observers
        Row of the world of the vehicle of each list.
    number
        Number of what each evaluation is about (`trust.claims.claim_number`); None if all are about detections.

    Returns
    -------
    `evaluated` itself if no active attack has the method `evaluations`.
    """
    rows = EvaluationRows(
        observers[lists.of_member()], lists.member, evaluated.evaluation, evaluated.visibility, number
    )
    evaluation, visibility = active.evaluations(rows, listed)
    if evaluation is rows.evaluation and visibility is rows.visibility:
        return evaluated
    return Evaluations(evaluation, visibility)


def messages_of(
    step: int,
    messages: Known,
    lists: ObjectLists,
    evaluations: Evaluations,
    keep: Bool[ndarray, "k"],
    number: Int[ndarray, "k"] | None = None,
) -> EvaluationMessages:
    """Evaluation messages, one per list.

    Parameters
    ----------
    messages
        Messages with the detections that are evaluated.
    lists
        What is evaluated; owners are rows of `messages`.
    evaluations
        One per member of `lists`.
    keep
        Members whose evaluations are in the messages.
    number
        Number of what each evaluation is about, in place of that of the detection; None if all are about detections.
    """
    kept = evaluations.take(keep)
    sent = subset(lists, keep)
    made = tables.as_messages(
        step, messages.pseudonym, sent, messages.detections, kept, messages.detection_step(sent.member)
    )
    return made if number is None else replace(made, detection_index=number[keep])
