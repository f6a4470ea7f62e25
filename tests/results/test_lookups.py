"""Lookups added up in one pass over all trust variants, against groups of the table that pandas makes."""

import numpy as np
import pandas as pd
import pytest

from cosim.base.codes import LookupState, labels
from results import part_encoder
from results.archive import open_run
from results.manifest import finish
from results.metrics import freshness, intervals, lookups, misbehaviour, survival
from results.metrics.lookups import AGES, RENEWED
from results.metrics.trust import watched
from results.recorder import Recorder
from tests.results.tiny import columns, fleet

VARIANTS = ("base", "other")
STEPS, VEHICLES = 24, 60
WINDOW_S = {"base": 50.0, "other": "off"}
ROLES = ["honest"] * 50 + ["malicious"] * 10


@pytest.fixture(scope="module", params=[(120_000, 1_000_000), (5_000, 5_000)], ids=["blocks", "pieces of blocks"])
def run(request, tmp_path_factory):
    """Two variants, 3,540 pairs, three blocks; ages of up to 400 s, a quarter of them null.

    The blocks are read at once, or in several pieces each.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part_encoder, "_GROUP_ROWS", request.param[0])
        patch.setattr(lookups, "_PIECE_ROWS", request.param[1])
        yield made(tmp_path_factory)


def made(tmp_path_factory):
    """The run on disk, opened."""
    folder, rng = tmp_path_factory.mktemp("lookups"), np.random.default_rng(5)
    receiver, subject = (side.ravel() for side in np.meshgrid(*2 * [np.arange(VEHICLES)]))
    receiver, subject = receiver[receiver != subject], subject[receiver != subject]
    vehicles = fleet(*ROLES, last_step=STEPS - 1)
    for vehicle in vehicles[50:]:
        vehicle["attack_start_step"] = vehicle["vehicle"] - 45
    used = [{"pseudonym": v, "vehicle": v, "to_step": STEPS - 1} for v in range(VEHICLES)]
    with Recorder(folder, "full", block_steps=10, variants=VARIANTS) as record:
        for step in range(STEPS):
            heard = rng.random(len(receiver)) < 0.3
            n = 2 * int(heard.sum())
            given = {
                "variant": np.repeat([0, 1], n // 2), "subject": np.tile(subject[heard], 2),
                "receiver": np.tile(receiver[heard], 2), "trust": rng.random(n), "source": np.zeros(n, int),
                "state": rng.integers(len(LookupState), size=n), "n_evaluations": rng.integers(3, size=n),
                "n_evaluators": rng.integers(3, size=n), "n_evaluators__valid": rng.random(n) < 0.5,
            }  # fmt: skip
            for column in AGES.values():
                given |= {
                    column: rng.random(n) * 10.0 ** rng.integers(3, size=n) * 4,
                    f"{column}__valid": rng.random(n) < 0.75,
                }
            record.append("trust_lookups", step, given)
        for name, rows in (("vehicles", vehicles), ("pseudonyms", used)):
            record.append(name, step, columns(name, rows))
    finish(folder, {"dt_s": 1.0, "steps": STEPS, "variants": VARIANTS, "config": {
        "trust": {"freshness_s": WINDOW_S["base"], "suspect_from": 2},
        "trust_variant": [{"name": "other", "freshness_s": WINDOW_S["other"]}],
    }})  # fmt: skip
    return open_run(folder)


@pytest.fixture(params=VARIANTS)
def variant(run, request):
    """One variant and its rows, with codes in place of labels."""
    rows = run.trust_lookups.query("variant == @request.param").reset_index(drop=True)
    role = pd.Series([run.role_labels.index(role) for role in ROLES])
    return run.as_variant(request.param), rows.assign(role=rows.subject.map(role), state=rows.state.cat.codes)


def table(groups, shape):
    """Numbers by group as an array."""
    found = np.zeros(shape)
    found[tuple(groups.index.get_level_values(k) for k in range(groups.index.nlevels))] = groups
    return found


def test_sums(variant):
    run, rows = variant
    n_pieces = len(list(run.pieces("trust_lookups", ["step"], lookups._PIECE_ROWS)))
    assert n_pieces in (3, 12)
    found, n_roles = lookups.sums(run), len(run.role_labels)
    by_receiver = ["receiver", "role"]
    sizes = (VEHICLES, n_roles)
    assert (
        found.states == table(rows.groupby([*by_receiver, "state"]).size(), (*sizes, len(labels(LookupState))))
    ).all()
    for limit_s in (10.0, 3.3):
        fresh = rows[rows.newest_evaluation_age_s.astype(float) <= np.float32(limit_s)]
        assert (lookups.sums(run, limit_s).fresh == table(fresh.groupby(by_receiver).size(), sizes)).all()
    for k, column in enumerate(AGES.values()):
        aged = rows.assign(age_s=rows[column].astype(float)).dropna(subset="age_s")
        groups = aged.groupby(by_receiver).age_s
        assert (found.aged[..., k] == table(groups.size(), sizes)).all()
        assert (found.age_sum_s[..., k] == table(groups.sum(), sizes)).all()
        for code in range(n_roles):
            ages_s, n = np.unique(aged.age_s[aged.role == code], return_counts=True)
            there = found.age_counts[code, k] > 0
            assert (lookups.ages_s(run)[there] == ages_s).all() and (found.age_counts[code, k][there] == n).all()
    some = rows[rows.newest_evaluation_age_s.notna()]
    for k, column in enumerate(lookups.BEHIND):
        counted = some[some[column].notna()].groupby("receiver")[column]
        assert (found.behind[:, k] == table(counted.size(), VEHICLES)).all()
        assert (found.behind_sum[:, k] == table(counted.sum().astype(float), VEHICLES)).all()


def test_ages_at_use_are_exact(variant):
    """Medians and 90th percentiles are NumPy's of the single ages, to the bit."""
    run, rows = variant
    found = freshness.ages(run).set_index(["what", "role"])
    for what, column in AGES.items():
        for role in ("all", "honest", "malicious"):
            of = rows if role == "all" else rows[rows.role == run.role_labels.index(role)]
            age_s = of[column].dropna().astype(float)
            mine = found.loc[(what, role)]
            assert (mine.median_s, mine.p90_s) == (np.quantile(age_s, 0.5), np.quantile(age_s, 0.9))


