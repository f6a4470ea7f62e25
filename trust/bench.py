"""Speed of the trust model on this machine, on a synthetic street where all vehicles see much the same."""

from collections.abc import Callable
from time import perf_counter

import numpy as np
from numpy import ndarray

from trust.evaluation import evaluate
from trust.fusion import Heard, Sight, fuse
from trust.ledger import SERVER, Ledger
from trust.matching import match
from trust.params import TrustParams
from trust.tables import Detections, Views, told

N_SEEN, STRIDE, N_NEAR, N_HEARD = 20, 5, 4, 10
"""Objects a vehicle sees, objects to the next vehicle, vehicles considered and heard each side."""

Pairs = tuple[ndarray, ndarray, ndarray]


def street(n_vehicles: int) -> tuple[Detections, Pairs, Views, Heard]:
    """A ring of vehicles; each sees `N_SEEN` objects, a quarter of which is new from vehicle to vehicle."""
    v, k = np.divmod(np.arange(n_vehicles * N_SEEN), N_SEEN)
    score = 0.5 + 0.5 * ((v * 7919 + k * 104729) % 1000) / 1000
    no = np.zeros(v.size, bool)
    table = Detections(v, k, ((v * STRIDE + k) % 4).astype(np.uint8), score, no, no)
    # object number v * STRIDE + k: the same one has number k - d * STRIDE with the d-th vehicle ahead
    ahead = np.arange(1, (N_SEEN - 1) // STRIDE + 1)[:, None]
    other = k - ahead * STRIDE
    i = np.broadcast_to(np.arange(v.size), other.shape)[other >= 0]
    j = ((v + ahead) % n_vehicles * N_SEEN + other)[other >= 0]
    pairs = (np.minimum(i, j), np.maximum(i, j), 0.2 + 0.8 * (i * 31 + j * 17) % 97 / 97)

    def around(n_each: int) -> ndarray:
        """Per vehicle its neighbours, ascending, itself left out."""
        off = np.setdiff1d(np.arange(-n_each, n_each + 1), [0])
        return np.sort((np.arange(n_vehicles)[:, None] + off) % n_vehicles, axis=1)

    who = np.hstack([np.arange(n_vehicles)[:, None], around(N_NEAR)])
    member = (who[:, :, None] * N_SEEN + np.arange(N_SEEN)).reshape(-1)
    per_view = who.shape[1] * N_SEEN
    views = Views(np.arange(n_vehicles + 1) * per_view, member, np.arange(n_vehicles))
    ears = around(N_HEARD)
    heard = Heard(np.arange(n_vehicles + 1) * ears.shape[1], ears.reshape(-1), np.full(ears.size, 0.7))
    return table, pairs, views, heard


def _best(work: Callable[[], object], repeats: int) -> float:
    """Shortest time of a few [s], after one run that compiles."""
    work()
    times = []
    for _ in range(repeats):
        start = perf_counter()
        work()
        times.append(perf_counter() - start)
    return min(times)


def bench(n_vehicles: int = 1000, repeats: int = 7) -> list[tuple[str, float, str]]:
    """What is measured, figure, unit; all threads that Numba may use."""
    params = TrustParams()
    table, pairs, views, heard = street(n_vehicles)
    m = views.member.size
    n_points, plausible = np.full(m, 30), np.ones(m, bool)

    def judge():
        return evaluate(views, match(views, table, pairs, params), table, n_points, plausible, params)

    groups, verdicts = match(views, table, pairs, params), judge()
    n_groups = groups.seeds().size
    sight = Sight(np.zeros(n_groups, np.int64), np.ones(n_groups, bool), np.ones(n_groups, bool))
    distance = np.full(len(table), 20.0)
    ids = np.arange(n_vehicles)
    said = told(0, ids, views, table, verdicts)
    ear = np.repeat(ids, np.diff(heard.ptr))

    def judge_s() -> float:
        return _best(judge, repeats)

    def book(holder: ndarray, voice: ndarray) -> float:
        """Shortest time to enter one step's deliveries and to read everybody's trust [s]."""
        times = []
        ledger = Ledger(params, 1.0)
        for step in range(repeats + 1):
            ledger.announce(step, ids, table.sender, table.k, table.score)
            now = told(step, ids, views, table, verdicts)
            start = perf_counter()
            ledger.enter(now, holder, voice)
            ledger.standing()
            times.append(perf_counter() - start)
        return min(times[1:])

    central = book(np.full(n_vehicles, SERVER), ids)
    local = book(ear, heard.vehicle)
    fused = _best(lambda: fuse(views, groups, table, views, verdicts, heard, sight, distance, params), repeats)
    n_local = int(np.diff(said.ptr)[heard.vehicle].sum())
    return [
        ("verdicts, from IoU pairs through matching and evaluation", m / judge_s(), "1/s"),
        ("updates of the central ledger, read once", m / central, "1/s"),
        ("updates of the vehicles' own ledgers, read once", n_local / local, "1/s"),
        ("accumulations of the fusion", (n_local + m) / fused, "1/s"),
    ]
