"""Safety metrics: by hand, and against SUMO's SSM device on the same trajectories."""

import xml.etree.ElementTree as ET

import numpy as np
import pandas as pd
import pytest

from cosim.addons.driver import conflicts, figure, safety
from results.archive import open_run
from results.measure import measure
from results.metrics import traffic
from sumo_nets import sumotools
from tests.drive import simulate
from tests.results.tiny import fleet, make


class Poses:
    """Stands for a run where only the length of a step is asked for."""

    dt_s = 0.5


def poses(tracks, ground_m=()):
    """Rows of `conflicts.tracks` of actors with (x, y, yaw, speed) per step; 5 m by 2 m, on these heights, or 0."""
    ground_m = dict(ground_m)
    rows = [
        {"step": step, "actor": actor, "x_m": x, "y_m": y, "ground_m": ground_m.get(actor, 0.0), "yaw_rad": yaw,
         "speed_mps": v, "length_m": 5.0, "width_m": 2.0}
        for actor, track in tracks.items() for step, (x, y, yaw, v) in enumerate(track)
    ]  # fmt: skip
    frame = pd.DataFrame(rows).sort_values(["actor", "step"])
    change = frame.speed_mps.diff() / Poses.dt_s
    frame["acceleration_mps2"] = change.where(frame.actor.diff() == 0)
    return frame.sort_values(["step", "actor"]).reset_index(drop=True)


def test_time_to_collision_by_hand():
    """20 m behind another centre to centre: gap 15 m; 10 m/s against 4 m/s: 15 / 6 = 2.5 s; 6^2 / (2 x 15) = 1.2 m/s2.
    A third drives the other way beside them, and is not a leader of either."""
    found = conflicts.following(Poses, poses({1: [(0, 0, 0, 10)], 2: [(20, 0, 0, 4)], 3: [(12, 1, np.pi, 10)]}))
    assert found[["actor", "leader"]].to_numpy().tolist() == [[1, 2]]
    np.testing.assert_allclose(found[["gap_m", "ttc_s", "drac_mps2"]].to_numpy(), [[15, 2.5, 1.2]])


def test_a_leader_that_turns_counts_by_its_middle():
    """A bus of 12 m, turned by 40 degrees, 25 m ahead and 2 m aside: half of both widths is 2.25 m. At 2.5 m aside it
    is no leader, though a corner of it is in the way. The gap is 25 - (5 + 12) / 2 = 16.5 m. It drives 5 cos 40."""
    turn = np.radians(40)
    for aside_m, n in ((2.0, 1), (2.5, 0)):
        rows = poses({1: [(0, 0, 0, 10)], 2: [(25, aside_m, turn, 5)]})
        bus = rows.actor == 2
        found = conflicts.following(
            Poses, rows.assign(length_m=rows.length_m + 7 * bus, width_m=rows.width_m + 0.5 * bus)
        )
        closing_mps = 10 - 5 * np.cos(turn)
        assert found.gap_m.tolist() == [16.5] * n
        assert found.ttc_s.tolist() == pytest.approx([16.5 / closing_mps] * n)


EAST = [(10 * (0.5 * k - 2), 0.0, 0.0, 10) for k in range(12)]
NORTH = [(0.0, 10 * (0.5 * k - 4), np.pi / 2, 10) for k in range(12)]


def test_post_encroachment_time_by_hand():
    """One goes east through the origin at t = 2 s, one north at t = 4 s, both at 10 m/s. The common area reaches
    (5 + 2) / 2 = 3.5 m either way: the first leaves at 2.35 s, the second arrives at 3.65 s: 1.3 s."""
    found = conflicts.encroachments(Poses, poses({1: EAST, 2: NORTH}))
    np.testing.assert_allclose(found[["first", "second", "time_s", "pet_s"]].to_numpy(), [[1, 2, 3.65, 1.3]], atol=1e-9)


def test_two_vehicles_that_cross_twice_count_once():
    """A kilometre further they cross in the other order, at 10 s and 11.8 s: the second is 1.8 - 0.7 = 1.1 s later."""
    east = EAST + [(1000 + 10 * (0.5 * k - 11.8), 0.0, 0.0, 10) for k in range(12, 30)]
    north = NORTH + [(1000.0, 10 * (0.5 * k - 10), np.pi / 2, 10) for k in range(12, 30)]
    found = conflicts.encroachments(Poses, poses({1: east, 2: north}))
    np.testing.assert_allclose(found[["first", "second", "pet_s"]].to_numpy(), [[2, 1, 1.1]], atol=1e-9)


