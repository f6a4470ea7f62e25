"""The trust model `trupercept` by hand."""

import pickle

import numpy as np
import pytest

from tests.trust.histories import add, assert_same, messages_from_rows, open_step, rejected, trust_of
from trust.models.trupercept import TruPercept
from trust.params import TrustParams, window_steps
from trust.tables import SERVER, EvaluationMessages, ReceivedEvaluations


def test_by_hand():
    # vehicle 7 sends s = 1 and s = 0.5; 8 reports (0.8, Phi 1) and (-1, Phi 0.5), 9 (0.2, Phi 0.5), 7 itself (1, 1)
    # T(0) = (0.8 + 0.1) / 1.5 = 0.6; T(1) = -1; T = (0.6 - 0.5) / 1.5
    model = TruPercept(TrustParams(), 1.0)
    open_step(model, 0, {7: [1, 0.5], 8: [], 9: []})
    add(model, 0, [(8, 7, 0, 0.8, 1), (8, 7, 1, -1, 0.5), (9, 7, 0, 0.2, 0.5), (7, 7, 0, 1, 1)])
    scores = model.scores(0)
    assert scores.subject.tolist() == [7]
    assert scores.trust[0] == pytest.approx(0.1 / 1.5, abs=1e-12)
    assert scores.weight[0] == 1.5
    assert scores.n_evaluations[0] == 3
    assert (scores.newest_step[0], scores.oldest_step[0]) == (0, 0)


def test_never_below_zero_and_back_to_default():
    model = TruPercept(TrustParams(freshness_s=3.0), 1.0)
    open_step(model, 0, {1: [0.7], 2: []})
    assert trust_of(model, 1) == 0.5
    add(model, 0, [(2, 1, 0, -1, 1)])
    assert trust_of(model, 1, 0) == 0
    assert trust_of(model, 1, 2) == 0
    assert trust_of(model, 1, 3) == 0.5


def test_what_its_own_sender_doubts_is_no_evidence():
    # s = 1 and 0.5 are confirmed by 0.8 and 0.6, s = 0.4 is denied: (0.8 + 0.5 x 0.6) / 1.5; all three: 0.7 / 1.9
    for least, expected, n in ((0.5, 1.1 / 1.5, 2), (0.0, (1.1 - 0.4) / 1.9, 3)):
        model = TruPercept(TrustParams(least_score=least), 1.0)
        open_step(model, 0, {1: [1.0, 0.5, 0.4], 2: []})
        add(model, 0, [(2, 1, 0, 0.8, 1), (2, 1, 1, 0.6, 1), (2, 1, 2, -1, 1)])
        assert trust_of(model, 1) == pytest.approx(expected, abs=1e-12)
        assert model.scores().n_evaluations.tolist() == [n]
    # who evaluates only what does not count is no evaluator behind the value
    for least, evaluators in ((0.5, 1), (0.0, 3)):
        model = TruPercept(TrustParams(least_score=least), 1.0)
        open_step(model, 0, {1: [1.0, 0.4], 2: [], 3: [], 4: []})
        add(model, 0, [(2, 1, 0, 0.8, 1), (3, 1, 1, 0.6, 1), (4, 1, 1, -1, 1)])
        assert model.scores().n_evaluators.tolist() == [evaluators]


@pytest.mark.parametrize(
    ("freshness_s", "dt_s", "window", "steps"),
    [
        (50, 1, "half_open", 50),
        (50, 1, "closed", 51),
        (50, 0.1, "half_open", 500),
        (0.3, 0.1, "half_open", 3),  # 0.3 / 0.1 is not 3 in floating point
        (2.5, 1, "half_open", 3),  # ages 0, 1, 2 are below 2.5
        (2.5, 1, "closed", 3),
        (0.2, 1, "half_open", 1),
    ],
)
def test_window_steps(freshness_s, dt_s, window, steps):
    assert window_steps(TrustParams(freshness_s=float(freshness_s), window=window), dt_s) == steps


@pytest.mark.parametrize(
    ("row", "cause"),
    [
        ((2, 1, 0, np.nan, 1), "BAD_VALUE"),
        ((2, 1, 0, -1, np.nan), "BAD_VALUE"),
        ((2, 1, 0, -1, np.inf), "BAD_VALUE"),
        ((2, 1, 0, -1.5, 1), "BAD_VALUE"),
        ((2, 1, 0, -1, -0.1), "BAD_VALUE"),
        ((2, 1, 0, -1, 1.1), "BAD_VALUE"),
        ((2, 1, 2, -1, 1), "UNKNOWN_DETECTION"),
        ((2, 1, -1, -1, 1), "UNKNOWN_DETECTION"),
        ((2, 1, 2**40, -1, 1), "UNKNOWN_DETECTION"),
        ((2, 1, 1, -1, 1), "UNKNOWN_DETECTION"),  # transmitted with the score NaN
        ((2, 99, 0, -1, 1), "UNKNOWN_OBSERVER"),
        ((2, -7, 0, -1, 1), "UNKNOWN_OBSERVER"),
        ((99, 1, 0, -1, 1), "UNKNOWN_EVALUATOR"),
        ((3, 1, 0, -1, 1), "DUPLICATE"),
    ],
)
def test_bad_input_has_no_effect(row, cause):
    model = TruPercept(TrustParams(), 1.0)
    open_step(model, 0, {1: [1, np.nan], 2: [], 3: []})
    assert model.n_bad_detections == 1
    add(model, 0, [(3, 1, 0, 0.75, 1)])
    before = model.scores(0)
    add(model, 0, [row])
    after = model.scores(0)
    assert rejected(model) == {cause: 1}
    assert model.n_received == 2
    assert_same(before, after)


