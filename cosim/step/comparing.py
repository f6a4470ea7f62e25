"""What every vehicle finds by itself about the detections that it knows: it groups, evaluates and fuses them.

A vehicle uses the messages that it knows and its own sweep. So parts of the vehicles can be computed in any place
(`KnownObjects.part`), and the result does not depend on it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.ragged import ptr_of, ranges
from cosim.base.threads import threads_for
from cosim.step.known import Pairs, Uses, renumbered
from cosim.step.object_lists import questions_of, received_lists, subset
from cosim.step.perception import BoxQuestions, Perceives
from cosim.step.stopwatch import Stopwatch
from sensors.association import bounded, certainty
from sensors.box_fusion import ObjectViews, StatedAccuracy, ViewLists, fuse_boxes, overlap_p
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from trust import tables
from trust.evaluation import evaluate
from trust.fusion import Fused, SensorEvidence, fuse, votes_of
from trust.matching import match_each
from trust.object_reports import ObjectReports
from trust.params import TrustParams
from trust.tables import Evaluations, FusionInput, Groups, ObjectLists, SenderTrust

_ROWS_PER_FUSED = 6
"""To fuse the box of one detection costs as much as this number of rows of a table."""
ROWS_PER_BOX = 10
"""Finding the boxes that overlap one box costs as much as this number of rows of a table."""

Recall = Callable[[ndarray, ndarray, ndarray], ndarray]
"""Recall of a detector, from number of returns, class and distance."""


@dataclass(frozen=True, slots=True)
class KnownObjects:
    """D detections in M messages, and the R vehicles that know them."""

    detections: tables.SentDetections
    boxes: Boxes
    transmitted: Bool[ndarray, "d"]
    ptr: Int[ndarray, "m+1"]
    """Row at which the detections of each message begin."""
    traced: Bool[ndarray, "d"]
    """Detections of which `Compared` says what they were grouped with."""
    pairs: Pairs
    """Detections that may be of one object."""
    own: Int[ndarray, "r"]
    """Message of each vehicle under its own identity, ascending."""
    received: Uses
    """Messages that vehicles know besides, from others or under further identities of their own."""
    bodies: Boxes
    """Where each vehicle believes itself to be."""
    variance_m2: Float[ndarray, "d 3"] | None = None
    """Variance of each detection's position, as stated, and of the position of a vehicle that compares it with its own
    sweep. None where boxes are taken to be exact."""
    accuracy: StatedAccuracy | None = None
    """What vehicles state of the accuracy of the detections. None where boxes are not fused by it."""

    def part(self, vehicles: Int[ndarray, "k"], received: Int[ndarray, "n"]) -> tuple["KnownObjects", "PartRows"]:
        """The same for some of the vehicles, which are numbered anew.

        Parameters
        ----------
        vehicles
            Their rows, ascending.
        received
            Rows of what they received, ascending.

        Returns
        -------
        What they know, and the rows of the messages and detections of it in these.
        """
        receiver, message = self.received.receiver[received], self.received.message[received]
        there = np.zeros(len(self.ptr) - 1, bool)
        there[self.own[vehicles]] = True
        there[message] = True
        messages = np.flatnonzero(there)
        of_message = np.cumsum(there) - 1
        n = np.diff(self.ptr)[messages]
        detections = ranges(self.ptr[messages], n)
        number = numbers(detections, len(self.boxes))
        all_ = self.detections
        part = KnownObjects(
            detections=tables.SentDetections(
                of_message[all_.message[detections]],
                *(getattr(all_, name)[detections] for name in ("detection_index", "label", "score", "is_self")),
            ),
            boxes=self.boxes.take(detections),
            transmitted=self.transmitted[detections],
            ptr=np.concatenate([[0], np.cumsum(n)]),
            traced=self.traced[detections],
            pairs=renumbered(self.pairs, number),
            own=of_message[self.own[vehicles]],
            received=Uses(numbers(vehicles, len(self.own))[receiver], of_message[message]),
            bodies=self.bodies.take(vehicles),
            variance_m2=None if self.variance_m2 is None else self.variance_m2[detections],
            accuracy=None if self.accuracy is None else self.accuracy.take(detections, messages),
        )
        return part, PartRows(messages, detections, number)


class PartRows(NamedTuple):
    """Rows of messages and detections of a part among all, and the row of every detection in the part, or -1."""

    messages: Int[ndarray, "m"]
    detections: Int[ndarray, "d"]
    number: Int[ndarray, "all"]


def numbers(rows: Int[ndarray, "k"], n: int) -> Int[ndarray, "n"]:
    """Position of each of n rows among some of them; -1 if it is not there."""
    number = np.full(n, -1, np.int32)
    number[rows] = np.arange(len(rows), dtype=np.int32)
    return number


class Traced(NamedTuple):
    """Traced detections in the lists of what vehicles know."""

    list: Int[ndarray, "k"]
    detection: Int[ndarray, "k"]
    seed: Int[ndarray, "k"]
    """The detection whose box represents the group."""


@dataclass(frozen=True, slots=True)
class FusionOf:
    """A trust variant that fuses."""

    trust: Float[ndarray, "h"]
    """Trust of the vehicle in the sender of each message in use."""
    params: TrustParams
    scorer: Callable[[ObjectReports], Float[ndarray, "g"]] | None
    """Method of a trust model that scores objects."""


@dataclass(frozen=True, slots=True)
class Used:
    """The evaluations that vehicles use in fusion. Messages have the rows of all `Known`."""

    messages: Uses
    """Messages whose evaluations the vehicles use, by vehicle."""
    in_time: bool
    """Whether these evaluations have arrived."""
    lists: ObjectLists
    """What was evaluated, one list per message."""
    own: Evaluations
    reported: Evaluations
    """As transmitted; `own` itself if no attack changed any."""
    from_own_m: Float[ndarray, "d"]
    """Distance of each detection from the sensor of its sender."""


class Fuses(Protocol):
    """What fusion needs of the comparison."""

    def fuse(self, used: Used, variants: Sequence[FusionOf]) -> list[Fused]:
        """Fused objects of every vehicle, per trust variant."""
        ...


@dataclass(frozen=True, slots=True)
class Grouped:
    """All detections that each vehicle knows, in groups, one per object."""

    lists: ObjectLists
    groups: Groups
    detections: tables.SentDetections
    of_seeds: SensorEvidence
    """What the sweeps say about the detection whose box represents each group."""
    boxes: Boxes
    """Of the detections."""
    accuracy: StatedAccuracy | None
    """As in `KnownObjects`."""

    def renumbered(self, messages: Int[ndarray, "m"]) -> "Grouped":
        """The same with these rows of the messages."""
        detections = replace(self.detections, message=messages[self.detections.message])
        accuracy = None if self.accuracy is None else self.accuracy.of_messages(messages)
        lists = replace(self.lists, owner=messages[self.lists.owner])
        return replace(self, lists=lists, detections=detections, accuracy=accuracy)

    def fuse(self, used: Used, variants: Sequence[FusionOf]) -> list[Fused]:
        """As in `Fuses`."""
        ptr = ptr_of(used.messages.receiver, len(self.lists.owner))
        in_time = np.full(len(used.messages.message), used.in_time)
        given = FusionInput(self.lists, self.groups, self.detections, used.lists, used.own, used.reported)
        fused, votes, by_mode = [], None, dict[str, list[int]]()
        for number, variant in enumerate(variants):
            params, sender_trust = variant.params, SenderTrust(ptr, used.messages.message, variant.trust, in_time)
            if variant.scorer is not None and votes is None:
                votes = votes_of(given, sender_trust)
            is_best = self.accuracy is None or params.fused_boxes == "best"
            fused.append(fuse(
                given, sender_trust, self.of_seeds, used.from_own_m if is_best else None, params, variant.scorer, votes,
                params.min_score,
            ))  # fmt: skip
            if not is_best:
                by_mode.setdefault(params.fused_boxes, []).append(number)
        for mode, rows in by_mode.items():
            found, of = [fused[number] for number in rows], [variants[number] for number in rows]
            for number, one in zip(rows, self._with_boxes(found, used, of, mode), strict=True):
                fused[number] = one
        return fused

    def _with_boxes(
        self, fused: Sequence[Fused], used: Used, variants: Sequence[FusionOf], mode: str
    ) -> Iterator[Fused]:
        """The objects with boxes from all their detections, and with scores that say how well the boxes may fit.

        What a vehicle states counts by the receiver's trust in it. From the trust of a stranger on, it counts fully.
        """
        assert self.accuracy is not None
        lists, groups, detections = self.lists, self.groups, self.detections
        ptr = ptr_of(used.messages.receiver, len(lists.owner))
        known = ViewLists(
            lists.ptr, lists.member, lists.owner, groups.numbers(), lists.member[groups.seeds()], ptr,
            used.messages.message,
        )  # fmt: skip
        weights = []
        for of in variants:
            enough = max(of.params.default_trust, 1e-9)
            weights.append(np.minimum(of.trust / enough, 1.0))
        wanted = np.zeros((len(fused), len(known.seed)), bool)
        for row, found in zip(wanted, fused, strict=True):
            row[found.group] = True
        views = ObjectViews(self.boxes, detections.label, detections.message, self.accuracy)
        with threads_for(_ROWS_PER_FUSED * len(lists.member) * len(fused)):
            boxes = fuse_boxes(views, known, weights, list(wanted), mode == "aligned")
        for found, of, its in zip(fused, variants, boxes, strict=True):
            score = found.score
            if of.params.least_overlap > 0:
                score = score * overlap_p(its, of.params.least_overlap)
            found = replace(found, box=its.columns(), variance_m2=its.variance_m2, score=score)
            yield found.take(score >= of.params.min_score)


@dataclass(frozen=True, slots=True)
class Compared:
    """What R vehicles find about the detections in the area that they evaluate; `v` is their number."""

    lists: ObjectLists
    groups: Groups
    n_points: Int[ndarray, "v"]
    """Number of returns of the vehicle's own sweep inside the box."""
    plausible: Bool[ndarray, "v"]
    """Whether an object can stand there by the vehicle's own sweep; tested if it did not detect the object itself."""
    own: Evaluations
    """Evaluations as each vehicle makes them."""
    traced: Traced
    """By list."""


