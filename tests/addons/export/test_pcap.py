"""Packets: the turning truck by hand, everything that is written read back, and tshark where it is installed."""

import json
import shutil
import subprocess
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from cosim.addons.export import pcap, veremi_nextgen
from cosim.base.codes import ObjectClass
from cosim.base.earth import Projection
from cosim.messages import cpm
from tests.addons.export import readers, truck
from tests.results import tiny

NORTH = Projection(60.0, 25.0)
START_MS = 662_774_405_000
"""2025-01-01 in milliseconds of atomic time since 2004: 7,671 days and five leap seconds."""


def written(run, folder, projection=NORTH, **params):
    of = replace(truck.selection(run), projection=lambda: projection)
    return truck.written(pcap.Pcap(pcap.Params(**params)).plan(of), folder)


def of_port(frames, port):
    return [f for f in frames if f["port"] == port]


def test_truck_by_hand(run, tmp_path):
    """The car's front is at (100, 52.25) on the ground. From there, the truck is 3 m west, 17.75 m north, 1.75 m up."""
    assert START_MS == (7671 * 86400 + 5) * 1000
    assert sorted(written(run, tmp_path)) == ["sent.pcap", "vehicles.csv"]
    frames = readers.pcap(tmp_path / "sent.pcap")
    first, second = frames[:2]
    assert (first["port"], second["port"], first["station"], first["type"]) == (2001, 2009, 0, 5)
    cam, cpm = readers.cam(first["message"]), readers.cpm(second["message"])
    # a degree of the meridian at 60 degrees is 111,412 m long, one of longitude 55,800 m
    lat, lon = 60 + 52.25 / 111412, 25 + 100 / 55800
    for place in (first, cam, cpm):
        assert (place["lat"], place["lon"]) == pytest.approx((lat * 1e7, lon * 1e7), abs=3)
    assert first["stamp_ms"] == START_MS % 2**32 and cam["delta_ms"] == START_MS % 2**16 and cpm["time_ms"] == START_MS
    assert first["time_s"] == 1_735_689_600 and cpm["range"] == 0
    assert cam["heading"] == first["heading"] == cpm["heading"] == 0 and cam["speed"] == 0 and cam["type"] == 5
    assert (cam["length"], cam["width"], cam["trailer"]) == (45, 18, 4)
    unknown = ("heading_sure", "speed_sure", "acceleration_sure", "curvature", "curvature_sure", "mode", "yaw_rate")
    assert [cam[name] for name in unknown] == [127, 127, 102, 1023, 7, 2, 32767] and cam["yaw_rate_sure"] == 8
    (seen,) = cpm["objects"]
    assert cpm["n_objects"] == 1 and cpm["segment"] is None
    assert (seen["x"], seen["y"], seen["z"]) == pytest.approx((-300, 1775, 175), abs=1)
    assert seen["angle"] == pytest.approx(1350, abs=2) and seen["class"] == "truck" and seen["sure"] == 75
    assert (seen["length"], seen["width"], seen["height"]) == (100, 25, 35)
    assert (seen["number"], seen["delta_ms"]) == (1, 0)
    mine = [readers.cam(f["message"]) for f in of_port(frames, 2001) if f["station"] == 1]
    assert [m["speed"] for m in mine] == [500, 600, 700, 800] and [m["acceleration"] for m in mine] == [0, 10, 10, 10]
    assert {m["heading"] for m in mine} <= {3149, 3150, 3151} and {m["type"] for m in mine} == {8}


def test_all_messages_that_were_sent(run, tmp_path):
    written(run, tmp_path)
    frames = readers.pcap(tmp_path / "sent.pcap")
    own = run.detections[(run.detections.detection_index == 0) & run.detections.transmitted]
    assert len(of_port(frames, 2001)) == len(of_port(frames, 2009)) == len(own)
    times = [f["time_s"] for f in frames]
    assert times == sorted(times) and {f["traffic_class"] for f in of_port(frames, 2009)} == {3}
    last = [readers.cpm(f["message"]) for f in of_port(frames, 2009) if f["time_s"] == times[-1]]
    assert all(m["n_objects"] == 0 for m in last), "the last detection was not transmitted"
    assert {readers.cpm(f["message"])["station"] for f in of_port(frames, 2009)} == {0, 1, 3}


