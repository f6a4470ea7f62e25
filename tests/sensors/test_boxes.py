"""Boxes: overlap by hand, by Shapely, and against the paper's own vectors."""

import numpy as np
import pytest
from hypothesis import given, settings

from sensors.boxes import Boxes, extrapolated, iou_3d, overlapping_pairs
from tests import solids
from tests.seeds import seeds
from tests.sensors.town import cases, from_camera, random_boxes


def by_shapely(a: Boxes, b: Boxes) -> np.ndarray:
    one, other = (np.column_stack([of.xyz_m, of.lwh_m, of.yaw_rad]) for of in (a, b))
    return np.array([solids.iou(*pair) for pair in zip(one, other, strict=True)])


def test_by_hand():
    # unit cubes: one moved by half a side shares 1/2 of 3/2; one turned by 45 degrees shares the regular octagon
    # 2 (sqrt 2 - 1) = 0.8284 of 2 - 0.8284; one moved by a full side only touches
    a = Boxes(np.zeros((3, 3)), np.ones((3, 3)), np.zeros(3))
    b = Boxes(np.array([[0.5, 0, 0], [0, 0, 0], [1, 0, 0]]), np.ones((3, 3)), np.array([0, np.pi / 4, 0]))
    octagon = 2 * (np.sqrt(2) - 1)
    assert iou_3d(a, b) == pytest.approx([1 / 3, octagon / (2 - octagon), 0.0], abs=1e-15)


def test_reference_vectors():
    found = cases("a_iou3d")
    a, b = (
        from_camera(
            *(
                [[c[k]["x"], c[k]["y"], c[k]["z"]] for c in found],
                *([c[k][d] for c in found] for d in ("h", "w", "l", "ry")),
            )
        )
        for k in ("a", "b")
    )
    assert iou_3d(a, b) == pytest.approx([c["exact_3d"] for c in found], abs=1e-12)
    assert iou_3d(a, b) == pytest.approx([c["iou_kitti_cpp_3d"] for c in found], abs=1e-6)  # float32 in there


@settings(max_examples=20)
@given(seed=seeds)
def test_symmetry_identity_and_rigid_motion(seed):
    rng = np.random.default_rng(seed)
    a, b = random_boxes(rng, 60, 3.0)[0], random_boxes(rng, 60, 3.0)[0]
    iou = iou_3d(a, b)
    assert iou == pytest.approx(by_shapely(a, b), abs=1e-9)
    assert (iou == iou_3d(b, a)).all()
    assert iou_3d(a, a) == pytest.approx(np.ones(60), abs=1e-12)
    turn, shift = rng.uniform(-4, 4), rng.uniform(-1000, 1000, 3)
    assert iou == pytest.approx(iou_3d(moved(a, turn, shift), moved(b, turn, shift)), abs=1e-9)


def moved(boxes: Boxes, turn: float, shift) -> Boxes:
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return Boxes(boxes.xyz_m @ rotation.T + shift, boxes.lwh_m, boxes.yaw_rad + turn)


@settings(max_examples=15)
@given(seed=seeds)
def test_overlapping_pairs_are_all_pairs(seed):
    rng = np.random.default_rng(seed)
    boxes, _ = random_boxes(rng, 80)
    label, owner = rng.integers(0, 3, 80).astype(np.uint8), rng.integers(0, 8, 80)
    i, j = np.triu_indices(80, 1)
    keep = (label[i] == label[j]) & (owner[i] != owner[j])
    i, j = i[keep], j[keep]
    iou = iou_3d(boxes.take(i), boxes.take(j))
    found_i, found_j, found = overlapping_pairs(boxes, label, owner)
    assert (found_i == i[iou > 0]).all() and (found_j == j[iou > 0]).all() and (found == iou[iou > 0]).all()
    swap = rng.permutation(80)
    found_i, found_j, found = overlapping_pairs(boxes.take(swap), label[swap], owner[swap])
    named = {(min(a, b), max(a, b), v) for a, b, v in zip(swap[found_i], swap[found_j], found, strict=True)}
    assert named == set(zip(i[iou > 0], j[iou > 0], iou[iou > 0], strict=True))


def test_no_pairs():
    none = Boxes.concat([])
    assert [len(part) for part in overlapping_pairs(none, np.zeros(0, np.uint8), np.zeros(0, int))] == [0, 0, 0]
    assert len(iou_3d(none, none)) == 0


@pytest.mark.parametrize(
    ("lwh", "yaw", "says"),
    [
        ((0, 1.8, 1.5), 0.0, "must be positive"),
        ((4, 1.8, 1.5), np.nan, "not finite"),
        ((4, np.inf, 1.5), 0.0, "not finite"),
    ],
)
def test_bad_boxes_are_refused(lwh, yaw, says):
    with pytest.raises(ValueError, match=says):
        Boxes(np.zeros((1, 3)), np.array([lwh]), np.array([yaw]))
    with pytest.raises(ValueError, match="shape"):
        Boxes(np.zeros((2, 3)), np.ones((1, 3)), np.zeros(2))


def test_extrapolation_by_hand():
    # 0.5 s at 10 m/s east and 2 m/s south is 5 m east and 1 m south; an absent velocity, or half of one, moves nothing
    boxes = Boxes(np.tile([1.0, 2.0, 3.0], (3, 1)), np.ones((3, 3)), np.array([0.0, 1.0, 2.0]))
    velocity = np.array([[10.0, -2.0], [np.nan, np.nan], [4.0, np.nan]])
    moved = extrapolated(boxes, velocity, 0.5)
    assert (moved.xyz_m == [[6.0, 1.0, 3.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]]).all()
    assert (moved.yaw_rad == boxes.yaw_rad).all() and (moved.lwh_m == boxes.lwh_m).all()
    assert (boxes.xyz_m == [1.0, 2.0, 3.0]).all(), "the given boxes stay"
    own = extrapolated(boxes, np.tile([1.0, 0.0], (3, 1)), np.array([0.0, 1.0, -2.0]))
    assert own.xyz_m[:, 0].tolist() == [1.0, 2.0, -1.0]


def test_extrapolation_used_wrongly():
    boxes = Boxes(np.zeros((2, 3)), np.ones((2, 3)), np.zeros(2))
    with pytest.raises(ValueError, match="one per box"):
        extrapolated(boxes, np.zeros((3, 2)), 1.0)
    with pytest.raises(ValueError, match="finite"):
        extrapolated(boxes, np.zeros((2, 2)), np.array([1.0, np.nan]))
    assert len(extrapolated(boxes.take(np.zeros(0, int)), np.zeros((0, 2)), 1.0)) == 0


def test_a_mask_takes_the_rows_that_it_marks():
    boxes = Boxes(np.arange(9.0).reshape(3, 3), np.ones((3, 3)), np.zeros(3))
    marked = np.array([False, True, True])
    assert boxes.take(marked).xyz_m.tolist() == boxes.take(np.array([1, 2])).xyz_m.tolist() == [[3, 4, 5], [6, 7, 8]]
