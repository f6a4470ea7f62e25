"""MCAP, nuScenes and floating car data: the truck by hand, and each field's own reader."""

import gzip
import json
import struct
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from cosim.addons.export import fcd, nuscenes, ros2
from cosim.addons.export.pcap import START_S
from cosim.base.earth import Projection
from cosim.base.extras import needed
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fleet import FleetParams
from cosim.traffic.params import TrafficParams
from cosim.traffic.replay import TraceReplay
from results.moments import Place
from sensors.scene import Shape
from tests.addons.export import truck
from tests.addons.export.truck import CAR_LIDAR, TRUCK_SENSOR, TRUCK_WORLD

TWO_TRIANGLES = np.array([[[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 0, 0], [0, 1, 0], [0, 0, 1]]], float)
HERE = Place(origin_m=(1000.0, 2000.0), buildings=lambda: TWO_TRIANGLES)
EQUATOR = Projection.of("+proj=utm +zone=31 +ellps=WGS84", 5e5, 0.0)
"""The world's origin at 3 degrees east on the equator."""


@pytest.fixture(scope="module")
def of(run):
    return replace(truck.selection(run), place=HERE, named=True, projection=lambda: EQUATOR)


def test_fcd_truck_by_hand(of, tmp_path):
    made = truck.written(fcd.Fcd().plan(of), tmp_path)
    root = ET.fromstring(gzip.decompress(made["fcd.xml.gz"]))  # the names in it are attacks on careless writers
    times = root.findall("timestep")
    assert root.tag == "fcd-export" and [float(t.get("time")) for t in times] == [0, 1, 2, 3]
    lorry = {v.get("id"): v for v in times[1]}["<script>alert(1)</script>"]
    # the front bumper is 5 m ahead of the middle, to the north-west; compass: north-west is 315 degrees
    ahead = 5 * np.sqrt(0.5)
    assert float(lorry.get("x")) == pytest.approx(1097 - ahead, abs=0.01)
    assert float(lorry.get("y")) == pytest.approx(2070 + ahead, abs=0.01)
    assert float(lorry.get("angle")) == pytest.approx(315, abs=0.1) and lorry.get("type") == "truck"
    assert float(lorry.get("z")) == 0 and float(lorry.get("speed")) == 6
    assert [v.tag for v in times[2]] == ["vehicle", "vehicle", "person", "vehicle"]


def test_fcd_is_replayed_as_the_run_that_it_came_from(run, of, tmp_path):
    """Classes, sizes and centres, to the last bit; step 0 of a replay is the road before the trace."""
    truck.written(fcd.Fcd().plan(of), tmp_path)
    who = ActorRegistry(FleetParams(), 4)
    traffic = TraceReplay(TrafficParams(step_s=run.dt_s), tmp_path / "fcd.xml.gz", who)
    assert len(traffic.advance()) == 0
    for step in sorted(run.actors.step.unique()):
        world = traffic.advance()
        there = run.actors[run.actors.step == step].merge(run.vehicles, left_on="actor", right_on="vehicle")
        there = there.set_index("sumo_id").loc[[who.names[a] for a in world.actor]]
        np.testing.assert_array_equal(world.boxes.lwh_m, there[["length_m", "width_m", "height_m"]])
        np.testing.assert_allclose(world.boxes.xyz_m[:, :2] - HERE.origin_m, there[["x_m", "y_m"]], atol=1 / 256)
        assert [Shape(code).name.lower() for code in world.shape] == there.vehicle_class.tolist()
    assert "types_guessed" not in traffic.report()


def turned(quaternion, xyz):
    """A vector turned by a quaternion w, x, y, z, by the textbook: v + 2 u x (u x v + w v)."""
    w, u = quaternion[0], np.array(quaternion[1:])
    return xyz + 2 * np.cross(u, np.cross(u, xyz) + w * np.array(xyz))


def nuscenes_in(folder):
    """Records of each table, as a list and by token."""
    table = {p.stem: json.loads(p.read_text()) for p in (folder / nuscenes.VERSION).iterdir()}
    return table, {name: {row["token"]: row for row in rows} for name, rows in table.items()}