def test_what_each_vehicle_received(run, tmp_path):
    files = written(run, tmp_path, received=True)
    assert sorted(files) == ["veh_0.pcap", "veh_1.pcap", "veh_3.pcap", "vehicles.csv"]
    for receiver in (0, 1, 3):
        frames = of_port(readers.pcap(tmp_path / f"veh_{receiver}.pcap"), 2009)
        got = run.receptions[run.receptions.receiver == receiver]
        stations = [readers.cpm(f["message"])["station"] for f in frames]
        steps = [(readers.cpm(f["message"])["time_ms"] - START_MS) / 1000 for f in frames]
        assert sorted(zip(steps, stations, strict=True)) == sorted(zip(got.step, got.sender, strict=True))
        assert [f["time_s"] - 1_735_689_600 for f in frames] == pytest.approx([s + 0.75 for s in steps])


def test_messages_of_roadside_units_are_counted(tmp_path):
    """Vehicles 0 and 1 are there in step 0, in which the unit 4 sends."""
    of = replace(truck.selection(truck.make(tmp_path / "run", units=[4])), projection=lambda: NORTH)
    (remark,) = pcap.Pcap(pcap.Params(received=True)).plan(of).remarks
    assert remark.startswith("2 received messages of roadside units are left out")


def test_messages_that_were_sent_before_the_chosen_steps(tmp_path):
    """All messages arrive a step late. In step 2 there are those of step 1, when 0, 1 and 3 were there."""
    run = truck.make(tmp_path / "run", late=1)
    of = replace(truck.selection(run), steps=np.array([2]), projection=lambda: NORTH)
    truck.written(pcap.Pcap(pcap.Params(received=True)).plan(of), tmp_path)
    frames = of_port(readers.pcap(tmp_path / "veh_0.pcap"), 2009)
    cpms = [readers.cpm(frame["message"]) for frame in frames]
    assert [cpm["station"] for cpm in cpms] == [1, 3]
    assert {cpm["time_ms"] for cpm in cpms} == {START_MS + 1000}
    made = truck.written(veremi_nextgen.VeremiNextGen().plan(of), tmp_path)
    assert [int(m["sender_alias"]) for m in json.loads(made["veh_0.json"])] == [1, 3]


def test_true_north(run, tmp_path):
    """Far from the central meridian: places of objects, from places of senders in degrees, are those of the map."""
    projection = Projection(60.0, 20.0, 0.9996, 250_000.0, 0.0)
    written(run, tmp_path, projection)
    frame = of_port(readers.pcap(tmp_path / "sent.pcap"), 2009)[0]
    cpm = readers.cpm(frame["message"])
    turn = projection.of_world(np.array([[100.0, 52.25]])).turn_rad[0]
    assert np.degrees(turn) > 3 and cpm["heading"] == pytest.approx(10 * np.degrees(turn), abs=1)
    (seen,) = cpm["objects"]
    true = projection.of_world(np.array([[97.0, 70.0]]))
    east = (true.longitude_deg[0] - cpm["lon"] / 1e7) * 55_800
    north = (true.latitude_deg[0] - cpm["lat"] / 1e7) * 111_412
    assert (seen["x"] / 100, seen["y"] / 100) == pytest.approx((east, north), abs=0.05)
    assert seen["angle"] == pytest.approx(1350 - 10 * np.degrees(turn), abs=2)


def car(**more):
    return truck.body(0, "car", (4, 2, 1.5), "a", **more)


def many(folder, n, **more):
    """A car at the origin, heading east, that detects `n` cyclists; without a self report."""
    (folder / "run").mkdir(parents=True)
    detections = [
        {"step": 0, "observer": 0, "detection_index": i, "class": "cyclist", "score": 0.5, "origin": "sensed",
         "transmitted": True, **truck.box((float(i), 0, 1), (2, 0.5, 1.8), 0.0)} for i in range(1, n + 1)
    ]  # fmt: skip
    actors = [{"step": s, "actor": 0, "z_m": 0.75, "speed_mps": 1} for s in range(4)]
    return tiny.make(folder / "run", 4, truck.CONFIG, vehicles=[car(**more)], actors=actors, detections=detections)


