"""Data sets in their layouts, made here: boxes come back as they were, and bad files end in one line."""

import json
import math

import numpy as np
import pytest

from cosim.addons.perception import dair, kitti_folder, opv2v
from cosim.addons.perception.clouds import points_in, points_of
from cosim.addons.perception.recorded import box_of_corners, moved, read_json, read_text
from results.moments import corners_of

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
    """Two agents; each sees a car and the other agent. The ego, 41, comes first as text: '41' < '7'."""
    other = [100.0, 51.0, 0.8, 4.2, 1.7, 1.5, -1.0]
    opv2v_file(tmp_path / "train/s/7/000069.yaml", POSE, {5: vehicle(CAR), 41: vehicle(other)})
    opv2v_file(tmp_path / "train/s/41/000069.yaml", POSE, {5: vehicle(CAR), 7: vehicle(other)})
    local = np.array([CAR])
    np.save(tmp_path / "train/s/7/000069_pred.npy", corners_of(local))
    np.save(tmp_path / "train/s/7/000069_score.npy", np.array([0.7]))
    data = opv2v.read(tmp_path)
    assert data.frames == ("s/000069",) and data.agents == (("41", "7"),)
    assert data.truth.box == pytest.approx(np.array([CAR]))  # agents are no objects
    assert data.aside.box == pytest.approx(np.array([other, other]))
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


def pose_matrix(pose):
    """The matrix of x, y, z, roll, yaw and pitch, with roll and pitch 0."""
    x, y, z, _, yaw, _ = pose
    cos, sin = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


CARS = {101: [31.0, 4.0, 0.8, 4.6, 1.9, 1.6, 0.6], 102: [25.0, -12.5, 0.75, 4.2, 1.8, 1.5, -2.4]}
POSES = {"0": [12, -7.5, 1.9, 0, 40, 0], "3": [52, 9, 2.1, 0, 165, 0]}
"""Two agents, 43 m apart, that look 125 degrees apart."""


def two_agents(folder, is_matrix, frame, poses=POSES, agents=("0", "3"), boxes=True):
    """Both annotate two cars, in the world or in the frame of their LiDARs, and detect them exactly."""
    for name in agents:
        motion = pose_matrix(poses[name])
        seen = {n: moved(np.array([b]), np.linalg.inv(motion))[0] for n, b in CARS.items()}
        given = CARS if frame == "world" else seen
        pose = motion.tolist() if is_matrix else poses[name]
        opv2v_file(folder / f"s/{name}/000017.yaml", pose, {n: vehicle(b) for n, b in given.items()})
        if boxes:
            np.save(folder / f"s/{name}/000017_pred.npy", corners_of(np.array(list(seen.values()))))
            np.save(folder / f"s/{name}/000017_score.npy", np.array([0.9, 0.8]))
    return folder


@pytest.mark.parametrize("is_matrix", [True, False])
@pytest.mark.parametrize("frame", ["world", "lidar"])
def test_the_frame_of_objects_is_that_in_which_agents_agree(tmp_path, is_matrix, frame):
    """The form of the pose says nothing; object 101 is at one place for both agents in one frame only."""
    data = opv2v.read(two_agents(tmp_path, is_matrix, frame, boxes=False))
    assert data.truth.box == pytest.approx(np.array(list(CARS.values())))
    is_usual = is_matrix == (frame == "lidar")
    assert is_usual or f"taken as in the frame of the {opv2v._SAID[frame]}: 2 objects that two" in data.remarks[0]
    assert len(data.remarks) == 0 + (not is_usual)


@pytest.mark.parametrize("frame", ["world", "lidar"])
def test_the_frame_of_objects_by_detections(tmp_path, frame):
    """One agent cannot agree with another; its two detections lie on the two objects in one frame only."""
    data = opv2v.read(two_agents(tmp_path, True, frame, agents=("3",)))
    assert data.truth.box == pytest.approx(np.array(list(CARS.values())))


def test_the_frame_of_objects_by_their_distance(tmp_path):
    """5 km from the origin, objects at 30 m are in the frame of the LiDAR, whatever the form of the pose."""
    opv2v_file(tmp_path / "s/0/000000.yaml", [5000, 0, 0, 0, 90, 0], {n: vehicle(b) for n, b in CARS.items()})
    data = opv2v.read(tmp_path)
    assert data.truth.box[:, :2] == pytest.approx(np.array([[5000 - 4, 31], [5000 + 12.5, 25]]))
    assert "beyond the reach of a LiDAR" in data.remarks[0]


