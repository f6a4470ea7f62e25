"""The ledger by hand."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trust.ledgers import announce, refused, tell, trust_of
from trust.ledger import SERVER, Ledger
from trust.params import TrustParams, window_steps
from trust.tables import Told, told_from_rows


def test_by_hand():
    # vehicle 7 sends s = 1 and s = 0.5; 8 says (0.8, Phi 1) and (-1, Phi 0.5), 9 says (0.2, Phi 0.5), itself (1, 1)
    # T(0) = (0.8 + 0.1) / 1.5 = 0.6; T(1) = -1; T = (0.6 - 0.5) / 1.5
    ledger = Ledger(TrustParams(), 1.0)
    announce(ledger, 0, {7: [1, 0.5], 8: [], 9: []})
    tell(ledger, 0, [(8, 7, 0, 0.8, 1), (8, 7, 1, -1, 0.5), (9, 7, 0, 0.2, 0.5), (7, 7, 0, 1, 1)])
    standing = ledger.standing(0)
    assert standing.subject.tolist() == [7]
    assert standing.trust[0] == pytest.approx(0.1 / 1.5, abs=1e-12)
    assert standing.weight[0] == 1.5
    assert standing.n_verdicts[0] == 3
    assert (standing.newest_step[0], standing.oldest_step[0]) == (0, 0)


def test_never_below_zero_and_back_to_default():
    ledger = Ledger(TrustParams(freshness_s=3.0), 1.0)
    announce(ledger, 0, {1: [0.7], 2: []})
    assert trust_of(ledger, 1) == 0.5
    tell(ledger, 0, [(2, 1, 0, -1, 1)])
    assert trust_of(ledger, 1, 0) == 0
    assert trust_of(ledger, 1, 2) == 0
    assert trust_of(ledger, 1, 3) == 0.5


@pytest.mark.parametrize(("unseen", "expected"), [("zero", 0.8 / 1.5), ("skip", 0.8)])
def test_unseen(unseen, expected):
    # s = 1 with T = 0.8; s = 0.5 that only its own detector judged; s = 0.9 that nobody judged at all
    ledger = Ledger(TrustParams(unseen=unseen), 1.0)
    announce(ledger, 0, {1: [1, 0.5, 0.9], 2: []})
    tell(ledger, 0, [(2, 1, 0, 0.8, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1)])
    assert trust_of(ledger, 1) == pytest.approx(expected, abs=1e-12)


def test_weighting():
    # T = 1 with s = 0.9 and T = 0 with s = 0.1: 0.9 weighted, 0.5 not
    for weighting, expected in (("score", 0.9), ("one", 0.5)):
        ledger = Ledger(TrustParams(weighting=weighting), 1.0)
        announce(ledger, 0, {1: [0.9, 0.1], 2: []})
        tell(ledger, 0, [(2, 1, 0, 1, 1), (2, 1, 1, 0, 1)])
        assert trust_of(ledger, 1) == pytest.approx(expected, abs=1e-12)


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


@pytest.mark.parametrize("window", ["half_open", "closed"])
@given(f=st.integers(1, 12), extra=st.integers(0, 5))
@settings(max_examples=20, deadline=None)
def test_forgets_exactly_at_f(f, extra, window):
    ledger = Ledger(TrustParams(freshness_s=float(f), window=window), 1.0)
    announce(ledger, extra, {1: [1], 2: []})
    tell(ledger, extra, [(2, 1, 0, 0.25, 1)])
    last = extra + f - (window == "half_open")
    assert trust_of(ledger, 1, last) == 0.25
    assert trust_of(ledger, 1, last + 1) == 0.5
    assert not ledger.pages


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
        ((2, 1, 1, -1, 1), "UNKNOWN_DETECTION"),  # announced with the score NaN
        ((2, 99, 0, -1, 1), "UNKNOWN_VEHICLE"),
        ((2, -7, 0, -1, 1), "UNKNOWN_VEHICLE"),
        ((99, 1, 0, -1, 1), "UNKNOWN_EVALUATOR"),
        ((3, 1, 0, -1, 1), "DUPLICATE"),
    ],
)
def test_bad_input_moves_nothing(row, cause):
    ledger = Ledger(TrustParams(), 1.0)
    announce(ledger, 0, {1: [1, np.nan], 2: [], 3: []})
    assert ledger.n_bad_detections == 1
    tell(ledger, 0, [(3, 1, 0, 0.75, 1)])
    before = ledger.standing(0)
    tell(ledger, 0, [row])
    after = ledger.standing(0)
    assert refused(ledger) == {cause: 1}
    assert ledger.n_entered == 2
    for name in before.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))


@pytest.mark.parametrize("k", [np.iinfo(np.int64).max, np.iinfo(np.int64).min])
def test_numbers_beyond_reason(k):
    ledger = Ledger(TrustParams(), 1.0)
    announce(ledger, 0, {1: [1], 2: [1]})
    ledger.enter(Told(0, *map(np.array, ([1], [0, 1], [2], [k], [1.0], [1.0]))), np.array([SERVER]), np.array([0]))
    assert refused(ledger) == {"UNKNOWN_DETECTION": 1}


def test_late_and_early_messages_are_counted():
    ledger = Ledger(TrustParams(freshness_s=5.0), 1.0)
    for step in range(10):
        announce(ledger, step, {1: [1], 2: []} if step < 8 else {2: []})
    tell(ledger, 4, [(2, 1, 0, -1, 1)])  # five steps old
    tell(ledger, 11, [(2, 1, 0, -1, 1), (2, 1, 1, -1, 1)])
    tell(ledger, 9, [(2, 1, 0, -1, 1)])  # 1 has left
    tell(ledger, 9, [(1, 2, 0, -1, 1)])
    assert refused(ledger) == {"LATE": 1, "FUTURE": 2, "UNKNOWN_VEHICLE": 1, "UNKNOWN_EVALUATOR": 1}
    assert ledger.standing().subject.size == 0
    tell(ledger, 5, [(2, 1, 0, 0.25, 1)])  # four steps old, and 1 was there
    assert trust_of(ledger, 1) == 0.25


def test_bad_detections_are_counted():
    ledger = Ledger(TrustParams(), 1.0)
    score = np.array([0.5, 1.5, -0.1, np.inf, 0.25, 0.75])
    ledger.announce(0, np.array([4, 6]), np.array([0, 0, 0, 0, 1, 1]), np.array([0, 1, 2, 3, 0, 0]), score)
    assert ledger.n_bad_detections == 4  # three scores, and a number given twice: the first counts
    tell(ledger, 0, [(4, 6, 0, 1, 1), *((6, 4, k, 1, 1) for k in range(4))])
    standing = ledger.standing()
    assert dict(zip(standing.subject.tolist(), standing.weight.tolist(), strict=True)) == {4: 0.5, 6: 0.25}


def test_self_evaluation_is_no_evidence():
    ledger = Ledger(TrustParams(unseen="skip"), 1.0)
    announce(ledger, 0, {1: [1]})
    tell(ledger, 0, [(1, 1, 0, 1, 1)])
    assert trust_of(ledger, 1) == 0.5
    assert ledger.standing().subject.size == 0


def test_memory_follows_the_window_not_the_run():
    """Ids only ever grow, nobody stays longer than ten steps."""
    ledger = Ledger(TrustParams(freshness_s=20.0), 1.0)
    sizes = []
    for step in range(400):
        ids = range(3 * step, 3 * step + 30)
        announce(ledger, step, {v: [0.5, 0.5] for v in ids})
        tell(ledger, step, [(v, u, k, 1, 1) for v in ids for u in ids[:5] for k in (0, 1)])
        ledger.standing()
        sizes.append(ledger.nbytes)
    assert max(sizes[200:]) <= max(sizes[25:50])
    assert len(ledger.pages) == 20


def test_many_words_and_growing_tables():
    """More verdicts than a word of bits holds, in several messages, to many holders."""
    ledger = Ledger(TrustParams(), 1.0)
    announce(ledger, 0, {1: np.full(500, 0.5), 2: [], 3: np.full(300, 1.0)})
    about_1 = [(2, 1, k, 0.5, 1) for k in range(500)]
    for part in (about_1[:100], about_1[50:], [(2, 3, k, 1, 0.5) for k in range(300)]):
        said = told_from_rows(0, *np.array(part, float).T)
        ledger.enter(said, np.arange(100), np.zeros(100, int))
    assert refused(ledger) == {"DUPLICATE": 50 * 100}
    standing = ledger.standing()
    assert standing.trust.reshape(100, 2).tolist() == [[0.5, 1.0]] * 100
    assert standing.n_verdicts.reshape(100, 2).tolist() == [[500, 300]] * 100


def test_first_of_contradicting_verdicts_counts():
    ledger = Ledger(TrustParams(), 1.0)
    announce(ledger, 0, {1: [1], 2: []})
    twice = Told(0, *map(np.array, ([2], [0, 2], [1, 1], [0, 0], [0.25, -1.0], [1.0, 1.0])))
    ledger.enter(twice, np.array([SERVER]), np.array([0]))
    tell(ledger, 0, [(2, 1, 0, -1, 1)])
    assert trust_of(ledger, 1) == 0.25
    assert refused(ledger) == {"DUPLICATE": 2}


def test_survives_a_pickle():
    ledger = Ledger(TrustParams(), 1.0)
    announce(ledger, 0, {1: [1], 2: []})
    tell(ledger, 0, [(2, 1, 0, 0.25, 1)])
    again = pickle.loads(pickle.dumps(ledger))
    announce(again, 1, {1: [1], 2: []})
    tell(again, 1, [(2, 1, 0, 0.75, 1)])
    assert trust_of(again, 1) == 0.5
