"""A replay is the run that it came from, whatever the traffic was written down in; and what a bad trace is told."""

import gzip
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pyarrow as pa
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import pytest

from cosim.runs.run import new_remarks
from cosim.traffic.interpolation import curve
from cosim.traffic.params import TrafficParams
from cosim.traffic.replay import TraceReplay
from cosim.traffic.scenario import find
from cosim.traffic.source import TrafficError
from sumo_nets import catalogue, sumotools
from tests.cosim.traffic import mixed_scenario
from tests.cosim.traffic.worlds import collect, live, registry, same
from tests.drive import SHORT, cosim, drive
from tests.fingerprint import fingerprint
from tests.processes import manifest_of, set_words
from tests.slow import slow

FORMATS = (
    "fcd.parquet",
    "fcd.xml",
    slow("fcd.csv"),
    slow("fcd.xml.gz"),
    slow("fcd.csv.gz"),
)


def record(config: Path, target: Path, end: int, **more: float) -> None:
    """What SUMO writes of its own accord; text needs more digits than SUMO's usual two."""
    options = {"configuration-file": config.resolve(), "seed": 1, "end": end, "fcd-output": target.resolve(),
               "no-step-log": True, "no-warnings": True, "step-length": 1, "verbose": False,
               "duration-log.statistics": False}  # fmt: skip
    if target.suffix != ".parquet":
        options["precision"] = 8
    sumotools.run("sumo", options | more, target.parent)


@pytest.fixture(scope="module")
def helsinki(tmp_path_factory):
    """Forty steps after two minutes, live."""
    folder = tmp_path_factory.mktemp("helsinki")
    return folder, live("helsinki", 120, 40)[0]


@pytest.mark.parametrize("name", FORMATS)
def test_a_trace_shows_the_world_that_was_live(helsinki, name):
    folder, worlds = helsinki
    assert sum(len(world["actor"]) for world in worlds) > 2000
    record(catalogue.find("helsinki").sumocfg_path, folder / name, 200)
    traffic = find("helsinki", str(folder / name)).traffic(TrafficParams(), registry())
    same(collect(traffic, 120, 40), worlds)


def test_a_replay_warms_up_as_long_as_sumo():
    """A warm-up of 30.5 steps ends with the step in which it is over: the first one recorded is step 31."""
    replay = object.__new__(TraceReplay)
    replay._dt_s = 1.0
    list(replay.warm_up(30.5))
    assert replay._n_skipped == 31


def test_a_finer_step_and_a_later_begin(tmp_path):
    """Ten steps a second from second 50 on; a pedestrian comes first, after whom SUMO then names all columns."""
    params = TrafficParams(step_s=0.1, begin_s=50)
    worlds = live("helsinki", 10, 30, params)[0]
    assert len(worlds[-1]["actor"]) > 3
    config = catalogue.find("helsinki").sumocfg_path
    record(config, tmp_path / "fcd.parquet", 65, begin=50, **{"step-length": 0.1})
    for traced in (params, TrafficParams(step_s=0.1)):  # the trace begins there of itself
        traffic = find("helsinki", str(tmp_path / "fcd.parquet")).traffic(traced, registry())
        same(collect(traffic, 10, 30), worlds)


def test_every_oddity_is_replayed_as_it_was_live(tmp_path):
    """Left-hand, hilly, far from its origin, with rail, ships, containers, riders, and a person named like a car."""
    config = mixed_scenario.write(tmp_path / "live")
    before = {p: p.read_bytes() for p in config.parent.iterdir()}
    worlds, report = live(str(config), 0, 200)
    assert {p: p.read_bytes() for p in config.parent.iterdir()} == before  # nothing written beside it
    assert len(worlds) == 91  # its own end: from 0 s to 90 s
    assert report["actors_left_out"] == {"rail": 1, "ship": 1}
    record(mixed_scenario.write(tmp_path / "fcd"), tmp_path / "fcd.parquet", 90)
    traffic = find(str(config), str(tmp_path / "fcd.parquet")).traffic(TrafficParams(), registry())
    same(collect(traffic, 0, 200), worlds)
    told = traffic.report()
    assert 0 < told.pop("vehicles_standing_p") < 0.5
    assert (told.pop("actors_at_trace_begin"), told.pop("trace_begin_s")) == (3, 1.0)  # they depart at 0 s
    assert told == {"actors_left_out": {"container": 1, "rail": 1, "ship": 1}}
    # The network lies 9,000 km west of its origin: the world is counted from a round place in its middle.
    xyz_m = np.concatenate([world["xyz_m"] for world in worlds])
    assert np.abs(xyz_m[:, :2]).max() < 1500 and np.ptp(xyz_m[:, 2]) > 6  # and it is a hill