@pytest.mark.parametrize("k", [np.iinfo(np.int64).max, np.iinfo(np.int64).min])
def test_detection_index_out_of_range(k):
    model = TruPercept(TrustParams(), 1.0)
    open_step(model, 0, {1: [1], 2: [1]})
    messages = EvaluationMessages(0, *map(np.array, ([1], [0, 1], [2], [k], [1.0], [1.0])))
    model.add_evaluations(ReceivedEvaluations(messages, np.array([SERVER]), np.array([0])))
    assert rejected(model) == {"UNKNOWN_DETECTION": 1}


def test_late_and_early_messages_are_counted():
    model = TruPercept(TrustParams(freshness_s=5.0), 1.0)
    for step in range(10):
        open_step(model, step, {1: [1], 2: []} if step < 8 else {2: []})
    add(model, 4, [(2, 1, 0, -1, 1)])  # five steps old
    add(model, 11, [(2, 1, 0, -1, 1), (2, 1, 1, -1, 1)])
    add(model, 9, [(2, 1, 0, -1, 1)])  # 1 has left
    add(model, 9, [(1, 2, 0, -1, 1)])
    assert rejected(model) == {"LATE": 1, "FUTURE": 2, "UNKNOWN_OBSERVER": 1, "UNKNOWN_EVALUATOR": 1}
    assert model.scores().subject.size == 0
    add(model, 5, [(2, 1, 0, 0.25, 1)])  # four steps old, and 1 was there
    assert trust_of(model, 1) == 0.25


def test_bad_detections_are_counted():
    model = TruPercept(TrustParams(), 1.0)
    score = np.array([0.5, 1.5, -0.1, np.inf, 0.25, 0.75])
    model.open_step(0, np.array([4, 6]), np.array([0, 0, 0, 0, 1, 1]), np.array([0, 1, 2, 3, 0, 0]), score)
    assert model.n_bad_detections == 4  # three scores, and an index given twice: the first counts
    add(model, 0, [(4, 6, 0, 1, 1), *((6, 4, k, 1, 1) for k in range(4))])
    scores = model.scores()
    assert dict(zip(scores.subject.tolist(), scores.weight.tolist(), strict=True)) == {4: 0.5, 6: 0.25}


def test_memory_follows_the_window_not_the_run():
    """Pseudonyms grow with time; none is present for more than ten steps."""
    model = TruPercept(TrustParams(freshness_s=20.0), 1.0)
    sizes = []
    for step in range(400):
        ids = range(3 * step, 3 * step + 30)
        open_step(model, step, {v: [0.5, 0.5] for v in ids})
        add(model, step, [(v, u, k, 1, 1) for v in ids for u in ids[:5] for k in (0, 1)])
        model.scores()
        sizes.append(len(pickle.dumps(model)))
    assert max(sizes[200:]) <= max(sizes[25:50]) + 64  # a number above 255 has one byte more
    assert len(model.store.steps) == 20


def test_many_evaluations_to_many_holders():
    """Of several messages of one evaluator, each holder counts the first."""
    model = TruPercept(TrustParams(), 1.0)
    open_step(model, 0, {1: np.full(500, 0.5), 2: [], 3: np.full(300, 1.0)})
    about_both = [(2, 1, k, 0.5, 1) for k in range(500)] + [(2, 3, k, 1, 0.5) for k in range(300)]
    for part in (about_both, [(2, 1, k, -1, 1) for k in range(50)]):
        messages = messages_from_rows(0, *np.array(part, float).T)
        model.add_evaluations(ReceivedEvaluations(messages, np.arange(100), np.zeros(100, int)))
    assert rejected(model) == {"DUPLICATE": 50 * 100}
    scores = model.scores()
    assert scores.trust.reshape(100, 2).tolist() == [[0.5, 1.0]] * 100
    assert scores.n_evaluations.reshape(100, 2).tolist() == [[500, 300]] * 100


@pytest.mark.parametrize("freshness_s", [6.0, "off"])
def test_late_evaluations_count_as_if_they_had_come_at_once(freshness_s):
    """A third of the messages come at once, all of them once more four steps later; other pairs are expired between."""
    rows = [(v, u, k, 0.5, 1) for v in range(40) for u in range(30) for k in (0, 1)]
    late, prompt = (TruPercept(TrustParams(freshness_s=freshness_s), 1.0) for _ in range(2))
    for step in range(10):
        for model in (late, prompt):
            open_step(model, step, {v: [0.5, 0.5] for v in range(40)})
        add(prompt, step, rows)
        add(late, step, [row for row in rows if row[0] % 3 == 0])
        late.scores()
        if step >= 4:
            add(late, step - 4, rows)
            add(late, step - 4, [(50, 1, 0, 1, 1)])
            add(prompt, step - 4, [(50, 1, 0, 1, 1)])
    for step in range(6, 10):
        add(late, step, rows)
    assert_same(late.scores(), prompt.scores())
    assert late.scores().n_evaluators.tolist() == prompt.scores().n_evaluators.tolist()
    assert rejected(late)["DUPLICATE"] > 1000 and rejected(late)["UNKNOWN_EVALUATOR"] == 6


def test_first_of_contradicting_evaluations_counts():
    model = TruPercept(TrustParams(), 1.0)
    open_step(model, 0, {1: [1], 2: []})
    twice = EvaluationMessages(0, *map(np.array, ([2], [0, 2], [1, 1], [0, 0], [0.25, -1.0], [1.0, 1.0])))
    model.add_evaluations(ReceivedEvaluations(twice, np.array([SERVER]), np.array([0])))
    add(model, 0, [(2, 1, 0, -1, 1)])
    assert trust_of(model, 1) == 0.25
    assert rejected(model) == {"DUPLICATE": 2}
