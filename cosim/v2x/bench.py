"""How fast the radio is on this machine."""

from time import thread_time

import numpy as np
from numpy import ndarray

from cosim import rng
from cosim.v2x import csma, disk
from cosim.v2x.channel import AccessParams, Packets, State, play
from cosim.v2x.exchange import Frames, RelayParams, neighbours
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


def _city(n: int, n_receivers: int, params: PropagationParams) -> tuple[ndarray, Sight]:
    """Antennas, and the city in which each has so many receivers."""
    side_m, key = 1000.0, np.arange(1, n + 1, dtype=np.uint64)
    for _ in range(12):
        links, _, _ = between(streets(n, side_m), key, params, np.uint64(1), Sight.of(Walls.of(blocks(side_m))))
        side_m *= (len(links.receiver) / n / n_receivers) ** 0.4
    return streets(n, side_m), Sight.of(Walls.of(blocks(side_m)))


def _network(xyz: ndarray, sight: Sight, params: PropagationParams) -> tuple[float, float, int]:
    """Seconds of one network step, of the event loop alone, and links."""
    n, key = len(xyz), np.arange(1, len(xyz) + 1, dtype=np.uint64)
    state, whole, air = State.start(), [], []
    for window in range(_ROUNDS):
        packets = messages(n, window)
        begin = thread_time()
        links, _, _ = between(xyz, key, params, np.uint64(1), sight)
        middle = thread_time()
        state, _ = play(state, links, packets, (window + 1) * WINDOW_NS, np.uint64(2), ReceiverParams(), AccessParams())
        end = thread_time()
        whole.append(end - begin)
        air.append(end - middle)
    return _best(whole), _best(air), len(links.receiver)


def _rounds(xyz: ndarray, sight: Sight, params: PropagationParams, relay: RelayParams) -> tuple[float, float, Frames]:
    """Seconds of the two rounds of a turn as the cycle asks for them, accounts included, and the last one's frames.

    Everybody says 300 bytes in 100 ms; before the first round of a turn everybody has moved.
    """
    n, p, names = len(xyz), RadioParams(), rng.keys(np.uint64(1), np.arange(len(xyz)))
    air, talks, length = csma.Air.start(sight, 1), np.ones(n, bool), np.full(n, 300)
    times: tuple[list[float], list[float]] = ([], [])
    for i in range(2 * _ROUNDS):
        if i % 2 == 0:
            air.ground = None
        begin = thread_time()
        _, frames = csma.broadcast(
            air, xyz, names, talks, length, i, 0.2 * i, 0.2, p.reach_m, params, p.receiver, p.access, p.dcc, relay
        )
        times[i % 2].append(thread_time() - begin)
    return _best(times[0]), _best(times[1]), frames


def _disk(xyz: ndarray) -> tuple[float, int]:
    """Seconds of one round of the disk model, and pairs within reach."""
    n, p, names, times = len(xyz), RadioParams(), rng.keys(np.uint64(1), np.arange(len(xyz))), []
    for i in range(_ROUNDS):
        chance = rng.key(1, rng.Stream.RADIO_DETECTIONS, i)
        begin = thread_time()
        disk.broadcast(xyz[:, :2], names, np.ones(n, bool), np.full(n, 300), chance, p.reach_m, 0.4, p.disk, p.relay)
        times.append(thread_time() - begin)
    return _best(times), len(neighbours(xyz[:, :2], p.reach_m)[0])


def bench() -> list[tuple[str, float, str]]:
    """Rows (what, figure, unit): processor time of one thread, best of several rounds in one process."""
    rows: list[tuple[str, float, str]] = []
    default, short = PropagationParams(), PropagationParams(reach_m=400.0, reach_nlos_m=200.0)
    for n in (1000, 5000):
        xyz, sight = _city(n, 60, short)
        step, air, links = _network(xyz, sight, short)
        first, second, _ = _rounds(xyz, sight, short, RelayParams())
        who = f"{n:,} senders x {links / n:.0f} receivers"
        rows.append((f"network step, {who}", 1e3 * step, "ms"))
        rows.append((f"event loop, {who}", 1e-6 * links / air, "million pairs/s"))
        rows.append((f"whole round, first of a turn, {who}", 1e3 * first, "ms"))
        rows.append((f"whole round, second of a turn, {who}", 1e3 * second, "ms"))
        rows.append((f"two rounds to two network steps, {n:,} senders", (first + second) / (2 * step), "times"))
        step, _, links = _network(xyz, sight, default)
        first, _, _ = _rounds(xyz, sight, default, RelayParams())
        who = f"{n:,} senders x {links / n:.0f} receivers"
        rows.append((f"default reach: network step, {who}", 1e3 * step, "ms"))
        rows.append((f"default reach: first round, {who}", 1e3 * first, "ms"))
        seconds, pairs = _disk(xyz)
        rows.append((f"round of disk, {n:,} senders x {pairs / n:.0f} within reach", 1e3 * seconds, "ms"))
    for n in (60, 300):
        xyz, sight = _city(n, 30, default)
        seconds, _, frames = _rounds(xyz, sight, default, RelayParams(max_hops=3))
        rows.append((f"round of 3 hops, {n} senders", 1e3 * seconds, "ms"))
        each = seconds / frames.n_transmissions.sum()
        rows.append((f"round of 3 hops, {n} senders, each transmission", 1e6 * each, "us"))
    xyz = streets(2000, 2000.0)
    walls = Walls.of(blocks(2000.0))
    sight = Sight.of(walls)
    a, b, _ = within(xyz, 300.0)
    for name, clear in (("exact", walls.clear), ("remembered", sight.clear)):
        times = []
        for _ in range(_ROUNDS):
            begin = thread_time()
            clear(xyz, a, b)
            times.append(thread_time() - begin)
        rows.append((f"line of sight, {name}", 1e-6 * len(a) / _best(times), "million pairs/s"))
    return rows