@pytest.mark.parametrize(("kind", "number"), [("car", 5), ("bus", 8)])
def test_long_messages_are_segments(tmp_path, kind, number):
    run = many(tmp_path, 255, vehicle_class=kind)
    of = replace(truck.selection(run, (0,)), projection=lambda: NORTH)
    truck.written(pcap.Pcap().plan(of), tmp_path / "out")
    frames = readers.pcap(tmp_path / "out" / "sent.pcap")
    messages = [readers.cpm(f["message"]) for f in frames]
    assert [m["segment"] for m in messages] == [(len(messages), i + 1) for i in range(len(messages))] and messages
    assert 1300 < max(4 + len(f["message"]) for f in frames) <= 1398 and {f["type"] for f in frames} == {number}
    seen = [o for m in messages for o in m["objects"]]
    assert [o["number"] for o in seen] == list(range(1, 256)) and {m["n_objects"] for m in messages} == {255}
    assert seen[9]["class"] == "cyclist" and seen[9]["x"] == pytest.approx(800, abs=1) and seen[9]["z"] == 100


def sent_by(run, out):
    """The detection messages that vehicle 0 of a run sends, read from a capture in the folder `out`."""
    of = replace(truck.selection(run, (0,)), projection=lambda: NORTH)
    truck.written(pcap.Pcap().plan(of), out)
    return [readers.cpm(f["message"]) for f in readers.pcap(out / "sent.pcap")]


def test_sensors_are_described_where_the_message_does_and_in_its_first_segment(tmp_path):
    messages = sent_by(many(tmp_path, 255), tmp_path / "out")
    assert [m["range"] for m in messages] == [0] + [None] * (len(messages) - 1)
    (tmp_path / "second").mkdir()
    seen = [{"step": s, "observer": 0, "detection_index": 1, "class": "car", "score": 0.5, "origin": "sensed",
             "transmitted": True, **truck.box((9, 0, 1), (4, 2, 1.8), 0.0)} for s in range(4)]  # fmt: skip
    actors = [{"step": s, "actor": 0, "z_m": 0.75, "speed_mps": 1} for s in range(4)]
    content = [{"step": s, "sender": 0, "length_bytes": 200, "sensors": s in (0, 2)} for s in range(3)]
    run = tiny.make(tmp_path / "second", 4, truck.CONFIG, vehicles=[car()], actors=actors, detections=seen,
                    cpm_content=content)  # fmt: skip
    messages = sent_by(run, tmp_path / "out")
    assert [m["range"] for m in messages] == [0, None, 0, 0], "the last is not in the table"


def read_back(perceived):
    """Objects of a message where the grid's north is turned by 90 degrees."""
    n = len(perceived)
    place = replace(NORTH.of_world(np.zeros((1, 2))), turn_rad=np.array([np.pi / 2]))
    objects = pcap.objects_of(perceived, np.zeros((n, 3)), place, np.zeros(n, int))
    return readers.cpm(cpm.cpm(cpm.CpmHead(1, 2, 3, 4, 5, 6.0), n, objects.between(0, n)))["objects"]


def test_velocities_and_numbers_of_tracks():
    """North is turned by 90 degrees: 3 m/s to the map's east are 3 m/s to the south. The second object has no track."""
    rows = [truck.box((9, 0, 1), (4, 2, 1.8), 0.0)] * 3
    perceived = pd.DataFrame(rows).assign(**{
        "observer": 5, "detection_index": [1, 2, 3], "class": "car", "score": 0.5,
        "velocity_x_mps": [3.0, np.nan, -1.25], "velocity_y_mps": [0.5, np.nan, 400.0],
        "object_id": pd.array([7, None, 2**15 + 9], "Int32"),
    })  # fmt: skip
    seen = read_back(perceived)
    assert [o["velocity"] for o in seen] == [(50, -300), None, (16382, 125)], "400 m/s: out of range"
    # 40,503 times 7, 32,769 and 9, and 5 x 2,654,435,761 / 65,536 = 202,517 of the pseudonym, modulo 65,536
    assert [o["number"] for o in seen] == [27286, 13644, 42756]
    seen = read_back(perceived.drop(columns=list(pcap.TRACKED)))
    assert [(o["velocity"], o["number"]) for o in seen] == [(None, 1), (None, 2), (None, 3)]