def test_capped_ages_count_every_lookup(variant):
    """A lookup without an evaluation counts as the window; without a window, as the recorded time."""
    run, rows = variant
    cap_s = STEPS if WINDOW_S[run.variant] == "off" else WINDOW_S[run.variant]
    found = freshness.capped_ages(run).set_index("role")
    for role in ("all", "honest", "malicious"):
        of = rows if role == "all" else rows[rows.role == run.role_labels.index(role)]
        age_s = of.newest_evaluation_age_s.astype(float).fillna(np.inf).clip(upper=cap_s)
        mine = found.loc[role]
        assert (mine.n, mine.median_s, mine.p90_s) == (len(of), np.quantile(age_s, 0.5), np.quantile(age_s, 0.9))
        assert mine.mean_s == pytest.approx(age_s.mean())


def test_peaks_and_ages_over_time(variant):
    """Renewals by what is renewed, across blocks, and the sawtooth between lookups, against pandas."""
    run, rows = variant
    found = lookups.sums(run)
    rows = rows.sort_values("step", kind="stable")
    for k, what in enumerate(RENEWED):
        age_s = rows[AGES[what]].astype(float)
        pairs = rows.assign(age_s=age_s).groupby(["receiver", "subject"])
        before_s, passed_s = pairs.age_s.shift(), pairs.step.diff()
        both = before_s.notna() & age_s.notna()
        newer = both & (rows.step - age_s > rows.step - passed_s - before_s + 0.5)
        near = before_s.notna() & (passed_s <= lookups.REACH_S)
        of = rows.receiver
        assert found.renewed[:, k].sum() > 1000
        assert (found.renewed[:, k] == table(newer.groupby(of).sum(), VEHICLES)).all()
        np.testing.assert_allclose(found.peak_sum_s[:, k], table(before_s[newer].groupby(of).sum(), VEHICLES))
        np.testing.assert_allclose(found.observed_s[:, k], table(passed_s[near].groupby(of).sum(), VEHICLES))
        area = (before_s + passed_s / 2) * passed_s
        np.testing.assert_allclose(found.area_s2[:, k], table(area[near].groupby(of).sum(), VEHICLES))
        peaks = (before_s + passed_s)[newer & near]
        assert (found.sawtooth_peaks[:, k] == table(peaks.groupby(of).size(), VEHICLES)).all()
        np.testing.assert_allclose(found.sawtooth_peak_sum_s[:, k], table(peaks.groupby(of).sum(), VEHICLES))


