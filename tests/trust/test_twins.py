"""Every trust model against its literal transcription, and against figures by hand or published."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.addons.trust_models import opinions
from cosim.addons.trust_models.eigentrust import eigentrust
from cosim.addons.trust_models.majority_ban import MajorityBan, MajorityBanParams
from cosim.addons.trust_models.mate import PRIOR, Mate, MateParams, gained
from cosim.addons.trust_models.minhas import MinhasParams, experienced
from tests.trust.histories import add, build, histories, open_step, play, trust_of
from tests.trust.test_judged_evaluators import JUDGING
from tests.verification import trust_models as literal
from trust.models import MODELS

SETTINGS = {
    "beta": [{}, {"decay_per_s": 0.5}, {"decay_per_s": 1.0}],
    "beta_discounted": [{}, {"decay_per_s": 0.5}],
    "beta_by_kind": [{}, {"evidence": ("detections", "speed")}, {"evidence": ("detections", "missing", "speed")}],
    "beta_correlated": [{}, {"correlation": 0.9, "decay_per_s": 0.5}],
    "subjective_logic": [{}, {"discounting": "opposite"}, {"discounting": "none"}],
    "mate": [{}],
    "minhas": [{}, {"consensus_margin": 0.0, "gain": 0.2}],
    "announcement": [{}, {"validity_s": 2.5}],
    "eigentrust": [{}, {"restart_p": 0.1}],
    "report_count": [{}],
    "majority_ban": [{}, {"ban_strikes": 2, "strike_window_s": 2.0}],
}
"""Parameters by model."""
CASES = [(name, own) for name, cases in SETTINGS.items() for own in cases]
PLAIN = {"denied_share", "mean_score"}
"""Rules of `tests/addons/trust_models/test_plain_rules.py`."""


def test_every_model_has_a_twin():
    scorers = {name for name in MODELS if name.startswith("raya_")}
    assert set(SETTINGS) | set(JUDGING) | scorers | PLAIN | {"trupercept"} == set(MODELS)


@pytest.mark.parametrize(("name", "own"), CASES)
@given(world=histories, grace=st.integers(1, 9))
@settings(max_examples=12)
def test_twin(name, own, world, grace):
    frames, rows = world
    for dt_s in (1.0, 0.5):
        model = build(name, dt_s, grace_s=float(grace), **own)
        (scores,) = play([model], frames, rows, scores_too=True)
        for now, one in enumerate(scores):
            theirs_now = getattr(literal, name)(dict(enumerate(rows[: now + 1])), now, dt_s, **literal.spelled(own))
            mine = dict(zip(one.subject.tolist(), one.trust.tolist(), strict=True))
            if name == "announcement":  # what has expired has no row
                theirs_now = {i: x for i, x in theirs_now.items() if i in mine or x > 0}
            assert mine == pytest.approx(theirs_now, abs=2e-6)


@pytest.mark.parametrize("name", MODELS)
@given(world=histories)
@settings(max_examples=6)
def test_two_half_steps_equal_one(name, world):
    """Steps half as long, every second one empty: a decay that depends on the step is a defect of published code."""
    frames, rows = world
    one, half = build(name, 1.0), build(name, 0.5)
    play([one], frames, rows)
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        open_step(half, 2 * step, frame)
        add(half, 2 * step, evaluated)
        if step < len(rows) - 1:
            open_step(half, 2 * step + 1, {v: [] for v in frame})
    a, b = one.scores(), half.scores()
    assert a.subject.tolist() == b.subject.tolist()
    for column in ("trust", "uncertainty", "weight"):
        np.testing.assert_allclose(getattr(a, column), getattr(b, column), rtol=1e-6, atol=1e-9)


def test_operators_of_subjective_logic():
    x, y = np.array([0.2, 0.8, 0.0]), np.array([0.4, 0.0, 0.6])
    np.testing.assert_allclose(opinions.discounted(np.asarray(opinions.projected(x)), y), [0.08, 0.0, 0.92], atol=1e-12)
    # opposite belief, by hand: b = .2 .4 + .8 0, d = .2 0 + .8 .4, u = 0 + 1 .6
    np.testing.assert_allclose(opinions.discounted_opposite(x, y), [0.08, 0.32, 0.6], atol=1e-12)
    # S = 2: g = 1 - 1.3^-2 = 0.408284
    np.testing.assert_allclose(
        opinions.of_check(np.array(1.5), np.array(0.5)), [0.306213, 0.102071, 0.591716], atol=1e-6
    )


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0.01, 1)), min_size=2, max_size=6))
def test_cumulative_fusion_is_a_sum(parts):
    x = np.array([np.array(p) / sum(p) for p in parts])
    one = x[0]
    for other in x[1:]:
        one = np.array(literal.fuse(one, other))
    np.testing.assert_allclose(opinions.of_evidence(opinions.evidence_of(x).sum(axis=0)), one, atol=1e-9)
    np.testing.assert_allclose(one.sum(), 1)


def test_a_good_vehicle_can_be_trustworthy():
    """Published code compares P with 1, which nothing exceeds; here 1/2 is exceeded by a single good opinion."""
    model = build("subjective_logic")
    open_step(model, 0, {1: [1.0], 2: []})
    add(model, 0, [(2, 1, 0, 1.0, 1.0)])
    assert 0.5 < trust_of(model, 1) < 1


def test_mate_of_published_figures():
    # v = 1, c = 0.5, 20 steps of 1 s: alpha 2.696, beta 0.5
    model = Mate(MateParams(), 1.0)
    excess = np.zeros((1, 2))
    for _ in range(20):
        excess = model._pulled(excess, 1)
        excess += np.column_stack(gained(np.array([1.0]), np.array([0.5]), 1.0))
    assert PRIOR + excess[0] == pytest.approx([2.696, 0.5], abs=5e-4)
    # a negative measurement weighs more: v = 0, c = 1, n = 4 adds 16 / 5 to beta
    assert gained(np.zeros(1), np.ones(1), 4.0) == (0.0, pytest.approx(3.2))


def test_an_absent_vehicle_is_not_forgotten():
    """Published code deletes a vehicle that is absent for one frame: whitewashing for nothing."""
    model = build("mate")
    for step in range(3):
        open_step(model, step, {1: [1.0], 2: [], 3: []})
        add(model, step, [(2, 1, 0, -1, 1), (3, 1, 0, -1, 1)])
    before = trust_of(model, 1)
    open_step(model, 3, {2: [1.0], 3: []})
    add(model, 3, [(3, 2, 0, 1, 1)])
    assert before < trust_of(model, 1) < 0.5


def test_eigentrust_of_published_figures():
    # 1 -> 2 100, 3 -> 2 100, 1 -> 3 75; 2 trusts nobody and passes on p; a = 0.5
    p = np.array([50.0, 0.0, 100.0]) / 150
    t = eigentrust(
        np.array([0, 2, 0]), np.array([1, 1, 2]), np.array([100.0, 100.0, 75.0]), p, np.zeros(3, int), 0.5, 1e-12
    )
    assert t == pytest.approx([0.2170543, 0.3023256, 0.4806202], abs=1e-7)
    twice = eigentrust(
        np.array([0, 2, 0, 3, 5, 3]), np.array([1, 1, 2, 4, 4, 5]), np.tile([100.0, 100.0, 75.0], 2),
        np.tile(p, 2), np.repeat([0, 1], 3), 0.5, 1e-12,
    )  # fmt: skip
    np.testing.assert_array_equal(twice, np.tile(t, 2))  # holders do not bear on each other


def test_minhas_by_hand():
    # good: 0 -> 0.1 -> (2 s later, l^2 = 0.9604) 0.9604 0.9 0.1 + 0.1 = 0.186436; bad: 1.3 0.186436 - 0.3 = -0.0576332
    # bad with T < 0, 1 s later: (1 / 0.98) 0.7 (-0.0576332) - 0.3 = -0.341167
    p, true, false = MinhasParams(), np.array([True]), np.array([False])
    t = experienced(np.zeros(1), true, np.ones(1), p)
    assert t[0] == pytest.approx(0.1)
    t = experienced(t, true, np.array([0.98**2]), p)
    assert t[0] == pytest.approx(0.186436)
    t = experienced(t, false, np.ones(1), p)
    assert t[0] == pytest.approx(-0.0576332)
    assert experienced(t, false, np.array([0.98]), p)[0] == pytest.approx(-0.3411666, abs=1e-6)
    with pytest.raises(ValueError, match="bad experience must weigh more"):
        MinhasParams(gain=0.3, loss=-0.2)


def test_announcement_by_hand():
    # rater 2: 1.0 at step 0, 0.5 at step 300; rater 3: 0 at step 300; read at 300: weights 1/2 and 1
    # rater 2: (0.5 + 0.5) / 1.5 = 2/3; mean with 0: 1/3; at 450 the certificate is 150 s old: weights 1/4 and 3/4,
    # (0.25 + 0.375) / 1 = 0.625, mean 0.3125, times 3/4
    model = build("announcement")
    open_step(model, 0, {1: [1.0], 2: [], 3: []})
    add(model, 0, [(2, 1, 0, 1.0, 0.5)])
    open_step(model, 300, {1: [1.0, 1.0], 2: [], 3: []})
    add(model, 300, [(2, 1, 0, 1.0, 0.5), (2, 1, 1, -1.0, 0.5), (3, 1, 0, -1.0, 1.0)])
    assert trust_of(model, 1) == pytest.approx(1 / 3, abs=1e-6)
    assert trust_of(model, 1, 450) == pytest.approx(0.3125 * 0.75, abs=1e-6)
    assert model.scores(900).subject.size == 0


def test_a_vehicle_is_guilty_after_six_reports():
    model = build("report_count")
    for step in range(6):
        open_step(model, step, {1: [1.0], 2: []})
        add(model, step, [(2, 1, 0, -1, 1)])
        assert (trust_of(model, 1) < 0.5) == (step == 5)


def test_history_is_looked_up_by_pseudonym():
    """Published code reads history by the true identity, which flatters detection when pseudonyms change."""
    for name in sorted(set(MODELS) - {"mean_score"}):  # which reads no evaluations
        model = build(name)
        for step in range(4):
            open_step(model, step, {1: [1.0], 2: [1.0], 3: [1.0]})
            add(model, step, [(2, 1, 0, -1, 1), (3, 1, 0, -1, 1), (3, 2, 0, 1, 1), (2, 3, 0, 1, 1)])
        open_step(model, 4, {9: [1.0], 2: [], 3: []})  # the same vehicle under another name
        add(model, 4, [])
        assert trust_of(model, 1) < trust_of(model, 2) and trust_of(model, 9) == 0.5
        if name != "false_discovery":  # which accuses nobody where one in three is denied: that is the usual share
            assert trust_of(model, 1) < 0.5


def test_majority_ban_by_hand():
    # one against three about object 0 of vehicle 1, twice a step: vehicle 2 loses and has two strikes per step
    model = MajorityBan(MajorityBanParams(ban_strikes=4, strike_window_s=2.0), 1.0)
    for step in range(3):
        open_step(model, step, {1: [1.0, 1.0], 2: [0.5], 3: [], 4: []})
        about = [(v, 1, k, -1.0 if v == 2 else 1.0, 1.0) for v in (2, 3, 4) for k in (0, 1)]
        add(model, step, [*about, (3, 2, 0, 1.0, 1.0)])
        assert (trust_of(model, 2) == 0) == (step >= 1)
    assert trust_of(model, 1) > 0.5
    # banned at step 1, it votes no more in step 2, where nothing is contradicted: no strike


def test_models_that_share_a_log_are_those_with_their_own():
    names = list(SETTINGS)
    rng = np.random.default_rng(5)
    frames, rows = [{v: [1.0, 0.5] for v in range(6)}] * 12, []
    for _ in frames:
        rows.append([
            (v, i, k, rng.choice([-1.0, 0.8]), rng.random()) for v in range(6) for i in range(6) for k in (0, 1)
        ])  # fmt: skip
    alone, shared = [build(name, grace_s=3.0) for name in names], [build(name, grace_s=3.0) for name in names]
    for model in shared[1:]:
        model.log = shared[0].log
    for a, b in zip(
        play(alone, frames, rows, scores_too=True), play(shared, frames, rows, scores_too=True), strict=True
    ):
        for one, other in zip(a, b, strict=True):
            for column in ("holder", "subject", "trust", "weight", "n_evaluations", "newest_step", "oldest_step"):
                np.testing.assert_array_equal(getattr(one, column), getattr(other, column))
