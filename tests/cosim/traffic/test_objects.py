"""Objects that stand still: seen like other actors, never equipped, and no change to the traffic beside them."""

import numpy as np
import pytest

from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fleet import FleetParams
from cosim.traffic.frame import Frame, TrafficError
from cosim.traffic.objects import ObjectParams, Placed, WithObjects
from cosim.traffic.params import TrafficParams
from cosim.traffic.scenario import find
from cosim.traffic.source import world_of
from results.archive import open_run
from sensors.scene import Shape
from tests.drive import drive

FRAME = Frame(bounds_m=(0.0, 0.0, 1000.0, 1000.0))


class Parade:
    """Car 0 from step 0 on, car 1 from step 2 on, each at rest."""

    def __init__(self, registry):
        self.registry, self.step, self.number = registry, 0, []

    def report(self):
        return {}

    def advance(self):
        step, self.step = self.step, self.step + 1
        if step in (0, 2):
            size = np.array([[4.5, 1.8, 1.5]])
            self.number += self.registry.register([f"car{step}"], np.array([Shape.CAR], np.uint8), size, step).tolist()
        n = len(self.number)
        xyz = np.column_stack([np.arange(n) * 10.0, np.zeros(n), np.full(n, 0.75)])
        return world_of(step, np.array(self.number, np.int32), xyz, np.zeros(n), np.zeros(n), self.registry, FRAME)


def test_worlds_by_hand():
    """Two objects, one of them from 1 s to 2 s at steps of 0.5 s: steps 2 and 3. Numbers follow appearance: car 0,
    object 0, then in step 2 car 1 before object 1."""
    registry = ActorRegistry(FleetParams(penetration_p=1.0), 1)
    objects = [
        ObjectParams(at_m=(100.0, 50.0), yaw_deg=90.0),
        ObjectParams(vehicle_class="pedestrian", at_m=(7.0, 8.0), ground_m=2.0, height_m=1.0, from_s=1.0, to_s=2.0),
    ]
    traffic = WithObjects(Parade(registry), Placed.of(objects, FRAME, 0.5), registry, FRAME)
    worlds = [traffic.advance() for _ in range(5)]
    assert [[registry.names[i] for i in world.actor] for world in worlds] == [
        ["car0", "object/0"], ["car0", "object/0"], ["car0", "object/0", "car2", "object/1"],
        ["car0", "object/0", "car2", "object/1"], ["car0", "object/0", "car2"],
    ]  # fmt: skip
    third = worlds[2]
    assert third.equipped.tolist() == [True, False, True, False] and third.shape[3] == Shape.PEDESTRIAN
    np.testing.assert_allclose(third.boxes.xyz_m[[1, 3]], [[100, 50, 0.75], [7, 8, 2.5]])
    np.testing.assert_allclose(third.boxes.lwh_m[[1, 3]], [[4.5, 1.85, 1.5], [0.5, 0.5, 1.0]], rtol=1e-6)
    np.testing.assert_allclose(third.boxes.yaw_rad[1], np.pi / 2, atol=1 / 512)
    assert not third.speed_mps.any()


def test_an_object_far_away_is_refused():
    with pytest.raises(TrafficError, match=r"objects.at_m: .*object/0"):
        Placed.of([ObjectParams(at_m=(1e6, 0.0))], FRAME, 1.0)
    with pytest.raises(ValueError, match="to_s = 1 s is not after"):
        ObjectParams(at_m=(0.0, 0.0), from_s=2.0, to_s=1.0)
    with pytest.raises(ValueError, match="at_m is not given"):
        ObjectParams()


