"""Denials that are weighed by the recall of the evaluator's detector: on a plane with forty vehicles."""

import numpy as np

from cosim.config.config import resolve_data
from cosim.step.parts import recall_of
from tests.cosim.attacks.plain import play

KEY = ["at", "evaluator", "observer", "detection_index"]


def test_denials_weigh_what_the_evaluator_can_know():
    """Of a permitted box the weight is (1 - q) / (1 + q) with q = 1 - visibility x recall, or 0 where q is above 1/2.

    Nothing else changes.
    """
    by_visibility, by_recall = (
        play(n_steps=1, tables=("evaluations", "detections"), trust={"denials": how})
        for how in ("visibility", "recall")
    )
    rows = by_recall["evaluations"].merge(by_visibility["evaluations"], on=KEY, suffixes=("", "_was"))
    rows = rows.merge(by_recall["detections"][["at", "observer", "detection_index", "class"]], on=["at", *KEY[2:]])
    assert len(rows) == len(by_recall["evaluations"]) > 1000
    np.testing.assert_array_equal(rows.evaluation, rows.evaluation_was)
    denied = ~rows.matched & rows.plausible
    np.testing.assert_array_equal(rows.visibility[~denied], rows.visibility_was[~denied])
    recall = recall_of(resolve_data({"trust": {"denials": "recall"}}, "a test", None))
    r = recall(rows.n_points.to_numpy(), rows["class"].to_numpy(), np.full(len(rows), 30.0))
    q = 1.0 - rows.visibility_was * r
    weight = ((1.0 - q) / (1.0 + q)).where(q <= 0.5, 0.0)
    np.testing.assert_allclose(rows.visibility[denied], weight[denied], rtol=1e-12)
    assert (q[denied] <= 0.5).sum() > 10 and ((q > 0.5) & (q < 1))[denied].sum() > 10


def test_a_detector_that_does_not_know_its_recall_misses_nothing():
    config = resolve_data({"trust": {"denials": "recall"}, "detector": {"model": "tests.parts:MixedActors"}}, "a", None)
    assert recall_of(config)(np.array([0, 7]), np.zeros(2, np.uint8), np.ones(2)).tolist() == [1.0, 1.0]
