"""Detections that may be of one object, by stated accuracy: by hand, against a slow twin, and laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors.association import (
    LEAST_VARIANCE_M2,
    MOST_VARIANCE_M2,
    Gate,
    bounded,
    certainty,
    pairs_across,
    pairs_within,
)
from sensors.boxes import Boxes, iou_3d
from tests.sensors.town import boxes_at

CAR, PEDESTRIAN, CYCLIST, TRUCK = range(4)
GATE = Gate(0.01, 0.1)
SIZES = np.array([[4.4, 1.8, 1.6], [0.7, 0.6, 1.75], [1.8, 0.6, 1.7], [9.0, 2.5, 3.3]])


def round_variance(sigma_m, n):
    return np.tile(np.square(sigma_m) * np.array([1.0, 0.0, 1.0]), (n, 1))


def people(*x_m):
    n = len(x_m)
    xyz = np.column_stack([x_m, np.zeros((n, 2))])
    return boxes_at(xyz, SIZES[PEDESTRIAN]), np.full(n, PEDESTRIAN, np.uint8)


def test_two_boxes_of_one_person_that_hardly_overlap():
    """0.5 m apart, each known to 0.25 m along each axis: d^2 = 0.25 / (2 x 0.0625) = 2, so exp(-1) = 0.37 of all such
    pairs are farther apart. Their boxes of 0.7 m overlap by 0.2 m: an IoU of 0.2 / 1.2 = 1/6. With 0.8 m they do not
    overlap, and exp(-0.64 / 0.25) = 0.077. With 1.1 m it is exp(-1.21 / 0.25) = 0.008, below 1 %."""
    for apart_m, agrees in ((0.5, np.exp(-1.0)), (0.8, np.exp(-2.56)), (1.1, None)):
        boxes, label = people(0.0, apart_m)
        i, j, value = pairs_within(boxes, label, round_variance(0.25, 2), np.array([0, 1]), GATE)
        if agrees is None:
            assert not len(i)
        else:
            assert (i.tolist(), j.tolist()) == ([0], [1])
            np.testing.assert_allclose(value, agrees)


def test_exact_detections_match_where_they_overlap():
    """With exact positions, 0.5 m is far outside of the gate; the overlap of 1/6 remains."""
    boxes, label = people(0.0, 0.5)
    _, _, value = pairs_within(boxes, label, bounded(np.zeros((2, 3))), np.array([0, 1]), GATE)
    np.testing.assert_allclose(value, 1 / 6)


def test_the_rear_of_a_truck():
    """A vehicle behind a truck of 9 m reports a car of 4.2 m at its rear. The centres are 2.4 m apart. The difference
    of sizes explains (9 - 4.2) / 2 = 2.4 m of it, so they agree fully. 1 m farther they are 1 m apart."""
    lwh = np.array([[9.0, 2.5, 3.3], [4.2, 1.75, 1.5]])
    label, owner = np.array([TRUCK, CAR], np.uint8), np.array([0, 1])
    for shift_m, d2 in ((2.4, 0.0), (3.4, 1.0 / (2 * 0.09))):
        boxes = Boxes(np.array([[0.0, 0, 0], [-shift_m, 0, 0]]), lwh, np.zeros(2))
        _, _, value = pairs_within(boxes, label, round_variance(0.3, 2), owner, Gate(0.01, 0.9))
        if np.exp(-0.5 * d2) > 0.01:
            np.testing.assert_allclose(value, np.exp(-0.5 * d2))
        else:
            assert not len(value)


def test_a_pair_does_not_depend_on_who_else_is_there():
    """The rear of a truck of 12 m is a car of 4.5 m to another vehicle. The centres are 9.5 m apart, of which sizes
    explain 3.75 m, and sigma is 2 m for both: d^2 = 5.75^2 / 8. A truck far away changes nothing."""
    lwh = np.array([[12.0, 2.5, 2.0], [4.5, 2.5, 2.0], [18.0, 2.5, 2.0]])
    boxes = Boxes(np.array([[0.0, 0, 0], [9.5, 0, 0], [500.0, 0, 0]]), lwh, np.zeros(3))
    label = np.array([TRUCK, CAR, TRUCK], np.uint8)
    for rows in (np.arange(2), np.arange(3)):
        i, j, value = pairs_within(boxes.take(rows), label[rows], round_variance(2.0, len(rows)), rows, Gate(0.01, 0.1))
        assert (i.tolist(), j.tolist()) == ([0], [1])
        np.testing.assert_allclose(value, np.exp(-0.5 * 5.75**2 / 8))


def test_on_a_bridge_and_below():
    """Cars of 1.5 m, one above the other: at 2.4 m, 0.9 m are between them, as where a box was moved along a steep
    road; at 6 m, as on a bridge, they are two cars."""
    lwh, label, owner = np.array([4.5, 1.8, 1.5]), np.zeros(2, np.uint8), np.array([0, 1])
    for above_m, agrees in ((0.0, [1.0]), (2.4, [1.0]), (-2.4, [1.0]), (6.0, []), (-6.0, [])):
        boxes, variance = boxes_at(np.array([[0.0, 0, 0], [0, 0, above_m]]), lwh), round_variance(0.3, 2)
        for found in (
            pairs_within(boxes, label, variance, owner, GATE),
            pairs_across(
                *(boxes.take([0]), label[:1], variance[:1]), *(boxes.take([1]), label[1:], variance[1:]), GATE
            ),
        ):
            np.testing.assert_allclose(found[2], agrees)


def slowly(a, a_label, a_var, b, b_label, b_var):
    """The definition, pair by pair."""
    found, n = {}, len(b)
    each = np.repeat(np.arange(len(a)), n)
    other = np.tile(np.arange(n), len(a))
    ious = iou_3d(a.take(each), b.take(other))
    groups = {CAR: 0, TRUCK: 0, PEDESTRIAN: 1, CYCLIST: 1}
    for i in range(len(a)):
        for j in range(n):
            if groups[int(a_label[i])] != groups[int(b_label[j])]:
                continue
            apart = a.xyz_m[i, :2] - b.xyz_m[j, :2]
            longer = a.yaw_rad[i] if a.lwh_m[i, 0] >= b.lwh_m[j, 0] else b.yaw_rad[j]
            axes = np.array([[np.cos(longer), np.sin(longer)], [-np.sin(longer), np.cos(longer)]])
            local = axes @ apart
            slack = np.abs(a.lwh_m[i, :2] - b.lwh_m[j, :2]) / 2
            local = np.sign(local) * np.maximum(np.abs(local) - slack, 0)
            apart = axes.T @ local
            xx, xy, yy = a_var[i] + b_var[j]
            p = np.exp(-0.5 * apart @ np.linalg.solve(np.array([[xx, xy], [xy, yy]]), apart))
            iou = ious[i * n + j]
            value = max(p if p > GATE.miss_p else 0.0, iou if iou > GATE.least_iou else 0.0)
            if value > 0:
                found[i, j] = value
    return found


def crowd(seed, n=60):
    rng = np.random.default_rng(seed)
    label = rng.integers(0, 4, n).astype(np.uint8)
    xyz = np.column_stack([rng.uniform(0, 25, (n, 2)), np.zeros(n)])
    boxes = Boxes(xyz, SIZES[label] * rng.uniform(0.9, 1.1, (n, 3)), rng.uniform(-np.pi, np.pi, n))
    root = rng.normal(0, 0.4, (n, 2, 2))
    full = root @ root.transpose(0, 2, 1)
    variance = bounded(np.column_stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]]))
    return boxes, label, variance


@pytest.mark.parametrize("seed", range(3))
def test_against_the_slow_twin(seed):
    boxes, label, variance = crowd(seed)
    owner = np.random.default_rng(seed + 50).integers(0, 6, len(boxes))
    i, j, value = pairs_within(boxes, label, variance, owner, GATE)
    every = slowly(boxes, label, variance, boxes, label, variance)
    expected = {pair: v for pair, v in every.items() if pair[0] < pair[1] and owner[pair[0]] != owner[pair[1]]}
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == sorted(expected)
    np.testing.assert_allclose(value, [expected[pair] for pair in sorted(expected)], rtol=1e-9)
    a, b = np.arange(0, 30), np.arange(30, 60)
    i, j, value = pairs_across(boxes.take(a), label[a], variance[a], boxes.take(b), label[b], variance[b], GATE)
    expected = slowly(boxes.take(a), label[a], variance[a], boxes.take(b), label[b], variance[b])
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == sorted(expected)
    np.testing.assert_allclose(value, [expected[pair] for pair in sorted(expected)], rtol=1e-9)


def test_an_enormous_box_a_far_place_and_an_unknown_class():
    """Cells grow with the largest box, places are bounded, and labels that are no classes go with none."""
    boxes, label, variance = crowd(4)
    lwh_m, xyz_m = boxes.lwh_m.copy(), boxes.xyz_m.copy()
    lwh_m[3] = 1e6
    xyz_m[5, :2], xyz_m[6, :2] = 1e300, -1e300
    boxes = Boxes(xyz_m, lwh_m, boxes.yaw_rad)
    with np.errstate(over="ignore", invalid="ignore"):  # the slow twin adds infinite terms; the order is BLAS's
        expected = slowly(boxes, label, variance, boxes, label, variance)
    label = np.where(np.arange(len(label)) == 7, 200, label).astype(np.uint8)
    i, j, _ = pairs_within(boxes, label, variance, np.arange(len(boxes)), GATE)
    expected = sorted((a, b) for a, b in expected if a < b and 7 not in (a, b))
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected


def test_the_gate_keeps_the_share_it_says():
    """Of pairs of one object with the stated errors, 99 % are within the gate of 1 %."""
    rng = np.random.default_rng(8)
    n = 4000
    root = np.array([[0.6, 0.0], [0.3, 0.2]])
    full = root @ root.T
    place = np.column_stack([np.arange(n) * 20.0, np.zeros(n), np.zeros(n)])
    a, b = (place + np.column_stack([rng.normal(size=(n, 2)) @ root.T, np.zeros(n)]) for _ in range(2))
    lwh, label = np.tile([0.01, 0.01, 1.0], (2 * n, 1)), np.full(2 * n, PEDESTRIAN, np.uint8)
    variance = np.tile([full[0, 0], full[0, 1], full[1, 1]], (2 * n, 1))
    boxes = Boxes(np.concatenate([a, b]), lwh, np.zeros(2 * n))
    i, j, _ = pairs_within(boxes, label, variance, np.repeat([0, 1], n), GATE)
    share = (j - i == n).sum() / n
    assert abs(share - 0.99) < 3 * np.sqrt(0.99 * 0.01 / n)


NUMBER = st.floats(-1e6, 1e6, allow_nan=False)


@settings(max_examples=200)
@given(st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=1, max_size=5))
def test_bounded_variances_are_variances_within_the_bounds(rows):
    found = bounded(np.array(rows))
    for xx, xy, yy in found:
        low, high = np.linalg.eigvalsh([[xx, xy], [xy, yy]])
        assert LEAST_VARIANCE_M2 * (1 - 1e-6) - 1e-9 <= low and high <= MOST_VARIANCE_M2 * (1 + 1e-6)
    np.testing.assert_allclose(bounded(found), found, rtol=1e-6, atol=1e-9)


def test_what_is_no_variance_is_the_largest_one():
    strange = np.array([[np.nan, 0, 1], [np.inf, 0, 1], [1, 2, 1], [-1, 0, 1], [1e30, 0, 1e30]])
    np.testing.assert_allclose(bounded(strange), np.tile([MOST_VARIANCE_M2, 0, MOST_VARIANCE_M2], (5, 1)))
    np.testing.assert_allclose(bounded(np.zeros((1, 3))), [[LEAST_VARIANCE_M2, 0, LEAST_VARIANCE_M2]])


def test_certainty_is_a_ratio_of_areas():
    """Standard deviations of 8 m and 0.5 m, of which 2 m count: a quarter of the region. Within the bounds: all."""
    np.testing.assert_allclose(certainty(np.array([[64.0, 0, 0.25], [1.0, 0.3, 0.5]])), [0.25, 1.0])