def test_nuscenes_truck_by_hand(of, tmp_path):
    made = truck.written(nuscenes.NuScenes().plan(of), tmp_path)
    table, by = nuscenes_in(tmp_path)
    (scene,) = [s for s in table["scene"] if s["name"] == "scene-000000-0"]
    sample = by["sample"][scene["first_sample_token"]]
    (data,) = [d for d in table["sample_data"] if d["sample_token"] == sample["token"]]
    (lorry,) = [a for a in table["sample_annotation"] if a["sample_token"] == sample["token"]]
    pose, mount = by["ego_pose"][data["ego_pose_token"]], by["calibrated_sensor"][data["calibrated_sensor_token"]]
    assert lorry["size"] == [2.5, 10, 3.5] and lorry["num_lidar_pts"] == 90 and lorry["visibility_token"] == "4"
    # from the world into the frame of the vehicle, then into the sensor's: x right, y forward
    away = np.array(lorry["translation"]) - pose["translation"]
    inverse = [pose["rotation"][0], *(-x for x in pose["rotation"][1:])]
    ego = turned(inverse, away) - mount["translation"]
    sensor = turned([mount["rotation"][0], *(-x for x in mount["rotation"][1:])], ego)
    forward, left, up = TRUCK_SENSOR[:3]
    assert sensor == pytest.approx([-left, forward, up], abs=0.025)
    assert np.array(pose["translation"]) + [0, 0, mount["translation"][2]] == pytest.approx(CAR_LIDAR[:3])
    points = np.frombuffer(made[data["filename"]], "<f4").reshape(-1, 5)
    assert points[:2].tolist() == [[-2, 1, 3, 0, 0], [-5, 4, 6, 0, 0]], "of (1, 2, 3) and (4, 5, 6)"
    assert data["timestamp"] == START_S * 10**6
    kinds = [by["category"][by["instance"][a["instance_token"]]["category_token"]]["name"] for a in (lorry,)]
    assert kinds == ["vehicle.truck"]


def test_nuscenes_is_linked(of, tmp_path):
    """Every token leads to a record, and chains lead from the first to the last."""
    truck.written(nuscenes.NuScenes().plan(of), tmp_path)
    table, by = nuscenes_in(tmp_path)
    assert all(len(by[name]) == len(rows) for name, rows in table.items())
    for name, rows in table.items():
        for row in rows:
            for key, value in row.items():
                target = key.removesuffix("_token").removesuffix("_tokens").removeprefix("first_").removeprefix("last_")
                target = {"annotation": "sample_annotation", "prev": name, "next": name}.get(target, target)
                if target in by and key not in ("token", "category") and value:
                    for one in value if isinstance(value, list) else [value]:
                        assert one in by[target], (name, key)
    for kind, owner, count in (
        ("sample", "scene", "nbr_samples"),
        ("sample_annotation", "instance", "nbr_annotations"),
    ):
        short = kind.removeprefix("sample_")
        for row in table[owner]:
            chain = [by[kind][row[f"first_{short}_token"]]]
            while chain[-1]["next"]:
                assert by[kind][chain[-1]["next"]]["prev"] == chain[-1]["token"]
                chain.append(by[kind][chain[-1]["next"]])
            assert chain[-1]["token"] == row[f"last_{short}_token"] and len(chain) == row[count]


