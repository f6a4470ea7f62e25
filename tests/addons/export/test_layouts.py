"""KITTI, TruPercept and OPV2V: a turning truck by hand, and everything that is written read back."""

import csv
import io

import numpy as np
import pytest

from cosim.addons.export import kitti, opv2v, trupercept
from cosim.base.plane import wrapped
from tests.addons.export import readers, truck
from tests.addons.export.truck import TRUCK_SENSOR, TRUCK_WORLD

GRAIN_M = 0.025
"""Tables keep headings to 1/512 rad: 2 cm at 20 m."""


def export(exporter, run, folder, **more):
    return truck.written(exporter().plan(truck.selection(run, **more)), folder)


def test_kitti_truck_by_hand(run, tmp_path):
    export(kitti.Kitti, run, tmp_path)
    # frames are numbered by (step, vehicle): step 0 has the vehicles 0 and 1
    (label,) = readers.kitti_labels(tmp_path / "object/training/label_2/000000.txt")
    assert label["type"] == "Truck" and label["occluded"] == 0  # 10 of 100 returns are lost
    assert [label["h"], label["w"], label["l"]] == [3.5, 2.5, 10]
    # camera: x right = -left, y down to the underside: 1.75 - 0.02, z ahead
    assert label["t"] == pytest.approx([-3, 1.73, 20], abs=GRAIN_M)
    # heading 45 degrees left of straight on, which is -90 in KITTI's count, growing to the right
    assert label["ry"] == pytest.approx(np.radians(-135), abs=2e-3)
    # the ray to it leans 8.53 degrees to the left
    assert label["alpha"] == pytest.approx(np.radians(-135 + 8.5308), abs=2e-3)
    # corners, 4.42 and 2.65 m beside and before the middle at 45 degrees, through 960 pixels of focal length
    left, right = 960 + 960 * (-3 - 2.6517) / (20 + 4.4194), 960 + 960 * (-3 + 4.4194) / (20 - 2.6517)
    assert label["rect"][0] == pytest.approx(left, abs=200) and label["rect"][2] == pytest.approx(right, abs=2)
    (found,) = readers.kitti_labels(tmp_path / "object/results/000000.txt")
    assert found["rest"] == [0.75] and found["t"] == pytest.approx(label["t"], abs=2e-3)
    assert (tmp_path / "object/results/000008.txt").read_text() == "", "what was withheld is not in the results"


def test_kitti_round_trip(run, tmp_path):
    made = export(kitti.Kitti, run, tmp_path)
    numbers = list(csv.DictReader(io.StringIO(made["object/frames.csv"].decode())))
    assert len(numbers) == len([p for p in made if p.startswith("object/training/velodyne")]) == 2 + 3 + 3 + 3
    n_labels = 0
    for row in numbers:
        step, vehicle, name = int(row["step"]), int(row["vehicle"]), f"{int(row['frame']):06d}"
        calib = tmp_path / f"object/training/calib/{name}.txt"
        points = readers.velodyne(tmp_path / f"object/training/velodyne/{name}.bin")
        assert points[:, :3].tolist() == truck.clouds(step, [vehicle])[0]().tolist() and not points[:, 3].any()
        actors = run.actors[run.actors.step == step].merge(run.vehicles, left_on="actor", right_on="vehicle")
        own = actors[actors.actor == vehicle].iloc[0]
        pose = [own.x_m, own.y_m, own.z_m + own.height_m / 2 + 0.23, own.yaw_rad]
        for label in readers.kitti_labels(tmp_path / f"object/training/label_2/{name}.txt"):
            if label["type"] == "DontCare":
                continue
            back = readers.to_world(readers.kitti_in_velodyne(label, calib), pose)
            away = np.abs(actors[["x_m", "y_m", "z_m"]].to_numpy() - back[:3]).max(axis=1)
            true = actors.iloc[int(np.argmin(away))]
            columns = ["x_m", "y_m", "z_m", "length_m", "width_m", "height_m"]
            assert back[:6] == pytest.approx(true[columns].to_numpy(float), abs=1e-3)
            assert wrapped(back[6] - true.yaw_rad) == pytest.approx(0, abs=1e-3)
            n_labels += 1
    assert n_labels == 4 + 3  # the truck before the first car four times, that car before the one behind three times


def test_kitti_tracking(run, tmp_path):
    made = export(kitti.Kitti, run, tmp_path)
    rows = list(csv.DictReader(io.StringIO(made["tracking/sequences.csv"].decode())))
    assert [r["vehicle"] for r in rows] == ["0"] * 4 + ["1"] * 4 + ["3"] * 3
    lines = made["tracking/training/label_02/0000.txt"].decode().splitlines()
    labelled = [line.split()[:3] for line in lines if "DontCare" not in line]
    assert labelled == [[str(frame), "1", "Truck"] for frame in range(4)]
    hidden = [line.split() for line in lines if "DontCare" in line]
    assert [words[:6] for words in hidden] == [[f, "-1", "DontCare", "-1", "-1", "-10"] for f in ("2", "3")]
    assert all(words[10:] == ["-1000", "-1000", "-1000", "-10", "-1", "-1", "-1"] for words in hidden)
    assert made["tracking/training/label_02/0001.txt"].startswith(b"0 -1 DontCare"), "it saw nothing"
    assert made["tracking/training/velodyne/0002/000000.bin"] == made["object/training/velodyne/000004.bin"]


