"""Presets: what they set, what comes before them, and what is said of a name that is none."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from cosim.config import preset
from cosim.config.config import Config, load, of_run, resolve_data
from cosim.config.data import read_toml
from cosim.studies import study
from tests.drive import assert_refused, cosim

GOLDEN = Path(__file__).parents[2] / "golden"


def config(**data):
    return resolve_data({"attacks": [], "encounters": [{}]} | data, "a test", None)


def recorded(config):
    """The config as a manifest has it."""
    return json.loads(json.dumps(config.to_dict()))


def test_a_retired_preset_keeps_its_keys_and_is_named_nowhere(monkeypatch):
    """Keys as the last state without presets resolved them. Keys that are newer are not in the file, and those of
    tracks have no effect there.

    The length of a run and the beginning of attacks belong to no preset.
    """
    before = json.loads((GOLDEN / "preset_v0.2.json").read_text()) | {"traffic.duration_s": 120.0}
    before["attacks"] = [attack | {"start_s": 30.0} for attack in before["attacks"]]
    now = flat(recorded(load(None, ["preset=v0.2"])))
    before = {key: value for key, value in before.items() if not key.startswith("tracking.") or key == "tracking.model"}
    assert {key: now.get(key) for key in before} == before
    assert "v0.2" not in preset.names()
    monkeypatch.setattr(preset, "DEFAULT", "modern")
    assert preset.farewell("v0.2")[0].startswith('note: preset = "v0.2" is the world of an earlier version')


def test_a_file_that_names_no_preset_is_modern(tmp_path):
    """In a process of its own: the tests' own default is another one."""
    (tmp_path / "mine.toml").write_text("seed = 1\n")
    done = subprocess.run(
        [sys.executable, "-m", "cosim", "check", "mine.toml", "--all"],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    said = tomllib.loads(done.stdout)
    assert (said["preset"], said["lidar"]["profile"], said["detector"]["model"]) == ("modern", "pandar64", "pv_rcnn")


@pytest.mark.parametrize("name", preset.names())
def test_a_presets_keys_hold_unless_the_config_sets_them(name):
    """Every key of the file is in the config; and a key of the user's own comes first."""
    found, told = config(preset=name).to_dict(), read_toml(preset._FOLDER / f"{name}.toml", "preset")
    for key, value in flat(told).items():
        assert flat(found)[key] == value, key
    own = config(preset=name, lidar={"profile": "vlp16"}, trust={"unseen": "skip"}, sensing_interval_s=2.0)
    assert (own.preset, own.lidar.profile, own.trust.unseen, own.sensing_interval_s) == (name, "vlp16", "skip", 2.0)


def flat(data, prefix=""):
    pairs = {}
    for key, value in data.items():
        value = list(value) if isinstance(value, tuple) else value
        pairs |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return pairs


def test_resolving_a_resolved_config_changes_nothing():
    once = config(preset="modern")
    assert resolve_data(recorded(once), "a test", None) == once


def test_a_run_of_an_earlier_version_has_no_preset_and_is_refused():
    manifest = recorded(Config())
    assert of_run(manifest, Path("runs/new")) == Config()
    del manifest["preset"]
    with pytest.raises(ValueError, match=r"runs/old/manifest\.json names no preset: an earlier cosim wrote the run"):
        of_run(manifest, Path("runs/old"))


def test_the_step_of_the_users_own_scenario_is_kept_if_it_is_shorter(tmp_path):
    for step, wanted in ((0.1, 0.1), (1.0, 0.2)):
        file = tmp_path / f"of_{step}.sumocfg"
        file.write_text(f'<configuration><time><step-length value="{step}"/></time></configuration>')
        assert config(preset="modern", traffic={"scenario": str(file)}).traffic.step_s == wanted
    assert config(preset="modern", traffic={"step_s": 0.5}).traffic.step_s == 0.5


def test_a_study_can_sweep_presets(tmp_path):
    file = tmp_path / "worlds.toml"
    file.write_text('[study]\nname = "worlds"\n[grid]\npreset = ["v0.2", "modern"]\n')
    found = study.load(file)
    phases = [study.config_at(found, keys, 0, "a test").sensing_phase for keys in found.combinations()]
    assert phases == ["common", "random"]


@pytest.mark.parametrize(
    "words", [("run", "--preset", "moder"), ("check", "--set", "preset=moder"), ("check", "--set", "preset=7")]
)
def test_a_name_that_is_none(words):
    done = cosim(*words)
    assert_refused(done, "preset")
    assert "modern" in done.stderr
