"""A driven run's freshness and attack success, against `tests.results.recompute`, row for row."""

import numpy as np
import pytest

from cosim.addons.attacks import effects as attack
from results.archive import open_run
from results.metrics import freshness
from tests.drive import drive
from tests.results import recompute
from tests.verification import recompute_metrics

LINKS = ("delay_min_s", "delay_mean_s", "uplink_loss_p", "downlink_loss_p")
VARIANTS = {
    "base": ("central", 4.0, 5.0), "long": ("central", 60.0, 2.0), "local": ("local", 4.0, 0.0),
}  # fmt: skip
"""Host, window and server period of each trust variant [s]."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return open_run(drive(tmp_path_factory.mktemp("run") / "full", *_changes("full")))


def _changes(level):
    changes = [f"server.cellular.{name}=0.0" for name in LINKS]
    changes += [f"record.level={level}", "trust.freshness_s=4.0", "traffic.duration_s=14"]
    for i, name in enumerate(list(VARIANTS)[1:]):
        host, window_s, period_s = VARIANTS[name]
        keys = {"name": f'"{name}"', "host": f'"{host}"', "freshness_s": window_s, "fused": "true"}
        keys |= {"server_period_s": period_s} if period_s else {}
        changes += [f"trust_variant.{i}.{key}={value}" for key, value in keys.items()]
    return changes


@pytest.mark.verify
def test_totals_of_lookups_say_the_same_as_single_ones(run, tmp_path):
    """A run at level `summary`, which keeps no single lookups, has the same shares of states and mean ages."""
    brief = open_run(drive(tmp_path / "brief", *_changes("summary")))
    assert "trust_lookups" in run.tables and "trust_lookups" not in brief.tables
    for name in VARIANTS:
        of_all = freshness.states(run.as_variant(name)).query("role == 'all'").set_index("state")
        assert freshness.states(brief.as_variant(name)).set_index("state").n.to_dict() == of_all.n.to_dict()
        ages = freshness.ages(run.as_variant(name)).query("role == 'all'").set_index("what")
        totals = freshness.ages(brief.as_variant(name)).set_index("what")
        assert totals.n.to_dict() == ages.n.to_dict()
        np.testing.assert_allclose(totals.mean_s, ages.mean_s, rtol=1e-3)


@pytest.mark.parametrize("name", VARIANTS)
def test_every_state_and_age_at_use(run, name):
    host, window_s, period_s = VARIANTS[name]
    expected = recompute.central(run, window_s, period_s) if host == "central" else recompute.local(run, window_s)
    have = run.as_variant(name).variant_table("trust_lookups")
    both = have.merge(expected, "outer", ["step", "receiver", "subject"], suffixes=("", "_expected"), indicator=True)
    assert (both._merge == "both").all() and len(both) > 1000
    assert (both.state.astype(str) == both.state_expected).all()
    for column, other in (("newest_evaluation_age_s", "newest_s"), ("oldest_evaluation_age_s", "oldest_s")):
        np.testing.assert_allclose(both[column].astype(float), both[other], atol=1e-3)
    known = both.n.notna()
    assert (both.n_evaluations[known] == both.n[known]).all() and not both.n_evaluations[~known].any()
    assert (both.n_evaluators[known].astype(float) == both.evaluators[known]).all()
    if host == "central":
        np.testing.assert_allclose(both.age_s[known].astype(float), both.value_s[known], atol=1e-3)
    else:
        assert (both.age_s.dropna() == 0).all()
    shares = freshness.states(run.as_variant(name)).query("role == 'all'").set_index("state").share
    for state, share in expected.state.value_counts(normalize=True).items():
        assert shares[recompute_metrics.STATE[state]] == pytest.approx(share)


@pytest.mark.parametrize("name", VARIANTS)
def test_attack_success(run, name):
    """The same pairs, and the same rates among honest vehicles, for the intended victim, and of any."""
    mine = run.as_variant(name)
    expected = recompute.attacks(mine)
    have = mine.variant_table("attack_outcomes").query("effect == 'inserted'")
    key = ["step", "observer", "detection_index", "receiver"]
    both = have.merge(expected[[*key, "score", "target"]], "outer", key, suffixes=("", "_expected"), indicator=True)
    assert (both._merge == "both").all() and len(both) > 100
    assert (both.intended == (both.target == both.receiver).fillna(False)).all()
    np.testing.assert_allclose(both.score.astype(float), both.score_expected.astype(float), atol=1e-3)
    role = run.vehicles.set_index("vehicle").role.astype(str)
    expected = expected[expected.receiver.map(role) == "honest"]
    expected = expected.assign(role=expected.observer.map(role), aimed=expected.target == expected.receiver)
    found = attack.success(mine, (0.1, 0.5)).query("effect == 'inserted' and receivers == 'honest'")
    assert len(found)
    for row in found.itertuples():
        pairs = expected[(expected.role == row.role) & (expected.aimed.fillna(False) | (row.among == "received"))]
        assert row.n == len(pairs)
        assert row.share == pytest.approx((pairs.score >= row.threshold).mean())
    for row in attack.per_lie(mine, (0.1, 0.5)).itertuples():
        lies = expected[expected.role == row.role].groupby(key[:3]).score.max()
        assert row.n == len(lies) and row.share == pytest.approx((lies >= row.threshold).mean())


def test_every_metric_is_what_its_definition_says(run):
    """All metrics of the acting variant, from the files and the definitions alone."""
    n, found = recompute_metrics.differences(run.path)
    assert n > 250 and not found, found
