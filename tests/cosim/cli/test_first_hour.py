"""What a newcomer types first: init, check, and files given to the wrong command."""

import json
import re
import shlex
import subprocess
import sys
import tomllib

import pytest

from cosim.config.config import load
from tests.drive import assert_refused, cosim


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A folder with the config and the study that `cosim init` writes."""
    folder = tmp_path_factory.mktemp("begun")
    cosim("init", cwd=folder)
    cosim("init", "--study", "ages.toml", cwd=folder)
    return folder


def test_init_writes_a_config_that_runs_and_a_study(tmp_path):
    done = cosim("init", cwd=tmp_path)
    text = (tmp_path / "mine.toml").read_text()
    assert done.returncode == 0 and "cosim run mine.toml" in done.stdout
    assert len(text.splitlines()) == 15 and load(tmp_path / "mine.toml").fleet.penetration_p == 0.35
    assert cosim("check", "mine.toml", cwd=tmp_path).returncode == 0
    again = cosim("init", cwd=tmp_path)
    assert again.returncode == 2 and "is there already" in again.stderr and (tmp_path / "mine.toml").read_text() == text
    assert cosim("init", "--study", "ages.toml", cwd=tmp_path).returncode == 0
    checked = cosim("check", "ages.toml", cwd=tmp_path)
    assert checked.returncode == 0 and "12 points" in checked.stdout and "cosim sweep ages.toml" in checked.stdout
    assert cosim("init", "mine.yaml", cwd=tmp_path).returncode == 2


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("run ages.toml", "cosim sweep ages.toml"),
        ("run freshness", "cosim sweep freshness"),
        ("sweep mine.toml --out x", "cosim run mine.toml"),
        ("run my.osm.pbf", "cosim nets build --osm my.osm.pbf --out my"),
        ("check --set traffic.scenario=my.osm.pbf", "my.osm.pbf --out my, cosim run"),
        ("run helsinki", "--set traffic.scenario=helsinki"),
        ("predict freshness helsinki", "--set traffic.scenario=helsinki"),
        ("sweep my.osm.pbf --out x", "cosim nets build --osm my.osm.pbf --out my"),
        ("sweep ages.toml --out x --set fleet.penetration_p=1 --dry-run", "the study sweeps"),
        ("sweep ages.toml --out x --set fleet.penetration=1 --dry-run", "unknown key"),
        ("check ages.toml --preset moder", "there is no such preset"),
        ("sweep 'a run'", "Its config is 'a run'/config.toml."),
        ("sweep swept", "cosim sweep swept/study.toml --out swept"),
    ],
)
def test_the_wrong_command_names_the_right_one(begun, words, says):
    (begun / "my.osm.pbf").write_bytes(b"")
    for name in ("a run/manifest.json", "swept/study.toml"):
        (begun / name).parent.mkdir(exist_ok=True)
        (begun / name).write_text("")
    done = cosim(*shlex.split(words), cwd=begun)
    assert_refused(done, says)


def test_a_study_takes_changes_of_its_base(begun):
    words = ["sweep", "ages.toml", "--out", "x", "--dry-run", "--json"]
    long, short = (
        json.loads(cosim(*words, *more, cwd=begun).stdout) for more in ([], ["--set", "traffic.duration_s=12"])
    )
    assert long["points"] == short["points"] == 12
    assert long["MB"] > 4 * short["MB"]
    assert cosim("check", "ages.toml", "--preset", "v0.2", "--all", cwd=begun).stdout.count('preset = "v0.2"') == 1


def test_check_says_what_changes_and_what_follows(tmp_path):
    (tmp_path / "mine.toml").write_text(
        'preset = "v0.2"\n[traffic]\nduration_s = 3600\n[fleet]\npenetration_p = 1.0\n'
        '[[attacks]]\nattack = "sybil"\nshare_p = 0.3\nn_ghosts = 7\n[trust]\nmodel = "beta"\n'
    )
    said = cosim("check", "mine.toml", cwd=tmp_path).stdout
    for line in (
        "7 keys differ from the default of preset v0.2",
        'attacks.0 of the default is left out: { attack = "ghost_insertion" }',
        'attacks.1 of the default is left out: { attack = "unreliable" }',
        "traffic.duration_s = 3600 (default 120)",
        'attacks.0 = { attack = "sybil", share_p = 0.3, n_ghosts = 7 }',
        'trust.model = "beta" (default "trupercept")',
        "about 200 on the road, 200 of them with LiDAR and radio",
        "about 200 sweeps of 33,280 rays, and up to 400 messages",
        "cosim run mine.toml",
    ):
        assert line in said, line
    assert re.search(r"time +about \d", said) and re.search(r"memory +about 0\.\d GB; \d+ MB on disk", said)
    assert len(said.splitlines()) <= 24
    whole = cosim("check", "mine.toml", "--all", cwd=tmp_path).stdout
    assert tomllib.loads(whole)["attacks"][0]["n_ghosts"] == 7


def test_check_loads_what_it_needs():
    """Neither tables nor figures nor SUMO: loading them took longer than the check."""
    code = """
import sys
from cosim.cli.main import main
sys.argv = ["cosim", "check"]
try:
    main()
except SystemExit:
    print(*sorted({"pandas", "matplotlib", "libsumo", "distributed"} & set(sys.modules)), "loaded")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded"


def test_check_of_a_study_says_what_it_takes(begun):
    said = cosim("check", "ages.toml", cwd=begun).stdout
    assert re.search(r"about \d+ (s|min) with \d+ workers? on (a free core|free cores), and \d\.\d GB of memory", said)
    assert "fleet.penetration_p: 0.1, 0.35" in said
    long = cosim("check", "ages.toml", "--set", "traffic.duration_s=36000", cwd=begun).stdout
    assert "half of it: --set traffic.duration_s=18000" in long


@pytest.mark.parametrize(("n", "says"), [(0, "no key differs"), (1, "1 key differs from"), (11, "11 keys differ from")])
def test_check_counts_the_keys_that_differ(n, says):
    changes = (
        "seed=5 traffic.seed=2 traffic.duration_s=60 fleet.penetration_p=0.5 trust.freshness_s=9 trust.tau=0.2 "
        "trust.min_score=0.2 radio.range_m=200 lidar.max_range_m=90 record.level=full record.block_steps=20"
    )
    assert says in cosim("check", *(f"--set={change}" for change in changes.split()[:n])).stdout


def test_a_study_has_a_folder_named_after_its_file(begun):
    done = cosim("sweep", "ages.toml", "--dry-run", cwd=begun)
    assert done.returncode == 0 and "processor time" in done.stdout
    one = '[study]\nname = "one"\n[grid]\ntrust.freshness_s = [10]\n'
    (begun / "one.toml").write_text(one)
    said = cosim("sweep", "one.toml", "--dry-run", cwd=begun).stdout.splitlines()
    assert said[0] == "one: 1 point, 0 finished, 1 run to make" and "replay" not in said[1]
    assert not (begun / "runs").exists()


def test_a_path_is_no_name_of_a_study(tmp_path):
    """`folder` beside `folder.toml` is the folder, and `./freshness` is no study that ships."""
    cosim("init", "--study", "ages.toml", cwd=tmp_path)
    (tmp_path / "ages").mkdir()
    assert_refused(cosim("sweep", str(tmp_path / "ages"), "--dry-run", cwd=tmp_path), "is no regular file")
    assert_refused(cosim("sweep", str(tmp_path / "freshness"), "--dry-run", cwd=tmp_path), "no such study")