def test_the_frame_of_objects_is_asked_for_or_named(tmp_path):
    folder = two_agents(tmp_path, True, "world", agents=("3",), boxes=False)
    assert "--objects world or --objects lidar" in one_line(opv2v.read, folder)
    assert opv2v.read(folder, objects="world").truth.box == pytest.approx(np.array(list(CARS.values())))
    wrong = {"5": POSES["3"], "6": POSES["0"]}
    two_agents(tmp_path / "b", True, "world", boxes=False)
    two_agents(tmp_path / "b/s", True, "lidar", wrong, ["5", "6"], boxes=False)
    assert "2 objects are at one place for two agents if they are" in one_line(opv2v.read, tmp_path / "b")


def test_poses_that_say_the_same_in_both_frames_need_no_evidence(tmp_path):
    opv2v_file(tmp_path / "s/0/000000.yaml", np.eye(4).tolist(), {1: vehicle(CAR)})
    assert opv2v.read(tmp_path).truth.box == pytest.approx(np.array([CAR]))


def test_the_ego_is_no_roadside_unit(tmp_path):
    """OpenCOOD: names as text, negative numbers to the end; and the ego of a scenario is that of all its frames."""
    for name in ("-2", "-1", "87", "9"):
        opv2v_file(tmp_path / f"s/{name}/000000.yaml", POSE, {5: vehicle(CAR)})
    opv2v_file(tmp_path / "s/-1/000001.yaml", POSE, {5: vehicle(CAR)})
    opv2v_file(tmp_path / "t/-1/000000.yaml", POSE, {5: vehicle(CAR)})
    data = opv2v.read(tmp_path)
    assert data.agents == (("87", "9", "-1", "-2"), ("-1",))
    assert data.remarks == ("1 frames are left out: their ego has no file there.",)
    data = opv2v.read(tmp_path, ego="-1")
    assert data.agents == (("-1", "87", "9", "-2"), ("-1",), ("-1",)) and not data.remarks
    data = opv2v.read(tmp_path, ego="9")
    assert data.agents == (("9", "87", "-1", "-2"),) and data.remarks[0].startswith("2 frames are left out")
    assert "There are: -1, -2, 87, 9." in one_line(lambda: opv2v.read(tmp_path, ego="x"))


def test_classes_keep_their_names_or_ours(tmp_path):
    kinds = {
        3: "Car",
        4: "BUS",
        5: "LongVehicle",
        6: "Pedestrian",
        7: "Scooter_Rider",
        8: "vehicle.car",
        9: "Tree",
        10: None,
    }
    opv2v_file(
        tmp_path / "s/0/000000.yaml", POSE, {n: vehicle([9 * n, *CAR[1:]], obj_type=kind) for n, kind in kinds.items()}
    )
    data = opv2v.read(tmp_path)
    assert sorted(data.truth.label) == ["car"] * 3 + ["cyclist", "pedestrian", "tree", "truck", "truck"]
    assert data.classes["BUS", "truck"] == data.classes["LongVehicle", "truck"] == 1 and data.classes["Car", "car"] == 2


def test_classes_at_the_top_of_a_file(tmp_path):
    """As UrbanIng-V2X has them. Other keys at the top, such as those of cameras, are no objects."""
    about = {
        "lidar_pose": POSE,
        "camera0": {"cords": {"x": 1}},
        "Car": {"1": vehicle(CAR)},
        "Truck": {"2": vehicle(CAR)},
    }
    (tmp_path / "s/0").mkdir(parents=True)
    (tmp_path / "s/0/000000.yaml").write_text(json.dumps(about))
    assert opv2v.read(tmp_path).truth.label.tolist() == ["car", "truck"]
    (tmp_path / "s/0/000000.yaml").write_text(json.dumps({"lidar_pose": POSE, "labels": {}}))
    said = one_line(opv2v.read, tmp_path)
    assert "no annotation was found. It has no key `vehicles`" in said and "it has lidar_pose, labels" in said
    opv2v_file(tmp_path / "s/1/000000.yaml", POSE, {})
    assert "1 of 2 files have no `vehicles`" in opv2v.read(tmp_path).remarks[0]


