"""Vehicles on the road, before anything is simulated."""

import json

import pytest

from cosim.base.durable import seal
from cosim.config.config import load
from cosim.studies.cost import cost_of
from cosim.studies.density import OF_CLASS, departures, equipped_on_road, note_density, vehicles_on_road
from cosim.studies.estimate import estimate
from cosim.studies.plan import PlannedRun, StudyPlan
from cosim.studies.speed import MachineSpeed, Pace, remember, remembered, speed_here
from results.tables import SCHEMA_VERSION
from tests.hostile.scenes import write_town, write_trace
from tests.slow import slow


def test_cities_are_told_apart():
    """As they were counted in runs of a minute after the warm-up."""
    assert vehicles_on_road(load()) == pytest.approx(200, rel=0.01)
    assert vehicles_on_road(load(None, ["traffic.scale=0.5"])) == pytest.approx(100, rel=0.01)
    assert vehicles_on_road(load(None, ["traffic.scenario=koenigs-wusterhausen"])) == pytest.approx(145, rel=0.01)


def test_persons_of_a_trace_are_no_vehicles(tmp_path):
    """A car drives for two steps, beside two pedestrians and a train, which no run has."""
    where = 'x="0" y="0" angle="0" speed="1"'
    persons = f'<person id="p" {where}/><person id="q" type="walker" {where}/>'
    vehicles = f'<vehicle id="c" type="car" {where}/><vehicle id="t" type="train" {where}/>'
    steps = "".join(f'<timestep time="{time}">{vehicles}{persons}</timestep>' for time in (0, 1))
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    assert vehicles_on_road(load(None, [f"traffic.scenario={tmp_path / 'fcd.xml'}"])) == 1


def test_of_a_trace_and_of_flows(tmp_path):
    """The street has 8 cars and a person; the town's flows have periods of 2, 3 and 4 s: 13 vehicles in 12 s."""
    assert vehicles_on_road(load(None, [f"traffic.scenario={write_trace(tmp_path)}"])) == 8
    town = write_town(tmp_path / "town")
    assert departures((town.parent / "town.rou.xml",), 10.0, 22.0) == pytest.approx(13)
    set_town = [f"traffic.scenario={town}", "traffic.warmup_s=30"]
    there = vehicles_on_road(load(None, set_town))
    assert 5 < there < 60
    as_additional = town.read_text().replace('<route-files value="town.rou.xml"/>', "")
    as_additional = as_additional.replace('<additional-files value="', '<additional-files value="town.rou.xml,')
    assert "route-files" not in as_additional
    town.with_name("other.sumocfg").write_text(as_additional)
    other = [f"traffic.scenario={town.with_name('other.sumocfg')}", "traffic.warmup_s=30"]
    assert vehicles_on_road(load(None, other)) == there
    odd = tmp_path / "odd.rou.xml"
    odd.write_text('<routes><flow id="f" begin="0" period="exp(0.5)"/><flow id="g" begin="0" period="0"/></routes>')
    assert departures((odd,), 10.0, 22.0) == pytest.approx(6)


