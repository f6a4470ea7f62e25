"""Trust on the evidence of a run on disk: tables as if the variants had been in the run."""

from pathlib import Path

import pytest

from cosim.config.config import resolve_data
from cosim.studies.retrust import not_computed, retrust
from results.archive import open_run
from results.verify import verify
from tests.cosim.studies.runs import assert_same, drive

VARIANTS = """
[[trust_variant]]
name = "short"
freshness_s = 7
server_period_s = 2
[[trust_variant]]
name = "own"
host = "local"
[[trust_variant]]
name = "beta"
model = "beta"
"""


@pytest.mark.parametrize("how", ["alone", pytest.param("piggybacked", marks=pytest.mark.verify)])
def test_as_if_they_had_been_in_the_run(tmp_path, how):
    common = ("record.level=full", f"radio.evaluations={how}", "record.block_steps=10")
    run = drive(tmp_path / "run", *common, "trust_variant=[]")
    (tmp_path / "variants.toml").write_text(VARIANTS)
    words = [
        "trust_variant.0.name=short", "trust_variant.0.freshness_s=7", "trust_variant.0.server_period_s=2",
        "trust_variant.1.name=own", "trust_variant.1.host=local",
        "trust_variant.2.name=beta", "trust_variant.2.model=beta",
    ]  # fmt: skip
    with_variants = drive(tmp_path / "live", *common, *words)
    again = open_run(retrust(run.path, tmp_path / "variants.toml", tmp_path / "again"))
    assert again.variants == ("base", "short", "own", "beta")
    for name in again.variants:
        assert_same(with_variants.as_variant(name), again.as_variant(name))
    assert verify(again.path)[1] == []
    said = again.manifest["summary"]["retrust"]
    assert said.startswith("No fused objects and no attack success for short, own, beta: ") and "\n" not in said
    assert set(again.fused.variant) == set(again.attack_outcomes.variant) == {"base"}, "as the line says"
    (tmp_path / "one.toml").write_text(VARIANTS[: VARIANTS.index("[[trust_variant]]", 5)])
    (tmp_path / "rest.toml").write_text(VARIANTS[VARIANTS.index("[[trust_variant]]", 5) :])
    first = retrust(run.path, tmp_path / "one.toml", tmp_path / "first")
    then = open_run(retrust(first, tmp_path / "rest.toml", tmp_path / "then"))
    for name in again.variants:
        assert_same(again.as_variant(name), then.as_variant(name))


def test_the_line_on_what_is_not_computed():
    """It names the variants that lack fused objects, and those alone."""
    rows = [{"name": "a", "model": "beta"}, {"name": "b", "fused": True}, {"name": "c", "freshness_s": 7}]
    said = not_computed(resolve_data({"trust_variant": rows}, "a test", Path()))
    assert "for a, c: fused objects need" in said and said.endswith("fused = true.")


def test_what_cannot_be_had_is_said(tmp_path):
    run = drive(tmp_path / "run")
    (tmp_path / "variants.toml").write_text(VARIANTS)
    with pytest.raises(ValueError, match=r"record\.level"):
        retrust(run.path, tmp_path / "variants.toml", tmp_path / "again")
    assert not (tmp_path / "again").exists()
