"""Laws of the trust model `trupercept`, and the slow transcription."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trust.histories import COLUMNS, add, assert_same, histories, open_step, received_by
from tests.verification import paper
from trust.models.trupercept import TruPercept
from trust.open_steps import RejectReason
from trust.params import TrustParams
from trust.tables import SERVER, ReceivedEvaluations, messages_from_rows


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
            ours = scores.trust_of(np.array([SERVER]), np.array([v]), 0.5)[0]
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


@given(world=histories, f=st.integers(1, 4))
@settings(max_examples=60)
def test_evaluators_of_shared_windows(world, f):
    """Windows that share their evidence, one without end among them, count evaluators as each would alone."""
    frames, rows = world
    params = [TrustParams(freshness_s=x, grace_s=2.0) for x in (1.0, float(f), "off")]
    shared, alone = TruPercept.build_shared(params, 1.0), [TruPercept(p, 1.0) for p in params]
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        for model in (*shared, *alone):
            open_step(model, step, frame)
        received = received_by(step, evaluated)
        for model in (*shared, *alone):
            model.add_evaluations(received)
        for one, other in zip(shared, alone, strict=True):
            assert one.scores().n_evaluators.tolist() == other.scores().n_evaluators.tolist()
    ever = {}
    for evaluated in rows:
        for who, subject, _, _, phi in evaluated:
            if phi > 0 and who != subject:
                ever.setdefault(subject, set()).add(who)
    last = shared[2].scores()
    for subject, n, evaluated in zip(last.subject.tolist(), last.n_evaluators, last.is_evaluated, strict=True):
        if evaluated:
            assert n == len(ever[subject])


@given(world=histories, seed=st.integers(0, 2**32 - 1), f=st.integers(2, 8))
@settings(max_examples=80)
def test_neither_order_nor_delay_nor_duplicates_matter(world, seed, f):
    """Messages in any order and batching, up to f - 1 steps late, some of them twice: bit by bit the same."""
    frames, rows = world
    rng = np.random.default_rng(seed)
    params = TrustParams(freshness_s=float(f))
    tidy, messy = TruPercept(params, 1.0), TruPercept(params, 1.0)
    in_flight, n_rows, n_added = [], sum(map(len, rows)), 0
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        open_step(tidy, step, frame)
        add(tidy, step, evaluated)
        open_step(messy, step, frame)
        for evaluator in {row[0] for row in evaluated}:
            message = [row for row in evaluated if row[0] == evaluator]
            for _ in range(1 + (rng.random() < 0.2)):
                in_flight.append((step + rng.integers(0, f), step, message))
        now = [m for m in in_flight if m[0] <= step or step == len(rows) - 1]
        in_flight = [m for m in in_flight if m not in now]
        rng.shuffle(now)
        while now:
            size = int(rng.integers(1, len(now) + 1))
            batch, now = now[:size], now[size:]
            for generation in {m[1] for m in batch}:
                in_batch = {m[2][0][0]: m[2] for m in batch if m[1] == generation}
                added = [row for message in in_batch.values() for row in message]
                n_added += len(added)
                add(messy, generation, added)
    assert_same(tidy.scores(), messy.scores())
    assert messy.rejected[RejectReason.DUPLICATE] == n_added - n_rows
    assert messy.rejected.sum() == messy.rejected[RejectReason.DUPLICATE]


@given(world=histories, seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_renaming_the_pseudonyms_permutes_the_trust(world, seed):
    frames, rows = world
    new = np.random.default_rng(seed).permutation(1000).tolist()
    a, b = TruPercept(TrustParams(), 1.0), TruPercept(TrustParams(), 1.0)
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        open_step(a, step, frame)
        add(a, step, evaluated)
        open_step(b, step, {new[v]: s for v, s in frame.items()})
        add(b, step, [(new[i], new[j], *rest) for i, j, *rest in evaluated])
    x, y = a.scores(), b.scores()
    at, found = y.rows_of(x.holder, np.array(new)[x.subject])
    assert found.all()
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(y, name)[at], getattr(x, name))


@given(world=histories)
@settings(max_examples=40)
def test_an_evaluator_without_visibility_changes_nothing(world):
    """One more evaluator with Phi = 0 on everything; every detection has its detector's own record."""
    frames, rows = world
    a, b = TruPercept(TrustParams(), 1.0), TruPercept(TrustParams(), 1.0)
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        own = [(v, v, k, 1, 1) for v, s in frame.items() for k in range(len(s))]
        evaluated = own + [r for r in evaluated if r[0] != r[1]]
        for model in (a, b):
            open_step(model, step, {**frame, 2000: []})
            add(model, step, evaluated)
        add(b, step, [(2000, v, k, -1, 0) for v, s in frame.items() for k in range(len(s))])
    assert_same(a.scores(), b.scores())


@given(world=histories, f=st.integers(1, 5))
@settings(max_examples=40)
def test_two_half_steps_equal_one(world, f):
    """Half as long a step, every second one empty; and half of each step's messages a step later."""
    frames, rows = world
    params = TrustParams(freshness_s=float(f))
    one, half = TruPercept(params, 1.0), TruPercept(params, 0.5)
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        open_step(one, step, frame)
        add(one, step, evaluated)
        open_step(half, 2 * step, frame)
        add(half, 2 * step, [row for row in evaluated if row[0] % 2])
        open_step(half, 2 * step + 1, {v: [] for v in frame})
        add(half, 2 * step, [row for row in evaluated if not row[0] % 2])
        assert_same(one.scores(), half.scores(), ("subject", "trust", "weight", "n_evaluations", "is_evaluated"))


@given(world=histories, seed=st.integers(0, 2**32 - 1))
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
