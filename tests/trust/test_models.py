"""Laws of every trust model, the beta reputation by hand, and shared evidence. Literal twins are in `test_twins`."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.seeds import seeds
from tests.trust.histories import (
    COLUMNS,
    add,
    assert_same,
    build,
    histories,
    messages_from_rows,
    open_step,
    play,
    received_by,
    rejected,
    trust_of,
)
from trust.models import MODELS, params_of
from trust.models.beta import Beta, BetaParams
from trust.models.trupercept import TruPercept
from trust.pair_index import PairIndex
from trust.params import TrustParams, differing_evidence_key, eta_of
from trust.tables import SERVER, ReceivedEvaluations

every_model = pytest.mark.parametrize("name", MODELS)


@every_model
def test_no_evidence_no_row(name):
    model = build(name)
    assert model.scores(0).subject.size == 0
    open_step(model, 0, {1: [1.0], 2: [0.5]})
    add(model, 0, [])
    assert model.scores().subject.size == 0
    assert trust_of(model, 1) == 0.5


@every_model
@given(world=histories, seed=seeds)
@settings(max_examples=12)
def test_order_of_arrival_changes_nothing(name, world, seed):
    """Messages one by one, up to nine steps late, in any order, some twice: bit for bit the same."""
    frames, rows = world
    rng = np.random.default_rng(seed)
    prompt, late = build(name), build(name)
    play([prompt], frames, rows)
    under_way = []
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        open_step(late, step, frame)
        messages = messages_from_rows(step, *np.array(evaluated, float).reshape(-1, 5).T)
        for i in range(messages.evaluator.size):
            one = ReceivedEvaluations(messages, np.array([SERVER]), np.array([i]))
            under_way += [(step + rng.integers(0, 9), one)] * (1 + (rng.random() < 0.2))
        rng.shuffle(under_way)
        last = step == len(rows) - 1
        for _, one in (x for x in under_way if x[0] <= step or last):
            late.add_evaluations(one)
        under_way = [x for x in under_way if x[0] > step and not last]
    assert_same(prompt.scores(), late.scores())
    assert set(rejected(late)) <= {"DUPLICATE"}


@every_model
@given(world=histories)
@settings(max_examples=6)
def test_copies_are_independent_and_go_on_alike(name, world):
    frames, rows = world
    model = build(name)
    play([model], frames, rows)
    before, after = model.scores(), []
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model)), model):
        assert_same(model.scores(), before)
        open_step(twin, len(frames), frames[0])
        twin.add_evaluations(received_by(len(frames), rows[0]))
        after.append(twin.scores())
    assert_same(after[0], after[2])
    assert_same(after[1], after[2])


@pytest.mark.parametrize("name", [name for name in MODELS if name != "trupercept"])
def test_an_evaluation_of_0_is_no_evidence(name):
    """e = 0 with visibility 1 speaks neither for nor against: a newcomer keeps the default, the known their trust."""
    model = build(name)
    open_step(model, 0, {1: [1.0, 1.0], 2: [1.0], 3: []})
    add(model, 0, [(3, 1, 0, 0.0, 1.0)])
    assert trust_of(model, 1) == 0.5 and not len(model.scores().subject)
    one, other = build(name), build(name)
    for known in (one, other):
        open_step(known, 0, {1: [1.0, 1.0], 2: [1.0], 3: []})
    add(one, 0, [(2, 1, 0, 0.8, 1.0)])
    add(other, 0, [(2, 1, 0, 0.8, 1.0), (3, 1, 0, 0.0, 1.0), (2, 1, 1, 0.0, 1.0)])
    assert_same(one.scores(), other.scores())


@every_model
def test_the_steps_of_evaluations_are_those_of_others_who_could_see(name):
    model = build(name)
    scores = [
        [(1, 1, 0, 1, 1)],
        [(2, 1, 0, 1, 0.5)],
        [(2, 1, 0, -1, 1), (3, 1, 0, 1, 1)],
        [(2, 1, 0, 1, 0), (1, 1, 0, 1, 1)],
    ]
    for step, evaluated in enumerate(scores):
        open_step(model, step, {1: [1.0], 2: [], 3: []})
        add(model, step, evaluated)
        is_evaluated = model.scores().is_evaluated
        assert is_evaluated.all() if step else not is_evaluated.any()
    last = model.scores()
    assert (last.newest_evaluation_step[0], last.oldest_evaluation_step[0], last.n_evaluations[0]) == (2, 1, 3)


def test_beta_by_hand():
    # step 0: pos 0.8 (Phi 1, e 0.8), neg 0.5 (Phi 0.5, e -1); read at step 2 with lambda 0.9: r = 0.648, s = 0.405
    # step 2: pos 0.25: r = 0.898; T = 1.898 / 3.303, u = 2 / 3.303
    model = Beta(BetaParams(decay_per_s=0.9), 1.0)
    open_step(model, 0, {1: [1.0], 2: [], 3: []})
    add(model, 0, [(2, 1, 0, 0.8, 1), (3, 1, 0, -1, 0.5), (1, 1, 0, 1, 1)])
    open_step(model, 1, {1: [], 2: []})
    open_step(model, 2, {1: [1.0], 2: [], 3: []})
    add(model, 2, [(2, 1, 0, 0.5, 0.5), (3, 1, 0, -1, 0)])
    scores = model.scores()
    assert scores.subject.tolist() == [1]
    assert scores.trust[0] == pytest.approx(1.898 / 3.303, abs=1e-9)
    assert scores.uncertainty[0] == pytest.approx(2 / 3.303, abs=1e-9)
    assert (scores.n_evaluations[0], scores.newest_step[0], scores.oldest_step[0]) == (3, 2, 0)


def test_beta_correlated_by_hand():
    """Vehicle 2 denies five detections of 1, and 3 confirms one: 5 / (1 + 4 / 2) = 5 / 3 against 1."""
    rows = [(2, 1, k, -1.0, 1.0) for k in range(5)] + [(3, 1, 0, 1.0, 1.0)]
    for correlation, denied in ((0.5, 5 / 3), (1.0, 1.0), (0.0, 5.0)):
        model = build("beta_correlated", correlation=correlation)
        open_step(model, 0, {1: [1.0] * 5, 2: [1.0], 3: [1.0]})
        add(model, 0, rows)
        assert trust_of(model, 1) == pytest.approx(2 / (1 + denied + 2), abs=1e-6)


def test_negative_evidence_follows_eta():
    rows = [(2, 1, 0, 0.0, 0.8), (3, 1, 0, -0.25, 0.8), (4, 1, 0, 0.5, 0.8), (1, 1, 0, -1, 1), (5, 1, 0, 0.5, 0.0)]
    for eta, neg in ((-1.0, [0.0, 0.2, 0.0]), (0.0, [0.8, 0.8, 0.0]), (-0.5, [0.0, 0.4, 0.0])):
        flat = received_by(0, rows, eta=eta).rows()
        first = 0 if eta == 0 else 1  # 0 is a denial where it stands for "unmatched", else no evidence
        assert flat.evaluator.tolist() == [2, 3, 4][first:]
        assert flat.neg.tolist() == pytest.approx(neg[first:], abs=1e-9)
        assert flat.pos.tolist() == pytest.approx([0, 0, 0.4][first:], abs=1e-9)


@given(world=histories, seed=seeds)
@settings(max_examples=30)
def test_sums_by_observer_equal_those_of_the_rows(world, seed):
    _, rows = world
    rng = np.random.default_rng(seed)
    messages = messages_from_rows(0, *np.array(rows[0], float).reshape(-1, 5).T)
    n = 2 * messages.evaluator.size
    received = ReceivedEvaluations(messages, rng.integers(0, 5, n), rng.permutation(n) // 2)
    flat, short = received.rows(), received.by_observer()
    sums = {}
    for x in zip(flat.holder, flat.evaluator, flat.observer, flat.pos, flat.neg, strict=True):
        sums.setdefault(x[:3], []).append(x[3:])
    # a message that one holder received twice is in the rows twice
    ours = {}
    for x in zip(short.holder, short.evaluator, short.observer, short.pos, short.neg, short.n, strict=True):
        ours[x[:3]] = ours.get(x[:3], np.zeros(3)) + np.array(x[3:])
    assert {k: (*np.sum(v, axis=0), len(v)) for k, v in sums.items()} == {k: tuple(v) for k, v in ours.items()}


def test_beta_drops_what_has_decayed():
    model = Beta(BetaParams(decay_per_s=0.5), 1.0)
    sizes = []
    for step in range(400):
        open_step(model, step, {3 * step: [1.0], 3 * step + 1: []})
        add(model, step, [(3 * step + 1, 3 * step, 0, 1, 1)])
        sizes.append(model.scores().subject.size)
    assert max(sizes) <= 64 + 40 + 10
    assert trust_of(model, 3 * 399) == pytest.approx(2 / 3)


COUNTED = ("holder", "subject", "uncertainty", "n_evaluators", *COLUMNS)
WINDOWS = [
    TrustParams(freshness_s=f, window=window, unseen=unseen, weighting=weighting, grace_s=2.0)
    for f, window, unseen, weighting in (
        (1.0, "half_open", "zero", "score"), (4.0, "closed", "zero", "score"), (3.0, "half_open", "zero", "score"),
        (2.0, "half_open", "skip", "score"), (5.0, "closed", "skip", "score"), (3.0, "half_open", "zero", "one"),
        ("off", "half_open", "zero", "score"), ("off", "half_open", "skip", "one"),
    )
]  # fmt: skip


@given(world=histories, seed=seeds)
@settings(max_examples=30)
def test_shared_evidence_changes_nothing(world, seed):
    """Scores and counters of models that share evidence are those of models of their own, late messages included."""
    frames, rows = world
    rng = np.random.default_rng(seed)
    shared, alone = TruPercept.build_shared(WINDOWS, 1.0), [TruPercept(p, 1.0) for p in WINDOWS]
    assert len({id(m.store) for m in shared}) == 3
    under_way = []
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        for a, b in zip(shared, alone, strict=True):
            if rng.random() < 0.3:  # a server that computes before the step's evidence exists
                assert_same(a.scores(step), b.scores(step))
        for model in (*shared, *alone):
            open_step(model, step, frame)
        messages = messages_from_rows(step, *np.array(evaluated, float).reshape(-1, 5).T)
        for i in range(messages.evaluator.size):
            one = ReceivedEvaluations(messages, rng.integers(0, 3, 2), np.array([i, i]))
            under_way += [(step + rng.integers(0, 7), one)] * (1 + (rng.random() < 0.3))
        due = [one for arrival, one in under_way if arrival <= step]
        under_way = [x for x in under_way if x[0] > step]
        if rng.random() < 0.5:
            for one in due:
                for model in (*shared, *alone):
                    model.add_evaluations(one)
        else:
            for model in (*shared, *alone):
                for one in due:
                    model.add_evaluations(one)
        if rng.random() < 0.2:
            shared = copy.deepcopy(shared)
        for a, b in zip(shared, alone, strict=True):
            assert_same(a.scores(), b.scores(), COUNTED)
            assert rejected(a) == rejected(b)
            assert (a.n_received, a.n_bad_detections) == (b.n_received, b.n_bad_detections)


@given(world=histories, grace=st.integers(1, 4))
@settings(max_examples=20)
def test_without_expiry_prompt_evidence_counts_for_ever(world, grace):
    frames, rows = world
    off = TruPercept(TrustParams(freshness_s="off", grace_s=float(grace)), 1.0)
    long = TruPercept(TrustParams(freshness_s=1e6), 1.0)
    for a, b in zip(*play([off, long], frames, rows, scores_too=True), strict=True):
        assert_same(a, b, COUNTED)
    assert len(off.store.steps) <= grace
    assert_same(off.scores(10**6), replace(long.scores(), step=10**6))


def test_without_expiry_late_evaluations_are_rejected():
    model = TruPercept(TrustParams(freshness_s="off", grace_s=3.0), 1.0)
    for step in range(5):
        open_step(model, step, {1: [1.0], 2: []})
        add(model, step, [(2, 1, 0, 0.5, 1)])
    add(model, 1, [(2, 1, 0, -1, 1)])
    assert rejected(model) == {"LATE": 1}
    assert model.scores().n_evaluations.tolist() == [5]


def test_which_evidence_key_differs():
    a = TrustParams()
    assert differing_evidence_key(a, replace(a, freshness_s=5.0, host="local", unseen="skip", model="beta")) is None
    assert differing_evidence_key(a, replace(a, tau=0.2)) == "tau"
    assert differing_evidence_key(a, replace(a, method="trupercept_1")) == "eta"  # 0 instead of -1
    assert differing_evidence_key(a, replace(a, method="trupercept_1", eta=eta_of(a))) is None


def test_parameters_of_a_model():
    trust = TrustParams(freshness_s=7.0, grace_s=3.0)
    assert params_of(TruPercept, trust).freshness_s == 7.0
    assert params_of(Beta, trust, {"decay_per_s": 0.9}) == BetaParams(decay_per_s=0.9, grace_s=3.0)
    with pytest.raises(ValueError, match=r"trust.decay_s: the trust model Beta has no such parameter"):
        params_of(Beta, trust, {"decay_s": 0.9})


def test_pair_index():
    pairs = PairIndex()
    assert pairs.rows(np.array([5, 1, 5]), np.array([2, 9, 2])).tolist() == [1, 0, 1]
    assert pairs.rows(np.array([3, 5]), np.array([0, 2])).tolist() == [2, 1]
    assert [a.tolist() for a in pairs.sorted()] == [[1, 3, 5], [9, 0, 2], [0, 2, 1]]
    assert pairs.find(np.array([1, 1]), np.array([9, 8]))[1].tolist() == [True, False]
    pairs.drop(np.array([False, False, True]))
    assert [a.tolist() for a in pairs.sorted()] == [[1, 5], [9, 2], [0, 1]]
    assert pairs.rows(np.array([6, 4]), np.array([9, 8])).tolist() == [3, 2], "row 2 is given again"
    assert len(pairs) == 4