def compare(
    perception: Perceives, sweeps: Any, known: KnownObjects, area: AreaParams, params: TrustParams,
    recall: Recall | None, watch: Stopwatch,
) -> tuple[Compared, Grouped]:  # fmt: skip
    """Group what each vehicle knows, ask its own sweep about it, and evaluate it.

    Parameters
    ----------
    perception
        Answers questions to the sweeps.
    sweeps
        Range images of the vehicles at their estimated positions.
    known
        What the vehicles know.
    area
        Where vehicles evaluate.
    params
        How they match and evaluate.
    recall
        Recall of their detector; None unless denials are weighted by it.
    watch
        Measures the stages.
    """
    boxes, detections = known.boxes, known.detections
    with watch("match"):
        lists = received_lists(known.received, known.ptr, known.transmitted, known.own)
        inside = perception.in_area(
            sweeps, lists.of_member(), boxes, area, lists.member, detections.label, known.bodies
        )
        near = subset(lists, inside)
        groups, near_groups = match_each((lists, near), detections, known.pairs, params)
    with watch("evaluate"):
        seeds, origin_m = groups.seeds(), sweeps.poses.origin_m
        away_m = distance_m(boxes.xyz_m, lists.member[seeds], origin_m, lists.of(seeds))
        # Of what stands beyond the range, no return counts and nothing is tested. Ranges are those of bottom centres.
        may_count = away_m < area.range_m + boxes.lwh_m[lists.member[seeds], 2]
        foreign = np.zeros(len(lists.member), bool)  # members whose plausibility is tested
        foreign[seeds[may_count]] = True
        foreign &= ~groups.ego_detected
        foreign[np.flatnonzero(inside)[~near_groups.ego_detected]] = True
        asked, counted, tested = questions_of(lists, inside, foreign, boxes, detections, area)
        n_points, plausible = np.zeros(len(lists.member), np.int32), np.ones(len(lists.member), bool)
        n_points[counted], plausible[tested] = perception.answers(sweeps, asked)
        permitted = plausible.astype(float)
        if known.variance_m2 is not None:
            permitted = _permitted_share(perception, sweeps, lists, plausible, known, area)
            plausible = permitted >= 0.5
        of_seeds = SensorEvidence(n_points[seeds], plausible[seeds], away_m < area.range_m)
        n_points, plausible, of_near = n_points[inside], plausible[inside], None
        if recall is not None:
            range_m = distance_m(boxes.xyz_m, near.member, origin_m, near.of_member())
            of_near = recall(n_points, detections.label[near.member], range_m)
        sure = None if known.variance_m2 is None else certainty(known.variance_m2)[near.member]
        own = evaluate(near, near_groups, detections, n_points, permitted[inside], params, of_near, sure)
        at = np.flatnonzero(known.traced[lists.member]) if known.traced.any() else np.zeros(0, np.int64)
        traced = Traced(lists.of(at), lists.member[at], lists.member[groups.seed[at]])
    compared = Compared(near, near_groups, n_points, plausible, own, traced)
    return compared, Grouped(lists, groups, detections, of_seeds, boxes, known.accuracy)


