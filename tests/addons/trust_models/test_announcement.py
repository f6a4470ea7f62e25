"""Ratings that age, in steps whose number times their length is rounded down."""

import pytest

from tests.trust.histories import open_step, received_by
from trust.models import MODELS, params_of
from trust.params import TrustParams


def test_a_rating_counts_until_its_validity():
    """90 steps of 0.7 s are 63 s, but 62.99... in floating point. A rating of 1 counts 1/90 in the step before."""
    params = params_of(MODELS["announcement"], TrustParams(), {"validity_s": 63.0, "grace_s": 1000.0})
    model = MODELS["announcement"](params, 0.7)
    open_step(model, 0, {1: [0.9], 2: []})
    model.add_evaluations(received_by(0, [(2, 1, 0, 1.0, 1.0)]))
    assert model.scores(89).trust == pytest.approx([1 / 90])
    assert model.scores(90).trust.size == 0