def test_a_finished_run_answers_for_its_own_half_hour(tmp_path, monkeypatch):
    """41 vehicles on the mean in a run of 60 s. One whose streets were filling says nothing of the next."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    sets = [f"traffic.scenario={write_town(tmp_path / 'town')}", "traffic.duration_s=60"]
    filling, full = {"vehicles_on_road_mean": 9.0, "vehicles_on_road_first": 0}, {"vehicles_on_road_mean": 41.0}
    for name, summary, more in (("a", filling, []), ("b", full, ["traffic.warmup_s=600", "traffic.scale=2"])):
        (tmp_path / name).mkdir()
        about = {"schema_version": SCHEMA_VERSION, "dt_s": 1.0, "steps": 60, "config": {}, "status": "finished"}
        text = json.dumps(seal(about | {"summary": summary}))
        (tmp_path / name / "manifest.json").write_text(text)
        note_density(load(None, [*sets, *more]), tmp_path / name)
    known = [*sets, "traffic.warmup_s=1200"]
    assert vehicles_on_road(load(None, known)) == pytest.approx(20.5)
    for other in (["traffic.begin_s=600"], ["traffic.warmup_s=1800"]):
        assert vehicles_on_road(load(None, [*known, *other])) != pytest.approx(20.5)


def test_demand_begins_with_the_configuration(tmp_path):
    """A begin at 6 o'clock, of the flows too, and a scale of the configuration; the town is small: 13 in 12 s."""
    town, sets = write_town(tmp_path / "town", end=30_000), ["traffic.warmup_s=30", "traffic.duration_s=20"]
    before = vehicles_on_road(load(None, [f"traffic.scenario={town}", *sets]))
    routes, late = town.parent / "town.rou.xml", tmp_path / "town" / "late.sumocfg"
    routes.write_text(routes.read_text().replace('begin="0"', 'begin="6:00:00"'))
    late.write_text(town.read_text().replace('<begin value="0"/>', '<begin value="6:00:00"/><scale value="2"/>'))
    assert vehicles_on_road(load(None, [f"traffic.scenario={late}", "traffic.begin_s=0", *sets])) == 0
    assert before > 5 and vehicles_on_road(load(None, [f"traffic.scenario={late}", *sets])) == pytest.approx(2 * before)


def test_classes_that_are_equipped_count():
    """7 buses are on the road of Helsinki, beside 167 cars and vans; all vehicles are as many as there are."""
    buses, all_kinds = (f"fleet.equipped_kinds={kinds}" for kinds in ('["bus"]', json.dumps([*OF_CLASS])))
    usual = equipped_on_road(load(None, ["fleet.penetration_p=0.5"]))
    assert usual == pytest.approx(100, rel=0.01)
    assert equipped_on_road(load(None, ["fleet.penetration_p=0.5", buses])) == pytest.approx(usual * 7 / 167)
    assert equipped_on_road(load(None, ["fleet.penetration_p=1", all_kinds])) == pytest.approx(2 * usual)
    assert cost_of(load(None, [buses])).n_equipped < 0.1 * cost_of(load()).n_equipped


def planned_s(*sets):
    config = load(None, list(sets))
    return estimate([], StudyPlan((PlannedRun("one", config, (("one", "base"),), ""),), {}, ()), (), None).planned_s


def test_a_dense_city_takes_longer():
    assert planned_s("fleet.penetration_p=1", "traffic.scale=3") > 2 * planned_s("fleet.penetration_p=1")


def test_what_a_run_costs():
    """As `cosim.studies.cost` measures it, by hand, for 60 equipped vehicles and 100 s after 600 s of warm-up.

    paper: 700 steps of SUMO at 0.8 ms, of which 100 are recorded: 1.0 ms to read and 23.1 ms to sense; 6,000 sweeps of
    520 x 64 rays at 9.0 ns, less those of vans, which it does not equip: 152 of 167. modern: steps of 0.2 s; 1800 x 64
    rays.
    """
    start_s = 3.4 + 0.5
    paper_s = start_s + 700 * 0.0008 + 100 * 0.0241 + 6000 * 152 / 167 * 520 * 64 * 9.0e-9
    modern_s = start_s + 3500 * 0.0008 + 500 * 0.0241 + 6000 * 1800 * 64 * 9.0e-9
    for preset, want_s in (("paper", paper_s), ("modern", modern_s)):
        sets = [f"preset={preset}", "traffic.duration_s=100", "traffic.warmup_s=600", "fleet.penetration_p=0.3"]
        assert planned_s(*sets) == pytest.approx(want_s, rel=0.01)


