"""What the shipped city's traffic does when SUMO drives it: one libsumo process per test, outside pytest's."""

import json
import subprocess

import pytest

from sumo_nets import catalogue
from tests.drive import python

CITY = catalogue.find("helsinki")

WATCH = """
import json, sys
import libsumo

cfg, end_s = sys.argv[1], int(sys.argv[2])
libsumo.start(["sumo", "-c", cfg, "--no-step-log", "--seed", "7"])
seen = dict(stood_at_red=0, ran_red=0, on_crossing=0, on_pavement=0, elsewhere=0, classes=[], sizes={})
crossers, classes, before = set(), set(), {}
for step in range(end_s):
    libsumo.simulationStep()
    now = {}
    for vehicle in libsumo.vehicle.getIDList():
        classes.add(libsumo.vehicle.getVehicleClass(vehicle))
        kind = libsumo.vehicle.getTypeID(vehicle)
        if kind not in seen["sizes"]:
            seen["sizes"][kind] = [libsumo.vehicle.getLength(vehicle), libsumo.vehicle.getWidth(vehicle),
                                   libsumo.vehicle.getHeight(vehicle)]
        ahead = libsumo.vehicle.getNextTLS(vehicle)
        if ahead and ahead[0][2] < 60.0:
            light, link, metres, state = ahead[0]
            now[vehicle] = (light, link, state)
            if metres < 4.0 and state == "r" and libsumo.vehicle.getSpeed(vehicle) < 0.1:
                seen["stood_at_red"] += 1
    for vehicle, (light, link, state) in before.items():
        gone_on = vehicle not in now or now[vehicle][:2] != (light, link)
        if gone_on and state == "r" and vehicle in set(libsumo.vehicle.getIDList()):
            still = libsumo.trafficlight.getRedYellowGreenState(light)[link] == "r"
            inside = [via for _, _, via in libsumo.trafficlight.getControlledLinks(light)[link]]
            if still and libsumo.vehicle.getLaneID(vehicle) in inside:
                seen["ran_red"] += 1
    before = now
    for person in libsumo.person.getIDList():
        classes.add("pedestrian")
        road = libsumo.person.getRoadID(person)
        if road.startswith(":"):
            if "_c" in road.rsplit("#", 1)[-1] or road.split("_")[-1].startswith("c"):
                crossers.add(person)
        else:
            lane = libsumo.person.getLaneID(person)
            allowed = libsumo.lane.getAllowed(lane)
            seen["on_pavement" if "pedestrian" in allowed and len(allowed) < 4 else "elsewhere"] += 1
seen["on_crossing"] = len(crossers)
seen["classes"] = sorted(classes)
seen["teleports"] = libsumo.simulation.getStartingTeleportNumber()
libsumo.close()
print(json.dumps(seen))
"""


@pytest.fixture(scope="module")
def seen():
    return json.loads(python(WATCH, str(CITY.sumocfg_path), "400").splitlines()[-1])


def test_vehicles_wait_at_red_and_nobody_runs_it(seen):
    assert seen["stood_at_red"] > 500
    assert seen["ran_red"] == 0


def test_pedestrians_keep_to_pavements_and_cross_at_crossings(seen):
    assert seen["on_crossing"] > 50
    assert seen["on_pavement"] > 5_000
    assert seen["elsewhere"] == 0


def test_an_afternoon_has_all_kinds_of_travellers_in_their_true_sizes(seen):
    assert seen["classes"] == ["bicycle", "bus", "delivery", "passenger", "pedestrian", "truck"]
    cars = [size for kind, size in seen["sizes"].items() if kind.startswith("car_")]
    assert len(cars) >= 3
    assert all(3.5 < length < 5.2 and 1.6 < width < 2.0 and 1.4 < height < 1.9 for length, width, height in cars)
    buses = [size for kind, size in seen["sizes"].items() if kind.startswith("bus_")]
    assert all(length in (12.0, 18.0) and width == 2.55 for length, width, _ in buses)
    assert seen["sizes"]["bicycle"] == [1.8, 0.65, 1.75]


@pytest.mark.verify
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_city_flows_for_half_an_hour(tmp_path, seed):
    # 30 min after the warm-up, as plain SUMO says: summary output averages over the vehicles on the road.
    import xml.etree.ElementTree as ET

    from sumo_nets import sumotools

    end_s = CITY.warm_up_s + 1800
    words = [str(sumotools.home() / "bin" / "sumo"), "-c", str(CITY.sumocfg_path), "--seed", str(seed), "--end", end_s]
    words += ["--summary-output", tmp_path / "s.xml", "--tripinfo-output", tmp_path / "t.xml"]
    words += ["--person-summary-output", tmp_path / "p.xml", "--tripinfo-output.write-unfinished"]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

    def after_warm_up(name, when):
        rows = [row.attrib for row in ET.parse(tmp_path / name).getroot()]
        return [row for row in rows if when in row and float(row[when]) >= CITY.warm_up_s]

    steps = after_warm_up("s.xml", "time")
    running = [float(step["running"]) for step in steps]
    assert sum(running) / len(steps) >= 150
    speed = sum(float(step["meanSpeed"]) * float(step["running"]) for step in steps) / sum(running)
    assert 3.6 * speed >= 15.0
    walking = [float(step["walking"]) for step in after_warm_up("p.xml", "time")]
    assert 80 <= sum(walking) / len(walking) <= 200
    trips = after_warm_up("t.xml", "depart")
    vehicles = [trip for trip in trips if "departDelay" in trip]
    teleports = int(steps[-1]["teleports"])
    assert teleports <= len(vehicles) / 100
    assert sum(float(trip["departDelay"]) for trip in vehicles) / len(vehicles) < 5.0
    assert max(int(step["waiting"]) for step in steps) < 20
    cars = [trip for trip in vehicles if trip["vType"].startswith("car_")]
    driven_m = sum(float(trip["routeLength"]) for trip in cars)
    assert 3.6 * driven_m / sum(float(trip["duration"]) for trip in cars) >= 15.0
