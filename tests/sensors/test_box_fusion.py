"""Boxes from the detections of several vehicles: a slow literal twin, cases by hand, and true covariances."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from cosim.base.threads import n_threads, use_threads
from sensors.box_fusion.fuse import fuse_boxes
from sensors.box_fusion.views import FusedBoxes, ObjectViews, StatedAccuracy, ViewLists, overlap_p
from sensors.boxes import Boxes, iou_3d
from tests.sensors.town import boxes_at

POSE_M2, TURN_RAD2 = 0.2**2, math.radians(0.2) ** 2


@dataclass(frozen=True)
class Scene:
    """Lists of one or more receivers."""

    views: ObjectViews
    ptr: np.ndarray
    member: np.ndarray
    owner: np.ndarray
    group: np.ndarray
    seed: np.ndarray
    weight: np.ndarray
    """Of each member; those of one message have the same."""

    def lists(self) -> tuple[ViewLists, np.ndarray]:
        """What the receivers know, and the weights of the messages that they received."""
        receiver = np.repeat(np.arange(len(self.owner)), np.diff(self.ptr))
        message = np.asarray(self.views.message, np.int64)[self.member]
        both, first = np.unique(receiver * 1000 + message, return_index=True)
        ptr = np.searchsorted(both // 1000, np.arange(len(self.ptr)))
        known = ViewLists(self.ptr, self.member, self.owner, self.group, self.seed, ptr, both % 1000)
        return known, self.weight[first]

    def fused(self, align: bool = True) -> FusedBoxes:
        """What `fuse_boxes` makes of it."""
        known, weight = self.lists()
        wanted = np.ones(len(self.seed), bool)
        return fuse_boxes(self.views, known, [weight], [wanted], align=align)[0]


def scene(seed: int, n_vehicles: int = 5, n_objects: int = 12, found_p: float = 0.6, n_receivers: int = 1):
    """Vehicles with pose errors that detect objects; their true places; and the pose errors.

    Every receiver knows all detections. Vehicle v is the receiver of list v.
    """
    rng = np.random.default_rng(seed)
    place = rng.uniform(-40, 40, (n_vehicles, 2))
    true = np.column_stack([rng.uniform(-40, 40, (n_objects, 2)), np.full(n_objects, 0.8)])
    heading = rng.uniform(-np.pi, np.pi, n_objects)
    lwh = np.tile([4.5, 1.8, 1.6], (n_objects, 1)) * rng.uniform(0.9, 1.1, (n_objects, 3))
    label = np.where(rng.random(n_objects) < 0.2, 3, 0).astype(np.uint8)
    error = rng.standard_normal((n_vehicles, 3)) * np.sqrt([POSE_M2, POSE_M2, TURN_RAD2])
    vehicle, thing = np.nonzero(rng.random((n_vehicles, n_objects)) < found_p)
    d = len(vehicle)
    along, across, turn = rng.uniform(0.05, 0.4, d), rng.uniform(0.05, 0.2, d), rng.uniform(-np.pi, np.pi, d)
    cos, sin = np.cos(turn), np.sin(turn)
    noise = rng.standard_normal((d, 2)) * np.column_stack([along, across])
    noise = np.column_stack([cos * noise[:, 0] - sin * noise[:, 1], sin * noise[:, 0] + cos * noise[:, 1]])
    xyz = true[thing].copy()
    away = xyz[:, :2] - place[vehicle]
    xyz[:, :2] += error[vehicle, :2] + error[vehicle, 2:] * np.column_stack([-away[:, 1], away[:, 0]]) + noise
    spread, size = rng.uniform(0.02, 0.2, d), rng.uniform(0.02, 0.1, d)
    flipped = np.where(rng.random(d) < 0.1, np.pi, 0.0)
    yaw = heading[thing] + error[vehicle, 2] + spread * rng.standard_normal(d) + flipped
    said = np.where(rng.random(d) < 0.1, 3 - label[thing], label[thing]).astype(np.uint8)
    boxes = Boxes(xyz, lwh[thing] * np.exp(size[:, None] * rng.standard_normal((d, 3))), yaw)
    accuracy = StatedAccuracy(
        variance_m2=np.column_stack([
            along**2 * cos**2 + across**2 * sin**2, (along**2 - across**2) * cos * sin,
            along**2 * sin**2 + across**2 * cos**2,
        ]),
        heading_variance=spread**2,
        size_variance=size**2,
        origin_m=place + error[:, :2],
        pose_variance=np.tile([POSE_M2, TURN_RAD2], (n_vehicles, 1)),
    )  # fmt: skip
    member, group, seeds, n_groups = [], [], [], 0
    for owner in range(n_receivers):
        order = np.lexsort((np.arange(d), vehicle, vehicle != owner))
        numbers: dict[int, int] = {}
        for row in order.tolist():
            if thing[row] not in numbers:
                numbers[thing[row]] = n_groups + len(numbers)
                seeds.append(row)
            group.append(numbers[thing[row]])
        member.append(order)
        n_groups += len(numbers)
    weight = np.where(rng.random((n_receivers, n_vehicles)) < 0.2, rng.choice([0.0, 0.5], n_vehicles), 1.0)
    np.fill_diagonal(weight, 1.0)
    made = Scene(
        views=ObjectViews(boxes, said, vehicle, accuracy),
        ptr=np.arange(n_receivers + 1) * d,
        member=np.concatenate(member),
        owner=np.arange(n_receivers),
        group=np.array(group),
        seed=np.array(seeds),
        weight=np.concatenate([weight[v, vehicle[rows]] for v, rows in enumerate(member)]),
    )
    return made, true, place, error, thing


def turned(x, y):
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])


def literal(s: Scene, align: bool = True):
    """The one receiver's boxes: pose errors and objects together, by dense least squares, object by object."""
    b, a = s.views.boxes, s.views.accuracy
    owner = int(s.owner[0])
    groups = [[int(s.member[p]) for p in np.flatnonzero(s.group == g)] for g in range(len(s.seed))]
    weight = {int(m): float(w) for m, w in zip(s.member, s.weight, strict=True)} | {int(d): 1.0 for d in s.seed}
    shares = set()
    for members in groups:
        used = [d for d in members if weight[d] > 0]
        shares |= {int(s.views.message[d]) for d in used} if len(used) > 1 else set()
    aligned = sorted((shares if align else set()) | {owner})
    column = {v: 3 * k for k, v in enumerate(aligned)}
    n = 3 * len(aligned)
    robust = dict.fromkeys(weight, 1.0)

    def noise(d, seed):
        r = a.variance_m2[d]
        cov = np.array([[r[0], r[1]], [r[1], r[2]]])
        if s.views.label[d] != s.views.label[seed]:
            half = 0.5 * (b.lwh_m[d, :2] - b.lwh_m[seed, :2])
            cos, sin = math.cos(b.yaw_rad[seed]), math.sin(b.yaw_rad[seed])
            turn = np.array([[cos, -sin], [sin, cos]])
            cov = cov + turn @ np.diag(half**2) @ turn.T
        v = int(s.views.message[d])
        if v not in column:
            for other in (v,) if align else (v, owner):
                h = turned(*(b.xyz_m[d, :2] - a.origin_m[other]))
                cov = cov + h @ np.diag(a.pose_variance[other][[0, 0, 1]]) @ h.T
        return cov / weight[d]

    for _ in range(3):
        rows, right = [], []
        for v in aligned:
            for c in range(3):
                row = np.zeros(n + 2 * len(groups))
                row[column[v] + c] = 1 / math.sqrt(a.pose_variance[v, 1 if c == 2 else 0] if align else 1e-10)
                rows.append(row)
                right.append(0.0)
        for g, members in enumerate(groups):
            for d in members:
                if weight[d] == 0:
                    continue
                root = np.linalg.cholesky(np.linalg.inv(noise(d, int(s.seed[g]))) * robust[d]).T
                block = np.zeros((2, n + 2 * len(groups)))
                block[:, n + 2 * g : n + 2 * g + 2] = np.eye(2)
                v = int(s.views.message[d])
                if v in column:
                    block[:, column[v] : column[v] + 3] = turned(*(b.xyz_m[d, :2] - a.origin_m[v]))
                rows += list(root @ block)
                right += list(root @ b.xyz_m[d, :2])
        matrix = np.array(rows)
        covariance = np.linalg.inv(matrix.T @ matrix)
        solution = covariance @ matrix.T @ np.array(right)
        used = dict(robust)
        for g, members in enumerate(groups):
            if len(members) < 2:
                continue
            for d in members:
                if weight[d] > 0:
                    v = int(s.views.message[d])
                    rest = b.xyz_m[d, :2] - solution[n + 2 * g : n + 2 * g + 2]
                    if v in column:
                        rest = rest - turned(*(b.xyz_m[d, :2] - a.origin_m[v])) @ solution[column[v] : column[v] + 3]
                    robust[d] = 1 / (1 + rest @ np.linalg.inv(noise(d, int(s.seed[g]))) @ rest / 6)
    box, variance = [], []
    for g, members in enumerate(groups):
        seed = int(s.seed[g])
        x = solution[n + 2 * g : n + 2 * g + 2]
        here = turned(*(x - a.origin_m[owner]))
        slope = np.zeros((2, len(solution)))
        slope[:, n + 2 * g : n + 2 * g + 2] = np.eye(2)
        slope[:, column[owner] : column[owner] + 3] = here
        variance.append(slope @ covariance @ slope.T)
        xy = x + here @ solution[column[owner] : column[owner] + 3]
        circle, sizes, bottom, direction = 0j, np.zeros(4), np.zeros(2), []
        own_turn, own_spread = solution[column[owner] + 2], covariance[column[owner] + 2, column[owner] + 2]
        for d in members:
            if weight[d] == 0 or s.views.label[d] != s.views.label[seed]:
                continue
            v, w = int(s.views.message[d]), weight[d] * used[d]
            angle, spread = b.yaw_rad[d], a.heading_variance[d]
            if v != owner:
                turn = solution[column[v] + 2] if v in column else 0.0
                angle = angle + own_turn - turn
                spread = spread + (own_spread if align else a.pose_variance[owner, 1])
                spread += covariance[column[v] + 2, column[v] + 2] if v in column else a.pose_variance[v, 1]
            circle += w / spread * np.exp(2j * angle)
            sizes += w / a.size_variance[d] * np.append(np.log(b.lwh_m[d]), 1.0)
            flat = w / (a.variance_m2[d, 0] + a.variance_m2[d, 2])
            bottom += flat * np.array([b.xyz_m[d, 2] - b.lwh_m[d, 2] / 2, 1.0])
            direction.append((w, b.yaw_rad[d]))
        axis = 0.5 * np.angle(circle)
        if sum(w * math.cos(y - axis) for w, y in direction) < 0:
            axis += math.pi
        lwh = np.exp(sizes[:3] / sizes[3])
        box.append([*xy, bottom[0] / bottom[1] + lwh[2] / 2, *lwh, axis])
    return np.array(box), np.array(variance)