_SIGMA_POINTS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]) * np.sqrt(2.0)
"""Places around a box along the axes of its variance, in standard deviations. Their mean and their variance are those
of the position: the points of third-degree cubature."""


def _permitted_share(
    perception: Perceives, sweeps: Any, lists: ObjectLists, plausible: Bool[ndarray, "m"], known: KnownObjects,
    area: AreaParams,
) -> Float[ndarray, "m"]:  # fmt: skip
    """Share of the places where a box may be that free space in the vehicle's own sweep permits.

    A box that is permitted where its message says has the share 1. For the others, the sweep is asked about four places
    around it, too.
    """
    assert known.variance_m2 is not None
    share = plausible.astype(float)
    rows = np.flatnonzero(~plausible)
    if not len(rows):
        return share
    b, o = lists.member[rows], lists.of_member()[rows].astype(np.int32)
    xx, xy, yy = bounded(known.variance_m2.take(b, axis=0)).T
    # The lower triangle of the Cholesky factor turns standard deviations into metres.
    a = np.sqrt(xx)
    c = xy / a
    d = np.sqrt(np.maximum(yy - c * c, 0.0))
    n = len(_SIGMA_POINTS)
    boxes = known.boxes.take(np.tile(b, n))
    u, v = np.repeat(_SIGMA_POINTS, len(rows), axis=0).T
    xyz_m = boxes.xyz_m.copy()
    xyz_m[:, 0] += np.tile(a, n) * u
    xyz_m[:, 1] += np.tile(c, n) * u + np.tile(d, n) * v
    none = np.zeros(0, np.int32)
    at = np.arange(n * len(rows)).reshape(n, -1).T.ravel()  # by sweep: each is read once
    asked = BoxQuestions(replace(boxes, xyz_m=xyz_m), area, none, at[:0], np.repeat(o, n), at)
    _, around = perception.answers(sweeps, asked)
    share[rows] = around.reshape(-1, n).sum(axis=1) / (1.0 + n)
    return share


def distance_m(
    a_m: Float[ndarray, "a 3"], i: Int[ndarray, "n"], b_m: Float[ndarray, "b 3"], j: Int[ndarray, "n"]
) -> Float[ndarray, "n"]:
    """Distance of each row i of `a_m` from the row j of `b_m`."""
    apart_m = a_m.take(i, axis=0) - b_m.take(j, axis=0)
    x, y, z = apart_m.T
    return np.sqrt(x * x + y * y + z * z)
