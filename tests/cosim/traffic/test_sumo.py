"""From SUMO's pose to ours, and the process that SUMO runs in."""

import gc
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fleet import FleetParams
from cosim.traffic.frame import Frame, TrafficError
from cosim.traffic.params import TrafficParams
from cosim.traffic.scenario import find
from cosim.traffic.source import world_from_bumpers
from sensors.scene import Shape
from tests.cosim.traffic import mixed_scenario
from tests.cosim.traffic.worlds import collect, live, registry, same


def pose(x, y, z, compass_deg, lwh):
    registry = ActorRegistry(FleetParams(), seed=1)
    number = registry.register(["a"], np.array([Shape.TRUCK], np.uint8), np.array([lwh], float), 0)
    front_m, angle = np.array([[x, y, z]], float), np.array([compass_deg], float)
    boxes = world_from_bumpers(0, number, front_m, angle, np.zeros(1), registry, Frame()).boxes
    return boxes.xyz_m[0], boxes.lwh_m[0], boxes.yaw_rad[0]


def test_turning_truck_by_hand():
    """A 10 m truck, 3 m high, front bumper at (100, 50, 2), in a left turn, heading 300 degrees by compass.

    300 degrees clockwise from north is 60 degrees west of north: direction (-sin 60, cos 60) = (-0.8660, 0.5);
    counter-clockwise from east that is 150 degrees. The centre lies 5 m behind the bumper:
    (100 + 4.3301, 50 - 2.5) = (104.3301, 47.5), and half the height, 1.5 m, above the road.
    """
    centre, lwh, yaw = pose(100, 50, 2, 300, (10.0, 2.5, 3.0))
    np.testing.assert_allclose(centre, [104.33012701892, 47.5, 3.5], atol=2**-9)  # to 1/256 m
    np.testing.assert_allclose(yaw, np.deg2rad(150), atol=2**-10)  # to 1/512 rad
    assert lwh.tolist() == [10.0, 2.5, 3.0]


@pytest.mark.parametrize(
    ("compass_deg", "yaw_deg"),
    [(0, 90), (90, 0), (180, -90), (270, 180), (360, 90), (269.999, -179.999), (45, 45), (225, -135)],
)
def test_compass(compass_deg, yaw_deg):
    """North is +90 degrees, east 0, south -90, and west exactly +180: yaw lies in (-pi, pi]."""
    yaw = pose(0, 0, 0, compass_deg, (4.0, 2.0, 1.5))[2]
    # 269.999 by compass is a hair south of west: 180.001 = -179.999 degrees.
    np.testing.assert_allclose(yaw, np.deg2rad(yaw_deg), atol=2**-10)
    assert -np.pi < yaw <= np.pi


ASKS = """<random_number><random value="true"/><seed value="77"/></random_number>
<traci_server><remote-port value="8813"/><num-clients value="2"/></traci_server>
<routing><device.rerouting.threads value="4"/></routing><processing><threads value="4"/></processing><report>"""


def test_clients_seeds_and_threads_that_a_configuration_asks_for_change_no_traffic(tmp_path):
    """A seed of the clock's, clients that are to steer it, threads: a run of the same config gives the same tables."""
    plain = live(str(mixed_scenario.write(tmp_path / "plain")), 0, 40)[0]
    config = mixed_scenario.write(tmp_path / "asks")
    config.write_text(config.read_text().replace("<report>", ASKS))
    same(live(str(config), 0, 40)[0], plain)


