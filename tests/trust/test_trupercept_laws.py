"""Laws of the trust model `trupercept`, and the slow transcription."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.seeds import seeds
from tests.trust.histories import COLUMNS, add, histories, messages_from_rows, open_step, values_of
from tests.verification import paper
from trust.models.trupercept import TruPercept
from trust.params import TrustParams
from trust.tables import SERVER, ReceivedEvaluations


@given(
    world=histories,
    f=st.integers(1, 6),
    unseen=st.sampled_from(["zero", "skip"]),
    weighting=st.sampled_from(["score", "one"]),
    window=st.sampled_from(["half_open", "closed"]),
)
@settings(max_examples=150)
def test_twin(world, f, unseen, weighting, window):
    frames, rows = world
    model = TruPercept(TrustParams(freshness_s=float(f), unseen=unseen, weighting=weighting, window=window), 1.0)
    by_name, records = {}, {}
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        open_step(model, step, frame)
        add(model, step, evaluated)
        for v, of_vehicle in frame.items():
            by_name |= {(step, v, k): s for k, s in enumerate(of_vehicle)}
        for evaluator, observer, k, e, phi in evaluated:
            records.setdefault((step, observer, k), {})[evaluator] = (e, phi)
        steps = f + (window == "closed")
        scores = model.scores()
        assert np.all((scores.trust >= 0) & (scores.trust <= 1))
        for v in {v for frame in frames for v in frame}:
            expected = paper.vehicle_trust(
                v, step, steps, by_name, records, 0.5, unseen == "skip", weighting == "score"
            )
            ours = values_of(scores, [v])[0]
            assert ours == pytest.approx(expected, abs=1e-9)  # sums of fixed-point numbers
        assert_evaluators(scores, step - steps, by_name, records, weighting)


def assert_evaluators(scores, after, by_name, records, weighting):
    """Newest and oldest evaluation by another that could see, their number and that of their authors, in plain loops.

    Detections of a step whose weights sum to 0 are no part of the value.
    """
    for row, subject in enumerate(scores.subject.tolist()):
        made = []
        for step in range(after + 1, scores.step + 1):
            of_step = {k: said for (s, v, k), said in records.items() if s == step and v == subject}
            if any(weighting == "one" or by_name[step, subject, k] > 0 for k in of_step):
                made += [(step, who) for said in of_step.values() for who, (_, phi) in said.items()
                         if who != subject and phi > 0]  # fmt: skip
        assert scores.n_evaluations[row] == len(made) and scores.is_evaluated[row] == bool(made)
        assert scores.n_evaluators[row] == len({who for _, who in made})
        if made:
            assert scores.newest_evaluation_step[row] == max(made)[0]
            assert scores.oldest_evaluation_step[row] == min(made)[0]


@given(world=histories, seed=seeds)
@settings(max_examples=40)
def test_local_scores_equal_as_many_central_ones(world, seed):
    """Scores of each holder equal those of a server that received the same messages."""
    frames, rows = world
    rng = np.random.default_rng(seed)
    vehicles = sorted({v for frame in frames for v in frame})
    together = TruPercept(TrustParams(), 1.0)
    alone = {v: TruPercept(TrustParams(), 1.0) for v in vehicles}
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        open_step(together, step, frame)
        for model in alone.values():
            open_step(model, step, frame)
        messages = messages_from_rows(step, *np.array(evaluated, float).reshape(-1, 5).T)
        arrived = np.argwhere(rng.random((len(vehicles), messages.evaluator.size)) < 0.6)
        together.add_evaluations(ReceivedEvaluations(messages, np.array(vehicles)[arrived[:, 0]], arrived[:, 1]))
        for row, v in enumerate(vehicles):
            message_row = arrived[arrived[:, 0] == row, 1]
            alone[v].add_evaluations(ReceivedEvaluations(messages, np.full(message_row.size, SERVER), message_row))
    all_scores = together.scores()
    for v, model in alone.items():
        mine = all_scores.holder == v
        one = model.scores()
        for name in ("subject", *COLUMNS):
            np.testing.assert_array_equal(getattr(all_scores, name)[mine], getattr(one, name))
