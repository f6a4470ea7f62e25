"""Positions from elsewhere become a trace: directions, speeds and places are those of the motion."""

from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pytest

from cosim.addons.traces import layouts, positions
from cosim.addons.traces.from_positions import write_trace
from cosim.addons.traces.tracks import TrackParams
from cosim.traffic import fcd
from cosim.traffic.frame import TrafficError
from results.archive import open_run
from tests.drive import assert_refused, cosim
from tests.processes import set_words
from tests.slow import slow

STEP_S, LENGTH_M = 0.1, 5.0


def traced(folder, *words):
    """How a trace of `p.csv` ends."""
    return cosim("trace", "p.csv", *words, "--out", "t.parquet", cwd=folder)


def written(tmp_path, rows, params=None):
    """The timesteps of the trace that is made of a table."""
    rows.to_csv(tmp_path / "positions.csv", index=False)
    columns = layouts.PositionColumns("id", "time", "x", "y", kind="class") if "class" in rows else None
    fixes = positions.read([tmp_path / "positions.csv"], columns)
    report = write_trace(fixes, params or TrackParams(STEP_S, 30.0), tmp_path / "out.parquet")
    return list(fcd.timesteps(tmp_path / "out.parquet")), report


def test_a_circle_is_driven_along_its_tangent(tmp_path):
    """Radius 50 m at 10 m/s: 0.2 rad/s. A chord over two steps has the direction of the tangent in its middle."""
    t = np.arange(0, 20, STEP_S)
    angle = 0.2 * t
    rows = pd.DataFrame({"id": "a", "time": t, "x": 50 * np.cos(angle), "y": 50 * np.sin(angle)})
    found, report = written(tmp_path, rows)
    assert len(found) == report["steps"] == len(t) and report["interpolated_share"] == 0
    inner = found[1:-1]
    tangent = np.column_stack([-np.sin(angle), np.cos(angle)])[1:-1]
    compass = np.array([step.compass_deg[0] for step in inner])
    assert np.column_stack([np.sin(np.radians(compass)), np.cos(np.radians(compass))]) == pytest.approx(tangent)
    chord = 50 * 2 * np.sin(0.2 * STEP_S) / (2 * STEP_S)
    assert np.abs([step.speed_mps[0] - chord for step in inner]).max() < 1e-9
    front = rows[["x", "y"]].to_numpy()[1:-1] + tangent * LENGTH_M / 2
    assert np.array([step.front_m[0, :2] for step in inner]) == pytest.approx(front)


def test_who_stands_keeps_its_direction_and_who_has_not_moved_has_its_first(tmp_path):
    t = np.arange(0, 6, STEP_S)
    x = np.clip(5 * (t - 2), 0, 10)  # stands until 2 s, drives east for 2 s, stands
    noise = 0.02 * np.cos(37 * t)
    rows = pd.DataFrame({"id": "a", "time": t, "x": x, "y": noise})
    found, _ = written(tmp_path, rows)
    compass = np.array([step.compass_deg[0] for step in found])
    assert np.abs(compass - 90).max() < 10
    speed = np.array([step.speed_mps[0] for step in found])
    assert np.abs(speed[(t > 2.2) & (t < 3.8)] - 5).max() < 0.05
    never = pd.DataFrame({"id": "b", "time": t, "x": 3.0, "y": 4.0})
    (tmp_path / "out.parquet").unlink()
    assert {step.compass_deg[0] for step in written(tmp_path, never)[0]} == {0.0}


def test_a_column_of_directions_is_said_to_be_left(tmp_path):
    rows = pd.DataFrame({"id": "a", "time": [0, 1, 2], "x": [0, 5, 10], "y": 0, "class": "car", "heading": 45})
    assert [said for said in written(tmp_path, rows)[1]["read_as"] if said.startswith("heading not read")]


