"""Vehicles make evaluation messages of what they found when they compared detections with their own sweeps.

This stage of a step (`cosim.step.cycle`) comes before evaluations are sent. `cosim.step.comparing` evaluates the
detections before it, and `cosim.step.claims` finds what vehicles think of other claims of the messages.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.attacks.adversary import ActiveAttacks
from cosim.attacks.attack import EvaluationRows
from cosim.base.ragged import expand, ptr_of
from cosim.config.config import Config
from cosim.messages.content import Detections
from cosim.step.claims import Claims
from cosim.step.comparing import Compared
from cosim.step.exchange import Exchange, Senders
from cosim.step.ground_truth import lies_in_evaluations
from cosim.step.known import Known
from trust.claims import DETECTION, answers, claim_number
from trust.params import KINDS
from trust.tables import EvaluationMessages, Evaluations, ObjectLists, as_messages


@dataclass(frozen=True, slots=True)
class Evaluated:
    """Evaluations of detections by every vehicle's own sweep; `v` is the number of members of `lists`.

    Where there are claims, each list has a member for each of them, too, after its detections. All identities of a
    vehicle evaluate the same detections.
    """

    lists: ObjectLists
    """What is evaluated under each identity; the list of `Compared` itself if no vehicle has a second identity."""
    n_points: Int[ndarray, "v"]
    """Number of returns of the vehicle's own sweep inside the box."""
    plausible: Bool[ndarray, "v"]
    """Whether an object can stand there by the vehicle's own sweep; tested if it did not detect the object itself."""
    matched: Bool[ndarray, "v"]
    """Whether the vehicle detected the object itself."""
    own: Evaluations
    """Evaluations as each vehicle makes them."""
    reported: Evaluations
    """Evaluations as each vehicle transmits them; `own` itself if no attack changed any."""
    lied: Bool[ndarray, "v"]
    """Whether the reported evaluation differs from the own one by more than noise."""
    own_messages: EvaluationMessages
    """The own evaluations, one message per vehicle."""
    sent: EvaluationMessages
    """The reported evaluations, one message per row of `Senders`."""
    kept_messages: EvaluationMessages
    """The own evaluations in the rows of `sent`."""
    is_sent: Bool[ndarray, "v"]
    """Whether the evaluation is in the message: its vehicle did not know the detection when it last sensed."""
    number: Int[ndarray, "v"] | None = None
    """Number of what each evaluation is about (`trust.claims.claim_number`); None if all are about detections."""

    def of_detections(self) -> tuple[ObjectLists, Evaluations, Evaluations]:
        """What is evaluated, own values, and values as sent, without what is not about detections.

        Values that are not sent are invalid: NaN in place of their visibility.
        """
        sent = self.reported
        if not self.is_sent.all():
            sent = Evaluations(sent.evaluation, np.where(self.is_sent, sent.visibility, np.nan))
        if self.number is None:
            return self.lists, self.own, sent
        is_detection = self.number % len(KINDS) == DETECTION
        at = np.flatnonzero(is_detection)
        return self.lists.subset(is_detection), self.own.take(at), sent.take(at)


def evaluate_objects(
    exchange: Exchange, messages: Known, compared: Compared, claims: Claims | None, config: Config
) -> Evaluated:
    """Add evaluations of the claims of messages to those of detections, and make the evaluation messages.

    A message contains the evaluations of the detections that are new since the vehicle last sensed.
    """
    lists, own = compared.lists, compared.own
    n_points, plausible, ego_detected = compared.n_points, compared.plausible, compared.groups.ego_detected
    number = None
    if claims is not None:  # they follow the detections of each list
        list_of = np.concatenate([lists.of_member(), claims.list])
        order = np.argsort(list_of, kind="stable")
        n_claims = len(claims.list)

        def with_claims(of_detections: ndarray, of_claims: ndarray | int) -> ndarray:
            added = np.full(n_claims, of_claims, of_detections.dtype)
            return np.concatenate([of_detections, added])[order]

        answered = answers(claims.support, config.trust)
        own = Evaluations(
            evaluation=with_claims(own.evaluation, answered.evaluation),
            visibility=with_claims(own.visibility, answered.visibility),
        )
        detection_index = messages.detections.detection_index[lists.member]
        number = with_claims(claim_number(detection_index, DETECTION), claims.number)
        n_points = with_claims(n_points, 0)
        plausible = with_claims(plausible, 0)
        ego_detected = with_claims(ego_detected, 0)
        ptr = ptr_of(list_of[order], len(lists.owner))
        lists = ObjectLists(ptr, with_claims(lists.member, claims.member), lists.owner)
    reported = _as_reported(exchange.attacks, own, lists, messages.objects, exchange.sensing.row, number)
    lied = lies_in_evaluations(own, reported)
    is_sent = messages.objects.transmitted[lists.member]
    is_sent &= messages.is_new(lists.of_member(), lists.member)
    step = exchange.now.step
    of_identities, at = _lists_of_identities(lists, exchange.senders)
    own_messages = _messages_of(step, messages, lists, own, is_sent, number)
    kept_messages = own_messages
    if at is not None:  # rows of the lists of vehicles, once for each of their identities
        lists = of_identities
        n_points, plausible, ego_detected = n_points[at], plausible[at], ego_detected[at]
        own, reported = own.take(at), reported.take(at)
        lied, is_sent = lied[at], is_sent[at]
        number = None if number is None else number[at]
        kept_messages = _messages_of(step, messages, lists, own, is_sent, number)
    kept = reported.take(is_sent)
    return Evaluated(
        lists=lists,
        n_points=n_points,
        plausible=plausible,
        matched=ego_detected,
        own=own,
        reported=reported,
        lied=lied,
        own_messages=own_messages,
        sent=replace(kept_messages, evaluation=kept.evaluation, visibility=kept.visibility),
        kept_messages=kept_messages,
        is_sent=is_sent,
        number=number,
    )


def _as_reported(
    active: ActiveAttacks,
    evaluated: Evaluations,
    lists: ObjectLists,
    listed: Detections,
    observers: ndarray,
    number: Int[ndarray, "m"] | None,
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


def _lists_of_identities(lists: ObjectLists, senders: Senders) -> tuple[ObjectLists, Int[ndarray, "m"] | None]:
    """What is evaluated under every identity. All identities of a vehicle evaluate the same detections.

    Parameters
    ----------
    lists
        What each vehicle that senses evaluates.
    senders
        The messages.

    Returns
    -------
    One list per message, and the positions of its members in `lists`, which are None if no vehicle has a second
    identity.
    """
    if len(senders) == len(senders.own):
        return lists, None
    list_ = senders.source
    at, of = expand(lists.ptr[list_], lists.ptr[list_ + 1])
    ptr = np.searchsorted(of, np.arange(len(senders) + 1))
    return ObjectLists(ptr, lists.member[at], np.arange(len(senders))), at


def _messages_of(
    step: int,
    messages: Known,
    lists: ObjectLists,
    evaluations: Evaluations,
    keep: Bool[ndarray, "k"],
    number: Int[ndarray, "k"] | None,
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
    sent = lists.subset(keep)
    made = as_messages(step, messages.pseudonym, sent, messages.detections, kept, messages.detection_step(sent.member))
    return made if number is None else replace(made, detection_index=number[keep])
