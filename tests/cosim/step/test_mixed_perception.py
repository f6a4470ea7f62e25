"""Roadside units sense beside vehicles, with a LiDAR of their own on a mast."""

import numpy as np
import pytest

from cosim.config.config import load
from cosim.messages.content import SELF
from cosim.step.mixed_perception import MixedPerception
from cosim.step.parts import perception_of
from cosim.step.perception import BoxQuestions
from cosim.step.stopwatch import Stopwatch
from cosim.traffic.roadside import RoadsideUnits
from cosim.world import World
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from sensors.scene import Scene, Shape
from tests.scene import assert_same
from tests.sensors.town import boxes_at

UNITS = RoadsideUnits(
    ("roadside/0/0", "roadside/30/0"), np.array([[0.0, 0.0, 1.0], [30.0, 0.0, 1.0]]), np.array([6.0, 4.0]),
    np.zeros(2), ("os1_64", "vlp16"), np.array([True, True]),
)  # fmt: skip


def world_of(with_units):
    """Eight cars on a street at 1 m, one of them below a mast; the units are the third and the seventh actor."""
    n = 8
    xyz = np.column_stack([np.linspace(-40.0, 40.0, n), np.where(np.arange(n) == 3, 0.2, 8.0), np.full(n, 1.75)])
    boxes = boxes_at(xyz, (4.5, 1.8, 1.5))
    columns = {"actor": np.arange(n) * 10, "name_key": np.arange(100, 100 + n).astype(np.uint64)}
    shape = np.full(n, Shape.CAR, np.uint8)
    if with_units:
        middle = UNITS.ground_m + np.column_stack([np.zeros((2, 2)), UNITS.height_m / 2])
        masts = Boxes(middle, np.array([[0.1, 0.1, 6.0], [0.1, 0.1, 4.0]]), UNITS.yaw_rad)
        columns = {
            "actor": np.append(columns["actor"], [15, 45]), "name_key": np.append(columns["name_key"], UNITS.name_key)
        }  # fmt: skip
        boxes, shape = Boxes.concat([boxes, masts]), np.append(shape, [Shape.ROADSIDE_UNIT] * 2).astype(np.uint8)
    order = np.argsort(columns["actor"])
    columns = {name: column[order] for name, column in columns.items()}
    n = len(order)
    return World(
        step=0, boxes=boxes.take(order), shape=shape[order], speed_mps=np.zeros(n), equipped=np.ones(n, bool),
        attack=np.zeros(n, np.uint8), **columns,
    )  # fmt: skip


@pytest.fixture(scope="module")
def observed():
    """What vehicles perceive alone, and with the units."""
    config = load(None, ["lidar.profile=vlp16"])
    found = []
    for with_units in (False, True):
        world, perception = world_of(with_units), perception_of(config, Scene.empty())
        if with_units:
            perception = MixedPerception.of(perception, UNITS)
        found.append((world, perception, perception(world, np.arange(len(world)), Stopwatch())))
    return found


def test_all_sensors_look_to_their_left_a_quarter_of_a_turn_later():
    """At 10 Hz, 0.025 s after they look ahead, and as long before to their right."""
    config = load(None, ["lidar.rotation_hz=10", "sensing_interval_s=1"])
    world, perception = world_of(True), MixedPerception.of(perception_of(config, Scene.empty()), UNITS)
    sweeps = perception(world, np.arange(len(world)), Stopwatch()).sweeps
    o, yaw = np.arange(len(world)), sweeps.poses.yaw_rad
    for side in (1.0, -1.0):
        beside_m = sweeps.poses.origin_m + side * np.column_stack([-np.sin(yaw), np.cos(yaw), np.zeros(len(o))])
        np.testing.assert_allclose(sweeps.seen_after_s(o, beside_m), side * 0.025)


def test_vehicles_perceive_what_they_perceive_without_units(observed):
    """Bit for bit: no ray meets a unit, and draws are keyed by names."""
    (alone, _, before), (world, _, after) = observed
    names = [alone.name_key[before.detections.observer], world.name_key[after.detections.observer]]
    mine = np.flatnonzero(np.isin(names[1], names[0]))
    assert len(mine) == len(before.detections) > 8
    assert_same(before.detections.boxes, after.detections.boxes.take(mine))
    for column in ("detection_index", "label", "score", "n_points", "origin"):
        np.testing.assert_array_equal(getattr(before.detections, column), getattr(after.detections, column)[mine])
    assert not np.isin(after.observability.actor, np.flatnonzero(world.is_roadside)).any()
    assert (np.diff(after.observability.observer) >= 0).all()


def test_units_report_what_is_around_them_and_not_themselves(observed):
    world, _, after = observed[1]
    by_unit = world.is_roadside[after.detections.observer]
    assert by_unit.sum() > 4 and not (after.detections.origin[by_unit] == SELF).any()
    poses = after.sweeps.poses
    np.testing.assert_allclose(poses.origin_m[world.is_roadside], [[0, 0, 7], [30, 0, 5]])
    images, row = after.sweeps.image(int(np.flatnonzero(world.is_roadside)[0]))
    z = images.xyz(row)[:, 2]
    np.testing.assert_allclose(z[z < -5.9], -6.0, atol=0.15)  # the street is 6 m below the sensor
    assert (z < -5.9).sum() > 1000 and images.range_steps.shape[1:] == (1024, 64)


def test_units_evaluate_what_stands_on_the_street_below_them(observed):
    """The bottom of a car at 8 m is 6 m below the sensor. Heights are those above the road (area.height_m = 3)."""
    world, perception, after = observed[1]
    n, unit = len(world), int(np.flatnonzero(world.is_roadside)[0])
    cars = np.flatnonzero(~world.is_roadside)
    o = np.full(len(cars), unit)
    inside = perception.in_area(
        after.sweeps, o, world.boxes, AreaParams(), cars, world.label, world.boxes
    )  # fmt: skip
    assert inside.all()
    asked = BoxQuestions(world.boxes, np.zeros((len(world), 2)), AreaParams(), o, cars, o, cars)
    n_points, _ = perception.answers(after.sweeps, asked)
    seen = after.observability
    returns = np.zeros(n, int)
    returns[seen.actor[seen.observer == unit]] = seen.n_returns[seen.observer == unit]
    assert (np.abs(n_points - returns[cars]) <= 3).all() and n_points.max() > 150  # noise moves a few out of the box


def test_what_is_below_the_beams_is_not_denied(observed):
    """The lowest beam of the first unit, at -16.6 degrees, is 20.1 m away on the street. An empty box 5 m away is in
    its blind cone; one on the open street 35 m away is implausible: rays pass over its place to the ground behind."""
    world, perception, after = observed[1]
    boxes = boxes_at([[0.0, -5.0, 1.75], [0.0, -35.0, 1.75]], (4.5, 1.8, 1.5))
    o, none = np.full(2, int(np.flatnonzero(world.is_roadside)[0])), np.zeros(0, int)
    _, plausible = perception.answers(
        after.sweeps, BoxQuestions(boxes, np.zeros((2, 2)), AreaParams(gaps="below"), none, none, o, np.arange(2))
    )
    assert plausible.tolist() == [True, False]


def test_displaced(observed):
    _, _, after = observed[1]
    error = np.column_stack([np.arange(20.0).reshape(10, 2), np.linspace(-1, 1, 10)])
    there, here = after.sweeps.displaced(error).poses, after.sweeps.poses
    np.testing.assert_allclose(there.origin_m - here.origin_m, error * [1, 1, 0], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * (there.yaw_rad - here.yaw_rad)), np.exp(1j * error[:, 2]))
