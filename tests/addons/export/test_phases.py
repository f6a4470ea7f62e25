"""Vehicles that sense at steps of their own: sequences, scenes, scenarios and perspectives are by their own sweeps."""

import numpy as np
import pytest

from cosim.addons.export import kitti, nuscenes, opv2v, trupercept
from results.moments import Selection
from tests.addons.export import truck
from tests.results import tiny

N_STEPS, EVERY = 20, 5
PHASES = {0: 0, 1: 3, 2: 0, 3: 3}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Four cars stand within 40 m. They sense every fifth step: 0 and 2 from step 0 on, 1 and 3 from step 3 on."""
    car = (4.5, 1.8, 1.5)
    vehicles = [
        truck.body(v, "car", car, str(v), last=N_STEPS - 1, sensing_interval_steps=EVERY, sensing_phase_steps=phase)
        for v, phase in PHASES.items()
    ]
    actors = [{"step": s, "actor": v, "x_m": 10.0 * v, "y_m": 0.0, "z_m": 0.75} for s in range(N_STEPS) for v in PHASES]
    return tiny.make(tmp_path_factory.mktemp("phases"), N_STEPS, truck.CONFIG, vehicles=vehicles, actors=actors)


def selection(run, steps=range(N_STEPS)):
    return Selection(run, tuple(PHASES), np.array(steps), lambda xy: np.zeros(len(xy)))


def test_a_sequence_is_a_vehicle_in_consecutive_sweeps(run):
    found = kitti.sequences_of(selection(run))
    by_vehicle = found.groupby("sequence").agg(vehicle=("vehicle", "unique"), steps=("step", list))
    assert [v.tolist() for v in by_vehicle.vehicle] == [[0], [1], [2], [3]]
    assert by_vehicle.steps.tolist() == [[0, 5, 10, 15], [3, 8, 13, 18]] * 2
    scenes = nuscenes.scenes_of(selection(run))
    assert [(scene.vehicle, len(scene.steps)) for scene in scenes] == [(0, 4), (1, 4), (2, 4), (3, 4)]


def test_a_sequence_ends_where_steps_are_left_out(run):
    found = kitti.sequences_of(selection(run, [0, 1, 2, 3, 4, 15, 16, 17, 18, 19]))
    assert found.groupby("sequence").step.apply(list).tolist() == [[0], [15], [3], [18]] * 2


def test_a_scenario_has_vehicles_of_one_phase(run, monkeypatch):
    few = opv2v.scenarios_of(selection(run))
    assert [(s.vehicles, s.steps.tolist()) for s in few] == [((0, 2), [0, 5, 10, 15]), ((1, 3), [3, 8, 13, 18])]
    monkeypatch.setattr(opv2v, "MOST", 2)  # the four are then more than a scenario takes
    many = opv2v.scenarios_of(selection(run))
    assert [(s.vehicles, s.steps.tolist()) for s in many] == [
        ((0, 2), [0, 5]), ((1, 3), [3, 8]), ((0, 2), [10, 15]), ((1, 3), [13, 18])
    ]  # fmt: skip


def test_a_scenario_ends_where_steps_are_left_out(run, monkeypatch):
    monkeypatch.setattr(opv2v, "MOST", 2)
    found = opv2v.scenarios_of(selection(run, [0, 1, 2, 3, 4, 10, 11, 12, 13, 14]))
    assert [scenario.steps.tolist() for scenario in found] == [[0], [3], [10], [13]]


def test_a_perspective_has_a_sweep_of_its_own(run, tmp_path):
    made = truck.written(trupercept.TruPerceptData().plan(selection(run)), tmp_path)
    perspectives = {path.split("/")[3] for path in made if "alt_perspective" in path}
    assert perspectives == {"0000002"}, "vehicles 1 and 3 do not sense when the ego does"
    assert sum("velodyne" in path for path in made) == 2 * 4
