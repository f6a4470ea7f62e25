"""`cosim view`: recordings that the viewer's own tools accept, and mistakes in one line."""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
from PIL import Image

from cosim.addons.export.view import (
    _block,
    _last_sensed,
    _received,
    colours,
    first_look,
    follow,
    role_colours,
    strips,
    view,
)
from cosim.addons.pictures.pictures import film
from results.archive import open_run
from tests.drive import assert_refused, cosim, drive
from tests.results.tiny import fleet, make

pytestmark = pytest.mark.skipif(find_spec("rerun") is None, reason="Rerun's SDK is not installed: make extra NAME=view")


def rerun(*words):
    tool = Path(sys.executable).with_name("rerun")
    return subprocess.run([tool, "rrd", *words], capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("view") / "run", "traffic.duration_s=8", "record.level=full")


@pytest.mark.verify
def test_the_viewers_own_tools_accept_it(folder, tmp_path):
    run = open_run(folder)
    vehicle = int(run.detections.merge(run.subjects, left_on="observer", right_index=True).vehicle.mode()[0])
    out = tmp_path / "sub" / "run.rrd"
    done = view(run, out, [vehicle], from_s=2, to_s=7)
    assert done["steps"] == 5 and done["bytes"] == out.stat().st_size
    assert rerun("verify", str(out)).returncode == 0
    stats = rerun("stats", str(out)).stdout
    for path in ("buildings", "actors", "edges", f"clouds/{vehicle}", "detected", "received", "believed"):
        assert f"/city/{path}:" in stats, path
    assert "/map/streets:" in stats and "/map/actors:" in stats
    without = view(run, tmp_path / "without.rrd", [vehicle], from_s=2, to_s=7, clouds=False)
    assert (
        without["bytes"] < done["bytes"] and "city/clouds" not in rerun("stats", str(tmp_path / "without.rrd")).stdout
    )


def test_colours_by_hand():
    assert colours(np.array([0.0, 0.5, 1.0, np.nan])).tolist() == [
        [213, 50, 40], [255, 224, 130], [30, 90, 200], [70, 70, 70]
    ]  # fmt: skip


def test_roles_have_the_colours_of_the_figures(folder):
    run = open_run(folder)
    some = [int(run.roles.index[run.roles == role][0]) for role in ("honest", "malicious")]
    other = int(run.vehicles.vehicle[~run.vehicles.equipped].iloc[0])
    honest, malicious, unequipped = role_colours(run, np.array([*some, other])).astype(int)
    assert honest.tolist() == [0x16, 0x32, 0x5C] and malicious.tolist() == [0xC1, 0x27, 0x2D]
    weights = np.array([0.2126, 0.7152, 0.0722])  # luminance: they differ in greyscale too
    assert weights @ (unequipped - honest) > 100


def test_boxes_of_a_late_message_are_those_that_were_sent(tmp_path):
    """Vehicle 0 sends a box at x = 1 m in step 0 and one at x = 2 m in step 1. The first one arrives in step 1."""
    sent = [{"step": s, "observer": 0, "x_m": 1.0 + s, "transmitted": True} for s in range(2)]
    late = [{"step": 1, "message_step": 0, "message_type": "cpm", "sender": 0, "receiver": 1}]
    run = make(tmp_path, 2, vehicles=fleet("honest", "honest"), detections=sent, receptions=late)
    (box,) = _received(run, pc.field("step") < 2, [1]).itertuples()
    assert (box.step, box.x_m) == (1, 1.0)


def test_boxes_are_shown_until_their_vehicle_senses_again(tmp_path):
    """Both sense every 5 steps: vehicle 0 in 3 and 8, vehicle 1 in 4 and 9. What it did in a step before the block of
    steps is shown in it. So is what a roadside unit sends, whose pseudonym is of no vehicle."""
    vehicles = fleet("honest", "malicious", None, sensing_interval_steps=5)
    vehicles[0]["sensing_phase_steps"], vehicles[1]["sensing_phase_steps"] = 3, 4
    detections = [
        {"step": 3, "observer": 0, "origin": "sensed", "x_m": 1.0, "transmitted": True},
        {"step": 4, "observer": 1, "origin": "fabricated", "x_m": 2.0, "transmitted": True},
        {"step": 4, "observer": 1, "detection_index": 1, "origin": "sensed", "x_m": 4.0},
        {"step": 6, "observer": 2, "origin": "sensed", "x_m": 5.0, "transmitted": True},
    ]
    heard = [
        {"step": step, "message_step": step, "message_type": "cpm", "sender": sender, "receiver": 0}
        for step, sender in ((4, 1), (6, 2))
    ]
    fused = [{"step": 3, "observer": 0, "source_index": 0}]
    run = make(tmp_path, 10, vehicles=vehicles, detections=detections, receptions=heard, fused=fused)
    shown = _last_sensed(run, np.arange(6, 10), [0])
    found = {name: rows[["x_m", "step", "end_step"]].to_numpy().tolist() for name, rows in shown.items()}
    assert found == {
        "fabricated": [[2.0, 4, 9]], "detected": [[1.0, 3, 8]], "received": [[2.0, 4, 9], [5.0, 6, 11]],
        "believed": [[1.0, 3, 8]],
    }  # fmt: skip
    assert list(_last_sensed(run, np.arange(6, 10), [])) == ["fabricated"]


