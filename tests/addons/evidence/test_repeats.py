"""The same observation heard again: by hand, in two extreme cases, and against chance."""

import numpy as np
import pytest

from cosim.addons.evidence.repeats import Said, agreement, of_evaluations


def said(rows, delay=0):
    """Rows (step, evaluator, subject, actor, denies), of detections that many steps before."""
    step, evaluator, subject, actor, denies = np.array(rows).reshape(-1, 5).T
    return Said(step, evaluator, subject, actor, denies > 0, step - delay)


def found(rows, dt_s=1.0):
    table = of_evaluations(said(rows), dt_s)
    return {(group, name): row[name] for group, row in table.set_index("group").iterrows() for name in row.index}


def test_by_hand():
    # vehicle 2 denies actor 7 of subject 1 in steps 0, 0 (two detections, or two pseudonyms), 9 and 10, and confirms it
    # in step 11; vehicle 3 confirms it in steps 0 and 9, and confirms actor 8 in step 0
    rows = [(0, 2, 1, 7, 1), (0, 2, 1, 7, 1), (9, 2, 1, 7, 1), (10, 2, 1, 7, 1), (11, 2, 1, 7, 0), (0, 3, 1, 7, 0),
            (9, 3, 1, 7, 0), (0, 3, 1, 8, 0)]  # fmt: skip
    value = found(rows)
    assert value["step", "distinct"] == 7 / 8
    assert value["10 s", "distinct"] == 4 / 8  # 2 in both spans, 3 of actors 7 and 8 in the first
    assert value["run", "distinct"] == 3 / 8
    # Same evaluator: groups of 4 (3 deny), 2 (none) and 1. Of 12 + 2 ordered pairs, 3 x 2 + 2 agree. Of the pairs'
    # first members, 3 x 3 of 14 deny.
    chance = (9 / 14) ** 2 + (5 / 14) ** 2
    kappa = (8 / 14 - chance) / (1 - chance)
    assert value["same evaluator, object", "kappa"] == pytest.approx(kappa)
    expected = (4 / (1 + 3 * kappa) + 2 / (1 + kappa) + 1) / 7 if kappa > 0 else 1
    assert value["same evaluator, object", "effective"] == pytest.approx(expected)
    # Same evaluator: groups of 4 (3 deny) and 3 (none). Of 12 + 6 ordered pairs, 6 + 6 agree; 9 are of denials.
    assert value["same evaluator", "kappa"] == pytest.approx((12 / 18 - 0.5) / 0.5)
    # Same object and step: steps 0 and 9 have one of each verdict: no pair agrees, half deny.
    assert value["same object, step", "kappa"] == -1
    assert value["same object, step", "effective"] == 1


def test_evaluators_that_sense_in_turns_judge_the_same_detection():
    """Two evaluators of each of two detections, one and three steps later. They agree about both."""
    rows = [(11, 2, 1, 7, 1), (13, 3, 1, 7, 1), (21, 2, 1, 7, 0), (23, 3, 1, 7, 0)]
    table = of_evaluations(said(rows, np.array([1, 3, 1, 3])), 0.2).set_index("group")
    assert table.kappa["same object, step"] == 1
    assert table.effective["same object, step"] == 0.5


def test_one_voice_and_many():
    """One vehicle that says the same ten times is one observation; ten that draw lots are ten."""
    steps = np.arange(10)
    once = found([(step, who, 1, 7, who % 2) for who in (2, 3) for step in steps])
    assert once["same evaluator, object", "kappa"] == once["same evaluator", "kappa"] == 1
    assert once["same evaluator", "effective"] == pytest.approx(once["run", "distinct"]) == 0.1
    lots = np.random.default_rng(1).random((10, 400)) < 0.3
    many = found([(step, who + 2, 1, 7, lots[step, who]) for step in steps for who in range(400)])
    assert abs(many["same evaluator", "kappa"]) < 0.04 and many["same evaluator", "effective"] > 0.7


def test_kappa_is_the_intraclass_correlation():
    """Groups with shares drawn from Beta(a, b) have the correlation 1 / (a + b + 1)."""
    random = np.random.default_rng(2)
    n = np.full(20_000, 6)
    denied = random.binomial(n, random.beta(1.0, 2.0, len(n)))
    assert agreement(n, denied) == pytest.approx(1 / 4, abs=0.01)
    assert np.isnan(agreement(np.ones(3, int), np.ones(3, int))) and np.isnan(agreement(n, n))


def test_without_evaluations():
    table = of_evaluations(said([]), 1.0)
    assert table[["distinct", "kappa", "effective"]].isna().to_numpy().all()