def test_one_number_at_two_places_is_two_objects(tmp_path):
    opv2v_file(tmp_path / "s/0/000000.yaml", POSE, {5: vehicle(CAR)})
    opv2v_file(tmp_path / "s/1/000000.yaml", POSE, {5: vehicle([40, *CAR[1:]])})
    data = opv2v.read(tmp_path)
    assert data.truth.box[:, 0].tolist() == [12, 40] and "1 annotations have the number of an object" in data.remarks[0]


def test_an_object_may_have_the_number_of_an_agent_that_is_elsewhere(tmp_path):
    opv2v_file(tmp_path / "s/7/000000.yaml", POSE, {7: vehicle(CAR)})
    data = opv2v.read(tmp_path)
    assert len(data.truth) == 1 and len(data.aside) == 0


def test_an_associated_number_is_not_the_name_of_an_agent(tmp_path):
    """V2V4Real's agents are called 0 and 1, and so may be objects."""
    for agent in ("0", "1"):
        opv2v_file(tmp_path / f"s/{agent}/000000.yaml", POSE, {7: vehicle(CAR, ass_id=1)})
    data = opv2v.read(tmp_path)
    assert len(data.truth) == 1 and len(data.aside) == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: m.T, "transposed"), (lambda m: m * [1, -1, 1, 1], "no rigid motion (determinant -1"),
        (lambda m: m * [1.05, 1.05, 1.05, 1], "determinant 1.16"), (lambda m: 1000 * m, "last row"),
        (lambda m: 0 * m, "last row"), (lambda m: np.vstack([m[:3], [9, 9, 9, 7]]), "last row"),
        (lambda m: m @ np.diag([1, -1, -1, 1]), "tilts the LiDAR by 180 degrees"),
    ],
)  # fmt: skip
def test_poses_that_are_no_rigid_motion(tmp_path, change, said):
    opv2v_file(tmp_path / "s/0/000000.yaml", change(WORLD).tolist(), {5: vehicle(CAR)})
    assert said in one_line(opv2v.read, tmp_path)


def test_six_numbers_in_another_order(tmp_path):
    opv2v_file(tmp_path / "s/0/000000.yaml", [100, 50, 1.9, 0, 0, 155], {5: vehicle(CAR)})
    assert "the last three are roll, yaw and pitch" in one_line(opv2v.read, tmp_path)


def test_rotations_of_dair_that_are_no_rotation(tmp_path):
    path = dair_folder(tmp_path) / "vehicle-side/calib/novatel_to_world/000001.json"
    about = json.loads(path.read_text())
    for scale, said in ((1.05, "no rigid motion"), (-1, "no rigid motion"), (0, "no rigid motion")):
        path.write_text(json.dumps(about | {"rotation": (scale * np.array(about["rotation"])).tolist()}))
        assert said in one_line(dair.read, tmp_path)
    path.write_text('{"transform": [1]}')
    assert "rotation should have 3 rows" in one_line(dair.read, tmp_path)


def test_the_shift_of_a_pair_moves_its_roadside_unit(tmp_path):
    index = dair_folder(tmp_path) / "cooperative/data_info.json"
    pair = json.loads(index.read_text())[0]
    index.write_text(json.dumps([pair | {"system_error_offset": {"delta_x": 1.5, "delta_y": "-0.5"}}]))
    data = dair.read(tmp_path)
    assert data.found.box[1, :3] == pytest.approx([CAR[0] + 1.5, CAR[1] - 0.5, CAR[2]])
    assert data.pose[0][1] == pytest.approx([1.5, -0.5, 0, 0])
    index.write_text(json.dumps([pair | {"system_error_offset": ""}]))
    assert dair.read(tmp_path).found.box[1] == pytest.approx(CAR)
    assert dair.read(tmp_path, ego="roadside unit").agents == (("roadside unit", "vehicle"),)
    assert dair.read(tmp_path, ego="roadside unit").found.box[0] == pytest.approx(CAR)
    index.write_text(json.dumps([pair, pair]))
    assert "in two pairs" in one_line(dair.read, tmp_path)


