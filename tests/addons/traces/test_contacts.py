"""Encounters of traces: those of a run row for row, those of other layouts by hand, and censoring at gaps."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cosim.addons.traces.contacts import ContactParams, contacts
from cosim.runs.stop import Failed
from results.archive import open_run
from results.encounters import EncounterParams, EncounterTracker
from sumo_nets import catalogue
from tests.cosim.traffic.test_replay import record
from tests.drive import assert_refused, cosim, full_disk, simulate

KEY = ["a", "b", "start_step", "radius_m", "pairs"]
CONFIG = """\
sensing = false
[traffic]
warmup_s = 120
duration_s = 30
[fleet]
penetration_p = 0.6
[[encounters]]
pairs = "all"
[[encounters]]
pairs = "los"
radius_m = 60
hysteresis_s = 0
[[encounters]]
"""
BESIDE = """\
sensing = false
traffic.warmup_s = 120
traffic.duration_s = 8
parked.per_100_m = 14
trees.per_100_m = 18
[[encounters]]
pairs = "all"
[[encounters]]
pairs = "all_los"
los = "buildings"
"""


def count(paths, out, **params):
    return open_run(contacts(paths, ContactParams(**params), out, lambda *_: None))


def table(folder):
    """Encounters without what only messages and trust can fill."""
    found = open_run(folder).encounters.sort_values(KEY).reset_index(drop=True)
    return found[[c for c in found.columns if not c.startswith(("trust", "source", "state", "age"))]]


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """A run of the shipped city, and what SUMO alone writes of the same traffic."""
    folder = tmp_path_factory.mktemp("contacts")
    (folder / "c.toml").write_text(CONFIG)
    simulate(folder / "run", config=folder / "c.toml")
    record(catalogue.find("helsinki").sumocfg_path, folder / "fcd.parquet", 152)
    return folder


def test_contacts_of_a_runs_own_trace_are_its_encounters(driven):
    """Row for row and bit for bit: SUMO labels step 0, the world after 120 s, with 119 s."""
    done = cosim("contacts", "fcd.parquet", "--config", "c.toml", "--scenario", "helsinki", "--from", "119", "--to",
                 "148", "--out", "fcd", cwd=driven)  # fmt: skip
    assert done.returncode == 0 and not done.stderr, done.stderr
    run = table(driven / "run")
    assert len(run) > 400 and run.pairs.nunique() == 3 and not run.los_share.eq(1).all()
    pd.testing.assert_frame_equal(table(driven / "fcd"), run, check_exact=True)
    vehicles = open_run(driven / "run").vehicles
    sensing = ["role", "attack", "attack_start_step", "sensing_interval_steps", "sensing_phase_steps"]
    vehicles = vehicles.drop(columns=sensing)
    there = open_run(driven / "fcd").vehicles[vehicles.columns]
    pd.testing.assert_frame_equal(there, vehicles, check_exact=True)


def test_contacts_of_a_run_with_its_own_and_other_definitions(driven):
    definitions = (EncounterParams(pairs="all"), EncounterParams(pairs="all", radius_m=30.0))
    again = count([driven / "run"], driven / "again", encounters=definitions)
    run = table(driven / "run")
    mine = again.encounters[again.encounters.radius_m == 100].sort_values(KEY).reset_index(drop=True)
    expected = run[run.pairs == "all"].reset_index(drop=True)
    pd.testing.assert_frame_equal(mine[expected.columns], expected, check_exact=True)
    assert 0 < (again.encounters.radius_m == 30).sum() < len(expected)


@pytest.mark.verify
def test_trees_and_parked_cars_of_a_run_are_in_the_way_in_its_contacts(tmp_path):
    (tmp_path / "c.toml").write_text(BESIDE)
    simulate(tmp_path / "run", config=tmp_path / "c.toml")
    done = cosim("contacts", "run", "--config", "c.toml", "--out", "again", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = table(tmp_path / "run")
    assert run.los_share.between(0.01, 0.99).sum() > 50
    pd.testing.assert_frame_equal(table(tmp_path / "again"), run, check_exact=True)
    moving = open_run(tmp_path / "again").vehicles.sumo_id.str.startswith("parked/").eq(False)
    summary = open_run(tmp_path / "again").manifest["summary"]
    assert sum(summary["classes"].values()) == moving.sum() < len(moving) and summary["speed_median_mps"] > 1


def test_a_config_says_who_is_equipped_in_a_run(driven):
    """All cars and vans, and the equipped share of the run's own config where there is none."""
    (driven / "all.toml").write_text("[fleet]\npenetration_p = 1\n[[encounters]]\n")
    done = cosim("contacts", "run", "--config", "all.toml", "--out", "all", cwd=driven)
    assert done.returncode == 0, done.stderr
    found = open_run(driven / "all").vehicles
    assert (found.equipped == found.vehicle_class.isin(["car", "van"])).all()
    plain = count([driven / "run"], driven / "unchanged").vehicles
    assert plain.equipped.tolist() == open_run(driven / "run").vehicles.equipped.tolist()


