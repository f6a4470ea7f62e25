"""Who hears whom: range-limited broadcast, relay and packet loss."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int, UInt64
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim import rng
from cosim.v2x.messages import expand, ptr_of


@dataclass(frozen=True, kw_only=True, slots=True)
class RadioParams:
    """Disk model: every radio within reach hears a frame, but for a flat share of losses."""

    reach_m: Annotated[float, Gt(0)] = 300.0
    """Largest distance of one hop [m]."""
    loss_p: Annotated[float, Ge(0), Le(1)] = 0.05
    """Probability that one hop fails at one receiver."""
    max_hops: Annotated[int, Ge(1), Le(10)] = 1
    """Hops that a message may travel; 1 is no relay."""
    relay_reach_m: Annotated[float, Gt(0)] = 600.0
    """Farthest from its origin that a message is re-broadcast [m]."""
    hop_latency_min_s: Annotated[float, Ge(0)] = 0.0004
    """Shortest time from a hop's start to its reception [s]; the default is that of Eclipse MOSAIC's SNS."""
    hop_latency_max_s: Annotated[float, Ge(0)] = 0.0024
    """Longest time from a hop's start to its reception [s]; drawn evenly between the two."""
    timeout_s: Annotated[float, Gt(0)] = 0.1
    """A message older than this when it arrives is late, and dropped [s]."""

    def __post_init__(self) -> None:
        if self.reach_m < 5:
            raise ValueError(
                f"radio.reach_m = {self.reach_m:g} m is shorter than one vehicle: nobody hears anybody. "
                "Metres, not kilometres? Set radio.reach_m to at least 5."
            )
        if self.hop_latency_max_s < self.hop_latency_min_s:
            raise ValueError(
                f"radio.hop_latency_max_s = {self.hop_latency_max_s:g} s is below radio.hop_latency_min_s = "
                f"{self.hop_latency_min_s:g} s. Set the larger one as maximum."
            )


@dataclass(frozen=True, slots=True)
class Heard:
    """M deliveries of one exchange, each (receiver, sender) once, sorted by receiver, then sender; radio rows."""

    receiver: Int[ndarray, "m"]
    sender: Int[ndarray, "m"]
    hops: Int[ndarray, "m"]
    latency_s: Float[ndarray, "m"]
    distance_m: Float[ndarray, "m"]


class Fate(IntEnum):
    """What became of one frame at one radio in its reach."""

    RECEIVED = 0
    LOST = 1
    LATE = 2


@dataclass(frozen=True, slots=True)
class Frames:
    """F (frame, radio in reach) of one exchange, all hops, in no particular order."""

    distance_m: Float[ndarray, "f"]
    """Between the two ends of the hop."""
    fate: Int[ndarray, "f"]
    """As `Fate`."""
    n_transmissions: Int[ndarray, "n"]
    """Of each radio's message: once by its author, then once per relay."""
    n_duplicate: int
    """Of the frames received, those whose message the receiver had or got elsewhere earlier."""


def neighbours(xy_m: Float[ndarray, "n 2"], reach_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """All ordered pairs within reach: sender, receiver, distance [m]; sorted by sender, then receiver."""
    pairs = cKDTree(xy_m).query_pairs(reach_m, output_type="ndarray")
    sender = np.concatenate([pairs[:, 0], pairs[:, 1]])
    receiver = np.concatenate([pairs[:, 1], pairs[:, 0]])
    order = np.lexsort((receiver, sender))
    sender, receiver = sender[order], receiver[order]
    return sender, receiver, np.linalg.norm(xy_m[sender] - xy_m[receiver], axis=1)


def broadcast(
    xy_m: Float[ndarray, "n 2"],
    name_key: UInt64[ndarray, "n"],
    talks: ndarray,
    chance: np.uint64,
    params: RadioParams,
) -> tuple[Heard, Frames]:
    """One message from every radio that talks, to all that it reaches, over at most `max_hops` hops.

    Each hop of each message fails at each receiver on its own draw. Who has the message already ignores
    copies; who got it for the first time within `relay_reach_m` of its origin passes it on, while hops last.

    Parameters
    ----------
    talks
        Whether each radio has something to say (bool[n]).
    chance
        Key of this exchange's draws.
    """
    n = len(xy_m)
    a, b, length_m = neighbours(xy_m, params.reach_m)
    ptr = ptr_of(a, n)
    origin = np.flatnonzero(talks)
    carrier = origin.copy()
    age_s = np.zeros(len(origin))
    reached = [origin * n + origin]
    parts: list[tuple[ndarray, ...]] = []
    frames: list[tuple[ndarray, ndarray]] = []
    n_duplicate = 0
    n_transmissions = np.asarray(talks).astype(int)
    for hop in range(1, params.max_hops + 1):
        if hop > 1:
            near = np.linalg.norm(xy_m[carrier] - xy_m[origin], axis=1) <= params.relay_reach_m
            origin, carrier, age_s = origin[near], carrier[near], age_s[near]
            n_transmissions += np.bincount(origin, minlength=n)
        link, which = expand(ptr[carrier], ptr[carrier + 1])
        source, via, to = origin[which], carrier[which], b[link]
        elsewhere = to != source  # nobody receives their own
        source, via, to, which = source[elsewhere], via[elsewhere], to[elsewhere], which[elsewhere]
        draws = rng.uniforms(chance, name_key[source], name_key[via], name_key[to], n=2)
        spread = params.hop_latency_max_s - params.hop_latency_min_s
        arrival = age_s[which] + params.hop_latency_min_s + spread * draws[:, 1]
        arrived = draws[:, 0] >= params.loss_p
        in_time = arrival <= params.timeout_s
        fate = np.where(arrived, np.where(in_time, Fate.RECEIVED, Fate.LATE), Fate.LOST)
        frames.append((length_m[link][elsewhere], fate))
        keep = np.flatnonzero(arrived & in_time)
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
    receiver, sender, hops, latency = (np.concatenate(c) for c in zip(*parts, strict=True))
    order = np.lexsort((sender, receiver))
    receiver, sender = receiver[order], sender[order]
    distance = np.linalg.norm(xy_m[receiver] - xy_m[sender], axis=1)
    tried, fates = (np.concatenate(c) for c in zip(*frames, strict=True))
    account = Frames(tried, fates, n_transmissions, n_duplicate)
    return Heard(receiver, sender, hops[order].astype(np.int32), latency[order], distance), account
