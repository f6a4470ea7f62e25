"""VeReMi NextGen: the turning truck by hand, and everything that is written read back."""

import json

import numpy as np
import pytest

from cosim.addons.export import veremi_nextgen
from tests.addons.export import truck
from tests.results import tiny


def export(exporter, run, folder):
    return truck.written(exporter().plan(truck.selection(run)), folder)


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
    assert [sender[name] for name in ("pos_noise", "hed_noise", "spd_noise")] == ["0.2,0.2,0", "0.5", "0"]
    assert [found["receiver"][name] for name in ("pos_noise", "hed_noise")] == ["0,0,0", "0"]  # the true state


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


def test_nextgen_receiver_of_a_late_message(tmp_path):
    """The truck drives with 5 m/s in step 0 and 8 in step 3, in which it receives what was sent in step 2."""
    made = export(veremi_nextgen.VeremiNextGen, truck.make(tmp_path / "run", late=1), tmp_path)
    received = [m for m in json.loads(made["veh_1.json"]) if m["sender_id"] == "veh_0"]
    assert [m["receiver"]["spd"] for m in received] == ["6.0000", "7.0000", "8.0000"]


def test_messages_without_a_self_report_are_counted(run, tmp_path):
    """There are 2 receptions in step 0 and 6 in each later one. In step 1 vehicles 0 and 3 receive the truck's message,
    in which it leaves its own report out."""
    silent = {"step": 1, "observer": 1, "detection_index": 0}
    some = truck.make(tmp_path / "run", lambda table, row: table != "detections" or not silent.items() <= row.items())
    (remark,) = veremi_nextgen.VeremiNextGen().plan(truck.selection(some)).remarks
    assert remark == "2 of 20 received messages are left out: they hold no self report."
    assert veremi_nextgen.VeremiNextGen().plan(truck.selection(run)).remarks == ()


def test_without_self_reports_there_is_nothing_to_export(tmp_path):
    (tmp_path / "run").mkdir()
    run = tiny.make(tmp_path / "run", 4, truck.CONFIG, vehicles=[truck.body(0, "car", (4, 2, 1.5), "a")])
    with pytest.raises(ValueError, match=r"no self report.*trust\.self_reports"):
        veremi_nextgen.VeremiNextGen().plan(truck.selection(run, vehicles=(0,)))
