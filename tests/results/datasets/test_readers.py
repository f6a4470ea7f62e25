"""Data sets in their layouts, made here: boxes come back as they were, and bad files end in one line."""

import json
import math

import numpy as np
import pytest

from results.datasets import dair, kitti_folder, opv2v
from results.datasets.clouds import points_in, points_of
from results.datasets.recorded import box_of_corners, corners_of, moved, read_json, read_text

CAR = [12.0, -3.0, 0.8, 4.4, 1.8, 1.6, 0.4]
POSE = [100.0, 50.0, 1.9, 0.0, 30.0, 0.0]  # x, y, z, roll, yaw, pitch
TURN = np.array([[math.cos(math.pi / 6), -0.5, 0], [0.5, math.cos(math.pi / 6), 0], [0, 0, 1]])
WORLD = np.block([[TURN, np.array([[100.0], [50.0], [1.9]])], [np.zeros((1, 3)), np.ones((1, 1))]])


def opv2v_file(path, pose, vehicles):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"lidar_pose": pose, "ego_speed": 3.5, "vehicles": vehicles}))  # JSON is YAML


def vehicle(box, **more):
    x, y, z, length, width, height, yaw = box
    return {
        "angle": [0, math.degrees(yaw), 0], "center": [0, 0, height / 2],
        "extent": [length / 2, width / 2, height / 2], "location": [x, y, z - height / 2], "speed": 1.0,
    } | more  # fmt: skip


def test_opv2v_world_frame(tmp_path):
    """Two agents; each sees a car and the other agent. The ego, 7, comes first as text: '41' < '7'."""
    other = [130.0, 60.0, 0.8, 4.2, 1.7, 1.5, -1.0]
    opv2v_file(tmp_path / "train/s/7/000069.yaml", POSE, {5: vehicle(CAR), 41: vehicle(other)})
    opv2v_file(tmp_path / "train/s/41/000069.yaml", POSE, {5: vehicle(CAR), 7: vehicle(other)})
    local = np.array([CAR])
    np.save(tmp_path / "train/s/7/000069_pred.npy", corners_of(local))
    np.save(tmp_path / "train/s/7/000069_score.npy", np.array([0.7]))
    data = opv2v.read(tmp_path)
    assert data.frames == ("s/000069",) and data.agents == (("41", "7"),)
    assert data.truth.box == pytest.approx(np.array([CAR]))  # agents are no objects
    assert data.pose[0][0] == pytest.approx([100, 50, 1.9, math.pi / 6])
    assert data.found.agent.tolist() == [1] and data.found.score.tolist() == [0.7]
    # 12 m ahead and 3 m to the right of an agent that looks 30 degrees to the left
    cos = math.cos(math.pi / 6)
    assert data.found.box[0, :2] == pytest.approx([100 + 12 * cos + 1.5, 50 + 6 - 3 * cos])
    assert data.found.box[0, 6] == pytest.approx(0.4 + math.pi / 6)


def test_v2v4real_objects_are_in_the_frame_of_the_lidar(tmp_path):
    for agent in ("0", "1"):
        opv2v_file(tmp_path / f"t/{agent}/000000.yaml", WORLD.tolist(), {
            "3": vehicle(CAR, ass_id=9, obj_type="Truck"), "4": vehicle(CAR, ass_id=-1),
        })  # fmt: skip
    assert "nothing tells whether the objects are in the frame" in one_line(opv2v.read, tmp_path)
    data = opv2v.read(tmp_path, objects="lidar")
    assert len(data.truth) == 1 + 2  # number 9 once; what has no common number, once per agent
    assert data.truth.box == pytest.approx(np.repeat(moved(np.array([CAR]), WORLD), 3, axis=0))
    assert data.truth.box[0, 6] == pytest.approx(0.4 + math.pi / 6)


def dair_folder(root):
    """One pair: the vehicle's LiDAR at POSE, the roadside unit at the origin."""
    turn = {"rotation": TURN.tolist(), "translation": [[100.0], [50.0], [1.9]]}
    same = {"rotation": np.eye(3).tolist(), "translation": [0, 0, 0]}
    files = {
        "cooperative/data_info.json": [{
            "vehicle_pointcloud_path": "vehicle-side/velodyne/000001.pcd",
            "infrastructure_pointcloud_path": "infrastructure-side/velodyne/000002.pcd",
            "cooperative_label_path": "cooperative/label_world/000003.json",
        }],
        "cooperative/label_world/000003.json": [
            {"type": "Van", "world_8_points": corners_of(np.array([CAR]))[0].tolist()},
            {"type": "Pedestrian", "world_8_points": corners_of(np.array([CAR]))[0].tolist()},
        ],
        "vehicle-side/calib/lidar_to_novatel/000001.json": {"transform": same},
        "vehicle-side/calib/novatel_to_world/000001.json": turn,
        "infrastructure-side/calib/virtuallidar_to_world/000002.json": same,
        "detections/veh/lidar/000001.json": {
            "boxes_3d": corners_of(np.array([CAR])).tolist(), "labels_3d": [2], "scores_3d": [0.5]
        },
        "detections/inf/lidar/000002.json": {
            "boxes_3d": corners_of(np.array([CAR])).tolist(), "labels_3d": ["Car"], "scores_3d": [0.25]
        },
    }  # fmt: skip
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(json.dumps(content))
    return root