def test_slow_actors_at_25_hz_look_where_they_go(tmp_path):
    """A pedestrian comes 0.06 m far in a step: from the third step on it is 0.2 m from where it began."""
    t = np.arange(0, 8, 0.04)
    x = np.minimum(1.4 * t, 5.6)
    rows = pd.DataFrame({"id": "a", "time": t, "x": x, "y": np.maximum(1.4 * (t - 4), 0), "class": "pedestrian"})
    found, _ = written(tmp_path, rows, TrackParams(0.04, 30.0))
    compass = np.array([step.compass_deg[0] for step in found])
    assert np.abs(compass[t < 3.9] - 90).max() < 1e-6  # east, from the first step on
    assert np.abs(compass[t > 4.4]).max() < 1e-6  # then north


def test_one_vehicle_goes_on_after_a_gap_and_classes_give_sizes(tmp_path):
    rows = pd.DataFrame({
        "id": ["a"] * 6 + ["w"] * 4, "time": [0, 1, 2, 100, 101, 102, 0, 1, 2, 3],
        "x": [0, 10, 20, 500, 510, 520, 0, 0, 0, 0], "y": [0.0] * 6 + [0, 1, 2, 3],
        "class": ["truck"] * 6 + ["pedestrian"] * 4,
    })  # fmt: skip
    found, report = written(tmp_path, rows, TrackParams(1.0, 30.0))
    assert report["actors"] == 2 and report["tracks"] == 3 and report["gaps"] == 1
    assert {name for step in found for name in step.names} == {"a", "w"}
    first = dict(zip(found[0].names, found[0].front_m[:, :2].tolist(), strict=True))
    assert first["a"] == pytest.approx([7.1 / 2, 0]) and first["w"] == pytest.approx([0, 0.215 / 2])
    assert [step.time_s for step in found] == [0, 1, 2, 3, 100, 101, 102]


def test_who_stands_after_a_gap_does_not_look_to_where_it_is_later(tmp_path):
    rows = pd.DataFrame({"id": "a", "time": [0, 1, 2, 100, 101], "x": [0.0, 0, 0, -500, -500], "y": 0.0})
    assert {step.compass_deg[0] for step in written(tmp_path, rows, TrackParams(1.0, 30.0))[0]} == {0.0}


