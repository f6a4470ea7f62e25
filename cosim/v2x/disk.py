"""The disk model: every radio within reach hears a frame, but for a flat share of losses."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.v2x.exchange import Fate, Frames, Heard, RelayParams, View, heard_of, neighbours
from cosim.v2x.messages import expand, ptr_of


@dataclass(frozen=True, kw_only=True, slots=True)
class DiskParams:
    """For theory and quick runs: no walls, no collisions."""

    loss_p: Annotated[float, Ge(0), Le(1)] = 0.05
    """Probability that one hop fails at one receiver."""
    latency_min_s: Annotated[float, Ge(0)] = 0.0004
    """Shortest time from a hop's start to its reception [s]; the default is that of Eclipse MOSAIC's SNS."""
    latency_max_s: Annotated[float, Ge(0)] = 0.0024
    """Longest time from a hop's start to its reception [s]; drawn evenly between the two."""

    def __post_init__(self) -> None:
        if self.latency_max_s < self.latency_min_s:
            raise ValueError(
                f"radio.disk.latency_max_s = {self.latency_max_s:g} s is below radio.disk.latency_min_s = "
                f"{self.latency_min_s:g} s. Set the larger one as maximum."
            )


def broadcast(
    xy_m: Float[ndarray, "n 2"],
    name_key: UInt64[ndarray, "n"],
    talks: Bool[ndarray, "n"],
    length_bytes: Int[ndarray, "n"],
    chance: np.uint64,
    reach_m: float,
    timeout_s: float,
    disk: DiskParams,
    relay: RelayParams,
) -> tuple[Heard, Frames]:
    """One message from every radio that talks, to all that it reaches, over at most `max_hops` hops.

    Each hop of each message fails at each receiver on its own draw. Who has the message already ignores
    copies; who got it for the first time within the relay's reach of its origin passes it on, while hops last.

    Parameters
    ----------
    chance
        Key of this round's draws.
    """
    n = len(xy_m)
    a, b, length_m = neighbours(xy_m, reach_m)
    ptr = ptr_of(a, n)
    origin = np.flatnonzero(talks)
    carrier = origin.copy()
    age_s = np.zeros(len(origin))
    reached = [origin * n + origin]
    parts: list[tuple[ndarray, ...]] = []
    frames: list[tuple[ndarray, ...]] = []
    n_duplicate = n_relayed = 0
    n_transmissions = np.asarray(talks).astype(int)
    for hop in range(1, relay.max_hops + 1):
        if hop > 1:
            near = np.linalg.norm(xy_m[carrier] - xy_m[origin], axis=1) <= relay.reach_m
            origin, carrier, age_s = origin[near], carrier[near], age_s[near]
            n_transmissions += np.bincount(origin, minlength=n)
            n_relayed += len(origin)
        link, which = expand(ptr[carrier], ptr[carrier + 1])
        source, via, to = origin[which], carrier[which], b[link]
        elsewhere = to != source  # nobody receives their own
        source, via, to, which = source[elsewhere], via[elsewhere], to[elsewhere], which[elsewhere]
        draws = rng.uniforms(chance, name_key[source], name_key[via], name_key[to], n=2)
        arrival = age_s[which] + disk.latency_min_s + (disk.latency_max_s - disk.latency_min_s) * draws[:, 1]
        arrived = draws[:, 0] >= disk.loss_p
        in_time = arrival <= timeout_s
        fate = np.where(arrived, np.where(in_time, Fate.RECEIVED, Fate.LATE), Fate.PROPAGATION)
        frames.append((source, to, np.full(len(to), hop), length_m[link][elsewhere], fate))
        keep = np.flatnonzero(fate == Fate.RECEIVED)
        # The earliest copy counts; copies of one message at one receiver are told apart by nothing else.
        keep = keep[np.lexsort((via[keep], arrival[keep], source[keep] * n + to[keep]))]
        pair = source[keep] * n + to[keep]
        first = np.ones(len(keep), bool)
        first[1:] = pair[1:] != pair[:-1]
        first &= ~np.isin(pair, np.concatenate(reached))
        n_duplicate += int(np.sum(~first))
        keep = keep[first]
        origin, carrier, age_s = source[keep], to[keep], arrival[keep]
        reached.append(origin * n + carrier)
        parts.append((carrier, origin, np.full(len(keep), hop), age_s))
        if not len(keep):
            break
    receiver, sender, hops, latency_s = (np.concatenate(c) for c in zip(*parts, strict=True))
    at_once = np.zeros(len(sender))
    heard = heard_of(receiver, sender, hops, at_once, at_once, latency_s, xy_m)
    source, to, hop_of, tried, fates = (np.concatenate(c) for c in zip(*frames, strict=True))
    view = np.full(len(to), View.UNKNOWN, np.uint8)
    sent_bytes = float(n_transmissions @ length_bytes)
    return heard, Frames(
        source, to, hop_of, tried, view, fates, n_transmissions, n_relayed, n_duplicate, sent_bytes, None
    )
