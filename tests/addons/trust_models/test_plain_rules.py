"""The rules of one line, against sums over dictionaries."""

import numpy as np
import pytest

from tests.trust.histories import add, build, history, play
from tests.verification.trust_models import evidence
from trust.claims import claims_of_messages
from trust.models import MODELS, params_of
from trust.params import TrustParams


def after(name, seed):
    """Trust by vehicle at the end of a random stream, and the stream."""
    frames, rows = history(seed, 1 + seed % 6, 2 + seed % 4)
    model = build(name)
    play([model], frames, rows)
    scores = model.scores()
    return dict(zip(scores.subject.tolist(), scores.trust.tolist(), strict=True)), frames, rows


@pytest.mark.parametrize("seed", range(30))
def test_share_that_is_only_denied(seed):
    trust, _, rows = after("denied_share", seed)
    said = {}
    for step, of_step in enumerate(rows):
        for _, sender, index, pos, neg in evidence(of_step):
            of = said.setdefault(sender, {}).setdefault((step, index), [0, 0])
            of[0] += pos
            of[1] += neg
    for sender, value in trust.items():
        evidence_of = said.get(sender, {}).values()
        judged = [(pos, neg) for pos, neg in evidence_of if pos or neg]
        denied = sum(not pos for pos, _ in judged)
        assert value == (1 - denied / len(judged) if judged else 0.5)


@pytest.mark.parametrize("seed", range(30))
def test_mean_score(seed):
    trust, frames, _ = after("mean_score", seed)
    for sender, value in trust.items():
        sent = [score for frame in frames for score in frame.get(sender, [])]
        assert value == pytest.approx(sum(sent) / len(sent) if sent else 0.5)


def test_mean_score_is_that_of_detections_alone():
    """Vehicle 1 sends scores 0.95, 0.90, 0.92 and 0.97, and claims that it withholds nothing. The mean is 0.935."""
    params = params_of(MODELS["mean_score"], TrustParams(evidence=("detections", "missing")), {})
    model = MODELS["mean_score"](params, 1.0)
    sent = claims_of_messages(np.zeros(4, int), np.arange(4), np.array([0.95, 0.90, 0.92, 0.97]))
    model.open_step(0, np.array([1, 2]), *sent)
    add(model, 0, [(2, 1, 0, 1.0, 1.0)])
    assert model.scores().trust == pytest.approx([0.935])
