"""The core runs without add-ons, and nothing else misses a hidden one."""

import shutil
from pathlib import Path

import pytest

from cosim.base.addons import Choices, addons, hook, loaded
from tests.drive import assert_refused, in_turn
from tests.processes import set_words

ROOT = Path(__file__).parents[1]
PACKAGES = ("cosim", "sensors", "trust", "results", "sumo_nets")
ADDONS = sorted(addons())
SHORT = ("traffic.duration_s=3", "traffic.warmup_s=60", "trust.server_period_s=1")
SETS = set_words(SHORT)


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A copy of the packages from which all add-ons are deleted. Compiled kernels come along."""
    folder = tmp_path_factory.mktemp("bare")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, folder / name)
    for name in ADDONS:
        shutil.rmtree(folder / "cosim" / "addons" / name)
    return folder


def carry_out(packages, *commands):
    """Carry out commands of the packages in a folder, in that folder."""
    commands = [[str(word) for word in words] for words in commands]
    return in_turn(*commands, cwd=packages, PYTHONPATH=str(packages))


def test_every_address_of_every_addon_leads_to_code():
    for name, addon in addons().items():
        addresses = [
            *addon.commands.values(),
            *addon.hooks.values(),
            *(at for of in addon.choices.values() for at in of.values()),
        ]
        assert addresses, f"{name} adds nothing"
        assert all(at.startswith(f"cosim.addons.{name}.") for at in addresses)
        assert all(loaded(at) is not None for at in addresses)


def test_the_cores_own_choices_come_first():
    found = Choices("trust", {"mine": int})
    assert next(iter(found)) == "mine"
    assert found["mine"] is int
    assert "mate" in found and len(found) > 10


def test_a_missing_hook_is_said_in_one_line():
    with pytest.raises(ValueError, match="cosim fly needs an add-on"):
        hook("fly", "cosim fly")


@pytest.mark.verify
def test_without_addons_the_core_runs_measures_draws_and_reports(bare, tmp_path):
    run, study = tmp_path / "run", tmp_path / "study.toml"
    study.write_text(
        '[study]\nname = "tiny"\n[base]\ntraffic.duration_s = 3\ntraffic.warmup_s = 60\ntrust.server_period_s = 1\n'
        '[grid]\n"trust.freshness_s" = [5.0, 10.0]\n'
    )
    commands = (
        ("run", *SETS, "--out", run),
        ("measure", run),
        ("plot", "trust", run),
        ("report", run),
        ("verify", run),
        ("nets", "list"),
        ("sweep", study, "--out", tmp_path / "out"),
        ("measure", tmp_path / "out"),
    )
    for done in carry_out(bare, *commands):
        assert done.returncode == 0, f"{done.args}: {done.stderr}"
    assert (run / "report.html").is_file() and (run / "trust.png").is_file()


def test_what_a_deleted_addon_would_bring_is_refused_in_one_line(bare):
    refused = {
        ("run", "--set", "trust.model=mate"): "mate",
        ("run", "--set", "radio.model=nr_mode2"): "nr_mode2",
        ("run", "--set", "driver.model=cautious"): "cautious",
        ("run", "--watch"): "needs an add-on",
        ("plot", "durations", "nowhere"): "durations",
        ("export", "kitti", "nowhere", "--out", "x"): "export",
    }
    for done, said in zip(carry_out(bare, *refused), refused.values(), strict=True):
        assert_refused(done, said)


@pytest.mark.verify
@pytest.mark.parametrize("name", ADDONS)
def test_each_deleted_in_turn(name, tmp_path):
    """The others still bring their commands, and a run is as before."""
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package)
    shutil.rmtree(tmp_path / "cosim" / "addons" / name)
    for done in carry_out(tmp_path, ["--help"], ["run", *SETS, "--out", tmp_path / "run"]):
        assert done.returncode == 0, done.stderr
