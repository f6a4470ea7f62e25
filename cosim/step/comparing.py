"""Vehicles group the detections that they know, ask their own sweeps about them, and evaluate them.

This stage of a step (`cosim.step.cycle`) follows when messages were received. `cosim.step.evaluate` makes evaluation
messages of its result, and `cosim.step.fuse` fuses the groups. A vehicle uses the messages that it knows and its own
sweep, so that the result of one vehicle does not depend on what others compute.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.ragged import offsets, ptr_of, ranges
from cosim.base.rows import Rows
from cosim.base.threads import in_parts, n_threads
from cosim.messages.content import FABRICATED
from cosim.step.accuracy import ALONG_BOTH, pose_variance
from cosim.step.exchange import Exchange, Senders
from cosim.step.known import Known, Pairs, Uses
from cosim.step.parts import Parts
from cosim.step.perception import BoxQuestions, Perceives
from cosim.step.sense import Positioned
from cosim.step.stopwatch import Stopwatch
from sensors.association import Gate, bounded, certainty, pairs_across, pairs_within
from sensors.box_fusion.views import StatedAccuracy
from sensors.boxes import Boxes, overlapping_pairs, pairs_between
from sensors.evidence import AreaParams
from trust.evaluation import evaluate
from trust.fusion import SensorEvidence
from trust.matching import Partners, match_partners
from trust.params import TrustParams
from trust.tables import Evaluations, Groups, ObjectLists, SentDetections


@dataclass(frozen=True, slots=True)
class FabricatedDetections(Rows):
    """Fabricated detections in the lists of what vehicles know: ground truth."""

    list: Int[ndarray, "k"]
    detection: Int[ndarray, "k"]
    seed: Int[ndarray, "k"]
    """The detection whose box represents the group."""


@dataclass(frozen=True, slots=True)
class ObjectGroups:
    """All detections that each vehicle knows, in groups, one per object."""

    lists: ObjectLists
    groups: Groups
    detections: SentDetections
    boxes: Boxes
    """Of the detections."""
    of_seeds: SensorEvidence
    """What the sweeps say about the detection whose box represents each group."""
    pairs: Pairs
    """Detections that may be of one object, as rows of `Known`."""
    from_own_m: Float[ndarray, "d"]
    """How inaccurate each detection is [m]: of an object's detections, the one with the least gives its box. It is the
    distance from the sensor of the vehicle that sends it. With `trust.matching = "gates"`: standard deviation of the
    position."""
    accuracy: StatedAccuracy | None
    """What vehicles state of the accuracy of the detections. None where boxes are not fused by it."""


@dataclass(frozen=True, slots=True)
class Compared:
    """What vehicles find about the detections in the area that they evaluate; `v` is the number of these."""

    lists: ObjectLists
    groups: Groups
    n_points: Int[ndarray, "v"]
    """Number of returns of the vehicle's own sweep inside the box."""
    plausible: Bool[ndarray, "v"]
    """Whether an object can stand there by the vehicle's own sweep; tested if it did not detect the object itself."""
    own: Evaluations
    """Evaluations as each vehicle makes them."""
    fabricated: FabricatedDetections
    """By list; beyond the area, too."""


