"""Data sets through matching, fusion and metrics: a hand-made scene, and what our own exporters write."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from cosim.addons.export.export import export
from cosim.addons.perception import kitti_folder, opv2v
from cosim.addons.perception.evaluate import evaluate, layout_of
from cosim.addons.perception.kitti import average_precision
from results.archive import open_run
from results.moments import corners_of
from tests.addons.perception.test_readers import dair_folder, opv2v_file, vehicle
from tests.drive import assert_refused, cosim, drive


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


def test_agents_of_one_name_in_two_scenarios_are_two(tmp_path):
    """Both find A; the partner with a score of 0.5 in `s` and of 0.9 in `t`. The ego's trust is the partner's score."""
    for scenario, score in (("s", 0.5), ("t", 0.9)):
        for agent, x, own in (("0", 0, 0.8), ("1", 40, score)):
            opv2v_file(tmp_path / f"{scenario}/{agent}/000000.yaml", [x, 0, 1.7, 0, 0, 0], {11: vehicle(car(10, 0))})
            local = np.array([car(10 - x, 0)])
            local[:, 2] -= 1.7
            np.save(tmp_path / f"{scenario}/{agent}/000000_pred.npy", corners_of(local))
            np.save(tmp_path / f"{scenario}/{agent}/000000_score.npy", np.array([own]))
            cloud(tmp_path / f"{scenario}/{agent}/000000.pcd", [car(10 - x, 0)])
    rows = evaluate(tmp_path)[0]["trust"]
    assert [row["agent"] for row in rows] == ["s/0", "s/1", "t/0", "t/1"]
    assert [row["trust"] for row in rows] == pytest.approx([0.5, 0.8, 0.9, 0.8])


def test_partners_beyond_the_range_of_communication_do_not_help(tmp_path):
    _, table = evaluate(scene(tmp_path, near=False))
    assert by_method(table, 0.5)["late"] == by_method(table, 0.5)["ego"]


def test_partners_beyond_the_range_of_communication_evaluate_nothing(tmp_path):
    """All three find A and have points of it. The third is 90 m from the ego: its boxes are not sent; it denied A."""
    for agent, x in (("0", 0), ("1", 40), ("2", 90)):
        folder = tmp_path / f"s/{agent}"
        opv2v_file(folder / "000000.yaml", [x, 0, 1.7, 0, 0, 0], {11: vehicle(car(50, 6))})
        local = np.array([car(50 - x, 6)])
        local[:, 2] -= 1.7
        np.save(folder / "000000_pred.npy", corners_of(local))
        np.save(folder / "000000_score.npy", np.array([0.9]))
        cloud(folder / "000000.pcd", [car(50 - x, 6)])
    rows = evaluate(tmp_path)[0]["trust"]
    assert [(row["n_frames"], row["n_evaluations"]) for row in rows] == [(1, 1), (1, 1), (0, 0)]
    assert [row["trust"] for row in rows] == [pytest.approx(0.9), pytest.approx(0.9), None]


def test_dair_and_labels_alone(tmp_path):
    about, table = evaluate(dair_folder(tmp_path / "a"), range_m=1000, partners_m=1000)
    assert about["boxes"] == 2 and set(table["class"]) == {"car", "pedestrian"}
    opv2v_file(tmp_path / "b/s/0/000000.yaml", [0, 0, 0, 0, 0, 0], {1: vehicle(car(1, 1))})
    about, table = evaluate(tmp_path / "b")
    assert about["objects"] == 1 and table.empty


def two_cars_and_agents(folder):
    """Case of OPV2V: 641 and 650 see each other and cars 700 and 701, and detect all that they see exactly."""
    there = {641: car(0, 0), 650: car(20, 0), 700: car(10, 8), 701: car(30, -6)}
    for agent, x in ((641, 0), (650, 20)):
        seen = {n: b for n, b in there.items() if n != agent}
        opv2v_file(folder / f"s/{agent}/000069.yaml", [x, 0, 1.9, 0, 0, 0], {n: vehicle(b) for n, b in seen.items()})
        local = np.array(list(seen.values())) - [x, 0, 1.9, 0, 0, 0, 0]
        np.save(folder / f"s/{agent}/000069_pred.npy", corners_of(local))
        np.save(folder / f"s/{agent}/000069_score.npy", np.array([0.95, 0.8, 0.7]))
    return folder


def test_boxes_on_the_agents_count_in_no_method(tmp_path):
    """The agents are no objects, so a box on one is neither right nor false; the boxes on both cars are right."""
    about, table = evaluate(two_cars_and_agents(tmp_path))
    assert (table.ap.round(9) == 100).all() and (table.n_truth == 2).all() and (table.n_boxes == 2).all()
    assert about["boxes_left_out"] == 2 and about["egos"] == {"641": 1}
    about, table = evaluate(tmp_path, ego="650")
    assert (table.ap.round(9) == 100).all() and about["egos"] == {"650": 1}


def test_a_box_on_an_agent_that_nobody_annotates_counts_in_no_method(tmp_path):
    two_cars_and_agents(tmp_path)
    path = tmp_path / "s/641/000069.yaml"
    about = json.loads(path.read_text())
    del about["vehicles"]["650"]
    path.write_text(json.dumps(about))
    about, table = evaluate(tmp_path)
    assert (table.ap.round(9) == 100).all() and about["boxes_left_out"] == 2


def test_an_agent_is_one_whatever_its_number(tmp_path):
    """V2V4Real numbers the other vehicle as any object: the LiDAR of an agent stands on it."""
    two_cars_and_agents(tmp_path)
    for path in tmp_path.rglob("*.yaml"):
        path.write_text(path.read_text().replace('"650"', '"12"').replace('"641"', '"13"'))
    about, table = evaluate(tmp_path)
    assert (table.ap.round(9) == 100).all() and (table.n_truth == 2).all() and about["objects"] == 2


def test_a_false_box_beside_an_agent_is_false(tmp_path):
    """0.4 m of its width of 1.8 m stand on the partner: an intersection over union of 0.4 / 3.2."""
    two_cars_and_agents(tmp_path)
    local = np.array([car(20, 1.4), car(10, 8), car(30, -6)]) - [0, 0, 1.9, 0, 0, 0, 0]
    np.save(tmp_path / "s/641/000069_pred.npy", corners_of(local))
    about, table = evaluate(tmp_path)
    # three boxes of the ego, and the false one comes first: precision 1/2 and 2/3, of which the larger counts
    assert by_method(table, 0.5)["ego"] == pytest.approx(100 * 2 / 3) and about["boxes_left_out"] == 1


def test_objects_of_other_classes_are_left_out_with_boxes_on_them(tmp_path):
    """Detections of OPV2V have no class. The bus is detected exactly, which is neither right nor false for cars."""
    bus = [30, 5, 1.7, 12, 2.5, 3.4, 0.0]
    objects = {3: vehicle(car(10, 0), obj_type="Car"), 4: vehicle(bus, obj_type="Bus")}
    opv2v_file(tmp_path / "s/0/000000.yaml", [0] * 6, objects)
    np.save(tmp_path / "s/0/000000_pred.npy", corners_of(np.array([car(10, 0), bus])))
    np.save(tmp_path / "s/0/000000_score.npy", np.array([0.6, 0.9]))
    about, table = evaluate(tmp_path)
    assert set(table["class"]) == {"car"} and (table.ap == 100).all() and (table.n_boxes == 1).all()
    assert about["classes"] == {"car": {"Car": 1}, "truck": {"Bus": 1}} and "1 truck" in about["remarks"][0]


def test_what_is_missing_is_named(tmp_path):
    """Of an empty table, the part that is empty."""
    folder = two_cars_and_agents(tmp_path)
    assert "No object is within 5 m of the ego" in evaluate(folder, range_m=5)[0]["missing"]
    for path in folder.rglob("*_pred.npy"):
        path.unlink()
    missing = evaluate(folder)[0]["missing"]
    assert "no detections beside 2 objects" in missing and "--set detections=true" in missing
    (tmp_path / "b").mkdir()
    folder = two_cars_and_agents(tmp_path / "b")
    for agent, x in ((641, 0), (650, 20)):
        opv2v_file(folder / f"s/{agent}/000069.yaml", [x, 0, 1.9, 0, 0, 0], {})
    assert evaluate(folder)[0]["missing"] == "No object is annotated in any frame."
    for path in folder.rglob("*_pred.npy"):
        path.unlink()
    assert evaluate(folder)[0]["missing"] == "No object is annotated in any frame."


@pytest.mark.parametrize("n", [300, 9000])
def test_equal_boxes(tmp_path, n):
    """300 boxes on one car: the first one is right, and the others come after it. 9,000 are refused in one line."""
    opv2v_file(tmp_path / "s/0/000000.yaml", [0] * 6, {3: vehicle(car(10, 0))})
    np.save(tmp_path / "s/0/000000_pred.npy", corners_of(np.repeat(np.array([car(10, 0)]), n, axis=0)))
    np.save(tmp_path / "s/0/000000_score.npy", np.full(n, 0.5))
    if n > 1000:
        with pytest.raises(ValueError, match="frame s/000000 has 9,001 boxes that lie on each other"):
            evaluate(tmp_path)
        return
    _, table = evaluate(tmp_path)
    assert (table.ap == 100).all() and table[table.method == "late"].n_boxes.tolist() == [1, 1]


def test_many_classes(tmp_path):
    path = dair_folder(tmp_path) / "detections/veh/lidar/000001.json"
    about = json.loads(path.read_text())
    names = [f"class {n}" for n in range(300)]
    path.write_text(json.dumps({
        "boxes_3d": about["boxes_3d"] * 300, "labels_3d": names, "scores_3d": about["scores_3d"] * 300
    }))  # fmt: skip
    with pytest.raises(ValueError, match="301 classes, more than 255"):
        evaluate(tmp_path, range_m=1000)


def test_a_cloud_that_cannot_be_read_is_named(tmp_path):
    folder = two_cars_and_agents(tmp_path)
    for agent in (641, 650):
        cloud(folder / f"s/{agent}/000069.pcd", [car(10, 8)])
    path = folder / "s/650/000069.pcd"
    path.write_text(path.read_text().replace("POINTS 200", "POINTS 1"))
    about, table = evaluate(folder)
    assert about["frames_without_clouds"] == 1 and "trupercept_1" not in set(table.method)
    assert about["remarks"] == [f"{path} says that it has 1 points, and has 200."]


def test_detections_that_are_nowhere_in_the_image_are_said(tmp_path):
    """A detector without a camera writes no image boxes: KITTI's levels but "all" leave its boxes out."""
    for name, image, score in (("training/label_2", "0 0 10 60", ""), ("results", "0 0 0 0", "0.9")):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "000000.txt").write_text(f"Car 0 0 0 {image} 1.5 1.7 4 2 1.6 20 0.1 {score}\n")
    about, table = evaluate(tmp_path)
    assert "1 of 1 detections have no height in the image" in " ".join(about["remarks"])
    assert set(table.level[table.ap11 > 0]) == {"all"}


