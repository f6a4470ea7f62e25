"""Laws of the ledger, and the slow transcription beside it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trust.ledgers import announce, histories, tell
from tests.verification import paper
from trust.ledger import SERVER, Ledger
from trust.page import Refusal
from trust.params import TrustParams
from trust.tables import told_from_rows


@given(
    world=histories,
    f=st.integers(1, 6),
    unseen=st.sampled_from(["zero", "skip"]),
    weighting=st.sampled_from(["score", "one"]),
    window=st.sampled_from(["half_open", "closed"]),
)
@settings(max_examples=150, deadline=None)
def test_twin(world, f, unseen, weighting, window):
    scores, rows = world
    ledger = Ledger(TrustParams(freshness_s=float(f), unseen=unseen, weighting=weighting, window=window), 1.0)
    by_name, records = {}, {}
    for step, (frame, said) in enumerate(zip(scores, rows, strict=True)):
        announce(ledger, step, frame)
        tell(ledger, step, said)
        for v, of_vehicle in frame.items():
            by_name |= {(step, v, k): s for k, s in enumerate(of_vehicle)}
        for evaluator, sender, k, e, phi in said:
            records.setdefault((step, sender, k), {})[evaluator] = (e, phi)
        steps = f + (window == "closed")
        standing = ledger.standing()
        assert np.all((standing.trust >= 0) & (standing.trust <= 1))
        for v in {v for frame in scores for v in frame}:
            expected = paper.vehicle_trust(
                v, step, steps, by_name, records, 0.5, unseen == "skip", weighting == "score"
            )
            ours = standing.trust_of(np.array([SERVER]), np.array([v]), 0.5)[0]
            assert ours == pytest.approx(expected, abs=1e-11)


@given(world=histories, seed=st.integers(0, 2**32 - 1), f=st.integers(2, 8))
@settings(max_examples=80, deadline=None)
def test_neither_order_nor_delay_nor_duplicates_matter(world, seed, f):
    """Verdicts in any order and batching, up to f - 1 steps late, some of them twice: bit by bit the same."""
    scores, rows = world
    rng = np.random.default_rng(seed)
    params = TrustParams(freshness_s=float(f))
    tidy, messy = Ledger(params, 1.0), Ledger(params, 1.0)
    in_flight, n_twice = [], 0
    for step, (frame, said) in enumerate(zip(scores, rows, strict=True)):
        announce(tidy, step, frame)
        tell(tidy, step, said)
        announce(messy, step, frame)
        for row in said:
            for _ in range(1 + (rng.random() < 0.2)):
                in_flight.append((step + rng.integers(0, f), step, row))
        now = [m for m in in_flight if m[0] <= step or step == len(rows) - 1]
        in_flight = [m for m in in_flight if m not in now]
        n_twice += len(now)
        rng.shuffle(now)
        while now:
            size = int(rng.integers(1, len(now) + 1))
            batch, now = now[:size], now[size:]
            for generation in {m[1] for m in batch}:
                tell(messy, generation, [m[2] for m in batch if m[1] == generation])
    ours, theirs = tidy.standing(), messy.standing()
    for name in ours.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert messy.refused[Refusal.DUPLICATE] == n_twice - sum(map(len, rows))
    assert messy.refused.sum() == messy.refused[Refusal.DUPLICATE]


@given(world=histories, seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_renaming_the_vehicles_permutes_the_trust(world, seed):
    scores, rows = world
    new = np.random.default_rng(seed).permutation(1000).tolist()
    a, b = Ledger(TrustParams(), 1.0), Ledger(TrustParams(), 1.0)
    for step, (frame, said) in enumerate(zip(scores, rows, strict=True)):
        announce(a, step, frame)
        tell(a, step, said)
        announce(b, step, {new[v]: s for v, s in frame.items()})
        tell(b, step, [(new[i], new[j], *rest) for i, j, *rest in said])
    x, y = a.standing(), b.standing()
    at, found = y.rows_of(x.holder, np.array(new)[x.subject])
    assert found.all()
    for name in ("trust", "weight", "n_verdicts", "newest_step", "oldest_step"):
        np.testing.assert_array_equal(getattr(y, name)[at], getattr(x, name))


@given(world=histories)
@settings(max_examples=40, deadline=None)
def test_who_sees_nothing_changes_nothing(world):
    """One more evaluator with Phi = 0 on everything; every detection has its detector's own record."""
    scores, rows = world
    a, b = Ledger(TrustParams(), 1.0), Ledger(TrustParams(), 1.0)
    for step, (frame, said) in enumerate(zip(scores, rows, strict=True)):
        own = [(v, v, k, 1, 1) for v, s in frame.items() for k in range(len(s))]
        said = own + [r for r in said if r[0] != r[1]]
        for ledger in (a, b):
            announce(ledger, step, {**frame, 2000: []})
            tell(ledger, step, said)
        tell(b, step, [(2000, v, k, -1, 0) for v, s in frame.items() for k in range(len(s))])
    x, y = a.standing(), b.standing()
    for name in x.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(x, name), getattr(y, name))


@given(world=histories, f=st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_two_half_steps_equal_one(world, f):
    """Half as long a step, every second one empty; and each step's verdicts in two halves."""
    scores, rows = world
    params = TrustParams(freshness_s=float(f))
    one, half = Ledger(params, 1.0), Ledger(params, 0.5)
    for step, (frame, said) in enumerate(zip(scores, rows, strict=True)):
        announce(one, step, frame)
        tell(one, step, said)
        announce(half, 2 * step, frame)
        tell(half, 2 * step, said[::2])
        announce(half, 2 * step + 1, {v: [] for v in frame})
        tell(half, 2 * step, said[1::2])
        x, y = one.standing(), half.standing()
        for name in ("subject", "trust", "weight", "n_verdicts"):
            np.testing.assert_array_equal(getattr(x, name), getattr(y, name))


@given(world=histories, seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_local_ledgers_are_as_many_central_ones(world, seed):
    """Every vehicle's own ledger is what a server would make of the messages that this vehicle heard."""
    scores, rows = world
    rng = np.random.default_rng(seed)
    vehicles = sorted({v for frame in scores for v in frame})
    together = Ledger(TrustParams(), 1.0)
    alone = {v: Ledger(TrustParams(), 1.0) for v in vehicles}
    for step, (frame, said) in enumerate(zip(scores, rows, strict=True)):
        announce(together, step, frame)
        for ledger in alone.values():
            announce(ledger, step, frame)
        told = told_from_rows(step, *np.array(said, float).reshape(-1, 5).T)
        heard = np.argwhere(rng.random((len(vehicles), told.evaluator.size)) < 0.6)
        together.enter(told, np.array(vehicles)[heard[:, 0]], heard[:, 1])
        for row, v in enumerate(vehicles):
            voice = heard[heard[:, 0] == row, 1]
            alone[v].enter(told, np.full(voice.size, SERVER), voice)
    all_of_them = together.standing()
    for v, ledger in alone.items():
        mine = all_of_them.holder == v
        one = ledger.standing()
        for name in ("subject", "trust", "weight", "n_verdicts", "newest_step", "oldest_step"):
            np.testing.assert_array_equal(getattr(all_of_them, name)[mine], getattr(one, name))