def test_an_object_in_the_coordinates_of_a_far_trace_is_refused(tmp_path):
    """The world of such a trace has an origin near the first actors."""
    registry = ActorRegistry(FleetParams(), 1)
    parade = Parade(registry)
    parade.report = lambda: {"origin_m": [50_000.0, 4_000_000.0]}
    traffic = WithObjects(parade, Placed.of([ObjectParams(at_m=(600.0, 20.0))], FRAME, 1.0), registry, FRAME)
    assert len(traffic.advance()) == 2
    rows = "".join(f"a,{t},{50_000 + 10 * t},4000000,90,10\n" for t in range(12))
    (tmp_path / "far.csv").write_text("id,time,x,y,angle,speed\n" + rows)
    scenario, params = find(str(tmp_path / "far.csv")), TrafficParams(step_s=1.0)
    in_the_world = ObjectParams(at_m=(30_000.0, 0.0))
    assert len(scenario.traffic(params, registry, objects=[in_the_world]).advance()) == 1
    traffic = scenario.traffic(params, registry, objects=[ObjectParams(at_m=(50_150.0, 4_000_020.0))])
    with pytest.raises(TrafficError, match=r"object/0: at_m = \[50150, 4000020\] .* Set at_m = \[150, 20\]."):
        traffic.advance()


def test_vehicles_of_a_trace_come_after_an_object(tmp_path):
    """One car from 0 s on, the object from step 0 on, five more cars from 3 s on."""
    rows = ["id,time,x,y,angle,speed"]
    rows += [f"a{k},{t},{10 * t},{9 * k},90,10" for t in range(6) for k in range(6) if t > 2 or not k]
    (tmp_path / "t.csv").write_text("\n".join(rows))
    registry, params = ActorRegistry(FleetParams(), 1), TrafficParams(step_s=1.0)
    objects = [ObjectParams(at_m=(70.0, 30.0))]
    traffic = find(str(tmp_path / "t.csv")).traffic(params, registry, objects=objects)
    assert [len(traffic.advance()) for _ in range(6)] == [1, 2, 2, 2, 7, 7]
    assert registry.names[:3] == ["object/0", "a0", "a1"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The shipped city with a parked car and a dummy 6 m ahead of where a vehicle begins; its replay; and without."""
    folder = tmp_path_factory.mktemp("objects")
    sets = ["traffic.duration_s=6", "attacks.0.start_s=1", "attacks.1.start_s=1", "traffic.warmup_s=120"]
    plain = drive(folder / "plain", *sets)
    run = open_run(plain)
    first = run.actors[(run.actors.step == 0) & run.actors.actor.isin(run.vehicles.vehicle[run.vehicles.equipped])]
    x, y, yaw = first.iloc[0][["x_m", "y_m", "yaw_rad"]]
    config = folder / "objects.toml"
    config.write_text(f"""
[[objects]]
vehicle_class = "pedestrian"
at_m = [{x + 8 * np.cos(yaw):.3f}, {y + 8 * np.sin(yaw):.3f}]
[[objects]]
at_m = [{x + 20 * np.cos(yaw):.3f}, {y + 20 * np.sin(yaw):.3f}]
yaw_deg = {np.degrees(yaw):.3f}
from_s = 2.0
""")
    with_objects = drive(folder / "with", *sets, config=config)
    replay = (f"traffic.trace={with_objects}", "traffic.warmup_s=0")
    again = drive(folder / "again", *replay, config=with_objects / "config.toml")
    return run, open_run(with_objects), open_run(again)


@pytest.mark.verify
def test_objects_are_detected_and_change_no_traffic(runs):
    plain, found, _ = runs
    names = found.vehicles.set_index("vehicle").sumo_id
    objects = names.index[names.str.startswith("object/")]
    assert len(objects) == 2 and not found.vehicles.set_index("vehicle").loc[objects].equipped.any()
    assert set(objects) & set(found.detections.truth_actor) and set(objects) <= set(found.actors.actor)
    n, n_plain = (run.manifest["summary"]["vehicles_on_road_mean"] for run in (found, plain))
    assert n == n_plain
    moving = found.actors[~found.actors.actor.isin(objects)]
    poses = ["step", "sumo_id", "x_m", "y_m", "yaw_rad", "speed_mps"]
    one = plain.actors.assign(sumo_id=plain.actors.actor.map(plain.vehicles.set_index("vehicle").sumo_id))[poses]
    two = moving.assign(sumo_id=moving.actor.map(names))[poses]
    assert one.sort_values(poses).reset_index(drop=True).equals(two.sort_values(poses).reset_index(drop=True))


@pytest.mark.verify
def test_a_replay_places_them_again(runs):
    _, found, again = runs
    for table in ("actors", "detections", "evaluations", "trust"):
        assert getattr(found, table).equals(getattr(again, table)), table