@pytest.mark.parametrize("align", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_twin(seed, align):
    s, *_ = scene(seed, n_objects=3 + seed, found_p=0.3 + 0.08 * seed)
    box, variance = literal(s, align)
    found = s.fused(align)
    np.testing.assert_allclose(found.columns()[:, :6], box[:, :6], atol=1e-8)
    np.testing.assert_allclose(np.exp(1j * found.boxes.yaw_rad), np.exp(1j * box[:, 6]), atol=1e-8)
    np.testing.assert_allclose(found.variance_m2, variance[:, [0, 0, 1], [0, 1, 1]], atol=1e-9)


def test_two_detections_by_hand():
    """The receiver at the origin is exact. It sees an object at x = 10 with a variance of 0.04; another vehicle, which
    knows its place to 0.3 m and stands beside the object, says 10.07 with a variance of 0.01. The second one counts
    with 0.01 + 0.09 = 0.1. Mean: (10 / 0.04 + 10.07 / 0.1) / (25 + 10) = 350.7 / 35 = 10.02; variance 1 / 35. The
    residuals, 0.02^2 / 0.04 and 0.05^2 / 0.1, reduce the weights by less than a hundredth."""
    boxes = boxes_at([[10.0, 0, 1], [10.07, 0, 1]], (4.0, 2, 2))
    accuracy = StatedAccuracy(
        np.array([[0.04, 0, 0.04], [0.01, 0, 0.01]]), np.full(2, 0.01), np.full(2, 0.01),
        np.array([[0.0, 0], [10.07, 0]]), np.array([[0.0, 0], [0.09, 0]]),
    )  # fmt: skip
    views = ObjectViews(boxes, np.zeros(2, np.uint8), np.array([0, 1]), accuracy)
    one = np.array([0])
    s = Scene(views, np.array([0, 2]), np.array([0, 1]), one, np.zeros(2, int), one, np.ones(2))
    # One object says nothing new about where the other vehicle is: alignment gives the same.
    for found in (s.fused(align=False), s.fused()):
        assert found.variance_m2[0, 0] == pytest.approx(1 / 35, rel=0.01)
        assert found.boxes.xyz_m[0, 0] == pytest.approx(10.02, abs=1e-4)


def test_a_pose_error_counts_once():
    """Vehicle 1 reports one object three times, each with the variance 0.03. Their mean has 0.01. On top of it there
    are the vehicle's pose error of 0.04 and the receiver's of 0.04."""
    boxes = boxes_at(np.tile([10.0, 0, 1], (3, 1)), (4.0, 2, 2))
    accuracy = StatedAccuracy(
        np.tile([0.03, 0, 0.03], (3, 1)), np.full(3, 0.01), np.full(3, 0.01), np.zeros((2, 2)),
        np.tile([0.04, 0.0], (2, 1)),
    )  # fmt: skip
    views, zero = ObjectViews(boxes, np.zeros(3, np.uint8), np.ones(3, int), accuracy), np.array([0])
    s = Scene(views, np.array([0, 3]), np.arange(3), zero, np.zeros(3, int), zero, np.ones(3))
    assert s.fused().variance_m2[0] == pytest.approx([0.09, 0, 0.09], abs=1e-5)


def test_shared_objects_reveal_the_offset_of_a_vehicle():
    """A vehicle that is off by 0.3 m sees nine objects that the receiver sees, and one that the receiver does not."""
    rng = np.random.default_rng(1)
    true = np.column_stack([rng.uniform(5, 40, 10), rng.uniform(-20, 20, 10), np.ones(10)])
    offset = np.array([0.3, -0.2, 0.0])
    boxes = boxes_at(np.concatenate([true[:9], true + offset]), (4.0, 2, 2))
    accuracy = StatedAccuracy(
        np.tile([0.01, 0, 0.01], (19, 1)), np.full(19, 0.01), np.full(19, 0.01), np.array([[0.0, 0], [20, 0]]),
        np.tile([POSE_M2, TURN_RAD2], (2, 1)),
    )  # fmt: skip
    views = ObjectViews(boxes, np.zeros(19, np.uint8), np.repeat([0, 1], [9, 10]), accuracy)
    group = np.concatenate([np.arange(9), np.arange(10)])
    s = Scene(views, np.array([0, 19]), np.arange(19), np.array([0]), group, np.append(np.arange(9), 18), np.ones(19))
    found, plain = s.fused(), s.fused(align=False)
    assert np.hypot(*(found.boxes.xyz_m[9, :2] - true[9, :2])) < 0.05
    assert found.variance_m2[9, 0] < 0.03 < POSE_M2 * 2 < plain.variance_m2[9, 0]
    assert np.abs(found.boxes.xyz_m[:9, :2] - true[:9, :2]).max() < 0.05


def test_a_displaced_detection_moves_little():
    """Three vehicles agree; a fourth says 3 m away. Its pose is as uncertain as theirs."""
    s, _, _, _, thing = scene(3, n_vehicles=4, n_objects=10, found_p=1.0)
    s = replace(s, weight=np.ones(len(s.member)))
    victim = np.flatnonzero((s.views.message == 3) & (thing == 0))
    xyz = s.views.boxes.xyz_m.copy()
    xyz[victim, 0] += 3.0
    moved = replace(s, views=s.views._replace(boxes=replace(s.views.boxes, xyz_m=xyz)))
    before, after = s.fused().boxes.xyz_m, moved.fused().boxes.xyz_m
    assert 0 < np.abs(after - before).max() < 0.15


def test_headings_of_opposite_directions_and_at_the_branch_cut():
    """Headings 3.1 and -3.1 have the mean pi; 0.1 and pi + 0.12 are one axis, whose direction the majority says."""
    for yaw, want in (
        ([3.1, -3.1], np.pi),
        ([0.1, np.pi + 0.12, 0.11], 0.11),
        ([0.1, np.pi + 0.1, np.pi + 0.1], -3.04),
    ):
        n = len(yaw)
        accuracy = StatedAccuracy(
            np.tile([0.01, 0, 0.01], (n, 1)), np.full(n, 0.01), np.full(n, 0.01), np.zeros((n, 2)),
            np.tile([POSE_M2, 0.0], (n, 1)),
        )  # fmt: skip
        boxes = boxes_at(np.tile([9.0, 0, 1], (n, 1)), yaw_rad=np.array(yaw))
        views = ObjectViews(boxes, np.zeros(n, np.uint8), np.arange(n), accuracy)
        one = np.array([0])
        s = Scene(views, np.array([0, n]), np.arange(n), one, np.zeros(n, int), one, np.ones(n))
        found = s.fused().boxes.yaw_rad[0]
        assert abs(np.exp(1j * found) - np.exp(1j * want)) < 0.01
        assert -np.pi < found <= np.pi


def test_the_result_does_not_depend_on_threads():
    s, *_ = scene(6, n_vehicles=9, n_objects=30, n_receivers=8)
    before, results = n_threads(), []
    for n in (1, before):
        use_threads(n)
        results.append(s.fused())
    use_threads(before)
    np.testing.assert_array_equal(results[0].columns(), results[1].columns())
    np.testing.assert_array_equal(results[0].variance_m2, results[1].variance_m2)


def squares(factor: float) -> np.ndarray:
    """Squared normalised errors of fused boxes in 300 drawn scenes, whose vehicles state `factor` times the variance.

    The receiver is vehicle 0; the error is that relative to it.
    """
    found = []
    for seed in range(300):
        s, true, place, error, thing = scene(1000 + seed, n_objects=8)
        a = s.views.accuracy
        stated = a._replace(variance_m2=factor * a.variance_m2, pose_variance=factor * a.pose_variance)
        same = np.zeros_like(s.views.label)  # classes are not confused here
        s = replace(s, views=s.views._replace(accuracy=stated, label=same), weight=np.ones(len(s.member)))
        fused = s.fused()
        target = true[thing[s.seed], :2]
        away = target - place[0]
        target = target + error[0, :2] + error[0, 2] * np.column_stack([-away[:, 1], away[:, 0]])
        x, y = (fused.boxes.xyz_m[:, :2] - target).T
        xx, xy, yy = fused.variance_m2.T
        found.append((yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy) / 2)
    return np.concatenate(found)


def test_the_stated_covariance_is_true():
    """The mean square of normalised errors is 1, in spite of pose errors that many detections have in common. Robust
    weights cost some information where errors are normal. Half and twice the variance are noticed."""
    assert 0.8 < squares(1.0).mean() < 1.1
    assert not 0.8 < squares(2.0).mean() < 1.25
    assert not 0.8 < squares(0.5).mean() < 1.25


@pytest.mark.parametrize("least", [0.1, 0.25, 0.5, 0.7])
@pytest.mark.parametrize("sigma", [(0.1, 0.1), (0.6, 0.2), (0.5, 0.5), (1.5, 1.0)])
def test_overlap_against_drawn_displacements(least, sigma):
    """Within 0.03 of the share of 4,000 drawn displacements, of which the deviation is at most 0.008."""
    rng = np.random.default_rng(0)
    n, size = 4000, np.array([4.5, 1.8, 1.6])
    off = rng.standard_normal((n, 2)) * sigma
    boxes = boxes_at(np.column_stack([off, np.zeros(n)]), size)
    there = boxes_at(np.zeros((n, 3)), size)
    drawn = (iou_3d(boxes, there) > least).mean()
    one = FusedBoxes(Boxes(np.zeros((1, 3)), size[None], np.zeros(1)), np.array([[sigma[0] ** 2, 0, sigma[1] ** 2]]))
    assert overlap_p(one, least)[0] == pytest.approx(drawn, abs=0.03)


def test_overlap_of_a_box_that_is_turned():
    """Turned by 90 degrees, the variance along the box is that along y."""
    size, variance = np.array([[4.5, 1.8, 1.6]]), np.array([[0.04, 0.0, 0.49]])
    along_x = FusedBoxes(Boxes(np.zeros((1, 3)), size, np.zeros(1)), variance[:, ::-1])
    along_y = FusedBoxes(Boxes(np.zeros((1, 3)), size, np.full(1, np.pi / 2)), variance)
    assert overlap_p(along_y, 0.5)[0] == pytest.approx(overlap_p(along_x, 0.5)[0])


def test_nothing():
    none = np.zeros(0, int)
    s, *_ = scene(1)
    empty = Scene(s.views, np.array([0, 0]), none, np.array([0]), none, none, np.zeros(0))
    assert len(empty.fused().boxes) == 0
