"""Ledgers in a few words, and random histories to feed them."""

import numpy as np
from hypothesis import strategies as st

from trust.ledger import SERVER
from trust.page import Refusal
from trust.tables import told_from_rows


def announce(ledger, step, scores):
    """Scores by vehicle id, a list each."""
    ids = np.array(sorted(scores))
    lists = [scores[v] for v in sorted(scores)]
    ledger.announce(
        step,
        ids,
        np.repeat(np.arange(ids.size), [len(s) for s in lists]),
        np.concatenate([np.arange(len(s)) for s in lists]).astype(int),
        np.concatenate(lists).astype(float),
    )


def tell(ledger, step, rows, holder=SERVER):
    """Rows (evaluator, sender, k, e, phi), to one holder."""
    said = told_from_rows(step, *np.array(rows, float).reshape(-1, 5).T)
    n = said.evaluator.size
    ledger.enter(said, np.full(n, holder), np.arange(n))


def trust_of(ledger, subject, now=None, holder=SERVER):
    return ledger.standing(now).trust_of(np.array([holder]), np.array([subject]), 0.5)[0]


def refused(ledger):
    return {r.name: int(n) for r, n in zip(Refusal, ledger.refused, strict=True) if n}


def history(seed, n_steps, n_vehicles):
    """Random detections and verdicts of a run: scores by step and vehicle, verdict rows by step."""
    rng = np.random.default_rng(seed)
    scores, rows = [], []
    ids = np.sort(rng.choice(1000, n_vehicles, replace=False))
    for _ in range(n_steps):
        here = ids[rng.random(n_vehicles) < 0.8] if n_vehicles > 1 else ids
        if not here.size:
            here = ids[:1]
        scores.append({int(v): rng.random(rng.integers(0, 5)) for v in here})
        said = []
        for evaluator in here:
            for sender in here:
                for k in range(len(scores[-1][int(sender)])):
                    if rng.random() < 0.6:
                        phi = rng.choice([0.0, 1.0, rng.random()])
                        e = rng.choice([-1.0, 0.0, 1.0, rng.random()])
                        said.append((int(evaluator), int(sender), k, e, phi))
        rows.append(said)
    return scores, rows


histories = st.builds(history, st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 5))
"""Runs of up to eight steps and five vehicles."""