def test_numbers_of_objects_do_not_tell_who_was_fabricated():
    """Two of 20 objects are fabricated, in three messages of each of 200 pseudonyms. Numbers differ within a message,
    stay from message to message, are new with a pseudonym, and those of fabricated objects are spread as others are."""
    track = pd.array([*range(18), None, None], "Int32")
    message = np.repeat(np.arange(600), 20)
    perceived = pd.DataFrame({"observer": message // 3, "object_id": np.tile(track, 600)})
    number = pcap._object_numbers(perceived, message).reshape(200, 3, 20)
    assert (number == number[:, :1]).all() and number.min() >= 0 and number.max() < 2**16
    of_pseudonym = number[:, 0]
    assert all(len(set(row)) == 20 for row in of_pseudonym.tolist())
    for column in of_pseudonym.T:
        assert len(set(column)) > 195 and 0.35 < (column < 2**15).mean() < 0.65


def test_stated_accuracies_are_confidence_values():
    """By hand: 1.96 standard deviations, in 0.01 m, 0.01 m/s, 0.1 degrees, 0.1 m. North is turned by 90 degrees."""
    perceived = pd.DataFrame([truck.box((9, 0, 1), (4, 2, 1.8), 0.0)] * 3).assign(**{
        "observer": 5, "detection_index": [1, 2, 3], "class": "car", "score": 0.5,
        "object_id": pd.array([1, 2, 3], "Int32"),
        "velocity_x_mps": 3.0, "velocity_y_mps": 0.0,
        "relative_x_std_m": [0.5, np.nan, 50.0], "relative_y_std_m": [0.2, np.nan, 50.0],
        "relative_xy_correlation": [0.3, np.nan, 0.0], "velocity_x_std_mps": [0.25, np.nan, 9.0],
        "velocity_y_std_mps": [0.1, np.nan, 9.0], "velocity_xy_correlation": [0.0, np.nan, 0.0],
        "yaw_std_rad": [np.radians(2), np.nan, 1.0], "size_std": [0.05, np.nan, 2.0],
    })  # fmt: skip
    found = [o.get("confidence") for o in read_back(perceived)]
    assert found[0] == {
        "x": 40, "y": 98, "z": 4096, "velocity": (20, 49), "angle": 40, "height": 2, "width": 2, "length": 4
    }  # fmt: skip
    assert found[1] is None, "nothing stated: unavailable"
    assert found[2] == {
        "x": 4095, "y": 4095, "z": 4096, "velocity": (126, 126), "angle": 126, "height": 31, "width": 31, "length": 31
    }, "out of range"  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_segments_hold_as_many_objects_as_fit(seed):
    """Also of moving objects, which are longer: every segment fits, and one object more would not."""
    rng = np.random.default_rng(seed)
    n = 255
    label, moves = rng.integers(0, 4, n), rng.random(n) < rng.random()
    velocity = np.where(moves[:, None], rng.uniform(-30, 30, (n, 2)), np.nan)
    columns = np.arange(n), label, rng.uniform(-9, 9, (n, 3)), np.ones((n, 3)), rng.uniform(-3, 3, n), rng.random(n)
    objects = cpm.CpmObjects.of(*columns, velocity)
    cuts = [0, *pcap.cuts_of(objects.is_used.sum(axis=1)), n]
    assert len(cuts) - 1 <= 8

    def length(first, last):
        return 4 + len(cpm.cpm(cpm.CpmHead(1, 2, 3, 4, 5, 6.0, (8, 1)), n, objects.between(first, last)))

    for first, last in pairwise(cuts):
        assert length(first, last) <= 1398
        assert last == n or length(first, last + 1) > 1398 - 2
    assert pcap.cuts_of(np.zeros(0, int)) == []


def test_where_on_earth(run, tmp_path):
    with pytest.raises(ValueError, match=r"does not say where on Earth.*--set latitude=60\.17"):
        pcap.Pcap().plan(truck.selection(run))
    with pytest.raises(ValueError, match="the latitude and the longitude of the origin"):
        pcap.Pcap(pcap.Params(latitude=60.0)).plan(truck.selection(run))
    truck.written(pcap.Pcap(pcap.Params(latitude=60.0, longitude=25.0)).plan(truck.selection(run)), tmp_path / "set")
    written(run, tmp_path / "net")
    assert (tmp_path / "set/sent.pcap").read_bytes() == (tmp_path / "net/sent.pcap").read_bytes()


def test_tables():
    assert "receptions" not in pcap.Pcap().TABLES and "receptions" in pcap.Pcap(pcap.Params(received=True)).TABLES


TSHARK = shutil.which("tshark")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """600 CAMs and 600 CPMs of 30 cars with up to 29 random objects."""
    folder, rng, kinds = tmp_path_factory.mktemp("tshark"), np.random.default_rng(0), tuple(ObjectClass)
    (folder / "run").mkdir()
    n_steps, cars = 20, range(30)
    vehicles = [truck.body(v, "car", (4.5, 1.8, 1.5), str(v), last=n_steps) for v in cars]
    actors = [{"step": s, "actor": v, "x_m": s, "z_m": 0.75, "speed_mps": 5} for s in range(n_steps) for v in cars]
    detections = [
        {"step": s, "observer": v, "detection_index": i, "class": kinds[rng.integers(4)].name.lower() if i else "car",
         "score": rng.random() if i else 1.0, "origin": "sensed" if i else "self", "transmitted": True,
         "speed_mps": None if i else 5.0 + s % 7, "acceleration_mps2": None if i else -1.0,
         **truck.box((*rng.uniform(-90, 90, 2), 1.0), rng.uniform(0.5, 12, 3), rng.uniform(-3, 3))}
        for s in range(n_steps) for v in cars for i in range(int(rng.integers(1, 30)))
    ]  # fmt: skip
    run = tiny.make(folder / "run", n_steps, truck.CONFIG, vehicles=vehicles, actors=actors, detections=detections)
    of = replace(truck.selection(run, tuple(cars)), projection=lambda: NORTH, steps=np.arange(n_steps))
    truck.written(pcap.Pcap().plan(of), folder)
    return folder / "sent.pcap"


def tshark(capture, *fields):
    """One tuple of texts per packet."""
    options = [w for f in fields for w in ("-e", f)]
    done = subprocess.run([TSHARK, "-r", capture, "-T", "fields", *options], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"this version of tshark has other names of fields: {done.stderr.strip().splitlines()[-1]}")
    return [tuple(line.split("\t")) for line in done.stdout.splitlines()]


@pytest.mark.skipif(TSHARK is None, reason="tshark is not installed")
def test_tshark_opens_all_packets(capture):
    """Not one of 1,200 packets is malformed. 4.0 dissects the header of a CPM of release 2, and says so, no more."""
    packets = tshark(capture, "btpb.dstport", "geonw.src_pos.addr.mid", "_ws.malformed", "_ws.expert.message")
    assert [p[0] for p in packets].count("2001") == [p[0] for p in packets].count("2009") == 600
    assert len({p[1] for p in packets}) == 30
    assert {p[2:] for p in packets if p[0] == "2001"} == {("", "")}
    said = {p[2:] for p in packets if p[0] == "2009"}
    assert said in ({("", "No subdissector found for this Message id/protocol version combination")}, {("", "")})


@pytest.mark.skipif(TSHARK is None, reason="tshark is not installed")
def test_tshark_reads_the_values_of_cams(capture):
    its = ("messageID", "stationID", "latitude", "longitude", "headingValue", "speedValue", "vehicleLengthValue",
           "longitudinalAccelerationValue", "curvatureValue", "yawRateValue")  # fmt: skip
    cam = ("vehicleWidth", "driveDirection", "stationType", "generationDeltaTime", "curvatureCalculationMode")
    packets = tshark(capture, "btpb.dstport", *(f"its.{name}" for name in its), *(f"cam.{name}" for name in cam))
    mine = ("station", "lat", "lon", "heading", "speed", "length", "acceleration", "curvature", "yaw_rate",
            "width", "direction", "type", "delta_ms", "mode")  # fmt: skip
    read = [readers.cam(f["message"]) for f in of_port(readers.pcap(capture), 2001)]
    assert [p[2:] for p in packets if p[0] == "2001"] == [tuple(str(m[name]) for name in mine) for m in read]
    assert {(p[0], p[1]) for p in packets} == {("2001", "2"), ("2009", "14")}