def test_a_folder_that_reads_like_a_run(driven):
    for words in ("contacts run --out plain", "measure plain", "plot encounters plain", "plot durations plain",
                  "verify plain"):  # fmt: skip
        done = cosim(*words.split(), cwd=driven)
        assert done.returncode == 0, f"{words}: {done.stderr}"
    run = open_run(driven / "plain")
    assert run.measure.value("encounters.n", "all, 100 m") == len(run.encounters)


def test_on_a_full_disk_nothing_stays(driven, monkeypatch):
    monkeypatch.setattr("cosim.addons.traces.contacts._Counted.close", full_disk)
    with pytest.raises(Failed, match="full: No space left on device"):
        count([driven / "run"], driven / "full")
    assert not (driven / "full").exists()


def test_positions_of_a_run_as_a_table_give_the_same_encounters(driven):
    """The same places without sizes and headings; nothing is known before the first and after the last position."""
    run = open_run(driven / "run")
    there = run.actors.merge(run.vehicles, left_on="actor", right_on="vehicle")
    there = there[there.vehicle_class != "pedestrian"].sort_values(["step", "actor"])
    rows = pd.DataFrame({"who": "v" + there.actor.astype(str), "t": there.step * 1.0, "e": there.x_m, "n": there.y_m})
    rows.to_csv(driven / "t.csv", index=False)
    done = cosim("contacts", "t.csv", "--id", "who", "--time", "t", "--x", "e", "--y", "n", "--appearance", "ends",
                 "--out", "table", cwd=driven)  # fmt: skip
    assert done.returncode == 0, done.stderr
    columns = ["start_step", "end_step", "duration_s", "censored_left", "censored_right", "entered", "departed"]
    found = []
    for folder, prefix in ((driven / "run", "v"), (driven / "table", "")):
        one, names = open_run(folder).encounters, open_run(folder).vehicles
        one = one[(one.pairs == "all")]
        name = prefix + names.vehicle.astype(str) if prefix else names.sumo_id
        pair = np.sort(np.column_stack([name.to_numpy()[one.a], name.to_numpy()[one.b]]).astype(str), axis=1)
        found.append(one[columns].assign(one=pair[:, 0], other=pair[:, 1]).sort_values(["one", "other", "start_step"]))
    pd.testing.assert_frame_equal(*(f.reset_index(drop=True) for f in found), check_exact=True)


def trace(tmp_path, rows) -> Path:
    path = tmp_path / "t.csv"
    path.write_text("id,time,x,y\n" + "".join(f"{i},{t},{x},{y}\n" for i, t, x, y in rows))
    return path


def test_gaps_censor(tmp_path):
    """Two stand 10 m apart from 0 s to 9 s and from 50 s to 59 s: four ends of observation, no end of an encounter."""
    rows = [(who, t, x, 0) for t in [*range(10), *range(50, 60)] for who, x in (("a", 0), ("b", 10))]
    run = count([trace(tmp_path, rows)], tmp_path / "o", max_gap_s=30.0)
    one = run.encounters
    assert run.vehicles.n_steps.tolist() == [20, 20]
    assert one[["start_step", "end_step"]].to_numpy().tolist() == [[0, 10], [50, 60]]
    assert one.censored_left.all() and one.censored_right.all() and one.gap_s.tolist()[1:] == [40]
    joined = count([trace(tmp_path, rows)], tmp_path / "p", max_gap_s=60.0).encounters
    assert joined[["start_step", "end_step"]].to_numpy().tolist() == [[0, 60]]
    ended = count([trace(tmp_path, rows)], tmp_path / "q", appearance="ends").encounters
    assert ended.censored_left.tolist() == [True, False] and ended.censored_right.tolist() == [False, True]


