"""Commands through SUMO: who brakes when, and who has control afterwards."""

import numpy as np
import pytest

from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fleet import FleetParams
from cosim.traffic.params import TrafficParams
from cosim.traffic.scenario import find
from tests.addons.driver import one_lane
from tests.drive import assert_refused, cosim, simulate
from tests.processes import set_words

GHOST = """
import json
import numpy as np
from cosim.traffic.actors import ActorRegistry
from cosim.addons.driver.cautious import Cautious, CautiousParams
from cosim.traffic.fleet import FleetParams
from cosim.traffic.params import TrafficParams
from cosim.traffic.scenario import find
from tests.addons.driver.test_cautious import belief

registry = ActorRegistry(FleetParams(penetration_p=1.0), seed=4)
traffic = find({config!r}).traffic(TrafficParams(step_s=0.5, warmup_s=0), registry, has_driver=True)
driver, state, speeds = Cautious(CautiousParams(reaction_s=0.0)), None, []
for step in range(40):
    world = traffic.advance()
    if len(world) < 3:
        speeds.append(None)
        continue
    row = dict(zip((registry.names[a] for a in world.actor), range(3)))
    speeds.append([float(world.speed_mps[row[name]]) for name in ("first", "second", "third")])
    if {ghost} and step == 4:
        x = world.boxes.xyz_m[row["second"], 0] + 2.5
        ghost_m = x + 20.4
    seen = belief(row["second"], ghost_m, known_s=step * 0.5) if {ghost} and 4 <= step < 10 else None
    if seen is not None:
        seen.boxes.xyz_m[0, 1] = world.boxes.xyz_m[row["second"], 1]
    state, commands = driver.commands(state, world, seen, 0.5)
    traffic.command(commands.actor, commands.speed_mps)
traffic.close()
print(json.dumps(speeds))
"""


def test_only_the_believer_reacts_before_its_brake_lights_matter(tmp_path):
    """Three cars at 10 m/s, fronts 40 and 20 m apart; the second believes, from step 4 on, in a person
    20 m ahead of it.

    Derived in test_cautious: its speed is 8.187 m/s in step 5 and 7.032 m/s in step 6. The first never brakes. The
    third has 15 m to the second and SUMO's time headway of 1 s: it is still at 10 m/s in step 5, when the second has
    begun to brake, and brakes afterwards, by its own car following. Without the ghost all keep 10 m/s.
    """
    config = str(one_lane.write(tmp_path))
    calm = np.array([s for s in one_lane.in_process(GHOST.format(config=config, ghost=False)) if s])
    np.testing.assert_allclose(calm, 10, atol=0.01)
    speeds = one_lane.in_process(GHOST.format(config=config, ghost=True))
    first, second, third = np.array([s if s else [np.nan] * 3 for s in speeds]).T
    np.testing.assert_allclose(first[1:], 10, atol=0.01)
    np.testing.assert_allclose(second[4:7], [10, 8.187, 7.032], atol=0.01)
    np.testing.assert_allclose(third[4:6], 10, atol=0.01)
    assert third[6:12].min() < 9
    # Believed until step 9 (4.5 s), released after one more second: both are back at 10 m/s at the end.
    assert second[10] < 7 and second[-1] > 9.9 and third[-1] > 9.9


RELEASE = """
import json, tempfile
from pathlib import Path
import libsumo
import numpy as np
from cosim.traffic.params import TrafficParams
from cosim.traffic.scenario import find
from cosim.traffic.sumo import sumo_options
from cosim.traffic.sumo_process import Simulator

with tempfile.TemporaryDirectory() as scratch:
    config = find("helsinki").sumocfg
    options = sumo_options(TrafficParams(step_s=0.5), config, Path(scratch), True)
    options[options.index("--no-warnings") + 1] = "true"  # that some brake as hard as they are told
    sumo = Simulator(options, True, (0.0, 0.0))
while sumo.warm_up(120.0) < 120.0:
    pass
rng, checked, forced, wanted = np.random.default_rng(1), 0, 0, {}
n_commands = n_left = step = 0
while checked < 12000:
    sumo.move()
    step += 1
    present = libsumo.vehicle.getIDList()
    n_left += len(wanted.keys() - set(present))
    for name in present:
        if name in wanted:
            continue
        checked += 1
        forced += abs(libsumo.vehicle.getSpeed(name) - libsumo.vehicle.getSpeedWithoutTraCI(name)) > 1e-9
        forced += libsumo.vehicle.getSpeedMode(name) != 31
    wanted = {}
    for name in present if step % 7 else ():
        factor = rng.choice([0.0, 0.5, 0.9]) if rng.random() < 0.3 else None
        if factor is not None:
            wanted[name] = factor * libsumo.vehicle.getSpeed(name)
    n_commands += len(wanted)
    sumo.command(wanted)
print(json.dumps([checked, int(forced), n_commands, n_left]))
"""


def test_no_vehicle_keeps_a_forced_speed_after_release():
    """Over 12,000 vehicle-steps of a city in which three cars in ten are commanded at random, some harder than their
    type brakes, every vehicle that is not commanded drives what SUMO would have it drive, in SUMO's speed mode."""
    checked, forced, n_commands, _ = one_lane.in_process(RELEASE)
    assert checked >= 10_000 and n_commands > 1_000
    assert forced == 0


def test_a_commanded_speed_holds_for_one_step_and_none_that_is_not_finite(tmp_path):
    """The first of three cars at 10 m/s brakes for half a second as hard as its type can, and then drives on."""
    registry = ActorRegistry(FleetParams(), seed=4)
    traffic = find(str(one_lane.write(tmp_path))).traffic(TrafficParams(step_s=0.5), registry, has_driver=True)
    while not len(world := traffic.advance()):
        pass
    first = np.array([registry.names.index("first")])
    speeds = []
    for wanted_mps in (np.nan, 7.75, np.nan, 10.0):
        traffic.command(first, np.array([wanted_mps]))
        world = traffic.advance()
        speeds.append(float(world.speed_mps[world.actor == first[0]][0]))
    traffic.close()
    np.testing.assert_allclose(speeds[:2], [10, 7.75], atol=0.01)
    assert 7.75 < speeds[2] < speeds[3] <= 10


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        (["traffic.step_s=1.0"], "traffic.step_s = 1 s is too long"),
        (["traffic.step_s=0.5", "sensing_interval_s=0.25"], "sensing_interval_s"),
        (["driver.share_p=2"], "driver.share_p"),
    ],
)
def test_one_line_for_a_mistake(tmp_path, keys, says):
    words = set_words(("driver.model=cautious", *keys))
    done = cosim("run", *words, "--out", str(tmp_path / "run"))
    assert_refused(done, says)


def test_replays_refuse_a_driver_in_one_line(tmp_path):
    base = ("traffic.duration_s=3", "traffic.step_s=0.5")
    simulate(tmp_path / "run", *base, "traffic.warmup_s=5")
    again = (*base, f"traffic.trace={tmp_path / 'run'}", "driver.model=cautious")
    done = cosim("run", *set_words(again), "--out", str(tmp_path / "again"))
    assert_refused(done, "is replayed: nothing can brake in it")
