"""Average precision: equal to the KITTI program's, by hand, and the rules one by one."""

import gzip
import json

import numpy as np
import pytest

from cosim.addons.perception import kitti, overlap
from tests import SHARED

REFERENCE = SHARED / "reference/trupercept"


def read_labels(files):
    """KITTI text files, one per frame, ground truth or detections.

    KITTI's camera frame (x right, y down, z forward; bottom of the box; turn about y) becomes x right, y
    forward, z up, centre of the box, counter-clockwise.
    """
    lines = [
        (n, line.split()) for n, file in enumerate(files) for line in file.read_text().splitlines() if line.strip()
    ]
    values = np.array([[float(v) for v in words[1:16]] + [np.nan] * (16 - len(words)) for _, words in lines])
    values = values.reshape(-1, 15)
    height, width, length, x, bottom, z, turn = values[:, 7:14].T
    return kitti.LabelledObjects(
        frame=np.array([n for n, _ in lines], int),
        label=np.array([words[0].lower() for _, words in lines], object),
        box=np.column_stack([x, z, height / 2 - bottom, length, width, height, -turn]),
        height_px=values[:, 6] - values[:, 4],
        occlusion=values[:, 1].astype(int),
        truncation=values[:, 0],
        score=values[:, 14],
    )


def reference_sets():
    if not REFERENCE.is_dir():
        return []
    return json.loads(gzip.open(REFERENCE / "h_kitti_ap.json.gz").read())["cases"]


@pytest.fixture(scope="module")
def sets():
    if not reference_sets():
        pytest.skip(f"no reference data at {REFERENCE}")
    loaded = {}
    for case in reference_sets():
        folder = REFERENCE / "kitti_ap" / case["set"]
        found = sorted((folder / "results/data").glob("*.txt"))
        loaded[case["set"]] = (
            read_labels([folder / "label_2" / file.name for file in found]), read_labels(found), case
        )  # fmt: skip
    return loaded


@pytest.mark.parametrize(
    "program, limits",
    [("evaluate_object_3d_offline", kitti.STRICT), ("evaluate_object_3d_offline_05_iou", kitti.LOOSE)],
)
@pytest.mark.parametrize("box, suffix", [("3d", "_3D"), ("bev", "_BEV")])
def test_equals_the_kitti_program(sets, program, limits, box, suffix):
    for name, (truth, found, case) in sets.items():
        result = case["result"][program]
        for label in ("car", "pedestrian", "cyclist"):
            answer = kitti.average_precision(truth, found, label, box, limits[label])
            for level, expected in zip(kitti.LEVELS, result["ap"][f"{label}_detection{suffix}"], strict=False):
                assert answer[level].ap11 == pytest.approx(expected, abs=1e-4), (name, label, level)
            curve = np.array(result["pr_curves_recall_easy_mod_hard"].get(f"{label}_detection{suffix}", []))
            for level in kitti.LEVELS[:3] if len(curve) else ():
                column = 1 + kitti.LEVELS.index(level)
                assert answer[level].precision == pytest.approx(curve[:, column], abs=1e-6), (name, label, level)


def objects(rows, scores=None):
    """Cars given as (frame, x, y); 4 m x 2 m x 1.5 m, 50 px high."""
    rows = np.array(rows, float).reshape(-1, 3)
    n = len(rows)
    box = np.column_stack(
        [rows[:, 1:], np.full(n, 0.75), np.full(n, 4.0), np.full(n, 2.0), np.full(n, 1.5), np.zeros(n)]
    )
    return kitti.LabelledObjects(
        rows[:, 0].astype(int), np.full(n, "car", object), box, np.full(n, 50.0), np.zeros(n, int), np.zeros(n),
        np.ones(n) if scores is None else np.array(scores),
    )  # fmt: skip


def test_perfect_detector():
    """50 cars found, nothing else: 41 thresholds, precision 1 at all of them."""
    truth = objects([(frame, 10 * k, 0) for frame in range(10) for k in range(5)])
    assert kitti.average_precision(truth, truth, "car")["easy"].ap11 == pytest.approx(100)


