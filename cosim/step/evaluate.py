"""Vehicles group the detections that they know, ask their own sweeps about them, and evaluate them.

A stage that changes a part of the state takes it as an argument and returns its new value before the result.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.ragged import ptr_of
from cosim.base.threads import threads_for
from cosim.config.config import Config
from cosim.messages.content import (
    FABRICATED,
)
from cosim.step import object_lists
from cosim.step.accuracy import pose_variance
from cosim.step.comparing import ROWS_PER_BOX, Compared, Fuses, KnownObjects, compare, distance_m
from cosim.step.exchange import Exchange, lists_of_identities
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
    """Distance of each detection from the sensor of the vehicle that sends it. With `trust.matching = "gates"`:
    standard deviation of its position."""


def compare_objects(
    exchange: Exchange, messages: Known, positioned: Positioned, parts: Parts
) -> tuple[Compared, Matched]:
    """Group the detections that each vehicle knows, ask its own sweep about them, and evaluate them.

    Sweeps are not read again in this step.
    """
    objects, senders, sweeps, c = messages.objects, exchange.senders, positioned.observed.sweeps, parts.config
    n_now, received = int(messages.ptr[len(senders)]), messages.received
    with parts.watch("match"):
        pairs = _pairs(messages, n_now, c.trust)
    further = np.flatnonzero(senders.identity)
    if len(further):
        sources, rows = (senders.source[further], received.receiver), (further, received.message)
        received = Uses(np.concatenate(sources), np.concatenate(rows))
    variance_m2 = None
    if c.trust.matching == "gates":  # of a box beside the evaluator's own sweep
        variance_m2 = objects.variance_m2 + c.gnss.std_m**2 * np.array([1.0, 0.0, 1.0])
    known = KnownObjects(
        detections=messages.detections, boxes=objects.boxes, transmitted=objects.transmitted, ptr=messages.ptr,
        traced=objects.origin == FABRICATED, pairs=pairs, own=senders.own, received=received,
        bodies=positioned.world.boxes.take(exchange.sensing.row),
        variance_m2=variance_m2, accuracy=_accuracy(exchange, messages, positioned, parts),
    )  # fmt: skip
    compared, grouped = compare(parts.perception, sweeps, known, c.area, c.trust, parts.recall, parts.watch)
    observer = senders.source[messages.detections.message[:n_now]]
    from_own_m = distance_m(objects.boxes.xyz_m, np.arange(n_now), sweeps.poses.origin_m, observer)
    from_own_m = np.concatenate([from_own_m, messages.earlier_m])
    if c.trust.matching == "gates":  # the most accurate detection of an object gives its box
        from_own_m = np.sqrt(0.5 * objects.variance_m2[:, [0, 2]].sum(axis=1))
    return compared, Matched(grouped, pairs, from_own_m)


def _accuracy(exchange: Exchange, messages: Known, positioned: Positioned, parts: Parts) -> StatedAccuracy | None:
    """What vehicles state of the accuracy of the detections; None if no variant fuses boxes by it."""
    c, objects = parts.config, messages.objects
    wanted = {variant.trust.fused_boxes for variant in parts.trust.variants if variant.fused}
    if c.trust.matching != "gates" or wanted <= {"best"}:
        return None
    place_m = positioned.world.boxes.xyz_m[exchange.vehicles.row[messages.vehicle], :2]
    selves = np.flatnonzero(messages.detections.is_self)
    place_m[messages.detections.message[selves]] = objects.boxes.xyz_m[selves, :2]  # where the message says
    return StatedAccuracy(
        variance_m2=objects.relative_m2,
        heading_variance=objects.heading_variance,
        size_variance=objects.size_variance,
        origin_m=place_m,
        pose_variance=np.tile(pose_variance(c), (len(place_m), 1)),
    )


def _pairs(messages: Known, n_now: int, params: TrustParams) -> Pairs:
    """Detections that may be of one object; `n_now` of them are of this step. Pairs of earlier ones are known."""
    boxes, label, message = messages.objects.boxes, messages.objects.label, messages.detections.message
    now, earlier, variance_m2 = slice(0, n_now), slice(n_now, None), bounded(messages.objects.variance_m2)
    gate = None if params.matching == "iou" else Gate(1.0 - params.gate_p, params.tau)
    with threads_for(ROWS_PER_BOX * n_now):
        if gate is None:
            pairs = overlapping_pairs(boxes.take(now), label[now], message[now])
        else:
            pairs = pairs_within(boxes.take(now), label[now], variance_m2[now], message[now], gate)
        if n_now == len(boxes):
            return pairs
        if gate is None:
            i, j, iou = pairs_between(boxes.take(now), label[now], boxes.take(earlier), label[earlier])
        else:
            i, j, iou = pairs_across(
                boxes.take(now), label[now], variance_m2[now],
                boxes.take(earlier), label[earlier], variance_m2[earlier], gate,
            )  # fmt: skip
    columns = zip(pairs, (i, n_now + j, iou), messages.earlier_pairs, strict=True)
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
    if claims is not None:
        of = np.concatenate([lists.of_member(), claims.list])
        order, n = np.argsort(of, kind="stable"), len(claims.list)
        found = answers(claims.support, config.trust)

        def with_claims(of_detections: ndarray, of_claims: ndarray | int) -> ndarray:
            return np.concatenate([of_detections, np.full(n, of_claims, of_detections.dtype)])[order]

        lists = ObjectLists(ptr_of(of[order], len(lists.owner)), with_claims(lists.member, claims.member), lists.owner)
        own = Evaluations(with_claims(own.evaluation, found.evaluation), with_claims(own.visibility, found.visibility))
        n_points, plausible, ego_detected = (with_claims(a, 0) for a in (n_points, plausible, ego_detected))
        index = messages.detections.detection_index[compared.lists.member]
        number = with_claims(claim_number(index, DETECTION), claims.number)
    reported = object_lists.as_reported(exchange.attacks, own, lists, messages.objects, exchange.sensing.row, number)
    lied = lies_in_evaluations(own, reported)
    sendable = messages.objects.transmitted[lists.member]
    is_new = messages.is_new(lists.of_member(), lists.member)
    sendable &= is_new

    def carried(by: ObjectLists, values: Evaluations, sendable: Bool[ndarray, "v"]) -> EvaluationMessages:
        return messages_of(exchange.now.step, messages, by, values, sendable, number)

    own_messages = carried(lists, own, sendable)
    lists, at = lists_of_identities(lists, senders)
    if at is not None:
        n_points, plausible, ego_detected, lied = n_points[at], plausible[at], ego_detected[at], lied[at]
        own, reported = (Evaluations(e.evaluation[at], e.visibility[at]) for e in (own, reported))
        sendable, number = sendable[at], None if number is None else number[at]
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