def test_boxes_of_a_bag_by_hand():
    """The bytes of two markers as a reader walks through them."""
    box = np.array([TRUCK_WORLD, TRUCK_WORLD + [1, 0, 0, 0, 0, 0, 0]])
    raw = ros2.boxes(1_500_000_000, "actors", np.array([7, 8]), box, np.array([[1, 0, 0, 1], [0, 1, 0, 0.5]], "f4"))
    assert raw[:4] == b"\0\1\0\0"
    body, at = raw[4:], 4
    assert struct.unpack_from("<I", body, 0) == (3,)
    found = []
    for _ in range(3):

        def take(form, size):
            nonlocal at
            at += -at % size
            values = struct.unpack_from("<" + form, body, at)
            at += struct.calcsize("<" + form)
            return values

        def text():
            nonlocal at
            (n,) = take("I", 4)
            at += n
            return body[at - n : at - 1].decode()

        row = {"stamp": take("iI", 4), "frame": text(), "ns": text(), "head": take("3i", 4), "pose": take("7d", 8)}
        row |= {"size": take("3d", 8), "ink": take("4f", 4), "life": take("iI?", 4), "empty": take("2I", 4)}
        row |= {"texture": text(), "stamp2": take("iI", 4), "frame2": text(), "format": text(), "rest": take("2I", 4)}
        row |= {"text": text(), "mesh": text(), "file": text(), "data": take("I", 4), "embedded": take("?", 1)}
        found.append(row)
    assert at == len(body), "nothing is left"
    assert [row["head"] for row in found] == [(0, 1, 3), (7, 1, 0), (8, 1, 0)], "id, a cube, and delete all or add"
    assert found[1]["stamp"] == (1, 500_000_000) and found[1]["frame"] == "map" and found[1]["ns"].strip() == "actors"
    assert found[2]["pose"] == pytest.approx([98, 70, 1.75, 0, 0, np.sin(np.radians(67.5)), np.cos(np.radians(67.5))])
    assert found[2]["size"] == (10, 2.5, 3.5) and found[2]["ink"] == (0, 1, 0, 0.5)


def bag(of, folder):
    pytest.importorskip("mcap")
    return truck.written(ros2.Ros2Bag().plan(of), folder)


def decoded(folder):
    """Topic, time and message, by the reader of MCAP's own project."""
    reader, decoder = pytest.importorskip("mcap.reader"), pytest.importorskip("mcap_ros2.decoder")
    for path in sorted(folder.glob("*.mcap")):
        with path.open("rb") as file:
            read = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
            for _, channel, message, content in read.iter_decoded_messages():
                yield channel.topic, message.log_time, content


def test_bag_is_read_by_mcap(run, of, tmp_path):
    bag(of, tmp_path)
    found = {}
    for topic, nanos, content in decoded(tmp_path):
        found.setdefault(topic, []).append((nanos, content))
    assert [t - START_S * 10**9 for t, _ in found["/actors"]] == [0, 10**9, 2 * 10**9, 3 * 10**9]
    (building,) = found["/buildings"]
    assert len(building[1].points) == len(building[1].colors) == 6 and building[1].type == 11
    for step, (_, array) in enumerate(found["/actors"]):
        there = run.actors[run.actors.step == step].sort_values("actor")
        assert [m.id for m in array.markers[1:]] == there.actor.tolist()
        assert [m.pose.position.x for m in array.markers[1:]] == there.x_m.tolist()
    (frame,) = [t for t in found["/tf"][0][1].transforms if t.child_frame_id == "vehicle_0/lidar"]
    place = frame.transform.translation
    assert [place.x, place.y, place.z] == pytest.approx(CAR_LIDAR[:3])
    (seen,) = [d for d in found["/vehicle_0/detections"][0][1].detections if d.id == "1"]
    assert seen.results[0].hypothesis.class_id == "truck" and seen.bbox.center.position.x == 97
    (rated,) = found["/trust"]
    points = np.frombuffer(rated[1].data, ros2.RATED)
    assert rated[0] == (START_S + 2) * 10**9 and points["subject"].tolist() == [0, 1]
    assert points["trust"].tolist() == [0, 0.25] and points["x"].tolist() == [100, 97]
    cloud = found["/vehicle_0/points"][2][1]
    assert cloud.header.frame_id == "vehicle_0/lidar" and cloud.width == 3
    assert np.frombuffer(cloud.data, "<f4").reshape(-1, 3).tolist() == truck.clouds(2, [0])[0]().tolist()


