"""What certified observers say replaces what others say of the same detection."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from trust.certified import upheld
from trust.claims import DETECTION, MISSING, claim_number
from trust.tables import EvaluationMessages


def messages_of(rows, n_evaluators, steps=None):
    """Messages of evaluators 0 ... n - 1 from rows (evaluator, observer, index, evaluation, visibility)."""
    order = sorted(range(len(rows)), key=lambda i: rows[i][0])
    by, observer, index, e, phi = (np.array([rows[i][k] for i in order]) for k in range(5))
    return EvaluationMessages(
        7, 10 + np.arange(n_evaluators), np.searchsorted(by.astype(int), np.arange(n_evaluators + 1)),
        observer.astype(int), index.astype(int), e.astype(float), phi.astype(float),
        None if steps is None else np.array([steps[i] for i in order]),
    )  # fmt: skip


def rows_of(messages):
    by = np.repeat(messages.evaluator - 10, np.diff(messages.ptr))
    columns = by, messages.observer, messages.detection_index, messages.evaluation, messages.visibility
    return list(zip(*(column.tolist() for column in columns), strict=True))


def test_by_hand():
    """Unit 12 sees detection (3, 1) and cannot see (3, 2). What the liar says of the first goes, of the second stays.
    Nobody evaluates the unit's own detections, (12, 5)."""
    rows = [
        (0, 3, 1, -1.0, 1.0), (0, 3, 2, -1.0, 1.0), (0, 12, 5, -1.0, 1.0),
        (2, 3, 1, 0.9, 0.2), (2, 3, 2, -1.0, 0.0),
    ]  # fmt: skip
    found = upheld(messages_of(rows, 3), np.array([False, False, True]), np.array([12]))
    assert rows_of(found) == [rows[1], rows[3], rows[4]]


def test_what_a_message_lacks_is_one_claim():
    """Unit 12 finds one object missing in the message of 3, its own object 4. Others number theirs differently."""
    missing, detected = claim_number(np.array([0, 4]), MISSING), claim_number(np.array([0]), DETECTION)
    rows = [(0, 3, missing[0], 1.0, 1.0), (0, 3, detected[0], 1.0, 1.0), (2, 3, missing[1], -1.0, 0.5)]
    given = messages_of(rows, 3), np.array([False, False, True]), np.array([12])
    assert rows_of(upheld(*given, are_claims=True)) == rows[1:]
    assert rows_of(upheld(*given)) == rows


def test_without_certified_observers_nothing_changes():
    sent = messages_of([(0, 3, 1, -1.0, 1.0)], 1)
    assert upheld(sent, np.array([False]), np.zeros(0, int)) is sent


_ROW = st.tuples(
    st.integers(0, 3), st.integers(10, 13), st.integers(0, 2), st.sampled_from([-1.0, 0.5]), st.sampled_from([0.0, 0.5])
)


@settings(max_examples=50)
@given(st.lists(st.tuples(_ROW, st.integers(5, 7)), min_size=1, max_size=30), st.sets(st.integers(0, 3)), st.booleans())
def test_equals_a_slow_twin(given_rows, certified, with_steps):
    """Row by row, from the rule as the docstring says it."""
    rows, steps = [row for row, _ in given_rows], [step if with_steps else 0 for _, step in given_rows]
    sent = messages_of(rows, 4, steps if with_steps else None)
    found = rows_of(upheld(sent, np.isin(np.arange(4), list(certified)), 10 + np.array(sorted(certified), int)))
    kept = []
    order = sorted(range(len(rows)), key=lambda i: rows[i][0])
    for i in order:
        by, observer, index, _, _ = rows[i]
        seen = any(
            rows[j][0] in certified and rows[j][1:3] == (observer, index) and rows[j][4] > 0 and steps[j] == steps[i]
            for j in order
        )
        if observer - 10 not in certified and (by in certified or not seen):
            kept.append(rows[i])
    assert found == kept
