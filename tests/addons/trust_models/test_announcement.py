"""Ratings that age, in steps whose number times their length is rounded down."""

import pytest

from tests.trust.histories import add, build, open_step


def test_a_rating_counts_until_its_validity():
    """90 steps of 0.7 s are 63 s, but 62.99... in floating point. A rating of 1 counts 1/90 in the step before."""
    model = build("announcement", 0.7, validity_s=63.0, grace_s=1000.0)
    open_step(model, 0, {1: [0.9], 2: []})
    add(model, 0, [(2, 1, 0, 1.0, 1.0)])
    assert model.scores(89).trust == pytest.approx([1 / 90])
    assert model.scores(90).trust.size == 0
