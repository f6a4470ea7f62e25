"""Denials that are weighed by the recall of the evaluator's detector: on a plane with forty vehicles."""

import numpy as np
import pytest

from cosim.config.config import resolve_data
from cosim.step.parts import recall_of
from tests.cosim.attacks.plain import play

KEY = ["at", "evaluator", "observer", "detection_index"]


def test_plausible_denials_alone_weigh_less():
    """Weights fall to r / (2 - r), with r of the detector for so many returns; nothing else changes."""
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
    np.testing.assert_allclose(rows.visibility[denied], (rows.visibility_was * r / (2 - r))[denied], rtol=1e-12)
    assert (rows.visibility_was[denied] > 0).sum() > 50 and ((r >= 0) & (r < 1)).all()


def test_a_detector_that_does_not_know_its_recall_is_refused():
    config = resolve_data({"trust": {"denials": "recall"}, "detector": {"model": "tests.parts:MixedActors"}}, "a", None)
    with pytest.raises(ValueError, match="has no method recall"):
        recall_of(config)