MEASURED = {
    "preset=modern traffic.duration_s=60": (18.0, 479, 5.6),
    "preset=modern traffic.duration_s=60 fleet.penetration_p=0.1": (14.2, 467, 1.8),
    "preset=modern traffic.duration_s=30 fleet.penetration_p=1.0": (16.9, 512, 9.9),
    "preset=modern traffic.duration_s=120 fleet.penetration_p=0.05": (21.4, 471, 2.9),
    "preset=paper traffic.duration_s=60": (9.0, 491, 3.6),
    "preset=modern sensing=false traffic.duration_s=200": (10.2, 419, 2.7),
    "preset=modern traffic.scenario=adlershof traffic.duration_s=60": (22.2, 484, 5.2),
    "preset=modern traffic.scenario=braunschweig traffic.duration_s=60": (12.1, 464, 0.9),
    "preset=modern traffic.scenario=koenigs-wusterhausen traffic.duration_s=60": (15.6, 476, 3.0),
    "preset=modern traffic.duration_s=30 sensing_interval_s=0.2 traffic.step_s=0.1": (27.1, 495, 12.9),
    "preset=modern traffic.duration_s=60 sensing_interval_s=0.5 traffic.step_s=0.1": (33.4, 489, 12.4),
    "preset=modern traffic.duration_s=60 sensing_phase=common": (12.5, 476, 5.1),
    "preset=modern traffic.duration_s=60 radio.model=nr_mode2": (18.1, 480, 5.6),
}
"""Processor time [s], memory [MB] and disk [MB] of runs on the machine of the costs, which did nothing else."""


OTHER_CITIES = ("scenario=adlershof", "scenario=braunschweig")  # they are read for seconds


@pytest.mark.parametrize("sets", [slow(s) if any(city in s for city in OTHER_CITIES) else s for s in MEASURED])
def test_estimates_are_near_what_runs_took(sets):
    cost = cost_of(load(None, sets.split()), MachineSpeed())
    for found, measured in zip(
        (cost.cpu_s, cost.memory_bytes / 1e6, cost.disk_bytes / 1e6), MEASURED[sets], strict=True
    ):
        assert 0.7 < found / measured < 1.3, (found, measured)


def test_a_long_run_says_what_halves_it():
    sets = ["preset=modern", "traffic.duration_s=3600", "fleet.penetration_p=1"]
    cost = cost_of(load(None, sets), MachineSpeed())
    assert cost.wall_s > 600
    shorter, penetration = cost.cheaper.split(" or ")[::-1][0], cost.cheaper.split(" or ")[0].strip(",")
    for change in (shorter, penetration):
        halved = cost_of(
            load(None, ["preset=modern", "traffic.duration_s=3600", "fleet.penetration_p=1", change[6:]]),
            MachineSpeed(),
        )
        assert 0.45 < halved.wall_s / cost.wall_s < 0.53
    assert not cost_of(load(None, ["preset=modern", "traffic.duration_s=60"]), MachineSpeed()).cheaper


def test_the_speed_of_this_machine_is_kept(tmp_path, monkeypatch):
    """Three runs took twice the predicted processor time in the second half of their steps."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "new"))
    assert speed_here() == MachineSpeed()
    Pace._keep(5.0, 10.0, 30.0)
    assert speed_here().wall_per_cpu == 1.0  # it was measured beside other work
    for wall_s in (8.0, 40.0):
        Pace._keep(5.0, 10.0, wall_s)
    assert (speed_here().cpu, speed_here().wall_per_cpu, speed_here().n_runs) == (2.0, 0.8, 3)
    Pace._keep(1.0, 2.0, 2.0)  # too short
    assert speed_here().n_runs == 3
    remember("/a/town.sumocfg", 41.0)
    assert remembered("/a/town.sumocfg") == 41.0 and remembered("elsewhere") is None and speed_here().n_runs == 3


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"cpu_and_wall_per_cpu": [[1]], "vehicles": 3}', "{" * 5000])
def test_a_damaged_file_of_speeds_is_no_speed(tmp_path, monkeypatch, content):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    (tmp_path / "speed.json").write_text(content)
    assert speed_here() == MachineSpeed() and remembered("x") is None
    remember("x", 3.0)
    assert remembered("x") == 3.0
