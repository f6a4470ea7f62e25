"""`cosim export`: clouds of the run itself, mistakes in one line, interrupted and taken up again."""

import gzip
import re

import numpy as np
import pandas as pd
import pytest

from cosim.addons.export.export import export
from cosim.runs import replay_lidar
from results.archive import open_run
from tests.addons.export import readers
from tests.drive import assert_refused, cosim, drive, simulate


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    run = tmp_path_factory.mktemp("export") / "run"
    return drive(run, "traffic.duration_s=6", "traffic.warmup_s=120", "cpm.length=uper")


@pytest.fixture(scope="module")
def vehicles(folder):
    found = open_run(folder).vehicles
    return found.vehicle[found.equipped & (found.first_step == 0) & (found.last_step == 5)].tolist()[:3]


def test_clouds_are_those_of_the_run(folder, vehicles, tmp_path):
    run = open_run(folder)
    named = ",".join(map(str, vehicles))
    done = export(run, "kitti", tmp_path / "out", named, "2-5")
    assert done["sweeps"] == 12 and 0.5 < done["estimated_bytes"] / done["bytes"] < 2
    config = replay_lidar.config_of(run)
    city = replay_lidar.city_of(config)
    for number, world in enumerate(replay_lidar.worlds(run, np.arange(2, 6))):
        rows = np.searchsorted(world.actor, vehicles)
        sweeps = replay_lidar.sweep(config, city, world, rows)
        seen = run.observability[run.observability.step == world.step]
        for o, vehicle in enumerate(vehicles):
            points = readers.velodyne(tmp_path / f"out/object/training/velodyne/{3 * number + o:06d}.bin")[:, :3]
            assert points.tobytes() == sweeps.xyz(o).astype("<f4").tobytes()
            # what the tables say of the run itself: returns from each actor
            of_actor = np.unique(sweeps.hit[o][sweeps.hit[o] >= 3] - 3, return_counts=True)
            mine = seen[(seen.observer == vehicle) & (seen.n_points > 0)]
            assert dict(zip(world.actor[of_actor[0]], of_actor[1], strict=True)) == dict(
                zip(mine.actor, mine.n_points, strict=True)
            )


def test_interrupted_and_taken_up_again(folder, vehicles, tmp_path):
    run, named = open_run(folder), ",".join(map(str, vehicles))
    whole = export(run, "opv2v", tmp_path / "whole", named)

    def stop(what, done, total):
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(run, "opv2v", tmp_path / "cut", named, progress=stop)
    again = export(run, "opv2v", tmp_path / "cut", named)
    assert again["resumed"] and again["files"] < whole["files"]
    paths = {p.relative_to(tmp_path / "whole"): p.read_bytes() for p in (tmp_path / "whole").rglob("*") if p.is_file()}
    assert paths == {
        p.relative_to(tmp_path / "cut"): p.read_bytes() for p in (tmp_path / "cut").rglob("*") if p.is_file()
    }
    assert len(paths) == whole["files"] + 1


CUT = """
from pathlib import Path

from cosim.extend import File, Plan


class Cut:
    TABLES = ("vehicles",)

    def plan(self, selection):
        return Plan.of_files([File("a.txt", lambda: b"a"), File("b.txt", self.second)])

    def second(self):
        if not Path({flag!r}).exists():
            Path({flag!r}).touch()
            raise KeyboardInterrupt
        return b"b"
"""


def test_an_export_that_is_cut_off_in_its_first_unit_goes_on(folder, tmp_path):
    """The folder was that of no export until then: "is not empty. Give a new folder." """
    (tmp_path / "cut.py").write_text(CUT.format(flag=str(tmp_path / "flag")))
    form, out = f"{tmp_path}/cut.py:Cut", tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        export(open_run(folder), form, out)
    assert (out / "a.txt").is_file() and not (out / "b.txt").exists()
    with pytest.raises(ValueError, match=r"another export \(other format"):
        export(open_run(folder), "fcd", out)
    export(open_run(folder), form, out)
    assert (out / "b.txt").read_bytes() == b"b"


def test_other_steps_with_the_same_ends_are_another_export(folder, vehicles, tmp_path):
    run, named = open_run(folder), ",".join(map(str, vehicles))
    export(run, "kitti", tmp_path / "out", named, "0-1,3", ["images=false"])
    with pytest.raises(ValueError, match=r"another export \(other steps\)"):
        export(run, "kitti", tmp_path / "out", named, "0,2-3", ["images=false"])


@pytest.mark.parametrize(
    ("form", "more", "says"),
    [
        ("waymo", {}, "no such choice. There are kitti"),
        ("kitti", {"vehicles": "99999"}, "there was never such a vehicle"),
        ("fcd", {"vehicles": "0"}, "fcd always has all vehicles"),
        ("kitti", {"vehicles": "../3"}, "numbers and spans"),
        ("kitti", {"vehicles": "5-3"}, "numbers and spans"),
        ("kitti", {"steps": "900-901"}, "no vehicle senses then"),
        ("fcd", {"steps": "900-901"}, "the run is over by then"),
        ("veremi-nextgen", {}, 'holds no table receptions: it is kept at record.level = "full"'),
        ("pcap", {"sets": ["received=true"]}, 'holds no table receptions: it is kept at record.level = "full"'),
        ("pcap", {"sets": ["latitude=60"]}, "the latitude and the longitude of the origin"),
        ("pcap", {"sets": ["latitude=99", "longitude=20"]}, "latitude"),
    ],
)
def test_mistakes(folder, tmp_path, form, more, says):
    with pytest.raises(ValueError, match=says):
        export(open_run(folder), form, tmp_path / "out", **more)
    assert not (tmp_path / "out").exists()