def test_options_that_go_with_another_layout(tmp_path):
    with pytest.raises(ValueError, match="goes with several agents"):
        evaluate(tmp_path, "kitti", ego="1")
    with pytest.raises(ValueError, match="goes with the layout opv2v"):
        evaluate(tmp_path, "dair-v2x", objects="world")


def test_what_is_no_data_set(tmp_path):
    for folder, said in ((tmp_path / "x", "not a folder"), (tmp_path, "none of the known layouts")):
        with pytest.raises(ValueError, match=said):
            layout_of(folder)
    ended = cosim("evaluate", str(tmp_path))
    assert_refused(ended)
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
    about, table = evaluate(tmp_path / "o")
    assert about["remarks"] == []
    assert (table.ap.between(0, 100)).all() and by_method(table, 0.5)["ego"] > 5


def test_kitti_export_reads_back(run, tmp_path):
    few = sorted(run.vehicles.vehicle[run.vehicles.equipped].tolist())[:5]
    export(run, "kitti", tmp_path / "k", ",".join(map(str, few)), None, ["images=false"], lambda *_: None)
    data = kitti_folder.read(tmp_path / "k")
    truth, found = data.truth, data.found
    about, table = evaluate(tmp_path / "k")
    (few,) = about["remarks"]
    assert few.startswith("average precision of fewer than 41 objects says little") and table.n_truth.min() < 41
    assert table.ap40.isna().equals(table.n_truth == 0)
    assert about["objects"] == len(truth) > 20 and about["boxes"] == len(found) > 10
    answer = average_precision(truth, found, "car")
    assert table[(table["class"] == "car") & (table.overlap == 0.7)].ap40.tolist() == [
        answer[level].ap40 for level in ("easy", "moderate", "hard", "all")
    ]
    real = truth.box[truth.label != "dontcare"]
    assert farthest(real[:, 3:6], run.vehicles[["length_m", "width_m", "height_m"]].to_numpy(float)) < 1e-4