def compare_objects(
    exchange: Exchange, messages: Known, comparison: "Comparison", parts: Parts
) -> tuple[Compared, ObjectGroups]:
    """Group the detections that each vehicle knows, ask its own sweep about them, and evaluate them.

    Sweeps are not read again in this step.
    """
    objects, senders = messages.objects, exchange.senders
    with parts.watch("match"):
        received = _with_own_identities(messages.received, senders)
        lists = received_lists(received, messages.ptr, objects.transmitted, senders.own)
    watches = []

    def compare(first: int, last: int) -> _OfLists:
        watch = parts.watch.of_thread()
        watches.append(watch)
        return comparison.of_lists(lists.part(first, last), watch)

    found = in_parts(compare, _bounds(lists.ptr))
    for watch in watches:
        parts.watch.add(watch, min(n_threads(), len(watches)))
    near = [one.compared for one in found]
    compared = Compared(
        lists=ObjectLists.joined([part.lists for part in near]),
        groups=Groups.joined([part.groups for part in near]),
        n_points=np.concatenate([part.n_points for part in near]),
        plausible=np.concatenate([part.plausible for part in near]),
        own=Evaluations.concat([part.own for part in near]),
        fabricated=FabricatedDetections.concat([part.fabricated for part in near]),
    )
    groups = ObjectGroups(
        lists=lists,
        groups=Groups.joined([one.groups for one in found]),
        detections=messages.detections,
        boxes=objects.boxes,
        of_seeds=SensorEvidence.concat([one.of_seeds for one in found]),
        pairs=comparison.pairs,
        from_own_m=comparison.from_own_m,
        accuracy=comparison.stated,
    )
    return compared, groups


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


_PART = 16_384
"""Detections in the lists that are compared at once. Columns of so many stay in a core's cache."""
_MOST_PARTS = 64
"""Each part needs memory for all detections of the step: with ever more parts, time would grow as the square."""