def test_a_run_takes_a_vehicle_after_a_gap_for_the_same(tmp_path):
    """Two stand side by side and are not seen for 45 s, in which the road is empty. Equipment goes by name."""
    at_s = [*range(20), *range(64, 80)]
    rows = pd.DataFrame({"id": np.repeat(["a", "b"], len(at_s)), "time": at_s * 2, "x": 0, "y": 0})
    rows.assign(y=np.where(rows.id == "a", 0, 20)).to_csv(tmp_path / "p.csv", index=False)
    made = traced(tmp_path)
    assert made.returncode == 0 and "4 tracks after 2 gaps" in made.stdout, made.stderr
    keys = ("traffic.scenario=t.parquet", "sensing=false", 'encounters=[{pairs="all"}]')
    ran = cosim("run", *set_words(keys), "--out", "run", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    run = open_run(tmp_path / "run")
    assert run.vehicles.sumo_id.tolist() == ["a", "b"] and run.encounters.gap_s.tolist()[1] == 44
    for name in ("p.csv", "t.parquet"):
        met = cosim("contacts", name, "--out", name[0], cwd=tmp_path)
        assert met.returncode == 0, met.stderr
        found = open_run(tmp_path / name[0])
        assert found.encounters[["start_step", "end_step"]].to_numpy().tolist() == [[0, 20], [64, 80]]
        assert found.encounters.gap_s.tolist()[1] == 44 and len(found.vehicles) == 2
        assert found.encounters.censored_left.all() and found.encounters.censored_right.all()


def test_a_trace_that_pandas_or_duckdb_wrote_again_is_still_of_positions(tmp_path):
    """Without its metadata, who came into view had entered the road: encounters were complete that had begun before."""
    written(tmp_path, pd.DataFrame({"id": "a", "time": [0, 1, 2], "x": [0.0, 9, 18], "y": 0.0}))
    made, again, sumo = (str(tmp_path / f"{name}.parquet") for name in ("out", "again", "sumo"))
    table = pd.read_parquet(made)
    duckdb.read_parquet(made).write_parquet(again)
    assert fcd.is_observed(Path(made)) and fcd.is_observed(Path(again))
    table.to_parquet(again)
    assert fcd.is_observed(Path(again))
    table.drop(columns=fcd.OBSERVED_COLUMN).to_parquet(sumo)
    assert not fcd.is_observed(Path(sumo))


@pytest.mark.parametrize("hz", [30000 / 1001, 0.4, slow(60), slow(12.5), slow(10 / 3), slow(1)])
def test_the_command_that_is_printed_can_be_run(tmp_path, hz):
    t = np.arange(0, 8, 1 / hz)
    pd.DataFrame({"id": "a", "time": t, "x": 10 * t, "y": 0.0}).to_csv(tmp_path / "p.csv", index=False)
    made = traced(tmp_path, *(("--step-s", "2.5") if hz < 1 else ()))
    assert made.returncode == 0, made.stderr
    words = made.stdout.partition("cosim run ")[2].split()
    few = ("--set", "traffic.duration_s=2.5", "--set", "fleet.penetration_p=0", "--out", "run")
    ran = cosim("run", *words, *few, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr


def test_the_command_that_is_printed_has_the_city(tmp_path):
    """Alone, the trace would have no streets and no buildings."""
    (tmp_path / "p.csv").write_text("id,time,lat,lon\na,0,60.17,24.94\na,1,60.1701,24.94\n")
    made = traced(tmp_path, "--scenario", "helsinki")
    assert "cosim run --set traffic.scenario=helsinki --set traffic.trace=t.parquet --set" in made.stdout, made.stderr


def test_positions_that_are_left_out_are_said(tmp_path):
    t = np.cumsum(np.random.default_rng(3).uniform(0.05, 0.1, 200))
    pd.DataFrame({"id": "a", "time": t, "x": 10 * t, "y": 0.0}).to_csv(tmp_path / "p.csv", index=False)
    assert "s apart (median)" in traced(tmp_path).stdout


def test_centres_with_the_columns_of_sumo_are_read_if_columns_are_named(tmp_path):
    """An angle from east: SUMO's would be clockwise from north, and of the front bumper."""
    (tmp_path / "p.csv").write_text("id,time,x,y,angle,speed\na,0,0,0,0,9\na,1,9,0,0,9\n")
    assert "name --x and --y" in traced(tmp_path).stderr
    made = traced(tmp_path, "--x", "x", "--y", "y")
    assert made.returncode == 0 and "angle not read" in made.stdout, made.stderr
    first = pd.read_parquet(tmp_path / "t.parquet").iloc[0]
    assert (first.vehicle_x, first.vehicle_angle) == (2.5, 90.0)


def test_what_is_time_0_is_said(tmp_path):
    (tmp_path / "p.csv").write_text("id,time,x,y\na,1700000000.5,0,0\na,1700000001.5,9,0\n")
    said = traced(tmp_path).stdout
    assert "2 steps of 1 s from 1700000000.5 s of the positions on, which is time 0" in said


def test_nothing_on_a_step_or_no_room_is_one_line_and_writes_nothing(tmp_path):
    rows = pd.DataFrame({"id": ["a", "b"], "time": [0.25, 0.35], "x": [0.0, 1.0], "y": [0.0, 1.0]})
    rows.to_csv(tmp_path / "p.csv", index=False)
    fixes = positions.read([tmp_path / "p.csv"])
    with pytest.raises(TrafficError, match="cannot be written"):
        write_trace(fixes, TrackParams(0.1, 1.0), tmp_path / "absent" / "out.parquet")
    assert [path.name for path in tmp_path.iterdir()] == ["p.csv"]


def test_a_run_drives_the_trace_and_counts_what_contacts_counts(tmp_path):
    """Encounters of the run's centres are those of the positions themselves."""
    rng, t = np.random.default_rng(2), np.arange(0, 40.0)
    rows = pd.concat([
        pd.DataFrame({"id": f"v{n}", "time": t, "x": x + vx * t, "y": y + vy * t})
        for n, (x, y, vx, vy) in enumerate(rng.uniform([-200, -200, -12, -12], [200, 200, 12, 12], (25, 4)))
    ])  # fmt: skip
    rows.to_csv(tmp_path / "p.csv", index=False)
    made = cosim("trace", "p.csv", "--out", "traffic.parquet", cwd=tmp_path)
    assert made.returncode == 0 and "25 vehicles, 40 steps of 1 s" in made.stdout, made.stderr
    keys = ("traffic.scenario=traffic.parquet", "traffic.duration_s=40", "sensing=false", "traffic.warmup_s=0")
    words = set_words(keys)
    ran = cosim("run", *words, "--set", 'encounters=[{pairs="all", radius_m=60}]', "--out", "run", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    met = cosim("contacts", "p.csv", "--radius-m", "60", "--appearance", "ends", "--out", "met", cwd=tmp_path)
    assert met.returncode == 0, met.stderr
    columns = ["a", "b", "start_step", "end_step"]
    a, b = (named_encounters(tmp_path / name, columns) for name in ("run", "met"))
    assert len(a) > 20
    assert np.array_equal(a, b)
    begun = open_run(tmp_path / "run").table("encounters").query("start_step == 0")
    assert len(begun) and begun.censored_left.all()  # the recording begins in traffic


def named_encounters(folder, columns):
    run = open_run(folder)
    names = dict(zip(run.table("vehicles").vehicle, run.table("vehicles").sumo_id.astype(str), strict=True))
    found = run.table("encounters")[columns]
    pair = np.sort(found[["a", "b"]].map(names.get).to_numpy(str), axis=1)
    return found.assign(a=pair[:, 0], b=pair[:, 1]).sort_values(columns).reset_index(drop=True)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--out", "t.csv"), "ends in .parquet"),
        (("--out", "t.parquet", "--step-s", "0"), "--step-s 0: a finite number"),
        (("--out", "t.parquet", "--class", "kind"), "goes with --x and --y"),
        (("--out", "t.parquet", "--x", "east", "--y", "north"), "no column"),
        (("--out", "p.csv.parquet", "--lat", "x"), "--lat and --lon"),
        (("--out", "t.parquet", "--lat", "lon_deg", "--lon", "lat_deg"), "Exchange the two"),
    ],
)
def test_wrong_use_is_one_line(words, says, tmp_path):
    (tmp_path / "p.csv").write_text("id,time,x,y\na,0,0,0\na,1,9,0\n")
    ended = cosim("trace", "p.csv", *words, cwd=tmp_path)
    assert_refused(ended, says)
    assert [path.name for path in tmp_path.iterdir()] == ["p.csv"]


def test_fronts_stay_fronts(tmp_path):
    """NGSIM: a truck of 60 ft whose front is at 100 ft, 104 ft ..., and so is that of the trace."""
    rows = "".join(f"1,{100 * k},16,{100 + 4 * k},60,8,3\n" for k in range(5))
    (tmp_path / "n.csv").write_text("Vehicle_ID,Global_Time,Local_X,Local_Y,v_Length,v_Width,v_Class\n" + rows)
    write_trace(positions.read([tmp_path / "n.csv"]), TrackParams(STEP_S, 30.0), tmp_path / "out.parquet")
    fronts_m = [step.front_m[0, 1] for step in fcd.timesteps(tmp_path / "out.parquet")]
    assert fronts_m == pytest.approx([0.3048 * y for y in (100, 104, 108, 112, 116)])