def test_trust_of_before_the_first_step_shown_is_known(tmp_path):
    """The server rated vehicle 0 in step 2, and the view begins with step 5."""
    from rerun import Clear, Points2D

    logged = {}

    class Kept:
        def set_time(self, *words, **time):
            pass

        def log(self, name, what):
            logged[name] = what

    actors = [{"step": 5, "actor": 0, "x_m": 1.0}]
    rated = [{"step": 2, "subject": 0, "trust": 0.25, "n_evaluations": 1}]
    run = make(tmp_path, 7, vehicles=fleet("honest"), actors=actors, trust=rated, detections=[])
    _block(Kept(), run, None, np.array([5]), run.encounters, (), None)
    expected = Points2D([[0, 0]], colors=colours(np.array([0.25]))).colors
    assert logged["map/rings"].colors.as_arrow_array().equals(expected.as_arrow_array())
    _block(Kept(), run, None, np.array([6]), run.encounters, (0,), lambda step, vehicles: [])
    assert len(logged["map/rings"].positions) == 0  # nobody is on the road any more
    assert isinstance(logged["city/clouds/0"], Clear)


def test_the_first_view(folder):
    run, steps = open_run(folder), np.arange(2, 7)
    vehicle = int(run.vehicles.vehicle[run.vehicles.first_step <= 2].iloc[-1])
    own = run.actors[(run.actors.actor == vehicle) & run.actors.step.isin(steps)].sort_values("step").iloc[0]
    assert first_look(run, steps, [vehicle]).tolist() == own[["x_m", "y_m", "z_m"]].tolist()
    lies = run.detections[run.detections.lied & run.detections.step.isin(steps)]
    seen = first_look(run, steps, [])
    if lies.empty:
        there = run.actors[run.actors.step == 2]
        assert seen.tolist() == there[["x_m", "y_m", "z_m"]].median().tolist()
    else:
        first = lies[lies.step == lies.step.min()][["x_m", "y_m", "z_m"]].to_numpy(float)
        assert (first == seen).all(axis=1).any()


@pytest.mark.parametrize(
    ("out", "more", "says"),
    [
        ("run.png", {}, "ends in .rrd"),
        ("run.rrd", {"vehicles": [99_999]}, "none that carries a LiDAR"),
        ("run.rrd", {"from_s": 900.0}, "no step in between"),
        ("file/run.rrd", {}, "cannot be written"),
    ],
)
def test_mistakes(folder, tmp_path, out, more, says):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ValueError, match=says):
        view(open_run(folder), tmp_path / out, **more)
    assert not (tmp_path / "run.rrd").exists()


def test_a_full_disk_is_one_line(folder, tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(small)], capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        done = cosim("view", str(folder), "--out", str(small / "run.rrd"))
        assert_refused(done)
        assert "run.rrd cannot be written to its end" in done.stderr and not list(small.iterdir())
        done = cosim("export", "kitti", str(folder), "--out", str(small / "kitti"))
        assert_refused(done, "are free")
        (small / "full").write_bytes(bytes(small.stat().st_blksize * 70))
        done = cosim("plot", "trust", str(folder), "--out", str(small / "trust.png"))
        assert len(done.stderr.strip().splitlines()) == 1 and "trust.png: No space left on device" in done.stderr
        assert done.returncode == 1 and {path.name for path in small.iterdir()} == {"kitti", "full"}
    finally:
        subprocess.run(["umount", str(small)], check=True)


@pytest.mark.verify
def test_movie(folder, tmp_path):
    run = open_run(folder)
    vehicle = int(run.vehicles[run.vehicles.equipped & (run.vehicles.first_step == 0)].vehicle.iloc[0])
    shown = []
    out = film(run, vehicle, tmp_path / "m.gif", lambda done, total: shown.append((done, total)))
    steps = int(run.vehicles.set_index("vehicle").last_step[vehicle]) + 1
    assert shown == [(n + 1, steps) for n in range(steps)]
    with Image.open(out) as picture:
        assert picture.n_frames == steps and picture.size[1] > picture.size[0] > 500
    for name, number, says in (
        ("m.avi", vehicle, "ends in .gif or .mp4"), ("m.gif", 99_999, "carries a LiDAR"),
        ("m.gif/x.gif", vehicle, "cannot be written"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=says):
            film(run, number, tmp_path / name)


@pytest.mark.verify
def test_a_run_is_followed_while_it_is_computed(tmp_path):
    """Blocks of two steps appear meanwhile; the recording has every step, and the run is as it would have been."""
    target, out = tmp_path / "run", tmp_path / "live.rrd"
    words = ("run", "--set", "traffic.duration_s=6", "--set", "record.block_steps=2", "--out", str(target))
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(cosim, *words)
        while not (target / "manifest.json").exists():
            assert not running.done(), running.result().stderr
            time.sleep(0.05)
        done = follow(target, out, every_s=0.1)
        assert running.result().returncode == 0
    assert done == {"out": str(out), "steps": 6, "status": "finished"}
    assert rerun("verify", str(out)).returncode == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "--out FILE.rrd"),
        (("--live", "--from", "3"), "--from and --to"),
        (("--live", "--out", "a.txt"), "ends in .rrd"),
    ],
)
def test_mistakes_of_following(folder, words, says):
    done = cosim("view", str(folder), *words)
    assert_refused(done, says)


@pytest.mark.parametrize("d", [2, 3])
def test_strips_are_what_the_sdk_makes_of_a_list(d):
    from rerun.components import LineStrip2DBatch, LineStrip3DBatch

    points = np.random.default_rng(0).normal(size=(9, d))
    batch = {2: LineStrip2DBatch, 3: LineStrip3DBatch}[d]
    made = strips(points, [4, 0, 5])
    assert batch(made).as_arrow_array() is made, "taken as it is"
    assert made.equals(batch([points[:4], points[:0], points[4:]]).as_arrow_array())
