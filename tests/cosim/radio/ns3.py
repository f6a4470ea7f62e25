"""The radio in the settings of the ns-3 reference curves, and the curves."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from cosim.radio.channel import AccessParams, ChannelRules, ChannelState, Links, Packets, PhyOutcome, run_window
from cosim.radio.phy import ReceiverParams
from cosim.radio.propagation import fading_class, free_space_db, log_distance_db, two_ray_ground_db
from tests import SHARED

HERE = SHARED / "reference" / "ns3"
DCF = AccessParams(aifsn=(2, 2, 2, 2), cw=(15, 15, 15, 15))
PERIOD_NS = 100_000_000
BIN_M = 25


def file(name: str) -> Path:
    """A reference file; skips the test where there is none."""
    if not (HERE / name).exists():
        pytest.skip(f"no reference data: {HERE / name} is absent")
    return HERE / name


def positions(kind: str, n: int, seed: int) -> ndarray:
    return np.loadtxt(file(f"positions/{kind}_{n}_{seed}.txt"))


def highway(n: int, seed: int) -> ndarray:
    """Positions drawn as those of the reference were."""
    g = np.random.default_rng(seed)
    return np.column_stack([g.uniform(0, 2000, n), 4.0 * g.integers(0, 4, n), np.full(n, 1.5)])


def distances(xyz: ndarray) -> ndarray:
    return np.linalg.norm(xyz[:, None] - xyz[None], axis=2)


def loss_db(model: str, xyz: ndarray) -> ndarray:
    d, h = np.maximum(distances(xyz), 0.01), xyz[:, 2]
    if model == "friis":
        return free_space_db(d)
    return two_ray_ground_db(d, h[:, None], h[None]) if model == "tworay" else log_distance_db(d, 2.75)


def links(xyz: ndarray, loss: ndarray, fades: bool) -> Links:
    """Everybody to everybody, but for what never reaches the floor."""
    n = len(xyz)
    dbm = 23 - loss
    a, b = np.nonzero((dbm > -112) & ~np.eye(n, dtype=bool))
    kind = fading_class(distances(xyz)[a, b], "nakagami" if fades else "none")
    power = (10 ** (dbm[a, b] / 10)).astype(np.float32)
    return Links(np.arange(1, n + 1, dtype=np.uint64), np.searchsorted(a, np.arange(n + 1)), b, power, kind)


@dataclass
class Measured:
    sent: ndarray  # per sender
    heard: ndarray  # sender, receiver
    busy: float
    busy_strong: float
    latency_s: ndarray


def measure(
    xyz: ndarray, loss: ndarray, fades: bool, receiver: ReceiverParams, access: AccessParams, first: int, last: int,
    seed: int, payload_bytes: int = 300, fixed_phase: bool = False,
) -> Measured:  # fmt: skip
    """Everybody sends once in each period; statistics of the periods from `first` to `last`."""
    n, net, g, state = len(xyz), links(xyz, loss, fades), np.random.default_rng(seed), ChannelState.start()
    phase, rules = g.integers(0, PERIOD_NS, n), ChannelRules(np.uint64(seed), receiver, access)
    sent, heard, busy, strong, latency = np.zeros(n), np.zeros((n, n)), [], [], []
    for period in range(last):
        when = phase if fixed_phase else g.integers(0, PERIOD_NS, n)
        packets = Packets(
            np.arange(n), np.full(n, period, np.uint64), period * PERIOD_NS + when, np.full(n, payload_bytes),
            np.full(n, 2, np.uint8), np.full(n, PERIOD_NS), np.arange(n),
        )  # fmt: skip
        state, out = run_window(state, net, packets, (period + 1) * PERIOD_NS, rules)
        if period >= first:
            aired = out.outcome == PhyOutcome.RECEIVED
            sent += np.bincount(out.tag[aired], minlength=n)
            ok = out.reception == PhyOutcome.RECEIVED
            np.add.at(heard, (np.repeat(out.tag, np.diff(out.ptr))[ok], out.receiver[ok]), 1)
            busy.append(out.busy.mean())
            strong.append(out.busy_strong.mean())
            latency.append(((out.start_ns - out.generated_ns) * 1e-9)[aired])
    return Measured(sent, heard, float(np.mean(busy)), float(np.mean(strong)), np.concatenate(latency))


def binned(xyz: ndarray, runs: Measured, among: ndarray | None, reach_m: int) -> tuple[ndarray, ndarray]:
    """Receptions and chances of reception by bins of distance."""
    d = distances(xyz)
    of = ~np.eye(len(d), dtype=bool) & (d < reach_m)
    if among is not None:
        of &= among
    k = (d[of] // BIN_M).astype(int)
    chances = np.broadcast_to(runs.sent[:, None], d.shape)[of]
    size = reach_m // BIN_M
    return np.bincount(k, runs.heard[of], size), np.bincount(k, chances, size)