@pytest.mark.parametrize("layout", ["positions", "SUMO's"])
def test_work_grows_with_rows_and_not_with_the_length_of_a_gap(tmp_path, monkeypatch, layout):
    """Two drive 14 m apart for 10 s, two others for 10 s a year later. --to in the gap ends the counting there."""
    year_s, path, updates = 31_536_000, tmp_path / "t.xml", []
    update = EncounterTracker.update
    monkeypatch.setattr(EncounterTracker, "update", lambda *given: updates.append(given[1]) or update(*given))
    if layout == "positions":
        rows = [(f"{begin}_{i}", t, 8 * (t % 1000) + 14 * i, 0) for begin in (0, year_s) for i in (0, 1)
                for t in range(begin, begin + 10)]  # fmt: skip
        path = trace(tmp_path, rows)
    else:
        both = late_trace(0, 9) + late_trace(year_s, year_s + 9).replace('id="v', 'id="w')
        path.write_text(both.replace("</fcd-export><fcd-export>", ""))
    own = EncounterParams(pairs="all", hysteresis_s=5)
    found = count([path], tmp_path / "o", encounters=(own,))
    steps = found.encounters[["start_step", "end_step"]].to_numpy().tolist()
    assert found.manifest["steps"] == steps[1][1] and steps[1][0] - steps[0][0] == year_s and len(updates) <= 22
    assert [end - start for start, end in steps] == [10, 10]
    assert found.encounters.departed.tolist() == [True, False]
    cut = count([path], tmp_path / "cut", encounters=(own,), to_s=20_000_000.0)
    assert len(cut.encounters) == 1 and len(updates) <= 22 + 12
    assert layout == "positions" or cut.manifest["steps"] == 20_000_001


def test_a_span_without_a_position_in_it(tmp_path):
    """A position every 30 s; from 32 s to 45 s both vehicles are between two of theirs: 14 steps."""
    rows = [("a", t, t, 0) for t in range(0, 91, 30)]
    rows += [("b", t, t, 10) for t in range(1, 92, 30)]
    run = count([trace(tmp_path, rows)], tmp_path / "o", step_s=1.0, max_gap_s=60.0, from_s=32.0, to_s=45.0)
    assert run.encounters[["start_step", "end_step"]].to_numpy().tolist() == [[0, 14]]
    assert run.encounters.min_distance_m.tolist() == [10]
    assert run.vehicles[["first_step", "last_step", "n_steps"]].to_numpy().tolist() == [[0, 13, 14]] * 2


def test_an_encounter_that_is_seen_whole(tmp_path):
    """b passes a at 20 m/s: within 100 m from 5 s to 15 s, eleven steps, of which none is censored."""
    rows = [(who, t, x, 0) for t in range(0, 31, 5) for who, x in (("a", 0), ("b", -200 + 20 * t))]
    found = count([trace(tmp_path, rows)], tmp_path / "o", step_s=1.0)
    (row,) = found.encounters.to_dict("records")
    assert (row["start_step"], row["end_step"], row["duration_s"]) == (5, 16, 11)
    assert not (row["censored_left"] or row["censored_right"] or row["entered"] or row["departed"])
    assert row["min_distance_m"] == 0
    assert found.manifest["summary"]["interpolated_share"] == pytest.approx(48 / 62)


