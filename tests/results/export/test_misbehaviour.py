"""VeReMi Extension and NextGen: the turning truck by hand, and everything that is written read back."""

import csv
import io
import json

import numpy as np
import pytest

from results.export import veremi, veremi_nextgen
from tests.results import tiny
from tests.results.export import readers, truck

GRAIN = 5e-3
"""Headings are kept to 1/512 rad, times 7 m/s at most."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return truck.make(tmp_path_factory.mktemp("export") / "run")


def export(exporter, run, folder):
    return truck.written(exporter().plan(truck.selection(run)), folder)


def test_veremi_truck_by_hand(run, tmp_path):
    export(veremi.Veremi, run, tmp_path)
    received = readers.json_lines(tmp_path / "traceJSON-0-0-A0-0-0.json")
    # the car hears the truck's message of step 1, which says 6 m/s and 1 m/s2 towards the north-west
    (found,) = [m for m in received if m["type"] == 3 and m["sender"] == 1 and m["sendTime"] == 1.25]
    assert found["rcvTime"] == 1.75 and found["pos"] == pytest.approx([97, 70, 1.75])
    assert found["spd"] == pytest.approx([-6 / np.sqrt(2), 6 / np.sqrt(2), 0], abs=GRAIN)
    assert found["acl"] == pytest.approx([-1 / np.sqrt(2), 1 / np.sqrt(2), 0], abs=GRAIN)
    assert found["hed"] == pytest.approx([-1 / np.sqrt(2), 1 / np.sqrt(2), 0], abs=GRAIN)
    assert (tmp_path / "traceJSON-1-1-A2-0-0.json").exists(), "malicious is role 2"


def test_veremi_round_trip(run, tmp_path):
    made = export(veremi.Veremi, run, tmp_path)
    truth = readers.json_lines(tmp_path / "traceGroundTruthJSON-0.json")
    sent = run.detections[run.detections.detection_index == 0]
    assert len(truth) == len(sent) and len({m["messageID"] for m in truth}) == len(truth)
    by_id = {m["messageID"]: m for m in truth}
    n = 0
    for path in tmp_path.glob("traceJSON-*"):
        receiver = int(path.name.split("-")[1])
        lines = readers.json_lines(path)
        times = [m["rcvTime"] for m in lines]
        assert times == sorted(times)
        own = run.actors[run.actors.actor == receiver]
        assert [m["pos"][:2] for m in lines if m["type"] == 2] == own[["x_m", "y_m"]].to_numpy().tolist()
        for m in (m for m in lines if m["type"] == 3):
            step = int(m["sendTime"])
            row = sent[(sent.step == step) & (sent.observer == m["senderPseudo"])].iloc[0]
            assert m["pos"] == pytest.approx([row.x_m, row.y_m, row.z_m], abs=1e-3)
            assert np.arctan2(m["hed"][1], m["hed"][0]) == pytest.approx(row.yaw_rad, abs=1e-3)
            assert by_id[m["messageID"]]["sender"] == m["sender"] and m["rcvTime"] - m["sendTime"] == pytest.approx(0.5)
            n += 1
    assert n == len(run.receptions)
    assert next(r["role"] for r in csv.DictReader(io.StringIO(made["attacks.csv"].decode()))) == "honest"


def test_nextgen_truck_by_hand(run, tmp_path):
    export(veremi_nextgen.VeremiNextGen, run, tmp_path)
    received = json.loads((tmp_path / "veh_0.json").read_text())
    (found,) = [m for m in received if m["sender_id"] == "veh_1" and m["sendTime"] == "1250000000"]
    assert found["rcvTime"] == "1750000000" and found["attacker"] == "0"
    sender = found["sender"]
    assert sender["pos"] == "97.0000,70.0000,1.7500" and sender["spd"] == "6.0000" and sender["acl"] == "1.0000"
    assert float(sender["hed"]) == pytest.approx(315, abs=0.06)  # north-west, clockwise from north
    assert float(found["receiver"]["hed"]) % 360 == pytest.approx(0, abs=0.06) and found["receiver"]["spd"] == "0.0000"
    assert sender["distance_to_road_edge"] == "1.2500"


def test_nextgen_round_trip(run, tmp_path):
    made = export(veremi_nextgen.VeremiNextGen, run, tmp_path)
    n = 0
    for path in tmp_path.glob("veh_*.json"):
        array = json.loads(path.read_text())
        for m in array:
            flat = [v for v in m.values() if not isinstance(v, dict)] + [*m["sender"].values(), *m["receiver"].values()]
            assert all(isinstance(v, str) for v in flat), "all values are strings"
            step = int(m["sendTime"]) // 10**9
            sender, receiver = int(m["sender_alias"]), int(path.stem.removeprefix("veh_"))
            assert m["attacker"] == str(int(sender == 1 and step >= 2))
            for side, number in (("sender", sender), ("receiver", receiver)):
                true = run.actors[(run.actors.step == step) & (run.actors.actor == number)].iloc[0]
                assert [float(x) for x in m[side]["pos"].split(",")] == pytest.approx([true.x_m, true.y_m, true.z_m])
                east, north = np.cos(true.yaw_rad), np.sin(true.yaw_rad)
                heading = np.radians(float(m[side]["hed"]))
                assert [np.sin(heading), np.cos(heading)] == pytest.approx([east, north], abs=1e-4)
                assert float(m[side]["spd"]) == pytest.approx(true.speed_mps)
            n += 1
    assert n == len(run.receptions) and "vehicles.csv" in made


def test_without_self_reports_there_is_nothing_to_export(tmp_path):
    (tmp_path / "run").mkdir()
    run = tiny.make(tmp_path / "run", 4, truck.CONFIG, vehicles=[truck.body(0, "car", (4, 2, 1.5), "a")])
    with pytest.raises(ValueError, match=r"no self report.*trust\.self_reports"):
        veremi.Veremi().plan(truck.selection(run, vehicles=(0,)))
