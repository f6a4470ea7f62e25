"""Data sets through matching, fusion and metrics: a hand-made scene, and what our own exporters write."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from cosim.offline.evaluate import evaluate, layout_of
from cosim.offline.export import export
from results.archive import open_run
from results.datasets import kitti_folder, opv2v
from results.datasets.recorded import corners_of
from results.metrics.kitti import average_precision
from tests.drive import cosim, drive
from tests.results.datasets.test_readers import dair_folder, opv2v_file, vehicle


def car(x: float, y: float) -> list[float]:
    return [x, y, 0.75, 4.4, 1.8, 1.5, 0.0]


def scene(folder, near=True):
    """Cars A, B, C. The ego finds A well, B badly and a weak ghost; its partner finds B well and C."""
    cars = {11: car(10, 0), 12: car(30, 5), 13: car(60, -5)}
    opv2v_file(folder / "s/0/000000.yaml", [0, 0, 1.7, 0, 0, 0], {k: vehicle(b) for k, b in cars.items()})
    away = 40 if near else 90
    opv2v_file(folder / "s/1/000000.yaml", [away, 0, 1.7, 0, 0, 0], {k: vehicle(b) for k, b in cars.items()})
    own = np.array([car(10, 0), car(31.2, 5), car(80, 20)]), [0.9, 0.4, 0.3]
    theirs = np.array([car(30 - away, 5), car(60 - away, -5)]), [0.8, 0.7]
    for agent, (box, score) in (("0", own), ("1", theirs)):
        box[:, 2] -= 1.7
        np.save(folder / f"s/{agent}/000000_pred.npy", corners_of(box))
        np.save(folder / f"s/{agent}/000000_score.npy", np.array(score))
    return folder


def by_method(table: pd.DataFrame, overlap: float) -> dict[str, float]:
    return table[(table.overlap == overlap)].set_index("method").ap.to_dict()


def test_by_hand(tmp_path):
    about, table = evaluate(scene(tmp_path))
    about.pop("trust")
    assert about == {
        "layout": "opv2v", "frames": 1, "agents": 2, "objects": 3, "boxes": 5, "frames_without_clouds": 1,
        "egos": {"0": 1}, "classes": {"car": {"Car": 6}}, "remarks": [], "boxes_left_out": 0,
    }  # fmt: skip
    # B of the ego is 1.2 m off: IoU 3.2 / 5.6 = 0.571. Alone at 0.5: A and B right, the ghost last: 2 of 3 objects
    assert by_method(table, 0.5)["ego"] == pytest.approx(100 * 2 / 3)
    assert by_method(table, 0.7)["ego"] == pytest.approx(100 / 3)
    # late: the partner's B, 0.8, suppresses the ego's, 0.4; A, B, C are right before the ghost
    assert by_method(table, 0.7)["late"] == pytest.approx(100)
    # averaging keeps the ego's box of B, with (0.4 + 0.8) / 2: at 0.7 A and C are right, B is wrong after them
    assert by_method(table, 0.5)["averaging"] == pytest.approx(100)
    assert by_method(table, 0.7)["averaging"] == pytest.approx(100 * 2 / 3)
    assert table[(table.method == "late") & (table.overlap == 0.5)].n_boxes.tolist() == [4]


def cloud(path, boxes):
    """A .pcd with 200 points in each of some boxes, in the frame of the LiDAR, which is 1.7 m high."""
    rng = np.random.default_rng(1)
    points = np.concatenate([np.array(b[:3]) - [0, 0, 1.7] + rng.uniform(-0.5, 0.5, (200, 3)) for b in boxes])
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
    body = "\n".join(" ".join(f"{v:.4f}" for v in row) for row in points)
    path.write_text(f"{head}POINTS {len(points)}\nDATA ascii\n{body}\n")


def test_trust_by_hand(tmp_path):
    """Both find A; the partner also reports a wall, of which the ego has points, and C, of which it has none."""
    for agent, x in (("0", 0), ("1", 40)):
        opv2v_file(tmp_path / f"s/{agent}/000000.yaml", [x, 0, 1.7, 0, 0, 0], {11: vehicle(car(10, 0))})
    wall, far = car(20, 8), car(60, 0)
    for agent, boxes, score in (
        ("0", [car(10, 0)], [0.9]),
        ("1", [car(-30, 0), car(-20, 8), car(20, 0)], [0.8, 0.4, 0.7]),
    ):
        local = np.array(boxes)
        local[:, 2] -= 1.7
        np.save(tmp_path / f"s/{agent}/000000_pred.npy", corners_of(local))
        np.save(tmp_path / f"s/{agent}/000000_score.npy", np.array(score))
    cloud(tmp_path / "s/0/000000.pcd", [car(10, 0), wall])
    cloud(tmp_path / "s/1/000000.pcd", [car(-30, 0), car(20, 0)])
    assert far[0] - 40 == 20
    about, table = evaluate(tmp_path)
    # Of the partner: A with s = 0.8 has T = 0.9, the wall with s = 0.4 has T = eta = 0, C has no evaluation and is
    # left out: (0.8 x 0.9 + 0.4 x 0) / 1.2. Of the ego: A with T = 0.8.
    assert about["frames_without_clouds"] == 0
    assert [(row["agent"], row["n_evaluations"]) for row in about["trust"]] == [("0", 1), ("1", 2)]
    assert [row["trust"] for row in about["trust"]] == pytest.approx([0.8, 0.6])
    assert set(table.method) == {"ego", "late", "averaging", "additive", "trupercept_1"}
    assert by_method(table, 0.5)["trupercept_1"] == 100


def test_partners_beyond_the_range_of_communication_do_not_help(tmp_path):
    _, table = evaluate(scene(tmp_path, near=False))
    assert by_method(table, 0.5)["late"] == by_method(table, 0.5)["ego"]


def test_dair_and_labels_alone(tmp_path):
    about, table = evaluate(dair_folder(tmp_path / "a"), range_m=1000, partners_m=1000)
    assert about["boxes"] == 2 and set(table["class"]) == {"car", "pedestrian"}
    opv2v_file(tmp_path / "b/s/0/000000.yaml", [0, 0, 0, 0, 0, 0], {1: vehicle(car(1, 1))})
    about, table = evaluate(tmp_path / "b")
    assert about["objects"] == 1 and table.empty


def test_what_is_no_data_set(tmp_path):
    for folder, said in ((tmp_path / "x", "not a folder"), (tmp_path, "none of the known layouts")):
        with pytest.raises(ValueError, match=said):
            layout_of(folder)
    ended = cosim("evaluate", str(tmp_path))
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    ended = cosim("evaluate", str(scene(tmp_path)))
    assert ended.returncode == 0 and "averaging" in ended.stdout and "66.7" in ended.stdout
    ended = cosim("evaluate", str(tmp_path), "--json", "--overlap", "0.5")
    assert ended.returncode == 0 and {row["method"] for row in json.loads(ended.stdout)["rows"]} == {
        "ego", "late", "averaging", "additive",
    }  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    sets = ("traffic.duration_s=4", "traffic.warmup_s=150", "fleet.penetration_p=0.3", "attacks=[]")
    return open_run(drive(tmp_path_factory.mktemp("evaluate") / "run", *sets))


def farthest(some: np.ndarray, others: np.ndarray) -> float:
    """Largest distance from one of some rows to the nearest of others."""
    return float(cKDTree(others).query(some)[0].max())


def test_opv2v_export_reads_back(run, tmp_path):
    """Boxes and average precision of the exported files are those of the tables."""
    few = sorted(run.vehicles.vehicle[run.vehicles.equipped].tolist())[:7]
    export(run, "opv2v", tmp_path / "o", ",".join(map(str, few)), None, ["detections=true"], lambda *_: None)
    data = opv2v.read(tmp_path / "o")
    rows = run.detections[(run.detections.origin == "sensed") & run.detections.transmitted]
    vehicle_of = run.subjects.vehicle
    rows = rows.assign(vehicle=rows.observer.map(vehicle_of))
    rows = rows[rows.vehicle.isin(few) & rows["class"].isin(["car", "truck"])]
    assert len(data.found) > 20
    columns = ["x_m", "y_m", "z_m", "length_m", "width_m", "height_m"]
    assert farthest(data.found.box[:, :6], rows[columns].to_numpy(float)) < 1e-4
    poses = run.actors.merge(run.vehicles[["vehicle", *columns[3:]]], left_on="actor", right_on="vehicle")
    assert farthest(data.truth.box[:, :6], poses[columns].to_numpy(float)) < 1e-4
    _, table = evaluate(tmp_path / "o")
    assert (table.ap.between(0, 100)).all() and by_method(table, 0.5)["ego"] > 5


def test_kitti_export_reads_back(run, tmp_path):
    few = sorted(run.vehicles.vehicle[run.vehicles.equipped].tolist())[:5]
    export(run, "kitti", tmp_path / "k", ",".join(map(str, few)), None, ["images=false"], lambda *_: None)
    data = kitti_folder.read(tmp_path / "k")
    truth, found = data.truth, data.found
    about, table = evaluate(tmp_path / "k")
    assert about["objects"] == len(truth) > 20 and about["boxes"] == len(found) > 10
    answer = average_precision(truth, found, "car")
    assert table[(table["class"] == "car") & (table.overlap == 0.7)].ap40.tolist() == [
        answer[level].ap40 for level in ("easy", "moderate", "hard", "all")
    ]
    real = truth.box[truth.label != "dontcare"]
    assert farthest(real[:, 3:6], run.vehicles[["length_m", "width_m", "height_m"]].to_numpy(float)) < 1e-4