def test_packets_are_in_helsinki(folder, vehicles, tmp_path):
    run = open_run(folder)
    export(run, "pcap", tmp_path / "out", ",".join(map(str, vehicles)), "2-5")
    frames = readers.pcap(tmp_path / "out/sent.pcap")
    sent = run.detections[run.detections.observer.map(run.subjects.vehicle).isin(vehicles) & run.detections.transmitted]
    sent = sent[sent.step.between(2, 5)]
    cpms = [readers.cpm(f["message"]) for f in frames if f["port"] == 2009]
    encoded = [f["message"] for f in frames if f["port"] == 2009]
    n_bytes = {(m["station"], m["time_ms"]): len(e) for m, e in zip(cpms, encoded, strict=True)}
    assert sum(len(m["objects"]) for m in cpms) == (sent.detection_index > 0).sum() > 0
    assert len(frames) - len(cpms) == (sent.detection_index == 0).sum() == 12
    content = run.cpm_content.set_index(["step", "sender"])
    for (
        message
    ) in cpms:  # with 44 bytes of the network and 96 of the signature; the self report is an object of 273 bits
        row = content.loc[((message["time_ms"] - 662_774_405_000) // 1000, message["station"])]
        assert row.sensors and message["range"] and row.n_included == len(message["objects"])
        own = row.length_bytes - 140 - n_bytes[message["station"], message["time_ms"]]
        assert row.self_report and 34 <= own <= 36
    for frame in frames:  # the network's bounds in degrees, of its own header
        assert 60.164 < frame["lat"] / 1e7 < 60.180 and 24.935 < frame["lon"] / 1e7 < 24.954


@pytest.mark.verify
@pytest.mark.parametrize("form", ["mcap", "fcd", "nuscenes"])
def test_the_same_bytes_again(folder, vehicles, tmp_path, form):
    run = open_run(folder)
    named = None if form == "fcd" else ",".join(map(str, vehicles[:1]))  # it has all vehicles
    for where in ("a", "b"):
        if form == "mcap":
            pytest.importorskip("mcap")
        assert export(run, form, tmp_path / where, named, "1-2")["files"]
    first, second = (
        {p.relative_to(tmp_path / w): p.read_bytes() for p in sorted((tmp_path / w).rglob("*")) if p.is_file()}
        for w in ("a", "b")
    )
    assert first == second


def test_a_mistake_is_one_line(folder, tmp_path):
    """Exit status 2, and nothing written."""
    done = cosim("export", "kitti", str(folder), "--out", str(tmp_path / "out"), "--vehicles", "../<b>x</b>")
    assert_refused(done)
    assert not (tmp_path / "out").exists()


def test_floating_car_data_of_a_run_without_sensing_come_back(tmp_path):
    """All steps are written, though nobody senses in any, and a replay has the run's boxes, one step later.

    Parked cars are no traffic, and are left out.
    """
    sets = ("sensing=false", "fleet.penetration_p=0", "traffic.step_s=0.5")
    simulate(tmp_path / "run", *sets, "traffic.duration_s=4", "traffic.warmup_s=60", "parked.per_100_m=3")
    done = cosim("export", "fcd", "run", "--out", "trace", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    refused = cosim("export", "kitti", "run", "--out", "kitti", cwd=tmp_path)
    assert refused.returncode == 2 and "sensing = false, so no vehicle senses or sends" in refused.stderr
    assert not (tmp_path / "kitti").exists()
    trace = f"traffic.trace={tmp_path / 'trace' / 'fcd.xml.gz'}"
    simulate(tmp_path / "again", *sets, "traffic.duration_s=4", "traffic.scenario=helsinki", trace)
    tables = []
    for name, shift in (("run", 0), ("again", 1)):
        of = open_run(tmp_path / name)
        rows = of.actors.merge(of.vehicles, left_on="actor", right_on="vehicle")
        columns = ["sumo_id", "vehicle_class", "length_m", "width_m", "height_m", "x_m", "y_m", "z_m", "yaw_rad"]
        is_parked = rows.sumo_id.str.startswith("parked/")
        assert is_parked.any() == (name == "run")
        rows = rows[~is_parked].assign(step=rows.step - shift)
        tables.append(rows[rows.step < 7].sort_values(["step", "sumo_id"])[["step", *columns]].reset_index(drop=True))
    assert len(tables[0]) > 100 and tables[0].step.nunique() == 7
    pd.testing.assert_frame_equal(*tables, check_exact=True)


def test_floating_car_data_are_where_a_far_trace_was(tmp_path):
    """The world of a trace without a network has an origin nearby; a replay of that run keeps it."""
    rows = [("a", t, 385_000.0 + 10 * t, 6_671_000.0, 90.0, 10.0) for t in range(6)]
    pd.DataFrame(rows, columns=["id", "time", "x", "y", "angle", "speed"]).to_csv(tmp_path / "far.csv", index=False)
    sets = ("sensing=false", "traffic.step_s=1", "traffic.duration_s=4")
    simulate(tmp_path / "run", *sets, f"traffic.scenario={tmp_path / 'far.csv'}")
    simulate(tmp_path / "again", *sets, f"traffic.trace={tmp_path / 'run'}", f"traffic.scenario={tmp_path / 'far.csv'}")
    for name in ("run", "again"):
        done = cosim("export", "fcd", name, "--out", f"of_{name}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        text = gzip.decompress((tmp_path / f"of_{name}" / "fcd.xml.gz").read_bytes()).decode()
        east_m = [float(x) for x in re.findall(r' x="([^"]*)"', text)]
        assert len(east_m) >= 3 and all(384_900 < x < 385_100 for x in east_m), (name, east_m)