def test_a_bridge_is_another_road():
    """Eight metres above: no leader, no common area, no overlap. On one height, or one metre apart, each of them."""
    behind = {1: [(0, 0, 0, 10)], 2: [(20, 0, 0, 4)]}
    crossing = {1: [(10 * (0.5 * k - 2), 0.0, 0.0, 10) for k in range(12)],
                2: [(0.0, 10 * (0.5 * k - 4), np.pi / 2, 10) for k in range(12)]}  # fmt: skip
    inside = {1: [(0, 0, 0, 5)], 2: [(1, 0, 0, 5)]}
    for height_m, n in ((0.0, 1), (1.0, 1), (8.0, 0), (-8.0, 0)):
        bridge = {2: height_m}
        assert len(conflicts.following(Poses, poses(behind, bridge))) == n
        assert len(conflicts.encroachments(Poses, poses(crossing, bridge))) == n
        assert len(conflicts.overlaps(Poses, poses(inside, bridge))) == n


@pytest.mark.parametrize("dt_s", [0.2, 0.5, 1.0])
def test_post_encroachment_time_in_long_steps(dt_s):
    """At 14 m/s, the way of a second is longer than the 12 m that are searched otherwise: 2 - 2 x 3.5 / 14 = 1.5 s."""

    class Run:
        pass

    Run.dt_s = dt_s
    times = np.arange(0, 10, dt_s)
    east = [(14 * (t - 4.1), 0.0, 0.0, 14) for t in times]
    north = [(0.0, 14 * (t - 6.1), np.pi / 2, 14) for t in times]
    (found,) = conflicts.encroachments(Run, poses({1: east, 2: north})).itertuples()
    assert found.pet_s == pytest.approx(1.5)


def test_braking_events_and_stops_by_hand():
    """Speeds 12, 10, 8.2, 8, 6, 3.5, 0, 0, 3, 0 in steps of 0.5 s: decelerations 4, 3.6, 0.4, 4, 5, 7, 0, -, 6.

    Hard from 3 m/s2: steps 1 and 2 are one event; 0.4 is below 1 and ends it; step 4 begins another, step 9 a third.
    Emergency from 4.5: steps 5 and 9. It stops in step 6 and, after 3 m/s, in step 9."""
    speeds = [12, 10, 8.2, 8, 6, 3.5, 0, 0, 3, 0]
    track = poses({4: [(0, 0, 0, v) for v in speeds]})
    events = safety.braking(Poses, track)
    assert events.step[events.severity == "hard"].tolist() == [1, 4, 9]
    assert events.step[events.severity == "emergency"].tolist() == [5, 9]
    assert safety.stops(Poses, track).step.tolist() == [6, 9]


def test_events_do_not_run_over_from_one_vehicle_to_the_next():
    on, off = np.array([True, True, True, True]), np.zeros(4, bool)
    assert conflicts.begins(on, off, np.array([1, 1, 2, 2])).tolist() == [True, False, True, False]


class Reacted(Poses):
    """Stands for a run with reactions: vehicle 1 brakes for a ghost in steps 1 and 2, vehicle 9 alone in step 1."""

    rows = ((1, 1, True, None, 9.0, 4.0), (2, 1, True, None, 8.0, 4.0), (1, 9, False, 3.0, 9.0, 3.0))

    def require(self, *names):
        assert names == ("reactions",)

    def table(self, name):
        columns = ["step", "vehicle", "fabricated", "truth_actor", "gap_m", "deceleration_mps2"]
        return pd.DataFrame(self.rows, columns=columns)


class TwoInTurn(Reacted):
    """Vehicle 1 brakes for a ghost in steps 1, 3 and 9, and for actor 3 in steps 2 and 4: 4 m/s2 for 0.5 s each."""

    rows = tuple((step, 1, step != 2 and step != 4, 3.0, 9.0, 4.0) for step in (1, 2, 3, 4, 9))


def test_reactions_to_two_objects_in_turn_are_one_episode_of_each():
    """Steps of one kind are 1 s apart at most, but for the ghost's last, 3 s later. Each step takes 2 m/s."""
    found = safety.reactions(TwoInTurn())
    assert found[["step", "end_step", "kind", "taken_mps"]].to_numpy().tolist() == [
        [1, 3, "ghost", 4.0], [2, 4, "real", 4.0], [9, 9, "ghost", 2.0],
    ]  # fmt: skip


