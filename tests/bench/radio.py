"""Measures the speed of the radio on this machine."""

from dataclasses import replace
from time import thread_time
from typing import Any

import numpy as np
from numpy import ndarray

from cosim.base import rng
from cosim.radio.channel import AccessParams, ChannelRules, Packets, run_window
from cosim.radio.channel_state import ChannelState
from cosim.radio.csma import CsmaMedium
from cosim.radio.link_budget import links_between
from cosim.radio.medium import MEDIA
from cosim.radio.message_round import FrameOutcomes, Messages, RoundKind, Stations
from cosim.radio.params import RadioParams, RelayParams
from cosim.radio.phy import ReceiverParams
from cosim.radio.propagation import PropagationParams
from sensors.line_of_sight import LosOfPlaces, WallIndex
from sensors.scene import Buildings, Scene

WINDOW_NS = 100_000_000
_ROUNDS = 15


def city_blocks(side_m: float) -> Buildings:
    """Buildings between a grid of streets: blocks of 100 m, streets of 25 m."""
    corner = np.arange(12.5, side_m, 125.0)
    square = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]])
    rings = [[square + np.array([x, y])] for x in corner for y in corner]
    return Scene.from_footprints(rings, [0.0] * len(rings), [20.0] * len(rings)).buildings


def streets(n: int, side_m: float, seed: int = 1) -> ndarray:
    """Antennas of `n` cars, 1.5 m high, uniformly distributed over the streets between `city_blocks` [m]."""
    g = np.random.default_rng(seed)
    along, across = g.uniform(0, side_m, n), 125.0 * g.integers(0, int(side_m / 125), n) + g.uniform(-8, 8, n)
    east = g.random(n) < 0.5
    return np.column_stack([np.where(east, along, across), np.where(east, across, along), np.full(n, 1.5)])


def packets_of(n: int, window: int, seed: int = 1) -> Packets:
    """One frame of 300 bytes from every station, at a random time in the window."""
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
    return min(times[1:])  # the first one compiles and fills caches


def _los(side_m: float) -> LosOfPlaces:
    return LosOfPlaces(WallIndex.of(city_blocks(side_m)))


def _city(n: int, n_receivers: int, params: PropagationParams) -> tuple[ndarray, LosOfPlaces]:
    """Antennas, and a city of a size in which each antenna has about `n_receivers` receivers."""
    side_m, key = 1000.0, np.arange(1, n + 1, dtype=np.uint64)
    for _ in range(12):
        links = links_between(streets(n, side_m), key, params, np.uint64(1), _los(side_m))
        side_m *= (len(links.receiver) / n / n_receivers) ** 0.4
    return streets(n, side_m), _los(side_m)


def _network(xyz: ndarray, los: LosOfPlaces, params: PropagationParams) -> tuple[float, float, int]:
    """Seconds of one network step, seconds of the event loop alone, and the number of links."""
    n, key = len(xyz), np.arange(1, len(xyz) + 1, dtype=np.uint64)
    state, whole, events = ChannelState.start(), [], []
    rules = ChannelRules(np.uint64(2), ReceiverParams(), AccessParams())
    for window in range(_ROUNDS):
        packets, until_ns = packets_of(n, window), (window + 1) * WINDOW_NS
        begin = thread_time()
        links = links_between(xyz, key, params, np.uint64(1), los)
        middle = thread_time()
        state, _ = run_window(state, links, packets, until_ns, rules)
        end = thread_time()
        whole.append(end - begin)
        events.append(end - middle)
    return _best(whole), _best(events), len(links.receiver)


def _rounds(
    xyz: ndarray, los: LosOfPlaces, params: PropagationParams, relay: RelayParams
) -> tuple[float, float, FrameOutcomes]:
    """Seconds of the two rounds of a step with frame outcomes, and the frames of the last round.

    Every station sends 300 bytes in 100 ms; before the first round of a step every station has moved.
    """
    n = len(xyz)
    stations = Stations(rng.keys(np.uint64(1), np.arange(n)), xyz, n)
    messages = Messages.one_each(np.full(n, 300))
    medium = CsmaMedium(RadioParams(propagation=params, relay=relay), 0.2, 1, los)
    state = medium.start()
    times: tuple[list[float], list[float]] = ([], [])
    for i in range(2 * _ROUNDS):
        if i % 2 == 0:
            state = replace(state, cache=None)
        begin = thread_time()
        state, happened = medium.broadcast(state, RoundKind(i % 2), i // 2, 0.2 * i, stations, messages)
        times[i % 2].append(thread_time() - begin)
    return _best(times[0]), _best(times[1]), happened.frames


def _times_real_time(xyz: ndarray, los: LosOfPlaces, params: PropagationParams, model: str, interval_s: float) -> float:
    """Simulated time over the processor time of all rounds, links included, when every station sends both messages."""
    n, round_s = len(xyz), 0.4 * interval_s
    stations = Stations(rng.keys(np.uint64(1), np.arange(n)), xyz, n)
    messages = Messages.one_each(np.full(n, 300))
    medium = MEDIA[model](RadioParams(model=model, propagation=params), round_s, 1, los)
    state: Any = medium.start()
    times = []
    for step in range(_ROUNDS):
        state = replace(state, cache=None)
        begin = thread_time()
        for kind in RoundKind:
            state, _ = medium.broadcast(state, kind, step, interval_s * step + kind * round_s, stations, messages)
        times.append(thread_time() - begin)
    return interval_s / float(np.median(times[3:]))  # stations reserve from their second message on


def bench() -> list[tuple[str, float, str]]:
    """Measure the radio: processor time of one thread, the best of several rounds. Rows of (what, figure, unit)."""
    rows: list[tuple[str, float, str]] = []
    default = PropagationParams()
    short = PropagationParams(interference_range_m=400.0, interference_range_nlos_m=200.0)
    for n in (1000, 5000):
        xyz, los = _city(n, 60, short)
        step, events, links = _network(xyz, los, short)
        first, second, _ = _rounds(xyz, los, short, RelayParams())
        who = f"{n:,} senders x {links / n:.0f} receivers"
        rows.append((f"network step, {who}", 1e3 * step, "ms"))
        rows.append((f"event loop, {who}", 1e-6 * links / events, "million pairs/s"))
        rows.append((f"whole round, first of a step, {who}", 1e3 * first, "ms"))
        rows.append((f"whole round, second of a step, {who}", 1e3 * second, "ms"))
        rows.append((f"two rounds to two network steps, {n:,} senders", (first + second) / (2 * step), "times"))
        for model in ("csma", "nr_mode2", "lte_mode4"):
            for interval_s in (1.0, 0.1):
                speed = _times_real_time(xyz, los, short, model, interval_s)
                rows.append((f"{model}, {who}, {1 / interval_s:.0f} Hz", speed, "times real time"))
    for n in (60, 300):
        xyz, los = _city(n, 30, default)
        seconds, _, frames = _rounds(xyz, los, default, RelayParams(max_hops=3))
        rows.append((f"round of 3 hops, {n} senders", 1e3 * seconds, "ms"))
        each = seconds / frames.n_transmissions.sum()
        rows.append((f"round of 3 hops, {n} senders, each transmission", 1e6 * each, "us"))
    return rows
