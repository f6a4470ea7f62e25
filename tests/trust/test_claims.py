"""Evaluations of claims: by hand, and against Bayes' rule carried out literally."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from cosim.base.codes import EvaluationKind
from tests.trust.histories import messages_from_rows
from trust.claims import (
    DETECTION,
    MISSING,
    N_OBJECTS,
    SPEED,
    answers,
    claim_number,
    claims_of_messages,
    presence_support,
    velocity_support,
)
from trust.models.trupercept import TruPercept
from trust.params import KINDS, TrustParams
from trust.tables import SERVER, ReceivedEvaluations


def test_kinds_are_those_of_the_tables():
    assert (DETECTION, MISSING, SPEED) == tuple(EvaluationKind) and len(KINDS) == len(EvaluationKind)


def test_support_of_presence_is_bayes_rule():
    """Posterior of "withholds nothing" minus posterior of "withholds each with probability 1/2", priors 1/2 each."""
    for a in (0.05, 0.3, 0.5, 0.8, 0.99, 1.0):
        for reported in (True, False):
            honest, withholding = (p if reported else 1.0 - p for p in (a, a / 2))
            expected = (honest - withholding) / (honest + withholding)
            found = presence_support(np.array([a]), np.array([reported]))[0]
            assert found == pytest.approx(expected, abs=1e-12)


def test_support_of_presence_by_hand():
    """Missing with a = 0.8: -0.8 / (4 - 2.4) = -1/2. Certainly there: -1. Not to be expected: nothing."""
    found = presence_support(np.array([0.8, 1.0, 0.0, 0.0]), np.array([False, False, False, True]))
    np.testing.assert_allclose(found, [-0.5, -1.0, 0.0, 0.0], atol=1e-15)


def test_honest_senders_gain_on_average():
    """a / 3 - (1 - a) a / (4 - 3 a) = a / (3 (4 - 3 a)) is positive."""
    a = np.linspace(0.01, 1, 50)
    mean = a * presence_support(a, np.ones(50, bool)) + (1 - a) * presence_support(a, np.zeros(50, bool))
    np.testing.assert_allclose(mean, a / (3 * (4 - 3 * a)), rtol=1e-9)
    assert (mean > 0).all()


def test_support_of_velocity_is_bayes_rule():
    rng, w = np.random.default_rng(1), 0.1
    difference, variance, prior = (
        rng.normal(0, 2, (200, 2)),
        rng.uniform(0.05, 2, (200, 2)),
        rng.uniform(0.2, 30, (200, 2)),
    )
    found = velocity_support(difference, variance, prior)
    for d, v, b, support in zip(difference, variance, prior, found, strict=True):
        narrow, wide = (multivariate_normal([0, 0], np.diag(of)).pdf(d) for of in (v, v + b))
        honest = (1 - w) * narrow + w * wide
        assert support == pytest.approx(2 * honest / (honest + wide) - 1, abs=1e-9)


def test_support_of_velocity_by_hand():
    """Variance 1 and prior 24 along, 1 and 0 across: f / g = 5 exp(-12 / 25 d^2).

    d = 0: 0.9 (5 - 1) / (4.5 + 1.1) = 9 / 14. d = 10: -0.9 / 1.1. d^2 = 25 ln(5) / 12: f = g, so 0.
    """
    d = np.array([0.0, 10.0, np.sqrt(25 * np.log(5) / 12)])
    n = (np.column_stack([d, 0 * d]), np.tile([1.0, 1.0], (3, 1)), np.tile([24.0, 0.0], (3, 1)))
    np.testing.assert_allclose(velocity_support(*n), [9 / 14, -9 / 11, 0.0], atol=1e-9)


def test_answers_have_the_support_as_expectation():
    support = np.array([0.3, -0.6, 0.0])
    for eta in (-1.0, -0.5):
        found = answers(support, TrustParams(eta=eta))
        np.testing.assert_array_equal(found.evaluation, [1.0, eta, 1.0])
        np.testing.assert_array_equal(found.visibility, np.abs(support))


def test_every_claim_has_a_number_of_its_own_and_a_model_takes_it():
    """One evaluator of three claims of message 5: of a detection, its velocity, and an object that is not withheld."""
    message, index, score = claims_of_messages(np.array([0, 0, 1]), np.array([0, 3, 0]), np.array([1.0, 0.6, 1.0]))
    assert len(np.unique(np.column_stack([message, index]), axis=0)) == len(index) == 3 + 3 + 2 * N_OBJECTS
    assert score[(index == claim_number(np.array([3]), SPEED))].tolist() == [0.6]
    model = TruPercept(TrustParams(), 1.0)
    model.open_step(0, np.array([5, 6]), message, index, score)
    claims = [
        claim_number(np.array([3]), DETECTION),
        claim_number(np.array([0]), MISSING),
        claim_number(np.array([3]), SPEED),
    ]
    sent = messages_from_rows(0, [6] * 3, [5] * 3, np.concatenate(claims), [0.9, 1.0, -0.5], [1.0] * 3)
    model.add_evaluations(ReceivedEvaluations(sent, np.array([SERVER]), np.array([0]), -1.0))
    # weights 0.6, 0.5 and 0.6 of the values 0.9, 1 and -0.5: (0.54 + 0.5 - 0.3) / 1.7
    found = model.scores(0)
    assert found.subject.tolist() == [5] and found.n_evaluations.tolist() == [3]
    assert found.trust[0] == pytest.approx(0.74 / 1.7)


@pytest.mark.parametrize("evidence", [(), ("missing",), ("detections", "speed", "speed"), ("speed", "detections")])
def test_lists_of_evidence_that_are_refused(evidence):
    with pytest.raises(ValueError, match=r"trust\.evidence"):
        TrustParams(evidence=evidence)