def test_hills_in_half_seconds(tmp_path):
    """SUMO's Parquet holds heights in single precision: 1 in 2,000 would round to another 1/256 m than live."""
    params = TrafficParams(step_s=0.5)
    config = mixed_scenario.write(tmp_path / "live")
    worlds, _ = live(str(config), 0, 181, params)
    record(mixed_scenario.write(tmp_path / "fcd"), tmp_path / "fcd.parquet", 90, **{"step-length": 0.5})
    same(collect(find(str(config), str(tmp_path / "fcd.parquet")).traffic(params, registry()), 0, 181), worlds)


def test_identical_tables(tmp_path):
    """The whole run, not only its worlds: live, from Parquet, and from the tables of the live run."""
    record(catalogue.find("helsinki").sumocfg_path, tmp_path / "fcd.parquet", 120)
    sets = ("traffic.duration_s=12", "record.level=full")
    told = fingerprint(drive(tmp_path / "live", *sets, "traffic.warmup_s=90"))
    assert len(told) > 10
    trace = drive(tmp_path / "trace", *sets, "traffic.warmup_s=90", f"traffic.trace={tmp_path / 'fcd.parquet'}")
    assert fingerprint(trace) == told
    again = drive(tmp_path / "again", *sets, "traffic.warmup_s=0", f"traffic.scenario={tmp_path / 'live'}")
    assert fingerprint(again) == told


def test_a_run_that_outlives_its_trace_ends_and_says_so(tmp_path):
    drive(tmp_path / "live", "traffic.duration_s=5", "traffic.warmup_s=60")
    sets = (*SHORT, "traffic.duration_s=9", "traffic.warmup_s=0", f"traffic.scenario={tmp_path / 'live'}")
    done = cosim("run", *set_words(sets), "--out", str(tmp_path / "longer"))
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("\n") == 1 and "ended before the 9 s asked for" in done.stderr
    manifest = manifest_of(tmp_path / "longer")
    assert manifest["steps"] == 5 and manifest["status"] == "finished"
    assert fingerprint(tmp_path / "longer") == fingerprint(tmp_path / "live")
    said = {}
    assert len(new_remarks(tmp_path / "longer", said)) == 1
    assert new_remarks(tmp_path / "longer", said) == [], "a study says it once"


def test_every_second_moment_of_a_finer_trace(tmp_path):
    rows = "".join(
        f'<timestep time="{t / 2}"><vehicle id="a" x="{t}" y="0" angle="90" type="t" speed="2"/></timestep>'
        for t in range(20)
    )
    (tmp_path / "fine.xml").write_text(f"<fcd-export>{rows}</fcd-export>")
    worlds = collect(find(str(tmp_path / "fine.xml")).traffic(TrafficParams(), registry()), 0, 99)
    # Step 0 is before the trace; steps 1 to 10 show 0 s to 9 s, where the front bumper is at 2 m/s x t.
    # A type that no file defines is a car of 5 m: its centre is 2.5 m behind its bumper.
    assert len(worlds[0]["actor"]) == 0
    assert [w["xyz_m"][0, 0] for w in worlds[1:]] == [2.0 * t - 2.5 for t in range(10)]


STRANGE = ["with space", 'it\'s "quoted"', "a/b\\c", "ööö 漢字 🚗", "<&>", "null", "NaN", "1", "-", ";,|"]


@pytest.mark.parametrize("name", ["strange.xml", "strange.csv", "strange.parquet"])
def test_any_name_will_do(tmp_path, name):
    path, n = tmp_path / name, len(STRANGE)
    if name.endswith(".xml"):
        rows = "".join(
            f'<vehicle id={quoteattr(who)} x="{10 * i}" y="0" angle="90" speed="1" type="bus"/>'
            for i, who in enumerate(STRANGE)
        )
        path.write_text(f'<fcd-export><timestep time="0">{rows}</timestep></fcd-export>', encoding="utf-8")
    else:
        table = pa.table({
            "timestep_time": [0.0] * n, "vehicle_id": STRANGE, "vehicle_x": [10.0 * i for i in range(n)],
            "vehicle_y": [0.0] * n, "vehicle_angle": [90.0] * n, "vehicle_type": ["bus"] * n,
            "vehicle_speed": [1.0] * n,
        })  # fmt: skip
        if name.endswith(".csv"):
            pcsv.write_csv(table, path, pcsv.WriteOptions(delimiter=";"))
        else:
            pq.write_table(table, path)
    who = registry()
    traffic = find(str(path)).traffic(TrafficParams(), who)
    traffic.advance()
    world = traffic.advance()
    assert who.names == sorted(STRANGE) and len(set(world.name_key.tolist())) == n
    x = {who.names[a]: box for a, box in zip(world.actor.tolist(), world.boxes.xyz_m[:, 0].tolist(), strict=True)}
    assert [x[name] + 6.0 for name in STRANGE] == [10.0 * i for i in range(n)]  # a bus is 12 m long