def test_pedestrians_count_only_if_a_definition_includes_them(tmp_path):
    """A car passes a pedestrian and another car that stand 10 m apart."""
    rows = [(who, t, x, 0, kind) for t in range(5) for who, x, kind in
            (("a", 8 * t, "car"), ("b", 20, "Car"), ("p", 30, "pedestrian"))]  # fmt: skip
    path = tmp_path / "t.csv"
    path.write_text("id,time,x,y,class\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    definitions = (EncounterParams(pairs="all"), EncounterParams(pairs="all", pedestrians=True))
    found = count([path], tmp_path / "o", encounters=definitions)
    name = found.vehicles.set_index("vehicle").sumo_id
    pairs = found.encounters.groupby("pedestrians")[["a", "b"]].apply(
        lambda part: {tuple(sorted((name[a], name[b]))) for a, b in part.to_numpy()}
    )
    assert pairs[False] == {("a", "b")} and pairs[True] == {("a", "b"), ("a", "p"), ("b", "p")}
    assert found.manifest["summary"]["classes"] == {"car": 2, "pedestrian": 1}
    assert found.manifest["summary"]["actors_per_step_mean"] == 3
    car = '<vehicle id="a" x="{x}" y="0" angle="90" type="car" speed="8"/>'
    walker = '<person id="p" x="30" y="0" angle="90" type="DEFAULT_PEDTYPE" speed="0"/>'
    steps = "".join(f'<timestep time="{t}">{car.format(x=8 * t)}{walker}</timestep>' for t in range(5))
    (tmp_path / "t.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    assert count([tmp_path / "t.xml"], tmp_path / "s").manifest["summary"]["actors_per_step_mean"] == 2


def test_what_the_numbers_were_taken_for_is_printed(tmp_path):
    """NGSIM's milliseconds and feet: 40 ft/s are 12.2 m/s."""
    rows = "".join(f"1,{1163065600000 + 100 * k},0,{4 * k}\n2,{1163065600000 + 100 * k},12,{4 * k}\n" for k in range(9))
    (tmp_path / "n.csv").write_text("Vehicle_ID,Global_Time,Local_X,Local_Y\n" + rows)
    done = cosim("contacts", "n.csv", "--out", "met", cwd=tmp_path)
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert "2 car; speeds 12.2 m/s (median)" in done.stdout and "read as: layout ngsim" in done.stdout
    made = cosim("trace", "n.csv", "--out", "t.parquet", cwd=tmp_path)
    assert "2 tracks after 0 gaps and 0 jumps; 2 car; speeds 12.2 m/s" in made.stdout, made.stderr
    rows = "".join(f"a,{t},{10 * t + 9000 * (t > 2)},0\n" for t in range(6))
    (tmp_path / "jump.csv").write_text("id,time,x,y\n" + rows)
    done = cosim("contacts", "jump.csv", "--out", "jumped", cwd=tmp_path)
    assert "1 vehicles with 6 positions; 0 gaps and 1 jumps cut them into 2 tracks of 2 vehicles" in done.stdout


def test_notes_on_a_trace_are_printed(tmp_path):
    """A type that no file defines, a lost timestep, and a type of a class: one note each for the first two."""
    row = '<vehicle id="a" x="{x}" y="0" angle="90" type="equipped" speed="10"/>'
    row += '<vehicle id="b" x="{x}" y="9" angle="90" type="bus" speed="10"/>'
    steps = "".join(f'<timestep time="{t}">{row.format(x=10 * t)}</timestep>' for t in (0, 1, 2, 4, 5))
    (tmp_path / "t.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    done = cosim("contacts", "t.xml", "--out", "met", cwd=tmp_path)
    guess, lost = done.stderr.splitlines()
    assert "types equipped (passenger)" in guess and "at 3 s for the first time: 1 steps" in lost


def test_steps_in_which_vehicles_pass_each_other_are_noted(tmp_path):
    """At 10 m/s each and in steps of 10 s, two come 200 m closer: within a radius of 50 m, not of 100 m, unseen."""
    rows = ['<vehicle id="{}" x="{}" y="{}" angle="{}" type="car" speed="10"/>'.format(*who) for who in
            (("a", "{a}", 0, 90), ("b", "{b}", 4, 270))]  # fmt: skip
    steps = "".join(
        f'<timestep time="{t}">{"".join(rows).format(a=10 * t, b=300 - 10 * t)}</timestep>' for t in range(0, 40, 10)
    )
    (tmp_path / "t.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    for radius_m, said in (("50", "10 m/s (95 %) come 200 m closer in a step of 10 s"), ("100", "")):
        done = cosim("contacts", "t.xml", "--radius-m", radius_m, "--out", f"met{radius_m}", cwd=tmp_path)
        assert done.returncode == 0 and (said in done.stderr if said else not done.stderr), done.stderr


def late_trace(begin_s, end_s):
    """What SUMO writes of two vehicles that drive in a line, from one time to another."""
    row = '<vehicle id="{name}" x="{x}" y="0" angle="90" type="passenger" speed="8"/>'
    steps = (
        f'<timestep time="{t}">'
        + "".join(row.format(name=f"v{i}", x=8 * (t % 1000) + 14 * i) for i in range(2))
        + "</timestep>"
        for t in range(begin_s, end_s + 1)
    )
    return f"<fcd-export>{''.join(steps)}</fcd-export>"


def test_the_end_is_a_time_of_the_trace_also_where_the_trace_begins_late(tmp_path):
    """From 100 s to 200 s, counted until 150 s: 51 worlds, with and without the begin said."""
    (tmp_path / "late.xml").write_text(late_trace(100, 200))
    for more in ("--from 100", ""):
        done = cosim("contacts", "late.xml", *more.split(), "--to", "150", cwd=tmp_path)
        assert "51 s in steps of 1 s" in done.stdout


BAD = {
    "no file": ("nothing.csv", "no such file"),
    "equipped": ("t.csv --pairs equipped", "says nothing of equipment"),
    "scenario": ("t.csv --scenario helsinki", "--scenario goes with a trace that SUMO wrote"),
    "radius": ("t.csv --radius-m -3", "radius_m"),
    "radius twice": ("t.csv --radius-m 50 --radius-m 50", "the same definition"),
    "gap": ("t.csv --max-gap-s nan", "--max-gap-s nan"),
    "half of a place": ("t.csv --x x", "Name both columns"),
    "metres and degrees": ("t.csv --x x --lat y", "a trace has one of the two"),
    "another column": ("t.csv --x x --y north", "no column north"),
    "config and radius": ("t.csv --config c.toml --radius-m 5", "Leave out --radius-m"),
    "later": ("t.csv --from 900", "the trace goes from 0 to 9"),
    "backwards": ("t.csv --from 9 --to 2", "from a time to a later one"),
    "two of SUMO's": ("a.xml b.xml", "one trace of SUMO's at a time"),
    "repair of SUMO's": ("a.xml --repair", "--repair: a.xml is a trace that SUMO wrote"),
    "gap of SUMO's": ("a.xml --max-gap-s 5", "--max-gap-s: a.xml is a trace that SUMO wrote"),
    "frames that are times": ("t.csv --frame-hz 25", "no frame numbers"),
    "control characters": ("e.csv", "columns \N{REPLACEMENT CHARACTER}[31mred)"),
    "no such attribute": ("a.xml", "no angle of its vehicles"),
    "degrees of SUMO's": ("g.xml", "look like degrees"),
    "a folder": (".", "not a run"),
    "units of SUMO's": ("a.xml --time-unit ms", "--time-unit: a.xml is a trace that SUMO wrote"),
    "no such unit": ("t.csv --length-unit yards", "--length-unit"),
    "lines of another time": ("cr.csv", "its lines end with CR alone"),
    "over before it begins": ("late.xml --to 50", "late.xml begins at 100 s, after --to 50"),
}


@pytest.mark.parametrize("what", BAD)
def test_misuse_ends_in_one_line_and_nothing_written(tmp_path, what):
    words, said = BAD[what]
    trace(tmp_path, [("a", t, t, 0) for t in range(10)])
    (tmp_path / "c.toml").write_text("[[encounters]]\n")
    (tmp_path / "e.csv").write_text("\x1b[31mred\n")
    (tmp_path / "cr.csv").write_bytes(b"id,time,x,y\ra,0,0,0\ra,1,1,0\r")
    (tmp_path / "late.xml").write_text(late_trace(100, 110))
    bare = "".join(f'<timestep time="{t}"><vehicle id="a" x="{t}" y="0"/></timestep>' for t in range(3))
    for name in ("a.xml", "b.xml"):
        (tmp_path / name).write_text(f"<fcd-export>{bare}</fcd-export>")
    moving = "".join(
        f'<timestep time="{t}">' + "".join(
            f'<vehicle id="v{i}" x="{12 + i / 100 + t * 1e-4}" y="41.8" angle="90" type="t" speed="10"/>'
            for i in range(10)
        ) + "</timestep>" for t in range(20)
    )  # fmt: skip
    (tmp_path / "g.xml").write_text(f"<fcd-export>{moving}</fcd-export>")
    before = sorted(tmp_path.iterdir())
    done = cosim("contacts", *words.split(), cwd=tmp_path)
    assert_refused(done, said)
    assert not [p for p in tmp_path.iterdir() if p not in before and p.name != "runs"]
    assert not list(tmp_path.glob("runs/*"))


def test_nobody_meets(tmp_path):
    """Two cars a kilometre apart: no encounter is no mistake."""
    cars = "".join(f'<vehicle id="{n}" x="{1000 * n}" y="0" angle="90" type="car" speed="0"/>' for n in (0, 1))
    steps = "".join(f'<timestep time="{t}">{cars}</timestep>' for t in range(3))
    (tmp_path / "apart.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    done = cosim("contacts", "apart.xml", cwd=tmp_path)
    assert done.returncode == 0 and "none: no two came within the radius of each other" in done.stdout, done.stderr
