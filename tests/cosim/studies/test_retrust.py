"""Further trust variants for a run: tables as if they had been in its config."""

from pathlib import Path

import pytest

from results.archive import open_run
from results.verify import verify
from tests.cosim.studies.runs import assert_same, drive
from tests.drive import cosim
from tests.hostile.shared import reseal, with_config

VARIANTS = """
[[trust_variant]]
name = "short"
freshness_s = 7
server_period_s = 2
[[trust_variant]]
name = "own"
host = "local"
fused = true
[[trust_variant]]
name = "beta"
model = "beta"
"""


def retrust(run: Path, file: Path, out: Path):
    return cosim("retrust", str(run), "--variants", str(file), "--out", str(out))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("retrust") / "run", "record.block_steps=10", "trust_variant=[]")


@pytest.fixture
def variants(tmp_path):
    (tmp_path / "variants.toml").write_text(VARIANTS)
    return tmp_path / "variants.toml"


def test_as_if_they_had_been_in_the_run(run, variants, tmp_path):
    """Fused objects and the outcomes of attacks included."""
    words = [
        "trust_variant.0.name=short", "trust_variant.0.freshness_s=7", "trust_variant.0.server_period_s=2",
        "trust_variant.1.name=own", "trust_variant.1.host=local", "trust_variant.1.fused=true",
        "trust_variant.2.name=beta", "trust_variant.2.model=beta",
    ]  # fmt: skip
    with_variants = drive(tmp_path / "live", "record.block_steps=10", *words)
    ended = retrust(run.path, variants, tmp_path / "again")
    assert ended.returncode == 0, ended.stderr
    again = open_run(tmp_path / "again")
    assert again.variants == ("base", "short", "own", "beta")
    for name in again.variants:
        assert_same(with_variants.as_variant(name), again.as_variant(name))
    assert_same(run, again.as_variant("base"), but=("encounter_trust",))
    assert verify(again.path)[1] == []
    assert set(again.fused.variant) == set(again.attack_outcomes.variant) == {"base", "own"}


@pytest.mark.verify
def test_a_repetition_that_differs_is_said_and_kept(run, variants, tmp_path):
    """As if another version of cosim had written the run: here with another seed, under the first one's name."""
    other = drive(tmp_path / "other", "record.block_steps=10", "trust_variant=[]", "seed=5")
    with_config(other.path, other.config | {"seed": run.config["seed"]})
    reseal(other.path, seed=run.config["seed"])
    ended = retrust(other.path, variants, tmp_path / "again")
    assert ended.returncode == 1 and "differs from that of" in ended.stderr and ended.stderr.count("\n") == 1
    assert verify(tmp_path / "again")[1] == []


def test_what_cannot_be_had_is_said(run, variants, tmp_path):
    variants.write_text("seed = 3\n" + VARIANTS)
    ended = retrust(run.path, variants, tmp_path / "again")
    assert ended.returncode == 2 and "[[trust_variant]] are wanted" in ended.stderr
    assert not (tmp_path / "again").exists()
