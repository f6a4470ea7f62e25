"""How fast the radio is on this machine."""

from time import perf_counter

import numpy as np
from numpy import ndarray

from cosim import rng
from cosim.v2x import csma, disk
from cosim.v2x.channel import AccessParams, Links, Packets, State, play
from cosim.v2x.exchange import neighbours
from cosim.v2x.links import between, within
from cosim.v2x.obstruction import Sight, Walls
from cosim.v2x.propagation import PropagationParams
from cosim.v2x.radio import RadioParams
from cosim.v2x.reception import ReceiverParams

WINDOW_NS = 100_000_000
_ROUNDS = 15


def blocks(side_m: float) -> list[tuple[ndarray, list[ndarray], float, float]]:
    """Houses of a grid of streets: blocks of 100 m, streets of 25 m."""
    corner = np.arange(12.5, side_m, 125.0)
    square = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]])
    return [(square + np.array([x, y]), [], 0.0, 20.0) for x in corner for y in corner]


def streets(n: int, side_m: float, seed: int = 1) -> ndarray:
    """Antennas of `n` cars, evenly strewn over the streets between `blocks`."""
    g = np.random.default_rng(seed)
    along, across = g.uniform(0, side_m, n), 125.0 * g.integers(0, int(side_m / 125), n) + g.uniform(-8, 8, n)
    east = g.random(n) < 0.5
    return np.column_stack([np.where(east, along, across), np.where(east, across, along), np.full(n, 1.5)])


def messages(n: int, window: int, seed: int = 1) -> Packets:
    """One frame of 300 bytes from everybody, at any time in the window."""
    g = np.random.default_rng((seed, window))
    return Packets(
        sender=np.arange(n),
        seq=np.full(n, window, np.uint64),
        generated_ns=window * WINDOW_NS + g.integers(0, WINDOW_NS, n),
        payload_bytes=np.full(n, 300),
        access=np.full(n, 2, np.uint8),
        lifetime_ns=np.full(n, WINDOW_NS),
        tag=np.arange(n),
    )


def _best(times: list[float]) -> float:
    return min(times[1:])  # the first one compiles and fills memories


def _network(n: int, n_receivers: int) -> tuple[float, float, Links]:
    """Seconds of one network step, of the event loop alone, and the links."""
    side_m, params = 1000.0, PropagationParams(reach_m=400.0, reach_nlos_m=200.0)
    key = np.arange(1, n + 1, dtype=np.uint64)
    for _ in range(12):  # find the city in which a radio has so many neighbours
        links, _, _ = between(streets(n, side_m), key, params, np.uint64(1), Sight.of(Walls.of(blocks(side_m))))
        side_m *= (len(links.receiver) / n / n_receivers) ** 0.4
    sight, xyz = Sight.of(Walls.of(blocks(side_m))), streets(n, side_m)
    state, whole, air = State.start(), [], []
    for window in range(_ROUNDS):
        packets = messages(n, window)
        begin = perf_counter()
        links, _, _ = between(xyz, key, params, np.uint64(1), sight)
        middle = perf_counter()
        state, _ = play(state, links, packets, (window + 1) * WINDOW_NS, np.uint64(2), ReceiverParams(), AccessParams())
        end = perf_counter()
        whole.append(end - begin)
        air.append(end - middle)
    return _best(whole), _best(air), links


def _round(n: int, n_receivers: int, model: str) -> tuple[float, int]:
    """Seconds of one round of messages as the cycle asks for it, accounts included, and pairs within reach."""
    side_m, p, names = 1000.0, RadioParams(), rng.keys(np.uint64(1), np.arange(n))
    for _ in range(12):
        pairs = len(neighbours(streets(n, side_m)[:, :2], p.reach_m)[0])
        side_m *= (pairs / n / n_receivers) ** 0.4
    xyz, air = streets(n, side_m), csma.Air.start(Sight.of(Walls.of(blocks(side_m))), 1)
    talks, length, times = np.ones(n, bool), np.full(n, 300), []
    for i in range(_ROUNDS):
        begin = perf_counter()
        if model == "csma":
            csma.broadcast(
                air, xyz, names, talks, length, i, 0.4 * i, 0.4, p.reach_m, p.propagation, p.receiver, p.access,
                p.dcc, p.relay,
            )  # fmt: skip
        else:
            chance = rng.key(1, rng.Stream.RADIO_DETECTIONS, i)
            disk.broadcast(xyz[:, :2], names, talks, length, chance, p.reach_m, 0.4, p.disk, p.relay)
        times.append(perf_counter() - begin)
    return _best(times), len(neighbours(xyz[:, :2], p.reach_m)[0])


def bench() -> list[tuple[str, float, str]]:
    """Rows (what, figure, unit), best of several rounds in one process."""
    rows: list[tuple[str, float, str]] = []
    for n in (1000, 5000):
        whole, air, links = _network(n, 60)
        pairs, degree = len(links.receiver), len(links.receiver) / n
        rows.append((f"network step, {n:,} senders x {degree:.0f} receivers", 1e3 * whole, "ms"))
        rows.append((f"event loop, {n:,} senders x {degree:.0f} receivers", 1e-6 * pairs / air, "million pairs/s"))
    for n in (1000, 5000):
        for model in ("csma", "disk"):
            seconds, pairs = _round(n, 60, model)
            rows.append((f"round of {model}, {n:,} senders x {pairs / n:.0f} within reach", 1e3 * seconds, "ms"))
            rows.append((f"round of {model}, {n:,} senders", 1e-6 * pairs / seconds, "million pairs/s"))
    xyz = streets(2000, 2000.0)
    walls = Walls.of(blocks(2000.0))
    sight = Sight.of(walls)
    a, b, _ = within(xyz, 300.0)
    for name, clear in (("exact", walls.clear), ("remembered", sight.clear)):
        times = []
        for _ in range(_ROUNDS):
            begin = perf_counter()
            clear(xyz, a, b)
            times.append(perf_counter() - begin)
        rows.append((f"line of sight, {name}", 1e-6 * len(a) / _best(times), "million pairs/s"))
    return rows