@pytest.mark.parametrize("most", [1 << 21, 1000])
def test_classification_at_lookup(variant, most, monkeypatch):
    """Shares, area and times per receiver against pandas; with too many values the area stays within its bound."""
    run, rows = variant
    monkeypatch.setattr(lookups, "_MOST_SCORES", most)
    run = open_run(run.path).as_variant(run.variant)
    rows = rows[rows.step >= rows.subject.map(watched(run).since)]
    low = rows[(rows.n_evaluations >= 2) & (rows.trust < 0.25)]
    found = misbehaviour.at_lookup(run).set_index("role")
    receivers = misbehaviour.detection_per_receiver(run).set_index("role")
    rated = rows[rows.n_evaluations > 0].astype({"trust": float})
    honest, attacking = (rated[rated.role == run.role_labels.index(role)] for role in ("honest", "malicious"))
    area = intervals.auc(*(of[name].to_numpy() for of in (honest, attacking) for name in ("trust", "subject")))
    off_by = found.auc_error["malicious"]
    assert (off_by == 0) == (most > 1000) and off_by < 2e-4
    assert found.auc["malicious"] == pytest.approx(area.value, abs=off_by + 1e-12)
    assert found.auc_low["malicious"] == pytest.approx(area.low, abs=1e-3 if off_by else 1e-12)
    for role in ("honest", "malicious"):
        mine = rows[rows.role == run.role_labels.index(role)]
        assert found.n[role] == len(mine)
        assert found.suspected[role] == pytest.approx(mine.index.isin(low.index).mean())
        pairs = mine.groupby(["receiver", "subject"]).step.agg(["min", "max"])
        first = low.groupby(["receiver", "subject"]).step.min().reindex(pairs.index)
        assert receivers.n[role] == len(pairs)
        assert receivers.share[role] == pytest.approx(first.notna().mean())
        waited = (first.fillna(pairs["max"]) - pairs["min"]).to_numpy(float)
        curve = survival.kaplan_meier(waited, first.notna().to_numpy())
        assert receivers.median_s[role] == pytest.approx(survival.median(curve), nan_ok=True)


def test_renewals_where_all_ages_are_equal(tiny):
    """A server that computes every second: each of 30 lookups, 0.8 s old, is of a new value. 29 renewals at 0.8 s.

    Counted only where the age falls, as it never does here, there would be none.
    """
    one = {"receiver": 0, "subject": 1, "source": "server", "n_evaluations": 1, "newest_evaluation_age_s": 1.8}
    rows = [one | {"step": step, "age_s": 0.8} for step in range(30)]
    run = tiny(30, vehicles=fleet("honest", "honest"), trust_lookups=rows)
    found = freshness.peaks(run).set_index("what")
    assert found.n.to_dict() == {"value": 29, "newest evaluation": 29}
    assert found.mean_s.to_dict() == pytest.approx({"value": 0.8, "newest evaluation": 1.8}, abs=1e-3)
    over_time = freshness.age_over_time(run).set_index("what")
    assert over_time.mean_s["value"] == pytest.approx(1.3, abs=1e-3)  # from 0.8 to 1.8 s in each second
    assert over_time.peak_s["value"] == pytest.approx(1.8, abs=1e-3)


def test_a_vehicle_that_senses_seldom_is_within_reach_for_two_of_its_own_intervals(tiny):
    """Lookups 5 s apart of a value that is 1 s old: the age goes from 1 to 6 s. Who senses each second counts none."""
    one = {"subject": 2, "source": "server", "n_evaluations": 1, "newest_evaluation_age_s": 1.0, "age_s": 1.0}
    rows = [one | {"receiver": receiver, "step": step} for step in range(0, 30, 5) for receiver in (0, 1)]
    vehicles = fleet("honest", "honest", "honest", sensing_interval_steps=1, sensing_phase_steps=0)
    vehicles[0]["sensing_interval_steps"] = 5
    run = tiny(30, vehicles=vehicles, trust_lookups=rows)
    assert lookups.sums(run).observed_s[:, 0].tolist() == [25.0, 0.0]
    over_time = freshness.age_over_time(run).set_index("what")
    assert over_time.mean_s["value"] == pytest.approx(3.5, abs=1e-3)


def test_first_lows(variant):
    """The first low value of each subject while it is watched, whatever the threshold."""
    run, rows = variant
    rows = rows[(rows.n_evaluations >= 2) & (rows.step >= rows.subject.map(watched(run).since))]
    for threshold in (0.01, 0.1, 0.5):
        step, subject = lookups.first_lows(run, threshold)
        first = rows[rows.trust < threshold].groupby("subject").step.min()
        assert dict(zip(subject.tolist(), step.tolist(), strict=True)) == first.to_dict() and len(first)