def test_kitti_by_the_requirements_of_openpcdet(run, tmp_path):
    """Four steps: train has the first two, val the third, test the last."""
    export(kitti.Kitti, run, tmp_path)
    root = tmp_path / "object"
    sets = {name: (root / f"ImageSets/{name}.txt").read_text().split() for name in ("train", "val", "trainval", "test")}
    frames_of_steps = [range(2), range(2, 5), range(5, 8), range(8, 11)]
    first, second, third, fourth = ([f"{n:06d}" for n in some] for some in frames_of_steps)
    assert sets == {"train": first + second, "val": third, "trainval": first + second + third, "test": fourth}
    for split, names in sets.items():
        for name in names:
            info = readers.openpcdet_info(root, split, name)
            assert info["image_shape"] == (1080, 1920) and len(info["points"]) == 3
            assert info["P2"].tolist() == [[960, 0, 960, 0], [0, 960, 540, 0], [0, 0, 1, 0]]
    truck_info = readers.openpcdet_info(root, "train", "000000")
    assert truck_info["lidar_m"] == pytest.approx(TRUCK_SENSOR[None, :3], abs=GRAIN_M)
    assert readers.openpcdet_info(root, "train", "000001")["names"].tolist() == ["DontCare"]
    assert not list((root / "testing").glob("label*"))


def test_kitti_regions_without_labels(run, tmp_path):
    """The pedestrian, 10 m ahead and 1 m to the right, is hidden: a region as the benchmark's files state one."""
    made = export(kitti.Kitti, run, tmp_path)
    line = made["object/training/label_2/000005.txt"].decode().splitlines()[-1].split()
    assert line[:4] == ["DontCare", "-1", "-1", "-10"]
    assert line[8:] == ["-1", "-1", "-1", "-1000", "-1000", "-1000", "-10"]
    # it is 0.5 m wide and deep and 1.75 m high: from 0.75 to 1.25 m right, 1.73 m below the camera to 0.02 m above
    left, top, right = 960 + 960 * 0.75 / 10.25, 540 - 960 * 0.02 / 9.75, 960 + 960 * 1.25 / 9.75
    bottom = 540 + 960 * 1.73 / 9.75
    assert [float(x) for x in line[4:8]] == pytest.approx([left, top, right, bottom], abs=2.5)


def test_kitti_without_images(run, tmp_path):
    made = truck.written(kitti.Kitti(kitti.Params(images=False)).plan(truck.selection(run)), tmp_path)
    assert not [path for path in made if "image_2" in path] and "object/ImageSets/train.txt" in made


@pytest.mark.parametrize(("n", "sizes"), [(1, (1, 0, 0)), (2, (1, 1, 0)), (4, (2, 1, 1)), (9, (5, 2, 2))])
def test_image_sets_by_time(n, sizes):
    found = kitti.image_sets(np.repeat(np.arange(n) * 5, 2))
    assert tuple(len(found[name]) // 2 for name in ("train", "val", "test")) == sizes
    assert np.concatenate([found["trainval"], found["test"]]).tolist() == list(range(2 * n))


def test_names_stay_in_tables(run, tmp_path):
    """Slashes and markup of SUMO's names are in no path."""
    for exporter in (kitti.Kitti, trupercept.TruPerceptData, opv2v.Opv2v):
        made = export(exporter, run, tmp_path / exporter.__name__)
        assert all(
            set(path) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_./-") for path in made
        )
        assert not any(".." in path or path.startswith("/") for path in made)
        names = list(csv.DictReader(io.StringIO(made["vehicles.csv"].decode())))
        assert [n["sumo_id"] for n in names] == run.vehicles.sumo_id.tolist()


def test_trupercept_truck_by_hand(run, tmp_path):
    made = export(trupercept.TruPerceptData, run, tmp_path)
    root = tmp_path / trupercept.ROOT
    rows = [list(map(float, r.split())) for r in made[f"{trupercept.ROOT}/position_world/000000.txt"].splitlines()]
    assert rows[:2] == [[100, 50, 0], [100, 50, 1.73]]  # underside, camera
    assert np.array(rows[2:]) == pytest.approx(np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]]), abs=2e-3)  # north, east, up
    (label,) = readers.kitti_labels(root / "label_aug_2/000000.txt")
    assert label["t"] == pytest.approx([-3, 1.73, 20], abs=GRAIN_M) and label["rest"] == [1, 5, 90]
    (own,) = readers.kitti_labels(root / "alt_perspective/0000001/ego_object/000000.txt")
    assert own["t"] == label["t"] and own["rest"][:2] == [1, 5], "in the ego's camera, not its own"
    assert made[f"{trupercept.ROOT}/label_2/000000.txt"].endswith(b"\r\n")