ROW = '<vehicle id="a" x="0" y="0" angle="0" type="t" speed="0"/>'
HEAD = "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed\n"
BAD = {
    "unsorted.xml": (f'<timestep time="1">{ROW}</timestep><timestep time="0">{ROW}</timestep>', "0 s comes after 1 s"),
    "twice.xml": (f'<timestep time="0">{ROW}{ROW}</timestep>', "'a' occurs twice at 0 s"),
    "again.xml": (f'<timestep time="0">{ROW}</timestep><timestep time="0">{ROW}</timestep>', "comes after 0 s"),
    "lacks.xml": ('<timestep time="0"><vehicle id="a" x="0" y="0"/></timestep>', "no angle of its"),
    "nan.xml": (f'<timestep time="0">{ROW.replace("0", "nan", 1)}</timestep>', "not finite"),
    "infinite.csv": (HEAD + "0;a;-inf;0;0;t;0\n", "'a' at 0 s has a number missing or not finite"),
    "word.xml": (f'<timestep time="0">{ROW.replace("0", "left", 1)}</timestep>', "could not convert"),
    "clock.xml": (f'<timestep time="0:01">{ROW}</timestep>', "neither a number of seconds nor a time of day"),
    "empty.xml": ("", "no actor is ever on the road"),
    "coarse.xml": (f'<timestep time="0">{ROW}</timestep><timestep time="2.5">{ROW}</timestep>', "every 2.5 s, and"),
    "unsorted.csv": (HEAD + "1;a;0;0;0;t;0\n0;a;0;0;0;t;0\n", "time 0 s comes after 1 s"),
    "twice.csv": (HEAD + "0;a;0;0;0;t;0\n0;a;1;0;0;t;0\n", "'a' occurs twice"),
    "hole.csv": (HEAD + "0;a;;0;0;t;0\n", "'a' at 0 s has a number missing"),
    "lacks.csv": ("time;id\n0;a\n", "no x of its"),
    "word.csv": (HEAD + "0;a;left;0;0;t;0\n", "column x"),
    "torn.csv": (HEAD + "0;a;0\n", "a row has 3 values and the header has 7 names"),
    "not.parquet": ("PAR1 and then nothing", "damaged, or not a trace"),
    "torn.xml.gz": (None, "ends, before </fcd-export>"),
    "ends.xml": (None, "ends after 1 s, before </fcd-export>: SUMO was stopped"),
    "ends.csv": (HEAD + "0;a;0;0;0;t;0\n1;a;1;0;0;t;0\n2;a;2", "its last row is not complete"),
    "thousands.csv": (HEAD + "0;a;1.234,5;0;0;t;0\n", "'1.234,5' in row 1. Are commas or points between thousands"),
    "other.xml": (None, "starts with <routes>"),
    "bomb.xml": (None, "DOCTYPE"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_trace_gets_one_line(tmp_path, name):
    text, says = BAD[name]
    path = tmp_path / name
    if name == "torn.xml.gz":
        path.write_bytes(gzip.compress(f"<fcd-export>{ROW * 9}".encode())[:-12])
    elif name == "ends.xml":
        path.write_text(f'<fcd-export><timestep time="0">{ROW}</timestep><timestep time="1">{ROW}')
    elif name == "other.xml":
        path.write_text("<routes/>")
    elif name == "bomb.xml":
        path.write_text('<!DOCTYPE f [<!ENTITY b SYSTEM "file:///etc/hosts">]><fcd-export>&b;</fcd-export>')
    else:
        path.write_text(f"<fcd-export>{text}</fcd-export>" if name.endswith(".xml") else text)
    with pytest.raises(TrafficError, match=r".") as caught:
        traffic = find(str(path)).traffic(TrafficParams(), registry())
        while True:
            traffic.advance()
    assert says in str(caught.value) and name in str(caught.value) and "\n" not in str(caught.value)


def test_between_the_timesteps_of_a_trace_actors_are_where_sumo_had_them(tmp_path):
    """Every tenth timestep of a trace of 0.1 s, replayed at 0.1 s, beside the whole trace."""
    record(catalogue.find("helsinki").sumocfg_path, tmp_path / "fcd.parquet", 90, **{"step-length": 0.1})
    trace = pq.read_table(tmp_path / "fcd.parquet")
    tenth = np.round(trace.column("timestep_time").to_numpy() * 10).astype(int) % 10 == 0
    pq.write_table(trace.filter(pa.array(tenth)), tmp_path / "coarse.parquet")
    params, off_m, off_mps = TrafficParams(step_s=0.1), [], []
    worlds = [
        collect(find("helsinki", str(tmp_path / name)).traffic(params, registry()), 80, 95)
        for name in ("fcd.parquet", "coarse.parquet")
    ]
    for step, (true, between) in enumerate(zip(*worlds, strict=False)):
        if (step - 1) % 10 == 0:
            assert len(true["actor"]) == len(between["actor"])
        keys = [dict(zip(w["name_key"].tolist(), range(len(w["actor"])), strict=True)) for w in (true, between)]
        assert keys[1].keys() <= keys[0].keys()
        rows = np.array([(keys[0][key], keys[1][key]) for key in keys[1]]).T
        off_m += np.hypot(*(true["xyz_m"][rows[0]] - between["xyz_m"][rows[1]])[:, :2].T).tolist()
        off_mps += np.abs(true["speed_mps"][rows[0]] - between["speed_mps"][rows[1]]).tolist()
    assert len(off_m) > 3000
    assert np.quantile(off_m, 0.9) < 0.1 and np.quantile(off_mps, 0.9) < 0.2


def test_curves_between_two_poses():
    """By hand: constant speed on a straight line; constant acceleration; a quarter of a circle of 5 m, within 8 cm."""
    begin, north = np.zeros((1, 3)), (np.zeros(1), np.zeros(1))
    straight = curve(begin, np.array([[0.0, 10.0, 2.0]]), north, (np.full(1, 10.0), np.full(1, 10.0)), 0.3)
    np.testing.assert_allclose(straight, [[0.0, 3.0, 0.6]], atol=1e-12)
    braking = curve(begin, np.array([[0.0, 5.0, 0.0]]), north, (np.full(1, 10.0), np.zeros(1)), 0.5)
    np.testing.assert_allclose(braking[0, 1], 10 * 0.5 - 10 * 0.5**2 / 2)  # 10 m/s, -10 m/s2, half a second
    arc = np.full(1, 5 * np.pi / 2)  # radius 5 m, from north to east
    middle = curve(begin, np.array([[5.0, 5.0, 0.0]]), (np.zeros(1), np.full(1, 90.0)), (arc, arc), 0.5)
    np.testing.assert_allclose(middle[0, :2], [5 - 5 * np.sqrt(0.5), 5 * np.sqrt(0.5)], atol=0.055)


def test_actors_that_appear_leave_or_are_put_elsewhere_are_not_interpolated(tmp_path):
    """`jump` is put 500 m away; `ends` and `comes` are at one timestep only; a person rides in `car`."""

    def row(kind: str, name: str, x: float, angle: float = 90.0) -> str:
        type_ = "DEFAULT_PEDTYPE" if kind == "person" else "t"
        return f'<{kind} id="{name}" x="{x}" y="0" angle="{angle}" type="{type_}" speed="10"/>'

    first = (
        row("vehicle", "car", 0)
        + row("person", "rider", 0, 80)
        + row("vehicle", "ends", 50)
        + row("vehicle", "jump", 100)
    )
    second = (
        row("vehicle", "car", 10)
        + row("person", "rider", 10, 80)
        + row("vehicle", "comes", 50)
        + row("vehicle", "jump", 600)
    )
    (tmp_path / "a.xml").write_text(
        f'<fcd-export><timestep time="0">{first}</timestep><timestep time="1">{second}</timestep></fcd-export>'
    )
    traffic = find(str(tmp_path / "a.xml")).traffic(TrafficParams(step_s=0.25), registry())
    worlds = collect(traffic, 0, 99)
    assert [len(world["actor"]) for world in worlds] == [0, 3, 1, 1, 1, 3]
    np.testing.assert_allclose([world["xyz_m"][0, 0] for world in worlds[1:]], [-2.5, 0.0, 2.5, 5.0, 7.5], atol=0.01)
    assert traffic.report()["trace_interpolated_s"] == 1.0
