"""Measures the speed of matching, evaluation, trust and fusion on a synthetic street."""

from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy import ndarray

from tests.bench.timing import least_s
from trust.evaluation import evaluate
from trust.fusion import SensorEvidence, fuse
from trust.matching import match
from trust.models.trupercept import TruPercept
from trust.params import TrustParams
from trust.tables import SERVER, FusionInput, ObjectLists, ReceivedEvaluations, SenderTrust, SentDetections, as_messages

N_SEEN, STRIDE, N_CONSIDERED, N_RECEIVED = 20, 5, 4, 10
"""Objects that a vehicle sees, objects between two vehicles, vehicles considered and received on each side."""

Pairs = tuple[ndarray, ndarray, ndarray]


def street(n_vehicles: int) -> tuple[SentDetections, Pairs, ObjectLists, SenderTrust]:
    """A ring of vehicles. Each sees `N_SEEN` objects; a quarter of them is not seen by the vehicle before it."""
    v, k = np.divmod(np.arange(n_vehicles * N_SEEN), N_SEEN)
    score = 0.5 + 0.5 * ((v * 7919 + k * 104729) % 1000) / 1000
    table = SentDetections(v, k, ((v * STRIDE + k) % 4).astype(np.uint8), score, np.zeros(v.size, bool))
    # object number v * STRIDE + k: the same one has number k - d * STRIDE with the d-th vehicle ahead
    ahead = np.arange(1, (N_SEEN - 1) // STRIDE + 1)[:, None]
    other = k - ahead * STRIDE
    i = np.broadcast_to(np.arange(v.size), other.shape)[other >= 0]
    j = ((v + ahead) % n_vehicles * N_SEEN + other)[other >= 0]
    pairs = (np.minimum(i, j), np.maximum(i, j), 0.2 + 0.8 * (i * 31 + j * 17) % 97 / 97)

    def around(n_each: int) -> ndarray:
        """The neighbours of each vehicle without itself, ascending."""
        off = np.setdiff1d(np.arange(-n_each, n_each + 1), [0])
        return np.sort((np.arange(n_vehicles)[:, None] + off) % n_vehicles, axis=1)

    who = np.hstack([np.arange(n_vehicles)[:, None], around(N_CONSIDERED)])
    member = (who[:, :, None] * N_SEEN + np.arange(N_SEEN)).reshape(-1)
    per_list = who.shape[1] * N_SEEN
    lists = ObjectLists(np.arange(n_vehicles + 1) * per_list, member, np.arange(n_vehicles))
    sender = around(N_RECEIVED)
    ptr = np.arange(n_vehicles + 1) * sender.shape[1]
    return table, pairs, lists, SenderTrust(ptr, sender.reshape(-1), np.full(sender.size, 0.7))


def bench(n_vehicles: int = 1000, repeats: int = 7) -> list[tuple[str, float, str]]:
    """Measure with all threads that Numba may use. Rows of (what, figure, unit)."""
    params = TrustParams()
    table, pairs, lists, sender_trust = street(n_vehicles)
    m = lists.member.size
    n_points, plausible = np.full(m, 30), np.ones(m, bool)

    def match_and_evaluate():
        return evaluate(lists, match(lists, table, pairs, params), table, n_points, plausible, params)

    groups, evaluations = match(lists, table, pairs, params), match_and_evaluate()
    n_groups = groups.seeds().size
    evidence = SensorEvidence(np.zeros(n_groups, np.int64), np.ones(n_groups, bool), np.ones(n_groups, bool))
    distance = np.full(len(table), 20.0)
    pseudonyms = np.arange(n_vehicles)
    receiver = np.repeat(pseudonyms, np.diff(sender_trust.ptr))

    def step_s(models: list[TruPercept], n_steps: int, holder: ndarray, message_row: ndarray) -> float:
        """Shortest time to add one step's received evaluations and to read all scores once [s]."""
        times = []
        for step in range(n_steps):
            messages = as_messages(step, pseudonyms, lists, table, evaluations)
            start = perf_counter()
            received = ReceivedEvaluations(messages, holder, message_row)
            for model in models:
                model.open_step(step, pseudonyms, table.message, table.detection_index, table.score)
            for model in models:
                model.add_evaluations(received)
            for model in models:
                model.scores()
            times.append(perf_counter() - start)
        return min(times[len(times) // 2 :])

    def windows(n: int) -> list[TruPercept]:
        return TruPercept.build_shared([replace(params, freshness_s=float(30 - i)) for i in range(n)], 1.0)

    central = np.full(n_vehicles, SERVER), pseudonyms
    local = receiver, sender_trust.message
    n_local = int(np.diff(lists.ptr)[sender_trust.message].sum())
    given = FusionInput(lists, groups, table, lists, evaluations, evaluations)
    fused_s = least_s(
        lambda: fuse(given, sender_trust, evidence, distance, params),
        repeats,
        perf_counter,
    )
    return [
        ("evaluations, from IoU pairs through matching", m / least_s(match_and_evaluate, repeats, perf_counter), "1/s"),
        ("evaluations added on the server, scores read once", m / step_s(windows(1), repeats, *central), "1/s"),
        ("evaluations added in vehicles, scores read once", n_local / step_s(windows(1), repeats, *local), "1/s"),
        ("server, a window of 30 steps", 1e3 * step_s(windows(1), 40, *central), "ms per step"),
        ("server, 20 windows of 11 to 30 steps", 1e3 * step_s(windows(20), 40, *central), "ms per step"),
        ("vehicles, a window of 30 steps", 1e3 * step_s(windows(1), 40, *local), "ms per step"),
        ("vehicles, 20 windows of 11 to 30 steps", 1e3 * step_s(windows(20), 40, *local), "ms per step"),
        ("accumulations of the fusion", (n_local + m) / fused_s, "1/s"),
    ]