def test_a_braking_wave_by_hand():
    """Four in a row, 20 m apart: the first reacts in step 1, the second brakes with 2 m/s2 in step 2, the third with 3
    in step 3, the fourth not; the third brakes again in step 5 and counts once. Two drivers, 40 m behind the first at
    the most: the first stands at 100 m from step 1 on, the third at 60 m. No vehicle is behind vehicle 9."""
    speeds = {1: [10, 8, 6, 6, 6, 6], 2: [10, 10, 9, 9, 9, 9], 3: [10, 10, 10, 8.5, 8.5, 7], 4: [10] * 6, 9: [10] * 6}
    place = {1: (100, 0), 2: (80, 0), 3: (60, 0), 4: (40, 0), 9: (0, 500)}
    tracks = {actor: [(*place[actor], 0.0, v) for v in speed] for actor, speed in speeds.items()}
    found = safety.waves(Reacted(), poses(tracks))
    assert found[["vehicle", "step", "kind", "n_vehicles", "length_m"]].to_numpy().tolist() == [
        [1, 1, "ghost", 2, 40.0], [9, 1, "real", 0, 0.0],
    ]  # fmt: skip


def test_overlaps_by_hand():
    """Two on one place are in each other by 2 m; two side by side, 1.9 m apart, by 0.1 m only."""
    found = conflicts.overlaps(
        Poses, poses({1: [(0, 0, 0, 5)], 2: [(1, 0, 0, 5)], 3: [(0, 50, 0, 5)], 4: [(0, 51.9, 0, 5)]})
    )
    assert found[["a", "b"]].to_numpy().tolist() == [[1, 2]]


@pytest.mark.parametrize(
    ("driver", "found"),
    [
        ("cautious", {"n": 3 * [0.0], "per_km": 3 * [0.0]}),
        ("none", {}),
    ],
)
def test_a_driver_without_reactions_has_none_and_no_driver_has_no_value(tmp_path, driver, found):
    """A car drives 10 m in each of four steps. What a reaction takes on average is not known without one."""
    actors = [{"step": step, "actor": 0, "x_m": 10.0 * step, "speed_mps": 10.0} for step in range(4)]
    config = {"driver": {"model": driver}}
    run = make(tmp_path, 4, config, vehicles=fleet("honest"), actors=actors, reactions=[])
    rows = measure(run, topics=("safety",)).dropna(subset="value")
    rows = rows[rows.metric.str.startswith(("safety.reactions.", "safety.speed_taken", "safety.wave"))]
    values = rows.groupby(rows.metric.str.removeprefix("safety.reactions.")).value.apply(list)
    assert values.to_dict() == found


NODES = """<nodes><node id="w" x="-300" y="0"/><node id="e" x="300" y="0"/><node id="s" x="0" y="-300"/>
<node id="n" x="0" y="300"/><node id="c" x="0" y="0" type="priority"/></nodes>"""
EDGES = """<edges><edge id="wc" from="w" to="c" speed="13" priority="2"/><edge id="ce" from="c" to="e" speed="13"
priority="2"/><edge id="sc" from="s" to="c" speed="13" priority="1"/><edge id="cn" from="c" to="n" speed="13"
priority="1"/></edges>"""
DEMAND = """<routes><vType id="car" length="5" width="2" height="1.5" sigma="0" speedDev="0"/>
<vehicle id="stops" type="car" depart="0" departPos="100" departSpeed="13"><route edges="wc ce"/>
<stop lane="ce_0" endPos="100" duration="15"/></vehicle>
<vehicle id="behind" type="car" depart="0" departPos="60" departSpeed="13"><route edges="wc ce"/></vehicle>
<vehicle id="late" type="car" depart="13" departPos="120" departSpeed="13"><route edges="wc ce"/></vehicle>
<vehicle id="crosses" type="car" depart="15.6" departPos="120" departSpeed="13"><route edges="sc cn"/></vehicle>
</routes>"""
CONFIG = """<configuration><input><net-file value="x.net.xml"/><route-files value="x.rou.xml"/></input>
<time><begin value="0"/><end value="60"/></time></configuration>"""