def test_dair(tmp_path):
    data = dair.read(dair_folder(tmp_path / "cooperative-vehicle-infrastructure").parent)
    assert data.frames == ("000003",) and data.truth.label.tolist() == ["car", "pedestrian"]
    assert data.truth.box == pytest.approx(np.array([CAR, CAR]))
    assert data.found.label.tolist() == ["car", "car"] and data.found.agent.tolist() == [0, 1]
    assert data.found.box[0] == pytest.approx(moved(np.array([CAR]), WORLD)[0])
    assert data.found.box[1] == pytest.approx(CAR)


def test_kitti(tmp_path):
    """A car 20 m ahead and 3 m to the left points away: -90 degrees in KITTI's count; its underside is 1.7 m down."""
    (tmp_path / "training/label_2").mkdir(parents=True)
    line = "Car 0.10 1 -1.4 600 300 700 360 1.5 1.8 4.4 -3.0 1.7 20.0 -1.5708"
    region = "DontCare -1 -1 -10 0 0 5 5 -1 -1 -1 -1000 -1000 -1000 -10"
    (tmp_path / "training/label_2/000000.txt").write_text(f"{line}\n{region}\n")
    (tmp_path / "results").mkdir()
    (tmp_path / "results/000000.txt").write_text(f"{line.replace('0.10 1', '-1 -1')} 0.9\n")
    data = kitti_folder.read(tmp_path)
    truth, found = data.truth, data.found
    assert truth.label.tolist() == ["car", "dontcare"] and found.score.tolist() == [0.9]
    assert truth.box[0] == pytest.approx([20, 3, -1.7 + 0.75, 4.4, 1.8, 1.5, 0], abs=1e-4)
    assert (truth.height_px[0], truth.occlusion[0], truth.truncation[0]) == (60, 1, 0.1)
    assert found.box[0] == pytest.approx(truth.box[0])


def test_corners_of_any_order(tmp_path):
    rng = np.random.default_rng(2)
    box = np.array([CAR, [3.0, 4.0, 1.0, 0.6, 0.8, 1.7, -2.0]])
    corner = corners_of(box)
    assert box_of_corners(corner, tmp_path) == pytest.approx(box)
    mixed = box_of_corners(corner[:, rng.permutation(8)], tmp_path)
    assert corners_of(mixed)[:, :, 2].min(axis=1) == pytest.approx(corner[:, :, 2].min(axis=1))
    for k in range(2):  # the same corners, whatever the heading is called
        apart = np.linalg.norm(corners_of(mixed)[k][:, None] - corner[k], axis=2).min(axis=1)
        assert apart == pytest.approx(np.zeros(8), abs=1e-9)
    with pytest.raises(ValueError, match="not those of an upright box"):
        box_of_corners(rng.normal(size=(1, 8, 3)) * 5, tmp_path)


def one_line(read, *words):
    with pytest.raises(ValueError) as caught:
        read(*words)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("lidar_pose: !!python/object/apply:os.system ['true']", "no plain YAML"),
        ("a: &a [1]\nlidar_pose: *a", "another place of itself"),
        ("[1, 2", "no plain YAML"),
        ("7", "keys and values"),
        ("lidar_pose: [1, 2, 3]", "list of 6 numbers"),
        ("lidar_pose: [1, 2, 3, 4, 5, .nan]", "list of 6 numbers"),
        ("lidar_pose: [1, 2, 3, 4, 5, 1e300]", "list of 6 numbers"),
        ("lidar_pose: [[1, 0], [0, 1]]", "4 rows"),
        ("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles: [1]", "objects by number"),
        ("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles: {1: 2}", "vehicles.1 should hold"),
        (
            "lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles:\n"
            "  1: {angle: [0, 0, 0], center: [0, 0, 0], extent: [0, 1, 1], location: [0, 0, 0]}",
            "above 0",
        ),
        ("a: " + "[" * 5000, "no plain YAML"),
    ],
)  # fmt: skip
def test_bad_yaml(tmp_path, text, said):
    (tmp_path / "s/0").mkdir(parents=True)
    (tmp_path / "s/0/000000.yaml").write_text(text)
    assert said in one_line(opv2v.read, tmp_path)


