"""Vehicles group the detections that they know, ask their own sweeps about them, and evaluate them.

Two stages of a step (`cosim.step.cycle`), after messages were received and before evaluations are sent:
`compare_objects` finds which detections are of one object and what the own sweep says of each; `evaluate_objects` makes
the evaluation messages. `cosim.step.claims` finds in between what vehicles think of other claims of the messages.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.ragged import ptr_of
from cosim.base.threads import threads_for
from cosim.config.config import Config
from cosim.messages.content import FABRICATED
from cosim.step import object_lists
from cosim.step.accuracy import pose_variance
from cosim.step.comparing import ROWS_PER_BOX, Compared, Fuses, KnownObjects, compare, distance_m
from cosim.step.exchange import Exchange, Senders, lists_of_identities
from cosim.step.ground_truth import lies_in_evaluations
from cosim.step.known import Known, Pairs, Uses
from cosim.step.object_lists import messages_of, subset
from cosim.step.parts import Parts
from cosim.step.sense import Positioned
from sensors.association import Gate, bounded, pairs_across, pairs_within
from sensors.box_fusion import StatedAccuracy
from sensors.boxes import overlapping_pairs, pairs_between
from trust.claims import DETECTION, answers, claim_number
from trust.params import KINDS, TrustParams
from trust.tables import EvaluationMessages, Evaluations, ObjectLists


@dataclass(frozen=True, slots=True)
class Matched:
    """What later stages need of the comparison."""

    objects: Fuses
    """The groups of detections that each vehicle knows."""
    pairs: Pairs
    """Detections that may be of one object, as rows of `Known`."""
    from_own_m: Float[ndarray, "d"]
    """How inaccurate each detection is [m]: of an object's detections, the one with the least gives its box. It is the
    distance from the sensor of the vehicle that sends it. With `trust.matching = "gates"`: standard deviation of the
    position."""


def compare_objects(
    exchange: Exchange, messages: Known, positioned: Positioned, parts: Parts
) -> tuple[Compared, Matched]:
    """Group the detections that each vehicle knows, ask its own sweep about them, and evaluate them.

    Sweeps are not read again in this step.
    """
    objects, senders, c = messages.objects, exchange.senders, parts.config
    sweeps = positioned.observed.sweeps
    n_now = int(messages.ptr[len(senders)])  # detections of this step; those of earlier messages follow
    with parts.watch("match"):
        pairs = _pairs(messages, n_now, c.trust)
    variance_m2 = None
    if c.trust.matching == "gates":  # of a box beside the sweep of an evaluator, whose own position has an error too
        variance_m2 = objects.variance_m2 + c.gnss.std_m**2 * np.array([1.0, 0.0, 1.0])
    known = KnownObjects(
        detections=messages.detections,
        boxes=objects.boxes,
        transmitted=objects.transmitted,
        ptr=messages.ptr,
        traced=objects.origin == FABRICATED,
        pairs=pairs,
        own=senders.own,
        received=_with_own_identities(messages.received, senders),
        bodies=positioned.world.boxes.take(exchange.sensing.row),
        variance_m2=variance_m2,
        accuracy=_accuracy(exchange, messages, positioned, parts),
    )
    compared, groups = compare(parts.perception, sweeps, known, parts.area, c.trust, parts.recall, parts.watch)
    if c.trust.matching == "gates":
        from_own_m = np.sqrt(0.5 * objects.variance_m2[:, [0, 2]].sum(axis=1))
    else:
        observer = senders.source[messages.detections.message[:n_now]]
        now_m = distance_m(objects.boxes.xyz_m, np.arange(n_now), sweeps.poses.origin_m, observer)
        from_own_m = np.concatenate([now_m, messages.earlier_m])
    return compared, Matched(groups, pairs, from_own_m)


def _with_own_identities(received: Uses, senders: Senders) -> Uses:
    """Messages that vehicles know besides those of their first identities: an attacker knows those of its others."""
    further = np.flatnonzero(senders.identity)
    if not len(further):
        return received
    receiver = np.concatenate([senders.source[further], received.receiver])
    return Uses(receiver, np.concatenate([further, received.message]))


def _accuracy(exchange: Exchange, messages: Known, positioned: Positioned, parts: Parts) -> StatedAccuracy | None:
    """What vehicles state of the accuracy of the detections; None if no variant fuses boxes by it."""
    c, objects = parts.config, messages.objects
    wanted = {variant.trust.fused_boxes for variant in parts.trust.variants if variant.fused}
    if c.trust.matching != "gates" or wanted <= {"best"}:
        return None
    sender_row = exchange.vehicles.row[messages.vehicle]
    origin_m = positioned.world.boxes.xyz_m[sender_row, :2]  # east and north, of each message
    self_reports = np.flatnonzero(messages.detections.is_self)
    origin_m[messages.detections.message[self_reports]] = objects.boxes.xyz_m[self_reports, :2]  # where it says to be
    return StatedAccuracy(
        variance_m2=objects.relative_m2,
        heading_variance=objects.heading_variance,
        size_variance=objects.size_variance,
        origin_m=origin_m,
        pose_variance=np.tile(pose_variance(c), (len(origin_m), 1)),
    )


def _pairs(messages: Known, n_now: int, params: TrustParams) -> Pairs:
    """Detections that may be of one object, as rows of `messages.objects`.

    The first `n_now` rows are of this step. They are paired with each other and with the earlier ones. Pairs of earlier
    ones are known from the step before.
    """
    boxes, label, message = messages.objects.boxes, messages.objects.label, messages.detections.message
    variance_m2 = bounded(messages.objects.variance_m2)
    now, earlier = slice(0, n_now), slice(n_now, None)
    gate = None if params.matching == "iou" else Gate(1.0 - params.gate_p, params.tau)
    boxes_now, boxes_earlier = boxes.take(now), boxes.take(earlier)
    with threads_for(ROWS_PER_BOX * n_now):
        if gate is None:
            within = overlapping_pairs(boxes_now, label[now], message[now])
        else:
            within = pairs_within(boxes_now, label[now], variance_m2[now], message[now], gate)
        if n_now == len(boxes):
            return within
        if gate is None:
            i, j, iou = pairs_between(boxes_now, label[now], boxes_earlier, label[earlier])
        else:
            of_now = boxes_now, label[now], variance_m2[now]
            of_earlier = boxes_earlier, label[earlier], variance_m2[earlier]
            i, j, iou = pairs_across(*of_now, *of_earlier, gate)
    columns = zip(within, (i, n_now + j, iou), messages.earlier_pairs, strict=True)
    one, other, overlap = (np.concatenate(column) for column in columns)
    return one, other, overlap


@dataclass(frozen=True, slots=True)
class Claims:
    """What vehicles find about C claims of the messages in their lists, sorted by list, member and number."""

    list: Int[ndarray, "c"]
    """Row of the vehicles that sense."""
    member: Int[ndarray, "c"]
    """Detection that makes the claim, a row of `Known`; the self report claims that the message withholds nothing."""
    number: Int[ndarray, "c"]
    """As `trust.claims.claim_number` gives it."""
    support: Float[ndarray, "c"]
    """Expected evaluation, in [-1, 1]."""


@dataclass(frozen=True, slots=True)
class Evaluated:
    """Evaluations of detections by every vehicle's own sweep; `v` is the number of members of `lists`.

    Where there are claims, `lists` has a member for each of them too, after the detections of the list.

    All identities of a vehicle evaluate the same detections.
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
    number: Int[ndarray, "v"] | None = None
    """Number of what each evaluation is about (`trust.claims.claim_number`); None if all are about detections."""

    def of_detections(self) -> tuple[ObjectLists, Evaluations, Evaluations]:
        """`lists`, `own` and `reported` without what is not about detections."""
        if self.number is None:
            return self.lists, self.own, self.reported
        is_detection = self.number % len(KINDS) == DETECTION
        at = np.flatnonzero(is_detection)
        own, reported = (Evaluations(e.evaluation[at], e.visibility[at]) for e in (self.own, self.reported))
        return subset(self.lists, is_detection), own, reported


