"""The edge of the program: places that cannot be written, streams that are closed, files that are none, odd names."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from results.archive import open_run
from results.verify import verify
from tests.hostile.scenes import write_town, write_trace
from tests.hostile.test_runs import judged
from tests.processes import set_words, sets_of_trace

pytestmark = pytest.mark.verify
ROOT = Path(__file__).parents[2]
MAY_MOUNT = (
    shutil.which("unshare")
    and not subprocess.run(
        ["unshare", "-m", "sh", "-c", "mount -t tmpfs none /mnt"], capture_output=True, check=False
    ).returncode
)
needs_mount = pytest.mark.skipif(not MAY_MOUNT, reason="needs the right to mount a file system")


def shell(script, cwd, **environment):
    """A shell line in which $COSIM is the command."""
    cosim = f"{sys.executable} -m cosim"
    env = {**os.environ, "COSIM": cosim, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run(["bash", "-c", script], cwd=cwd, env=env, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def run(cosim, tmp_path_factory):
    """A short run, in a folder with the trace that it replayed."""
    folder = tmp_path_factory.mktemp("edges")
    assert cosim("run", *sets_of_trace(write_trace(folder)), "--out", "run", cwd=folder).status == 0
    return folder


@pytest.fixture
def words(tmp_path):
    """Without the retired preset, of which a note would say so."""
    return sets_of_trace(write_trace(tmp_path))[2:]


OUT = {
    "below a file": ("mkdir d; touch d/f", "d/f/run"),
    "a dangling link": ("ln -s nowhere link", "link"),
    "a link to itself": ("ln -s loop loop", "loop"),
    "too long": ("true", "x" * 300),
    "a device": ("true", "/dev/null"),
    "below a device": ("true", "/dev/null/run"),
    "read-only": ("true", "/proc/run"),
    "not empty": ("mkdir d; touch d/x", "d"),
}


@pytest.mark.parametrize("what", OUT)
def test_out_that_cannot_be(cosim, tmp_path, words, what):
    prepare, out = OUT[what]
    subprocess.run(["bash", "-c", prepare], cwd=tmp_path, check=True)
    before = sorted(str(p) for p in tmp_path.rglob("*"))
    ended = cosim("run", *words, "--out", out, cwd=tmp_path)
    assert ended.status == 2 and not ended.wrong, ended
    assert sorted(str(p) for p in tmp_path.rglob("*") if p.name[:2] not in (".o", ".e", ".t")) == before


@pytest.mark.parametrize("name", ["[/]2", "[bold]", ":smile:", "ä b'c", "-x", "a\nb", "[a-b]*?"])
def test_odd_names(cosim, tmp_path, words, name):
    ended = cosim("run", *words, f"--out={name}", cwd=tmp_path)
    assert ended.status == 0 and not ended.wrong, ended
    assert verify(tmp_path / name)[1] == [] and name.split("\n")[0] in ended.out
    ended = cosim("measure", "--", name, cwd=tmp_path)
    assert ended.status == 0 and not ended.wrong, ended


def test_the_same_out_can_be_had_after_a_clean_error(cosim, tmp_path):
    town = write_town(tmp_path / "town", end=12)
    bad = (tmp_path / "town" / "town.rou.xml").read_text()
    (tmp_path / "town" / "town.rou.xml").write_text(bad.replace("A0B0", "nowhere"))
    ended = cosim("run", *sets_of_trace(town), "--out", "run", cwd=tmp_path)
    assert ended.status == 2 and not (tmp_path / "run").exists(), ended
    (tmp_path / "town" / "town.rou.xml").write_text(bad)
    sets = [*sets_of_trace(town), "--set", "traffic.warmup_s=2"]
    ended = cosim("run", *sets, "--out", "run", cwd=tmp_path)
    assert ended.status == 0, ended.err


def test_links_are_replaced_and_not_followed(cosim, run, tmp_path):
    shutil.copytree(run / "run", tmp_path / "run")
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "run" / "trust.png").unlink()
    for name in ("report.html", "trust.png"):
        (tmp_path / "run" / name).symlink_to(tmp_path / "mine")
    assert cosim("report", "run", cwd=tmp_path, cpu_s=60).status == 0
    assert cosim("plot", "trust", "run", cwd=tmp_path).status == 0
    assert (tmp_path / "mine").read_text() == "mine"
    assert not (tmp_path / "run" / "report.html").is_symlink()
    ended = cosim("report", "run", "--out", ".", cwd=tmp_path, cpu_s=60)
    assert ended.status == 2 and "is a folder" in ended.err and not ended.wrong


def test_figures_to_a_device(cosim, run, tmp_path):
    (tmp_path / "out.png").symlink_to("/dev/null")
    before = os.stat("/dev/null").st_rdev
    assert cosim("report", str(run / "run"), "--out", "/dev/null", cwd=tmp_path, cpu_s=60).status == 0
    assert os.stat("/dev/null").st_rdev == before


@pytest.mark.parametrize("text", ["--fresh-s=nan", "--threshold=nan", "--false-positives=nan", "--fresh-s=-1"])
def test_options_that_are_no_numbers(cosim, run, text):
    ended = cosim("measure", "run", text, cwd=run)
    assert ended.status == 2 and not ended.wrong, ended


def test_files_that_are_none(cosim, tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "deep.toml").write_text("seed = " + "[" * 3000 + "]" * 3000)
    (tmp_path / "binary.toml").write_bytes(bytes(range(256)))
    for path in ("pipe.toml", "/dev/zero", "/dev/null", ".", "deep.toml", "binary.toml"):
        ended = cosim("check", path, cwd=tmp_path)
        assert not ended.wrong and ended.cpu_s < 5, (path, ended)
        assert ended.status == (0 if path == "/dev/null" and not ended.err else 2), (path, ended)


def test_closed_and_full_streams(run):
    full = "; echo $? >&3"
    for script, says in {
        "$COSIM measure run >/dev/full 3>&1": "1",
        "$COSIM measure run --json >/dev/full": "1",
        "$COSIM measure run 2>&- >/dev/null": "0",
        "$COSIM measure run >&-": "0",
        "$COSIM measure nowhere 2>&-": "2",
        "$COSIM measure nowhere 2>/dev/full": "2",
        "$COSIM measure run --json <&-": "0",
    }.items():
        done = shell(f"({script}) 3>&1{full.replace('>&3', '')}", run)
        assert done.stdout.strip().splitlines()[-1] == says, (script, done)
        assert "Traceback" not in done.stdout + done.stderr, (script, done)
    piped = shell("$COSIM measure --explain | head -1; echo ${PIPESTATUS[0]}", run)
    assert "Traceback" not in piped.stderr and "Exception ignored" not in piped.stderr


@needs_mount
def test_a_read_only_installation_and_home(tmp_path):
    script = (
        f"mount --bind {ROOT} {ROOT} && mount -o remount,ro,bind {ROOT} && cd {tmp_path} && "
        "env -u XDG_CACHE_HOME -u NUMBA_CACHE_DIR HOME=/proc/none $COSIM check --json"
    )
    done = shell(f"unshare -m bash -c '{script}'", tmp_path, TMPDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["traffic"]["scenario"] == "helsinki"
    assert list(tmp_path.iterdir()) == []


@needs_mount
@pytest.mark.parametrize("kilobytes", [16, 100, 200, 300])
def test_a_full_disk(tmp_path, words, kilobytes):
    """What fits is whole, and the status says what happened."""
    kept = tmp_path / "kept"
    line = " ".join(f"'{word}'" for word in words)
    script = (
        f"mkdir disk && mount -t tmpfs -o size={kilobytes}k none disk && cd disk && "
        f"$COSIM run {line} --out run 1>&2; status=$?; cp -r {tmp_path}/disk {kept}; exit $status"
    )
    (tmp_path / "fill.sh").write_text(script)
    done = shell("unshare -m bash fill.sh", tmp_path)
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode == 1, done
    if (kept / "run").exists():
        about, problems = verify(kept / "run")
        assert problems == [] and about["status"] in ("failed", "killed", "finished")
        print(f"\n{kilobytes} kB: {about['status']}, {about['steps']} steps")
    else:
        print(f"\n{kilobytes} kB: nothing is left")


def test_output_that_is_deleted_meanwhile(tmp_path):
    sets = [*sets_of_trace(write_town(tmp_path / "town"))[2:], "--set", "traffic.warmup_s=2", "--set",
            "traffic.duration_s=40"]  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-m", "cosim", "run", *sets, "--out", "run"], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    while process.poll() is None and not (tmp_path / "run" / "inventory.jsonl").exists():
        time.sleep(0.02)
    (tmp_path / "run").rename(tmp_path / "gone")  # at once: while a folder is emptied, the run may write into it
    shutil.rmtree(tmp_path / "gone")
    _, said = process.communicate(timeout=120)
    assert process.returncode == 1 and said.startswith("error: ") and said.count("\n") == 1, said
    assert not (tmp_path / "run").exists()


def test_twelve_whole_runs_together(tmp_path, words):
    """With and without the same --out: whole runs, or one and clear refusals."""
    for out, wanted in (((), [0] * 12), (("--out", "mine"), [0] + [2] * 11)):
        many = [
            subprocess.Popen([sys.executable, "-m", "cosim", "run", *words, *out], cwd=tmp_path,
                             stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            for _ in range(12)
        ]  # fmt: skip
        said = [process.communicate(timeout=600)[1] for process in many]
        assert sorted(process.returncode for process in many) == wanted, said
        lines = [line for text in said for line in text.splitlines()]
        assert all(line.startswith(("note: ", "error: ")) for line in lines), said
        assert sum(line.startswith("error: ") for line in lines) == wanted.count(2)
    folders = [*sorted((tmp_path / "runs").iterdir()), tmp_path / "mine"]
    assert len(folders) == 13
    for folder in folders:
        about, problems = verify(folder)
        assert about["status"] == "finished" and problems == []


def test_a_changed_input_is_said(cosim, run, tmp_path):
    shutil.copytree(run, tmp_path / "all")
    folder = tmp_path / "all"
    config = folder / "run" / "config.toml"
    config.write_text(config.read_text().replace(str(run), str(folder)))
    assert "changed since" not in cosim("run", "run/config.toml", "--out", "same", cwd=folder).err
    trace = folder / "street.csv"
    trace.write_text(trace.read_text().replace(";12;car", ";11;car"))
    ended = cosim("run", "run/config.toml", "--out", "other", cwd=folder)
    assert ended.status == 0 and "note: changed since run was recorded: street.csv" in ended.err, ended.err


def test_a_victim_or_an_attacker_that_never_appears_is_said(cosim, tmp_path, words):
    keys = ("attacks.0.victim=one", "attacks.0.victim_id=nobody", 'attacks.0.ids=["ghost"]')
    ended = cosim("run", *words, *set_words(keys), "--out", "run", cwd=tmp_path)
    assert ended.status == 0 and 'attacks.0.victim_id = "nobody": no vehicle of that id' in ended.err, ended.err
    assert "attacks.0.ids: ghost did not attack: no equipped vehicle" in ended.err, ended.err


def test_the_ray_caster_is_said(cosim, run, tmp_path, words):
    ended = cosim("run", *words, "--set", "lidar.engine=embree", "--out", "run", cwd=tmp_path, cpu_s=30)
    assert not judged(ended, tmp_path / "run"), ended
    assert "columnar" in open_run(tmp_path / "run").manifest["lidar_engine"]
    ended = cosim("measure", "run", str(run / "run"), cwd=tmp_path)
    assert ended.status == 0 and "cast by columnar and embree" in ended.err, ended.err
