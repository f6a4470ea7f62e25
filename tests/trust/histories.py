"""Calls of trust models in short, and random histories as their input."""

import numpy as np
from hypothesis import strategies as st

from tests.seeds import seeds
from trust.models import MODELS, params_of
from trust.open_steps import RejectReason
from trust.params import TrustParams
from trust.tables import SERVER, EvaluationMessages, ReceivedEvaluations

COLUMNS = (
    "trust", "weight", "n_evaluations", "newest_step", "oldest_step",
    "newest_evaluation_step", "oldest_evaluation_step", "is_evaluated",
)  # fmt: skip


def build(name, dt_s=1.0, **own):
    """A model with parameters of its own."""
    return MODELS[name](params_of(MODELS[name], TrustParams(), own), dt_s)


def messages_from_rows(step: int, evaluator, observer, detection_index, evaluation, visibility) -> EvaluationMessages:
    """Evaluations in any order, one column each, as messages in canonical order.

    Parameters
    ----------
    evaluator, observer
        Pseudonyms of who evaluates, and of the sender of the detection.
    detection_index, evaluation, visibility
        As in `EvaluationMessages`.
    """
    evaluator, observer, index = (np.asarray(a, np.int64) for a in (evaluator, observer, detection_index))
    evaluation, visibility = (np.asarray(a, float) for a in (evaluation, visibility))
    order = np.lexsort((visibility, evaluation, index, observer, evaluator))
    of_message, n = np.unique(evaluator, return_counts=True)
    ptr = np.concatenate([[0], np.cumsum(n)])
    return EvaluationMessages(
        step, of_message, ptr, observer[order], index[order], evaluation[order], visibility[order]
    )


def open_step(model, step, scores):
    """Scores by pseudonym, a list each."""
    pseudonyms = np.array(sorted(scores))
    lists = [scores[v] for v in sorted(scores)]
    model.open_step(
        step,
        pseudonyms,
        np.repeat(np.arange(pseudonyms.size), [len(s) for s in lists]),
        np.concatenate([np.arange(len(s)) for s in lists]).astype(int),
        np.concatenate(lists).astype(float),
    )


def received_by(step, rows, holder=SERVER, eta=-1.0):
    """Rows (evaluator, observer, detection_index, evaluation, visibility), received by one holder."""
    messages = messages_from_rows(step, *np.array(rows, float).reshape(-1, 5).T)
    n = messages.evaluator.size
    return ReceivedEvaluations(messages, np.full(n, holder), np.arange(n), eta)


def add(model, step, rows, holder=SERVER):
    model.add_evaluations(received_by(step, rows, holder))


def values_of(scores, subjects, holder=SERVER):
    """Trust of a holder in subjects; 1/2 where it has none."""
    subjects = np.asarray(subjects)
    row, is_there = scores.rows_of(np.full(len(subjects), holder), subjects)
    found = np.full(len(subjects), 0.5)
    found[is_there] = scores.trust[row[is_there]]
    return found


def trust_of(model, subject, now=None, holder=SERVER):
    return values_of(model.scores(now), [subject], holder)[0]


def rejected(model):
    return {r.name: int(n) for r, n in zip(RejectReason, model.rejected, strict=True) if n}


def assert_same(a, b, names=("holder", "subject", "uncertainty", *COLUMNS)):
    """Trust scores that are equal bit for bit."""
    for name in names:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def history(seed, n_steps, n_vehicles):
    """Random detections and evaluations of a run: scores by step and pseudonym, evaluation rows by step."""
    rng = np.random.default_rng(seed)
    scores, rows = [], []
    pseudonyms = np.sort(rng.choice(1000, n_vehicles, replace=False))
    for _ in range(n_steps):
        here = pseudonyms[rng.random(n_vehicles) < 0.8] if n_vehicles > 1 else pseudonyms
        if not here.size:
            here = pseudonyms[:1]
        scores.append({int(v): rng.random(rng.integers(0, 5)) for v in here})
        evaluated = []
        for evaluator in here:
            for observer in here:
                for index in range(len(scores[-1][int(observer)])):
                    if rng.random() < 0.6:
                        visibility = rng.choice([0.0, 1.0, rng.random()])
                        evaluation = rng.choice([-1.0, 0.0, 1.0, rng.random()])
                        evaluated.append((int(evaluator), int(observer), index, evaluation, visibility))
        rows.append(evaluated)
    return scores, rows


histories = st.builds(history, seeds, st.integers(1, 8), st.integers(1, 5))
"""Runs of up to eight steps and five vehicles."""


def play(models, frames, rows, scores_too=False):
    """A history given to models of any kind, in lockstep: the evaluations of each step, right away.

    Returns
    -------
    The scores of each model after each step, by model, if asked for.
    """
    out = [[] for _ in models]
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        for model in models:
            open_step(model, step, frame)
        received = received_by(step, evaluated)
        for model in models:
            model.add_evaluations(received)
        if scores_too:
            for model, scores in zip(models, out, strict=True):
                scores.append(model.scores())
    return out
