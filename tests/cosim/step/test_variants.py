"""Trust variants: any number of models, windows and hosts on the same evidence, as if each had had a run of its own."""

import json

import pandas as pd
import pytest

from results.archive import open_run
from tests.drive import assert_refused, cosim, drive
from tests.processes import set_words
from tests.slow import slow

VARIANTS = {
    "short": {"freshness_s": 5.0},
    "never": {"freshness_s": "off"},
    "frequent": {"server_period_s": 1.0, "default_trust": 0.3},
    "skip": {"unseen": "skip", "freshness_s": 12.0},
    "beta": {"model": "beta"},
    "local": {"host": "local"},
    "local short": {"host": "local", "freshness_s": 5.0},
    "own": {"host": "local", "local_evidence": "own"},
    "none": {"host": "none"},
    "averaging": {"method": "averaging"},
}
RARE = ("beta", "local", "never", "frequent", "skip", "local short", "none", "own", "averaging")
"""Those that differ from another one by a parameter or a model, or that compute nothing.

`tests/cosim/studies/test_sweep.py` has local trust beside a plain run.
"""
FUSED = ("short", "local", "averaging")
TABLES = ("trust", "trust_lookups", "fused")
SHORT = ("record.level=full", "traffic.duration_s=14")


def settings(changes, prefix):
    return [f"{prefix}.{key}={json.dumps(value)}" for key, value in changes.items()]


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    """One run that carries all variants."""
    overrides = []
    for number, (name, changes) in enumerate(VARIANTS.items()):
        overrides += settings({"name": name, "fused": name in FUSED} | changes, f"trust_variant.{number}")
    return open_run(drive(tmp_path_factory.mktemp("variants") / "run", *SHORT, *overrides))


def of(run, table, name):
    frame = run.table(table)
    return frame[frame.variant == name].drop(columns="variant").reset_index(drop=True)


@pytest.mark.parametrize("name", [slow(name) if name in RARE else name for name in VARIANTS])
def test_a_variant_equals_a_run_of_its_own(together, tmp_path, name):
    alone = open_run(drive(tmp_path / "run", *SHORT, *settings(VARIANTS[name], "trust")))
    compared = 0
    for table in TABLES if name in FUSED else TABLES[:2]:
        mine, own = of(together, table, name), of(alone, table, "base")
        pd.testing.assert_frame_equal(mine, own, check_exact=True)
        compared += len(own)
    assert compared > 500
    if name not in FUSED:
        assert not len(of(together, "fused", name))


@pytest.mark.verify
def test_the_acting_one_does_not_notice(together, tmp_path):
    """`tests/cosim/studies/test_sweep.py` says so of other settings."""
    alone = open_run(drive(tmp_path / "run", *SHORT))
    for table in together.tables:
        mine, own = together.table(table), alone.table(table)
        if "variant" in mine:
            mine, own = of(together, table, "base"), of(alone, table, "base")
        pd.testing.assert_frame_equal(mine, own, check_exact=True)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["trust_variant.0.name=a", "trust_variant.0.tau=0.3"], "tau changes the evaluations"),
        (["trust_variant.0.name=a", "trust_variant.0.method=trupercept_1"], "eta changes the evaluations"),
        (["trust_variant.0.name=base"], "is taken"),
        (["trust_variant.0.name=a", "trust_variant.1.name=a"], "is taken"),
        (["trust_variant.0.freshness_s=3.0"], "must have a name"),
        (["trust_variant.0.name=a", "trust_variant.0.freshnes_s=3.0"], "Did you mean"),
        (["trust_variant.0.name=a", "trust_variant.0.freshness_s=-3.0"], "freshness_s"),
        (["trust_variant.0.name=a", "trust_variant.0.decay_per_s=0.5"], "decay_per_s"),
        (["trust_variant.0.name=a", "trust_variant.0.fused=maybe"], "true or false"),
        (
            ["trust_variant.0.name=a", "trust_variant.0.freshness_s=3.0", "server.uplink=rsu", "rsu.n_at_junctions=1"],
            "loads the channel",
        ),
    ],
)
def test_mistakes_are_one_line(overrides, told):
    done = cosim("check", *set_words(overrides))
    assert_refused(done, told)
