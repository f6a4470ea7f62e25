"""A run that is watched: the same tables, a whole recording, what it shows, and mistakes in one line."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.addons.export import view
from results.archive import open_run
from tests.drive import SHORT, assert_refused, cosim, drive
from tests.fingerprint import fingerprint
from tests.processes import set_words

SETS = ("traffic.duration_s=8", "traffic.warmup_s=120", "attacks.0.start_s=2")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("live") / "plain", *SETS)


def watched(folder, name):
    words = set_words((*SHORT, *SETS))
    done = cosim("run", *words, "--out", str(folder / "run"), "--watch-file", str(folder / name))
    assert done.returncode == 0, done.stderr
    return folder / "run"


@pytest.mark.verify
def test_rerun(plain, tmp_path):
    pytest.importorskip("rerun")
    assert fingerprint(watched(tmp_path, "live.rrd")) == fingerprint(plain), "watching changes nothing"
    rerun = Path(sys.executable).with_name("rerun")
    said = subprocess.run([rerun, "rrd", "verify", tmp_path / "live.rrd"], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.verify
def test_vehicles_that_use_earlier_messages_are_watched(tmp_path):
    """With random phases, a value is looked up for the sender of a message of an earlier step, too."""
    words = "run", "--preset", "modern", "--set", "traffic.duration_s=3", "--set", "traffic.warmup_s=120"
    for folder, more in (("plain", ()), ("seen", ("--watch-file", str(tmp_path / "live.mcap")))):
        done = cosim(*words, "--out", str(tmp_path / folder), *more)
        assert done.returncode == 0, done.stderr
    assert fingerprint(tmp_path / "seen") == fingerprint(tmp_path / "plain")


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_mcap(plain, tmp_path):
    """Its boxes and colours are the run's; trust is the mean of what receivers look up."""
    reader, decoder = pytest.importorskip("mcap.reader"), pytest.importorskip("mcap_ros2.decoder")
    run = open_run(watched(tmp_path, "live.mcap"))
    assert fingerprint(run.path) == fingerprint(plain)
    found = {}
    with (tmp_path / "live.mcap").open("rb") as file:
        read = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for _, channel, _, content in read.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(content)
    assert len(found["/actors"]) == len(found["/trust"]) == 8 and len(found["/buildings"]) == 1
    for step, array in enumerate(found["/actors"]):
        there = run.actors[run.actors.step == step].sort_values("actor")
        assert [m.id for m in array.markers[1:]] == there.actor.tolist()
        assert np.abs([m.pose.position.x for m in array.markers[1:]] - there.x_m).max() < 1 / 256
    last = run.trust_lookups[(run.trust_lookups.step == 7) & (run.trust_lookups.variant == "base")]
    mean = last[last.source != "default"].groupby("subject").trust.mean()
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("trust", "<f4"), ("age", "<f4"), ("vehicle", "<i4")]
    shown = np.frombuffer(found["/trust"][7].data, kinds)
    of = dict(zip(shown["vehicle"].tolist(), shown["trust"].tolist(), strict=True))
    assert len(mean) > 3 and all(of[number] == pytest.approx(value, abs=1e-5) for number, value in mean.items())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--watch-file", "live.txt"), "must end in .rrd or .mcap"),
        (("--watch-file", "/dev/null/live.mcap"), "cannot be written"),
        (("--watch", "--watch-file", "live.rrd"), "Choose one"),
    ],
)
def test_mistakes(tmp_path, words, says):
    done = cosim("run", "--out", str(tmp_path / "run"), *words)
    assert_refused(done, says)
    assert not (tmp_path / "run").exists()


VIEWER = """#!{python}
import pathlib, socket, sys, time
words = sys.argv[1:]
pathlib.Path({said!r}).write_text(" ".join(words))
with socket.create_server((words[words.index("--bind") + 1], int(words[words.index("--port") + 1]))):
    time.sleep(30)
"""


def test_the_viewer_is_that_of_the_installation_and_listens_to_this_machine(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    for name, text in (("rerun", "#!/bin/sh\ntouch {said}-of-path\n"), ("viewer", VIEWER)):
        (tmp_path / name).write_text(text.format(python=sys.executable, said=str(tmp_path / "said")))
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setenv("RERUN_CLI_PATH", str(tmp_path / "viewer"))
    connected = []
    recording = SimpleNamespace(connect_grpc=connected.append)
    viewer = view.show(recording, "--watch", "Use --watch-file")
    os.killpg(viewer.pid, signal.SIGKILL)
    viewer.wait()
    words = (tmp_path / "said").read_text().split()
    port = words[words.index("--port") + 1]
    assert words[words.index("--bind") + 1] == "127.0.0.1" and connected == [f"rerun+http://127.0.0.1:{port}/proxy"]
    assert not (tmp_path / "said-of-path").exists()


def test_a_viewer_that_does_not_start_is_one_line(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    monkeypatch.setenv("RERUN_CLI_PATH", str(tmp_path / "nothing"))
    with pytest.raises(ValueError, match=r"^--watch: the Rerun viewer does not start; .*Use --watch-file.$"):
        view.show(SimpleNamespace(), "--watch", "Use --watch-file")