def test_keys_and_frames_that_come_twice(tmp_path):
    path = tmp_path / "s/0/000000.yaml"
    opv2v_file(path, POSE, {5: vehicle(CAR)})
    path.write_text("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles:\n  9: {a: 1}\nvehicles: {}\n")
    assert "has the key 'vehicles' twice in one place in line 4" in one_line(opv2v.read, tmp_path)
    opv2v_file(path, POSE, {5: vehicle(CAR)})
    opv2v_file(path.with_name("0.yaml"), POSE, {5: vehicle(CAR)})
    assert "are of one frame" in one_line(opv2v.read, tmp_path)
    label = dair_folder(tmp_path / "d") / "cooperative/label_world/000003.json"
    label.write_text(label.read_text().replace('{"type"', '{"type": "Car", "type"', 1))
    assert "has the key 'type' twice" in one_line(dair.read, tmp_path / "d")
    (tmp_path / "k/training/label_2").mkdir(parents=True)
    for name in ("0", "000000"):
        (tmp_path / f"k/training/label_2/{name}.txt").write_text("")
    assert "are of one frame" in one_line(kitti_folder.read, tmp_path / "k")


def test_scores_are_shares(tmp_path):
    folder = two_agents(tmp_path, False, "world")
    for score in (1.7, -0.1, 93.0):
        np.save(folder / "s/3/000017_score.npy", np.array([0.5, score]))
        assert f"000017_score.npy has the score {score:g}; scores should be from 0 to 1" in one_line(opv2v.read, folder)
    boxes = dair_folder(tmp_path / "d") / "detections/veh/lidar/000001.json"
    boxes.write_text(boxes.read_text().replace("[0.5]", "[50]"))
    assert "scores should be from 0 to 1" in one_line(dair.read, tmp_path / "d")


def test_missing_detections_are_counted(tmp_path):
    folder = two_agents(tmp_path, False, "world")
    (folder / "s/3/000017_pred.npy").unlink()
    (said,) = opv2v.read(folder).remarks
    assert said.startswith("1 of 2 files of detections are missing, such as 000017_pred.npy of") and "agent 3" in said
    (dair_folder(tmp_path / "d") / "detections/veh/lidar/000001.json").unlink()
    assert "1 of 2 files of detections are missing" in dair.read(tmp_path / "d").remarks[0]


def test_numbers_of_yaml(tmp_path):
    """Those of YAML 1.2: with an exponent and without a point, with leading zeros; clock times are no numbers."""
    opv2v_file(tmp_path / "s/0/000000.yaml", POSE, {5: vehicle(CAR)})
    path = tmp_path / "s/0/000000.yaml"
    path.write_text("lidar_pose: [010, 1e-05, 1e1, 0, -.5e+1, 0]\nvehicles: {}")
    assert opv2v.read(tmp_path).pose[0][0] == pytest.approx([10, 1e-5, 10, math.radians(-5)])
    path.write_text("lidar_pose: [0, 0, 0, 0, 1:30, 0]\nvehicles: {}")
    assert "list of 6 numbers" in one_line(opv2v.read, tmp_path)
    path.write_text(f"lidar_pose: [{':'.join('1' * 200_000)}]")
    assert "list of 6 numbers" in one_line(opv2v.read, tmp_path)
    path.write_text("a: " + "1" * 5000)
    assert "list of 6 numbers" in one_line(opv2v.read, tmp_path)
    path.write_text("a: " + "x" * 2_000_001)
    assert "more than the 2,000,000 that are read of YAML" in one_line(opv2v.read, tmp_path)


def test_arrays_of_impossible_shapes(tmp_path):
    folder = two_agents(tmp_path, False, "world")
    for shape in ("-1", "1" + "0" * 30, "99999999"):
        path = folder / "s/0/000017_pred.npy"
        head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape}, 8, 3), }}".ljust(117) + "\n"
        path.write_bytes(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode() + bytes(384))
        assert "000017_pred.npy is no array of numbers" in one_line(opv2v.read, folder)


def test_sides_of_boxes_are_those_of_objects(tmp_path):
    opv2v_file(tmp_path / "s/0/000000.yaml", POSE, {5: vehicle([*CAR[:3], 4400, 1.8, 1.6, 0])})
    assert "the sides of box 0 are 4400, 1.8, 1.6 m" in one_line(opv2v.read, tmp_path)


def test_kitti_in_degrees(tmp_path):
    (tmp_path / "training/label_2").mkdir(parents=True)
    line = "Car 0.10 1 -1.4 600 300 700 360 1.5 1.8 4.4 -3.0 1.7 20.0 -90"
    (tmp_path / "training/label_2/000000.txt").write_text(line)
    assert "line 1: rotation_y is -90; radians are right" in one_line(kitti_folder.read, tmp_path)


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