@pytest.fixture(scope="module")
def crossing(tmp_path_factory):
    """A car that stops, two behind it, one that crosses: the run from SUMO's trace, and what the SSM device says."""
    folder = tmp_path_factory.mktemp("ssm")
    for name, text in (("x.nod.xml", NODES), ("x.edg.xml", EDGES), ("x.rou.xml", DEMAND), ("x.sumocfg", CONFIG)):
        (folder / name).write_text(text)
    sumotools.run(
        "netconvert", {"node-files": "x.nod.xml", "edge-files": "x.edg.xml", "output-file": "x.net.xml",
                       "no-warnings": True}, folder,
    )  # fmt: skip
    sumotools.run(
        "sumo", {"configuration-file": "x.sumocfg", "step-length": 0.1, "fcd-output": "fcd.xml", "no-step-log": True,
                 "device.ssm.probability": 1, "device.ssm.measures": "TTC DRAC PET",
                 "device.ssm.thresholds": "3 3 5", "device.ssm.range": 50, "device.ssm.file": "ssm.xml"}, folder,
    )  # fmt: skip
    keys = [f"traffic.scenario={folder / 'x.sumocfg'}", f"traffic.trace={folder / 'fcd.xml'}", "traffic.step_s=0.1",
            "traffic.duration_s=58", "fleet.penetration_p=0", "traffic.warmup_s=0"]  # fmt: skip
    return open_run(simulate(folder / "run", *keys)), ET.parse(folder / "ssm.xml").getroot()


def said(root, measure):
    """What the device says of a measure, by follower (type 2) or pair."""
    found = {}
    for conflict in root.iter("conflict"):
        entry = conflict.find(measure)
        if entry.get("value") != "NA" and (measure == "PET" or entry.get("type") == "2"):
            found[conflict.get("ego"), conflict.get("foe")] = float(entry.get("value"))
    return found


def test_against_the_ssm_device(crossing):
    """The least time to collision, the largest deceleration to avoid a crash, and the post-encroachment time."""
    run, root = crossing
    names = run.vehicles.set_index("vehicle").sumo_id
    pairs = conflicts.following(run)
    pairs = pairs[pairs.gap_m > 0].assign(actor=pairs.actor.map(names), leader=pairs.leader.map(names))
    ours = pairs.groupby(["actor", "leader"]).agg(ttc=("ttc_s", "min"), drac=("drac_mps2", "max"))
    ttc, drac = said(root, "minTTC"), said(root, "maxDRAC")
    assert ("behind", "stops") in ttc and ("late", "behind") in ttc
    for pair in (("behind", "stops"), ("late", "behind")):  # the device also pairs vehicles with one in between
        assert ours.ttc[pair] == pytest.approx(ttc[pair], abs=0.05)
        assert ours.drac[pair] == pytest.approx(drac[pair], abs=0.05)
    (found,) = conflicts.encroachments(run).itertuples()
    assert {names[found.first], names[found.second]} == {"late", "crosses"}
    assert found.pet_s == pytest.approx(said(root, "PET")["crosses", "late"], abs=0.3)


def test_topic_and_figure(crossing):
    run, _ = crossing
    measured = run.measure(topics=("safety",)).set_index("metric").value
    assert measured["safety.collisions.n"] == 0 and measured["safety.driven_km"] > 1
    figure = run.measure.safety.plot()
    assert len(figure.axes) == 2 and figure.axes[0].get_xlim()[0] == 0  # nobody reacts to what it believes


def test_hard_braking_is_drawn_for_each_of_few_steps(tmp_path):
    """Twenty parts of three steps: in most of them nobody drove, and the figure showed no braking there."""
    drives = [{"step": step, "actor": 0, "x_m": 10.0 * step, "speed_mps": 10.0} for step in range(2)]
    run = make(tmp_path, 3, vehicles=fleet("honest", n_steps=2), actors=drives)
    (line,) = figure.draw([run]).axes[1].lines
    assert line.get_xdata().tolist() == [1, 2, 3]
    assert np.isnan(line.get_ydata()).tolist() == [False, False, True]


def test_what_stands_there_by_the_config_is_no_traffic(tmp_path):
    """Of four actors in 20 s two stand there. The car that drives 200 m in 20 s takes 100 s per kilometre."""
    there = fleet("honest", "honest", "honest", "honest", n_steps=20)
    there[1] |= {"sumo_id": "object/0", "equipped": False}
    there[2] |= {"sumo_id": "parked/12", "equipped": False}
    there[3] |= {"vehicle_class": "pedestrian", "equipped": False}
    drives = [{"step": step, "actor": 0, "x_m": 10.0 * step, "speed_mps": 10.0} for step in range(20)]
    stands = [{"step": step, "actor": actor} for actor in (1, 2, 3) for step in range(20)]
    run = make(tmp_path, 20, vehicles=there, actors=drives + stands)
    assert traffic.on_road(run)["mean"].tolist() == [2, 1]
    assert safety.summary(run)["travel_time.s_per_km"] == 100
