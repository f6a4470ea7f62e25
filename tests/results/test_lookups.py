"""Lookups added up in one pass over all trust variants, against groups of the table that pandas makes."""

import numpy as np
import pandas as pd
import pytest

import results.run
from results import part_encoder
from results.archive import open_run
from results.codes import LookupState, labels
from results.manifest import finish
from results.metrics import lookups
from results.metrics.lookups import AGES, EDGES_S, RENEWED
from results.metrics.trust import watched
from results.recorder import Recorder
from tests.results.tiny import columns, fleet

VARIANTS = ("base", "other")
STEPS, VEHICLES = 24, 60
ROLES = ["honest"] * 50 + ["malicious"] * 10


@pytest.fixture(scope="module", params=[(120_000, 1_000_000), (5_000, 5_000)], ids=["blocks", "pieces of blocks"])
def run(request, tmp_path_factory):
    """Two variants, 3,540 pairs, three blocks; ages of up to 400 s, a quarter of them null.

    The blocks are read at once, or in four pieces each.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part_encoder, "_GROUP_ROWS", request.param[0])
        patch.setattr(results.run, "_PIECE_ROWS", request.param[1])
        yield made(tmp_path_factory)


def made(tmp_path_factory):
    """The run on disk, opened."""
    folder, rng = tmp_path_factory.mktemp("lookups"), np.random.default_rng(5)
    receiver, subject = (side.ravel() for side in np.meshgrid(*2 * [np.arange(VEHICLES)]))
    receiver, subject = receiver[receiver != subject], subject[receiver != subject]
    vehicles = fleet(*ROLES)
    for vehicle in vehicles[50:]:
        vehicle["attack_start_step"] = vehicle["vehicle"] - 45
    used = [{"pseudonym": v, "vehicle": v, "to_step": 99} for v in range(VEHICLES)]
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
        "trust": {}, "trust_variant": [{"name": "other"}],
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
    n_pieces = len(list(run.pieces("trust_lookups", ["step"])))
    assert n_pieces in (3, 10)
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
            edges_s = np.r_[EDGES_S[:-1], np.inf]  # np.histogram takes the last edge into the last bin
            assert (found.histogram[code, k] == np.histogram(aged.age_s[aged.role == code], edges_s)[0]).all()
    some = rows[rows.newest_evaluation_age_s.notna()]
    for k, column in enumerate(lookups.BEHIND):
        counted = some[some[column].notna()].groupby("receiver")[column]
        assert (found.behind[:, k] == table(counted.size(), VEHICLES)).all()
        assert (found.behind_sum[:, k] == table(counted.sum().astype(float), VEHICLES)).all()


def test_peaks(variant):
    run, rows = variant
    found = lookups.sums(run)
    rows = rows.assign(block=rows.step // 10).sort_values("step", kind="stable")
    for k, what in enumerate(RENEWED):
        age_s = rows[AGES[what]].astype(float)
        before_s = age_s.groupby([rows.block, rows.receiver, rows.subject]).shift()
        peaks = before_s[age_s < before_s].groupby(rows.receiver)
        assert found.renewed[:, k].sum() > 1000
        assert (found.renewed[:, k] == table(peaks.size(), VEHICLES)).all()
        assert (found.peak_sum_s[:, k] == table(peaks.sum(), VEHICLES)).all()


def test_lows(variant):
    """The first low value of a subject, while it is watched, is one of them, whatever the threshold."""
    run, rows = variant
    lows, since = lookups.lows(run), watched(run).since
    rows = rows[(rows.n_evaluations > 0) & (rows.step >= rows.subject.map(since))]
    for threshold in (0.01, 0.1, 0.5):
        low = lows.trust < threshold
        found = pd.Series(lows.step[low]).groupby(lows.subject[low]).min()
        assert found.to_dict() == rows[rows.trust < threshold].groupby("subject").step.min().to_dict()
        assert len(found)