def test_bag_has_trust_in_pseudonyms_in_use_alone(tmp_path):
    """The server rates pseudonyms 0 and 1 in step 2; since that step, vehicle 0 has pseudonym 9."""
    used = [
        {"pseudonym": number, "vehicle": vehicle, "from_step": first, "to_step": last}
        for number, vehicle, first, last in ((0, 0, 0, 1), (9, 0, 2, 3), (1, 1, 0, 3), (3, 3, 1, 3))
    ]
    run = truck.make(tmp_path / "run", pseudonyms=used)
    bag(truck.selection(run), tmp_path / "bag")
    (rated,) = [content for topic, _, content in decoded(tmp_path / "bag") if topic == "/trust"]
    assert np.frombuffer(rated.data, ros2.RATED)["subject"].tolist() == [1]


def test_boxes_are_deleted_where_nobody_is_on_the_road(of, tmp_path):
    """Actors are there in steps 0 to 3. The message of step 4 deletes their boxes and adds none."""
    bag(replace(of, steps=np.arange(5)), tmp_path)
    arrays = [content for topic, _, content in decoded(tmp_path) if topic == "/actors"]
    assert [len(array.markers) for array in arrays] == [3, 4, 5, 5, 1]


def test_bag_of_no_vehicle_in_particular(of, tmp_path):
    bag(replace(of, named=False), tmp_path)
    assert {topic for topic, _, _ in decoded(tmp_path)} == {"/actors", "/buildings", "/fabricated", "/trust"}


def test_a_missing_library_is_one_line():
    with pytest.raises(ValueError, match="pip install 'cosim-perception\\[formats\\]'"), needed("x", "does", "formats"):
        import no_such_library  # noqa: F401


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_nuscenes_by_its_devkit(run, of, tmp_path):
    """The kit asks for NumPy 1 and Shapely 2.0; installed without its dependencies it runs beside newer ones."""
    kit = pytest.importorskip("nuscenes.nuscenes")
    geometry = pytest.importorskip("nuscenes.utils.geometry_utils")
    truck.written(nuscenes.NuScenes().plan(of), tmp_path)
    found = kit.NuScenes(nuscenes.VERSION, str(tmp_path), verbose=False)
    found.list_scenes()
    assert len(found.scene) == 3 and len(found.sample) == 4 + 4 + 3
    (scene,) = [s for s in found.scene if s["name"] == "scene-000000-0"]
    data = found.get("sample", scene["first_sample_token"])["data"]["LIDAR_TOP"]
    path, (box,), _ = found.get_sample_data(data)
    assert box.center == pytest.approx([-TRUCK_SENSOR[1], TRUCK_SENSOR[0], TRUCK_SENSOR[2]], abs=0.025)
    assert kit.LidarPointCloud.from_file(path).points.shape == (4, 3)
    inside = geometry.points_in_box(box, np.array([[-3.0], [20.0], [0.0]]))
    assert inside.all()


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_bag_by_rosbags(of, tmp_path):
    """A second reader of ROS 2 bags, with the metadata."""
    reader = pytest.importorskip("rosbags.highlevel")
    bag(of, tmp_path)
    with reader.AnyReader([tmp_path]) as opened:
        counted = {c.topic: c.msgcount for c in opened.connections}
        found = [(c.topic, opened.deserialize(raw, c.msgtype)) for c, _, raw in opened.messages()]
        assert sum(counted.values()) == len(found) == opened.message_count
    assert [m.markers[1].scale.z for topic, m in found if topic == "/actors"] == [1.5] * 4


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_fcd_by_sumolib(run, of, tmp_path):
    sumolib = pytest.importorskip("sumolib")
    truck.written(fcd.Fcd().plan(of), tmp_path)
    times = list(sumolib.xml.parse(str(tmp_path / "fcd.xml.gz"), "timestep"))
    assert [float(t.time) for t in times] == [0, 1, 2, 3]
    car = next(v for v in times[0].vehicle if v.id == "a/../../b")
    # its front bumper is 2.25 m north of its middle
    assert (float(car.x), float(car.y)) == pytest.approx((1100, 2052.25), abs=0.01)