def test_trupercept_round_trip(run, tmp_path):
    export(trupercept.TruPerceptData, run, tmp_path)
    root = tmp_path / trupercept.ROOT
    assert sorted(p.name for p in (root / "alt_perspective").iterdir()) == ["0000001", "0000003"]
    for folder, vehicle in ((root, 0), (root / "alt_perspective/0000003", 3)):
        for path in sorted((folder / "label_aug_2").iterdir()):
            step = int(path.stem)
            actors = run.actors[run.actors.step == step].merge(run.vehicles, left_on="actor", right_on="vehicle")
            for label in readers.kitti_labels(path):
                true = actors[actors.actor == label["rest"][0]].iloc[0]
                back = readers.trupercept_to_world(label, folder / "position_world" / path.name)
                under = [true.x_m, true.y_m, true.z_m - true.height_m / 2, true.yaw_rad]
                assert back == pytest.approx(under, abs=2e-3) and label["rest"][1] == true.speed_mps
            whole, filtered = (readers.kitti_labels(folder / f"label_aug{x}_2" / path.name) for x in ("", "_filtered"))
            assert [x for x in whole if x["rest"][2] > 0] == filtered
            assert all(x["occluded"] == 3 for x in whole if x["rest"][2] == 0)
        assert len(readers.velodyne(folder / "velodyne/000001.bin")) == 3
        assert vehicle in (0, 3)


def test_opv2v_truck_by_hand(run, tmp_path):
    export(opv2v.Opv2v, run, tmp_path)
    # vehicle 3 comes in step 1: two scenarios
    assert sorted(p.name for p in (tmp_path / "train").iterdir()) == ["step_000000_vehicle_0", "step_000001_vehicle_0"]
    found = readers.opv2v_yaml(tmp_path / "train/step_000000_vehicle_0/0/000000.yaml")
    assert found["lidar_pose"] == pytest.approx([100, 50, 1.73, 0, 90, 0], abs=0.06)
    assert found["true_ego_pos"] == pytest.approx([100, 50, 0, 0, 90, 0], abs=0.06)
    other = found["vehicles"][1]
    assert other["location"] == [97, 70, 0] and other["center"] == [0, 0, 1.75] and other["extent"] == [5, 1.25, 1.75]
    assert other["angle"] == pytest.approx([0, 135, 0], abs=0.06) and other["speed"] == pytest.approx(18)  # 5 m/s
    assert readers.opv2v_box(other) == pytest.approx(TRUCK_WORLD, abs=2e-3)


def test_opv2v_round_trip(run, tmp_path):
    export(opv2v.Opv2v, run, tmp_path)
    for scenario, steps, members in (
        ("step_000000_vehicle_0", [0], [0, 1]),
        ("step_000001_vehicle_0", [1, 2, 3], [0, 1, 3]),
    ):
        folder = tmp_path / "train" / scenario
        assert sorted(int(p.name) for p in folder.iterdir()) == members, "every folder is a vehicle"
        for vehicle in members:
            stamps = sorted(p.stem for p in (folder / str(vehicle)).glob("*.yaml"))
            assert stamps == [f"{i:06d}" for i in range(len(steps))], "every vehicle has every time stamp"
            for at, step in enumerate(steps):
                points = readers.pcd(folder / f"{vehicle}/{at:06d}.pcd")
                assert points[:, :3].tolist() == truck.clouds(step, [vehicle])[0]().tolist()
                found = readers.opv2v_yaml(folder / f"{vehicle}/{at:06d}.yaml")
                seen = run.observability
                seen = seen[(seen.step == step) & (seen.observer == vehicle) & (seen.n_points > 0)].actor
                assert set(found["vehicles"]) == set(seen[seen != 2])
                for number, other in found["vehicles"].items():
                    true = run.actors[(run.actors.step == step) & (run.actors.actor == number)].iloc[0]
                    assert readers.opv2v_box(other)[[0, 1, 2, 6]] == pytest.approx(
                        [true.x_m, true.y_m, true.z_m, true.yaw_rad], abs=1e-3
                    )


def test_groups_of_at_most_seven_have_constant_members(run):
    scenarios = opv2v.scenarios_of(truck.selection(run))
    assert [s.vehicles for s in scenarios] == [(0, 1), (0, 1, 3)]
    with pytest.raises(ValueError, match="no two of these"):
        opv2v.Opv2v().plan(truck.selection(run, vehicles=(1,)))