def test_by_hand():
    """Four cars in two frames; scores .9 hit, .8 false, .7 hit, .6 hit; one car is missed.

    Recall steps of 1/40 never skip a hit (4 cars: 1/4 per hit), so the thresholds are .9, .7, .6 with
    precisions 1/1, 2/3, 3/4; made monotone 1, .75, .75; recall samples 0, 1, 2 of 41 are filled, the rest 0.
    11 points take sample 0 only: 100/11. 40 points: (.75 + .75) / 40.
    """
    truth = objects([(0, 0, 0), (0, 10, 0), (1, 0, 0), (1, 10, 0)])
    found = objects([(0, 0.1, 0), (0, 50, 0), (0, 10.1, 0), (1, 0.1, 0)], [0.9, 0.8, 0.7, 0.6])
    answer = kitti.average_precision(truth, found, "car")["moderate"]
    assert answer.precision[:4] == pytest.approx([1, 0.75, 0.75, 0])
    assert answer.ap11 == pytest.approx(100 / 11)
    assert answer.ap40 == pytest.approx(100 * 1.5 / 40)
    assert answer.n_truth == 4


def test_ranking_is_over_all_frames():
    """Renumbering frames changes nothing; neither does an empty frame."""
    rng = np.random.default_rng(3)
    rows = np.column_stack([np.repeat(np.arange(30), 3), rng.uniform(0, 100, (90, 2))])
    truth = objects(rows)
    found = objects(rows + rng.normal(0, 0.15, rows.shape) * [0, 1, 1], rng.random(90))
    apart = [kitti.LabelledObjects(o.frame * 7 + 3, *[getattr(o, n) for n in o.__slots__[1:]]) for o in (truth, found)]
    one = kitti.average_precision(truth, found, "car")["all"]
    assert kitti.average_precision(*apart, "car")["all"].ap11 == one.ap11
    assert 5 < one.ap11 < 95


def test_nothing_there():
    nothing, one = objects([]), objects([(0, 0, 0)])
    for truth, found in ((nothing, one), (one, nothing), (nothing, nothing)):
        assert kitti.average_precision(truth, found, "car")["all"].ap11 == 0


def test_overlap_by_hand():
    """A 4 x 2 box: shifted by 1 along: 6 of 8 common, 6/10; turned by 90 degrees: 4 common, 4/12; far: 0."""
    box = np.array([[100.0, -50, 1, 4, 2, 1.5, 0]])
    for change, expected in (
        ([1, 0, 0, 0, 0, 0, 0], 6 / 10), ([0, 0, 0, 0, 0, 0, np.pi / 2], 4 / 12), ([9, 0, 0, 0, 0, 0, 0], 0),
        ([0] * 7, 1), ([0, 0, 0, 0, 0, 0, np.pi], 1),
    ):  # fmt: skip
        assert overlap.iou_bev(box, box + change) == pytest.approx(expected, abs=1e-12)
    assert overlap.iou_3d(box, box + np.array([0, 0, 0.5, 0, 0, 0, 0])) == pytest.approx(1 / 2)  # 1 m of 1.5 m common
    # Two unit squares turned by 45 degrees share a regular octagon: 2 (sqrt 2 - 1).
    square = np.array([[0.0, 0, 0, 1, 1, 1, 0.3]])
    assert overlap.footprint_overlap(square, square + np.eye(7)[6] * np.pi / 4) == pytest.approx(2 * (2**0.5 - 1))


def test_overlap_is_symmetric_and_rigid():
    rng = np.random.default_rng(0)
    a = np.column_stack([rng.uniform(-2, 2, (500, 3)), rng.uniform(0.5, 5, (500, 3)), rng.uniform(-4, 4, 500)])
    b = np.column_stack([rng.uniform(-2, 2, (500, 3)), rng.uniform(0.5, 5, (500, 3)), rng.uniform(-4, 4, 500)])
    common = overlap.footprint_overlap(a, b)
    assert overlap.footprint_overlap(b, a) == pytest.approx(common, abs=1e-9)
    turn = 1.234
    spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = []
    for box in (a, b):
        moved.append(np.column_stack([box[:, :2] @ spin.T + [1000, -700], box[:, 2:6], box[:, 6] + turn]))
    assert overlap.footprint_overlap(*moved) == pytest.approx(common, abs=1e-8)