def test_the_demand_is_scaled_from_the_scale_of_a_configuration(tmp_path):
    """A configuration's scale of 2 at traffic.scale = 1.5 is a scale of 3."""
    plain, scaled = mixed_scenario.write(tmp_path / "plain"), mixed_scenario.write(tmp_path / "scaled")
    text = scaled.read_text()
    scaled.write_text(text.replace("<report>", '<processing><scale value="2"/></processing><report>'))
    worlds = live(str(scaled), 0, 40, TrafficParams(scale=1.5))[0]
    same(worlds, live(str(plain), 0, 40, TrafficParams(scale=3.0))[0])
    assert len(worlds[-1]["actor"]) > len(live(str(scaled), 0, 40)[0][-1]["actor"])
    for value, why in (("two", "is no number"), ("inf", "is no factor of a demand")):
        scaled.write_text(text.replace("<report>", f'<processing><scale value="{value}"/></processing><report>'))
        with pytest.raises(ValueError, match=f"scale = {value} {why}"):
            find(str(scaled)).traffic(TrafficParams(scale=1.5), registry())


CALIBRATOR = """<additional><route id="r" edges="db bc"/><calibrator id="c" edge="db" pos="5">
<flow begin="3" end="43" vehsPerHour="900" speed="10" route="r"/></calibrator></additional>"""


def test_vehicles_of_a_calibrator_come_although_sumo_expects_none(tmp_path):
    """900 vehicles per hour for 40 s are ten, and the last ones are still on 800 m of road at 50 s."""
    config = mixed_scenario.write(tmp_path)
    (tmp_path / "odd.rou.xml").write_text("<routes/>")
    (tmp_path / "odd.add.xml").write_text(CALIBRATOR)
    worlds = live(str(config), 0, 50)[0]
    assert len(worlds) == 50
    assert len({actor for world in worlds for actor in world["actor"].tolist()}) in (9, 10, 11)


def test_persons_whose_type_has_no_class_are_pedestrians(tmp_path):
    """SUMO gives such a type the class `passenger`, and 5 x 1.8 m."""
    config = mixed_scenario.write(tmp_path)
    text = (tmp_path / "odd.rou.xml").read_text().replace('<person id="walker"', '<person id="walker" type="adult"')
    (tmp_path / "odd.rou.xml").write_text(text.replace("<routes>", '<routes><vType id="adult" maxSpeed="1.2"/>'))
    who = registry()
    collect(find(str(config)).traffic(TrafficParams(), who), 0, 6)
    walker = who.names.index("walker")
    assert who.shape[walker] == Shape.PEDESTRIAN and not who.equipped[walker]
    assert who.lwh_m[walker] == pytest.approx([0.215, 0.478, 1.719])


def mixed(folder: Path, **keys):
    """The mixed scenario, running."""
    return find(str(mixed_scenario.write(folder))).traffic(TrafficParams(), registry(), **keys)


def test_simulations_beside_each_other_have_the_traffic_of_one_alone(tmp_path):
    """One process holds several, and each is the first of its own process."""
    config = str(mixed_scenario.write(tmp_path / "alone"))
    alone = [world["xyz_m"] for world in live(config, 0, 12)[0]]
    one, other = mixed(tmp_path / "one"), mixed(tmp_path / "other")
    for want in alone:
        for traffic in (one, other):
            np.testing.assert_array_equal(traffic.advance().boxes.xyz_m, want)
    one.close()
    other.close()


def test_a_sumo_that_breaks_down_is_told_in_one_line(tmp_path):
    traffic = mixed(tmp_path)
    traffic.advance()
    os.kill(traffic._process.pid, signal.SIGKILL)
    with pytest.raises(TrafficError, match=r"\.sumocfg: SUMO broke down \(signal 9\)\.$"):
        for _ in range(3):  # one answer may be under way
            traffic.advance()
    traffic.close()
    assert not traffic._scratch.path.exists()


@pytest.mark.parametrize("how", ["closed", "forgotten"])
def test_no_process_outlasts_its_traffic(tmp_path, how):
    traffic = mixed(tmp_path)
    traffic.advance()
    process = traffic._process
    if how == "closed":
        traffic.close()
    del traffic
    gc.collect()
    assert process.returncode == 0


def test_modules_of_the_working_directory_are_not_those_of_sumos_process(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("pickle.py").write_text("raise SystemExit(3)")
    traffic = mixed(tmp_path / "scenario")
    assert traffic.advance().step == 0
    traffic.close()