def _bounds(ptr: Int[ndarray, "e+1"]) -> list[int]:
    """The lists at which parts of some `_PART` members or more begin, and the end of the last part."""
    n = min(max(1, int(ptr[-1]) // _PART), _MOST_PARTS)
    begins = ptr[-1] * np.arange(n) // n
    lists = np.searchsorted(ptr, begins)
    return [*lists.tolist(), len(ptr) - 1]


class _OfLists(NamedTuple):
    """What some vehicles find about the detections that they know."""

    compared: Compared
    groups: Groups
    of_seeds: SensorEvidence


@dataclass(frozen=True, slots=True)
class Comparison:
    """All that vehicles need to compare what they know with what they see. It does not depend on who received what."""

    messages: Known
    pairs: Pairs
    partners: Partners
    sweeps: Any
    bodies: Boxes
    """Where each vehicle believes itself to be."""
    velocity_mps: Float[ndarray, "d 2"]
    """Of each detection; 0 where it states none."""
    accuracy: "RelativeAccuracy"
    from_own_m: Float[ndarray, "d"]
    stated: StatedAccuracy | None
    """These two as in `ObjectGroups`."""
    parts: Parts

    @staticmethod
    def of(exchange: Exchange, messages: Known, positioned: Positioned, parts: Parts) -> "Comparison":
        """Of all detections in these messages."""
        objects, params, sweeps = messages.objects, parts.config.trust, positioned.observed.sweeps
        n_now = int(messages.ptr[len(exchange.senders)])  # detections of this step; those of earlier messages follow
        pairs = _pairs(messages, n_now, params)
        # The evaluator's own position has an error, too.
        own_m2, _ = pose_variance(exchange.world.is_roadside[exchange.sensing.row], parts.config).T
        return Comparison(
            messages=messages,
            pairs=pairs,
            partners=Partners.of(pairs, len(messages.detections), params),
            sweeps=sweeps,
            bodies=positioned.world.boxes.take(exchange.sensing.row),
            velocity_mps=np.nan_to_num(messages.velocity_mps),
            accuracy=RelativeAccuracy(objects.variance_m2, own_m2),
            from_own_m=_from_own_m(exchange, messages, n_now, sweeps.poses.origin_m, params),
            stated=_accuracy(exchange, messages, positioned, parts),
            parts=parts,
        )

    def of_lists(self, lists: ObjectLists, watch: Stopwatch) -> _OfLists:
        """What the owners of these lists find."""
        objects, detections = self.messages.objects, self.messages.detections
        boxes, area, params = objects.boxes, self.parts.area, self.parts.config.trust
        perception, origin_m = self.parts.perception, self.sweeps.poses.origin_m
        with watch("match"):
            inside = perception.in_area(
                self.sweeps, lists.of_member(), boxes, area, lists.member, detections.label, self.bodies
            )
            near = lists.subset(inside)
            groups = match_partners(lists, detections, self.partners, params)
            near_groups = match_partners(near, detections, self.partners, params)
        with watch("evaluate"):
            seeds = groups.seeds()
            away_m = distance_m(boxes.xyz_m, lists.member[seeds], origin_m, lists.of(seeds))
            # Of what stands beyond the range, no return counts and nothing is tested. Ranges are those of bottom
            # centres.
            may_count = away_m < area.range_m + boxes.lwh_m[lists.member[seeds], 2]
            is_tested = _is_tested(groups, near_groups, inside, seeds[may_count])
            questions, counted, tested = _questions_of(
                lists, inside, is_tested, detections, boxes, self.velocity_mps, area
            )
            n_points = np.zeros(len(lists.member), np.int32)
            plausible = np.ones(len(lists.member), bool)
            n_points[counted], plausible[tested] = perception.answers(self.sweeps, questions)
            permitted, compared_share = plausible.astype(float), None
            if params.matching == "gates":
                permitted = _permitted_share(perception, self.sweeps, lists, plausible, questions, self.accuracy)
                plausible = permitted >= 0.5
                compared_share = certainty(self.accuracy.variance_m2(near.member, near.of_member()))
            recall = None
            if self.parts.recall is not None:
                range_m = distance_m(boxes.xyz_m, near.member, origin_m, near.of_member())
                recall = self.parts.recall(n_points[inside], detections.label[near.member], range_m)
            own = evaluate(
                near, near_groups, detections, n_points[inside], permitted[inside], params, recall, compared_share
            )
            at = np.flatnonzero(objects.origin[lists.member] == FABRICATED)
            seed = lists.member[groups.seed[at]]
        return _OfLists(
            compared=Compared(
                lists=near,
                groups=near_groups,
                n_points=n_points[inside],
                plausible=plausible[inside],
                own=own,
                fabricated=FabricatedDetections(lists.of(at), lists.member[at], seed),
            ),
            groups=groups,
            of_seeds=SensorEvidence(n_points[seeds], plausible[seeds], away_m < area.range_m),
        )


def _with_own_identities(received: Uses, senders: Senders) -> Uses:
    """Messages that vehicles know besides those of their first identities: an attacker knows those of its others."""
    further = np.flatnonzero(senders.identity)
    if not len(further):
        return received
    receiver = np.concatenate([senders.source[further], received.receiver])
    return Uses(receiver, np.concatenate([further, received.message]))


def _questions_of(
    lists: ObjectLists,
    evaluated: Bool[ndarray, "m"],
    foreign: Bool[ndarray, "m"],
    detections: SentDetections,
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


def _is_tested(
    groups: Groups, near_groups: Groups, inside: Bool[ndarray, "m"], seeds: Int[ndarray, "k"]
) -> Bool[ndarray, "m"]:
    """Members that each vehicle tests for plausibility: these seeds and all `inside`, but none that it detected itself.

    `near_groups` are the groups of the members inside the area.
    """
    is_tested = np.zeros(len(inside), bool)
    is_tested[seeds] = True
    is_tested &= ~groups.ego_detected
    is_tested[np.flatnonzero(inside)[~near_groups.ego_detected]] = True
    return is_tested


def _from_own_m(
    exchange: Exchange, messages: Known, n_now: int, origin_m: Float[ndarray, "s 3"], params: TrustParams
) -> Float[ndarray, "d"]:
    """As in `ObjectGroups`. The first `n_now` detections are of this step, by sensors at `origin_m`."""
    objects = messages.objects
    if params.matching == "gates":
        return np.sqrt(0.5 * objects.variance_m2[:, [0, 2]].sum(axis=1))
    observer = exchange.senders.source[messages.detections.message[:n_now]]
    now_m = distance_m(objects.boxes.xyz_m, np.arange(n_now), origin_m, observer)
    return np.concatenate([now_m, messages.earlier_m])


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
        pose_variance=pose_variance(exchange.world.is_roadside[sender_row], c),
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


class RelativeAccuracy(NamedTuple):
    """How well the positions of D detections relative to S vehicles are known."""

    detection_m2: Float[ndarray, "d 3"]
    """Stated variances xx, xy, yy."""
    vehicle_m2: Float[ndarray, "s"]
    """Variance of the vehicle's own position along each axis."""

    def variance_m2(
        self,
        detection: Int[ndarray, "n"],
        vehicle: Int[ndarray, "n"],
    ) -> Float[ndarray, "n 3"]:
        """Variances of these detections relative to these vehicles."""
        own = self.vehicle_m2.take(vehicle)[:, None] * ALONG_BOTH
        return self.detection_m2.take(detection, axis=0) + own


_SIGMA_POINTS = np.sqrt(2.0) * np.array(
    [
        [1.0, 0.0],
        [-1.0, 0.0],
        [0.0, 1.0],
        [0.0, -1.0],
    ]
)
"""Places around a box along the axes of its variance, in standard deviations. Their mean and their variance are those
of the position: the points of third-degree cubature."""


def _permitted_share(
    perception: Perceives,
    sweeps: Any,
    lists: ObjectLists,
    plausible: Bool[ndarray, "m"],
    asked: BoxQuestions,
    accuracy: "RelativeAccuracy",
) -> Float[ndarray, "m"]:
    """Share of the places where a box may be that free space in the vehicle's own sweep permits.

    A box that is permitted where its message says has the share 1. For the others, the sweep is asked about four places
    around it, too.

    Parameters
    ----------
    plausible
        Whether each member of `lists` is permitted where its message says.
    asked, accuracy
        Questions about all detections, and how well their positions are known.
    """
    share = plausible.astype(float)
    rows = np.flatnonzero(~plausible)
    if not len(rows):
        return share
    detection = lists.member[rows]
    sweep = lists.of_member()[rows].astype(np.int32)
    xx, xy, yy = bounded(accuracy.variance_m2(detection, sweep)).T
    # Lower triangle of the Cholesky factor, which turns standard deviations into metres: east = x_of_u * u,
    # north = y_of_u * u + y_of_v * v.
    x_of_u = np.sqrt(xx)
    y_of_u = xy / x_of_u
    y_of_v = np.sqrt(np.maximum(yy - y_of_u * y_of_u, 0.0))
    n = len(_SIGMA_POINTS)
    u, v = np.repeat(_SIGMA_POINTS, len(rows), axis=0).T
    of = np.tile(detection, n)
    around = asked.boxes.take(of)
    xyz_m = around.xyz_m.copy()
    xyz_m[:, 0] += np.tile(x_of_u, n) * u
    north_of_u = np.tile(y_of_u, n) * u
    north_of_v = np.tile(y_of_v, n) * v
    xyz_m[:, 1] += north_of_u + north_of_v
    around = replace(around, xyz_m=xyz_m)
    by_sweep = np.arange(n * len(rows)).reshape(n, -1).T.ravel()  # so that each sweep is read once
    around_each = replace(
        asked,
        boxes=around,
        velocity_mps=asked.velocity_mps.take(of, axis=0),
        counting=sweep[:0],
        counted=by_sweep[:0],
        testing=np.repeat(sweep, n),
        tested=by_sweep,
    )
    _, permits = perception.answers(sweeps, around_each)
    share[rows] = permits.reshape(-1, n).sum(axis=1) / (1.0 + n)
    return share


def distance_m(
    a_m: Float[ndarray, "a 3"],
    i: Int[ndarray, "n"],
    b_m: Float[ndarray, "b 3"],
    j: Int[ndarray, "n"],
) -> Float[ndarray, "n"]:
    """Distance of each row i of `a_m` from the row j of `b_m`."""
    apart_m = a_m.take(i, axis=0) - b_m.take(j, axis=0)
    x, y, z = apart_m.T
    return np.sqrt(x * x + y * y + z * z)