def evaluate_objects(
    exchange: Exchange, messages: Known, compared: Compared, claims: Claims | None, config: Config
) -> Evaluated:
    """Add evaluations of the claims of messages to those of detections, and make the evaluation messages.

    A message contains the evaluations of the detections that are new since the vehicle last sensed.
    """
    lists, own, senders = compared.lists, compared.own, exchange.senders
    n_points, plausible, ego_detected = compared.n_points, compared.plausible, compared.groups.ego_detected
    number = None
    if claims is not None:  # they follow the detections of each list
        list_of = np.concatenate([lists.of_member(), claims.list])
        order, n = np.argsort(list_of, kind="stable"), len(claims.list)
        of_claims = answers(claims.support, config.trust)

        def with_claims(detections: ndarray, claims: ndarray | int) -> ndarray:
            return np.concatenate([detections, np.full(n, claims, detections.dtype)])[order]

        ptr = ptr_of(list_of[order], len(lists.owner))
        lists = ObjectLists(ptr, with_claims(lists.member, claims.member), lists.owner)
        own = Evaluations(
            evaluation=with_claims(own.evaluation, of_claims.evaluation),
            visibility=with_claims(own.visibility, of_claims.visibility),
        )
        n_points, plausible, ego_detected = (with_claims(a, 0) for a in (n_points, plausible, ego_detected))
        index = messages.detections.detection_index[compared.lists.member]
        number = with_claims(claim_number(index, DETECTION), claims.number)
    reported = object_lists.as_reported(exchange.attacks, own, lists, messages.objects, exchange.sensing.row, number)
    lied = lies_in_evaluations(own, reported)
    sendable = messages.objects.transmitted[lists.member] & messages.is_new(lists.of_member(), lists.member)

    def carried(lists: ObjectLists, values: Evaluations, sendable: Bool[ndarray, "v"]) -> EvaluationMessages:
        return messages_of(exchange.now.step, messages, lists, values, sendable, number)

    own_messages = carried(lists, own, sendable)
    lists, at = lists_of_identities(lists, senders)
    if at is not None:  # rows of the lists of vehicles, once for each of their identities
        n_points, plausible, ego_detected, lied, sendable = (
            column[at] for column in (n_points, plausible, ego_detected, lied, sendable)
        )
        own, reported = (Evaluations(e.evaluation[at], e.visibility[at]) for e in (own, reported))
        number = None if number is None else number[at]
    return Evaluated(
        lists=lists,
        n_points=n_points,
        plausible=plausible,
        matched=ego_detected,
        own=own,
        reported=reported,
        lied=lied,
        own_messages=own_messages,
        sent=carried(lists, reported, sendable),
        kept_messages=own_messages if at is None else carried(lists, own, sendable),
        number=number,
    )