def test_bad_arrays(tmp_path):
    opv2v_file(tmp_path / "s/0/000000.yaml", POSE, {})
    pred, score = tmp_path / "s/0/000000_pred.npy", tmp_path / "s/0/000000_score.npy"
    pred.write_bytes(b"not an array")
    assert "no array of numbers" in one_line(opv2v.read, tmp_path)
    np.save(pred, np.array([{"a": 1}], object), allow_pickle=True)  # a pickle would run code
    assert "no array of numbers" in one_line(opv2v.read, tmp_path)
    np.save(pred, np.zeros((2, 7)))
    assert "shape (n, 8, 3)" in one_line(opv2v.read, tmp_path)
    np.save(pred, np.full((1, 8, 3), np.nan))
    assert "not finite" in one_line(opv2v.read, tmp_path)
    np.savez(tmp_path / "x.npz", np.zeros(3))
    pred.write_bytes((tmp_path / "x.npz").read_bytes())
    assert "no array of numbers" in one_line(opv2v.read, tmp_path)
    np.save(pred, corners_of(np.array([CAR])))
    pred.write_bytes(pred.read_bytes()[:-8])  # shorter than its head says
    assert "no array of numbers" in one_line(opv2v.read, tmp_path)
    np.save(pred, corners_of(np.array([CAR])))
    assert "000000_score.npy is not a file" in one_line(opv2v.read, tmp_path)
    np.save(score, np.zeros(3))
    assert "shape (1)" in one_line(opv2v.read, tmp_path)


def test_bad_dair(tmp_path):
    index = dair_folder(tmp_path) / "cooperative/data_info.json"
    pair = json.loads(index.read_text())
    for path in ("../../etc/passwd", "/etc/passwd", 7, "a\0b"):
        index.write_text(json.dumps([pair[0] | {"cooperative_label_path": path}]))
        assert "relative path inside" in one_line(dair.read, tmp_path)
    index.write_text(json.dumps(pair))
    label = tmp_path / "cooperative/label_world/000003.json"
    few = '[{"type": "Car", "world_8_points": [[1]]}]'
    bad = (("{", "no JSON"), ("[7]", "should hold"), (few, "8 rows"), ("[" * 100_000, "nested too deeply"))
    for text, said in bad:
        label.write_text(text)
        assert said in one_line(dair.read, tmp_path)


def test_bad_kitti(tmp_path):
    assert "no label files" in one_line(kitti_folder.read, tmp_path)
    (tmp_path / "training/label_2").mkdir(parents=True)
    place = tmp_path / "training/label_2/000000.txt"
    place.write_text("Car 0 0 0\n")
    assert "line 1 has 4 columns" in one_line(kitti_folder.read, tmp_path)
    place.write_text("Car 0 0 x 1 1 2 2 1 1 1 1 1 1 1\n")
    assert "column 4" in one_line(kitti_folder.read, tmp_path)


def test_large_and_strange_files(tmp_path):
    large = tmp_path / "large.json"
    with large.open("wb") as file:
        file.truncate(16_000_001)
    assert "more than" in one_line(read_json, large)
    assert "not a file" in one_line(read_text, tmp_path)
    (tmp_path / "x").write_bytes(b"\xff\xfe")
    assert "no text" in one_line(read_text, tmp_path / "x")


def test_clouds(tmp_path):
    path, points = tmp_path / "x.pcd", np.array([[1, 2, 3, 9], [4, 5, 6, 9], [np.nan, 0, 0, 0]], "<f4")
    head = "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\n"
    path.write_bytes(head.encode() + b"DATA binary\n" + points.tobytes())
    assert points_of(path).tolist() == [[1, 2, 3], [4, 5, 6]]
    path.write_text(head.replace("3\nH", "1\nH").replace("POINTS 3", "POINTS 1") + "DATA ascii\n1 2 3 0\n")
    assert points_of(path).tolist() == [[1, 2, 3]]
    few = b"DATA ascii\n" + 3 * b"1 2\n"
    for bad, said in (
        (b"DATA binary_compressed\n\0\0", "no point cloud"), (b"DATA binary\n\0", "and has 0"), (b"", "no point cloud"),
        (b"DATA ascii\n1 2", "and has 1"), (few, "no point cloud"), (b"DATA binary\n", "and has 0"),
    ):  # fmt: skip
        path.write_bytes(head.encode() + bad)
        assert said in one_line(points_of, path)
    for n in ("99999999999999", "1", "-1", "9" * 30):  # beside three points
        path.write_bytes(head.replace("POINTS 3", f"POINTS {n}").encode() + b"DATA binary\n" + points.tobytes())
        assert f"says that it has {n[:20]}" in one_line(points_of, path)
    path.write_bytes(head.encode() + b"DATA binary\n" + np.full((3, 4), 1e30, "<f4").tobytes())
    assert "beyond 1000 km" in one_line(points_of, path)


def test_points_in_a_turned_box():
    # 4 m long towards the upper left: (-1, 1) lies inside, (1, 1) 1.41 m to its side
    box = np.array([[0, 0, 0, 4, 2, 2, 3 * math.pi / 4]])
    assert points_in(np.array([[-1, 1, 0.5], [1, 1, 0.5], [-1, 1, 1.5], [0, 0, 0.0]]), box).tolist() == [2]
    assert points_in(np.zeros((0, 3)), box).tolist() == [0]
