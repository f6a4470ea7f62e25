"""The disk model: every radio within reach hears a frame, but for a flat share of losses."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.rng import mix, unit
from cosim.v2x.exchange import Fate, Frames, Heard, RelayParams, View, heard_of, neighbours
from cosim.v2x.kernel import inlined, kernel
from cosim.v2x.messages import ptr_of

_RECEIVED, _LATE, _LOST = (int(fate) for fate in (Fate.RECEIVED, Fate.LATE, Fate.PROPAGATION))


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


@inlined
def _drawn(h, loss_p, since_s, latency_s, spread_s, timeout_s):
    """Fate of a frame at one receiver, and when it is there; `h` is the hash of who, through whom, and to whom."""
    arrival_s = since_s + latency_s + spread_s * unit(mix(h, np.uint64(1)))
    if unit(mix(h, np.uint64(0))) < loss_p:
        return _LOST, arrival_s
    return _RECEIVED if arrival_s <= timeout_s else _LATE, arrival_s


@kernel
def _first_hop(ptr, neighbour, length_m, talks, name, chance, loss_p, latency_s, spread_s, timeout_s,
               source, to, apart_m, fate, got, by, arrival_s, away_m):  # fmt: skip
    """Every author's frame at every neighbour, and what is received, both by receiver, then sender."""
    tried = m = 0
    for r in range(len(ptr) - 1):
        for link in range(ptr[r], ptr[r + 1]):
            s = neighbour[link]
            if not talks[s]:
                continue
            f, t = _drawn(mix(mix(mix(chance, name[s]), name[s]), name[r]), loss_p, 0.0, latency_s, spread_s, timeout_s)
            source[tried], to[tried], apart_m[tried], fate[tried] = s, r, length_m[link], f
            tried += 1
            if f == _RECEIVED:
                got[m], by[m], arrival_s[m], away_m[m] = r, s, t, length_m[link]
                m += 1
    return tried, m


@kernel
def _next_hop(ptr, neighbour, length_m, origin, carrier, age_s, name, chance, loss_p, latency_s, spread_s, timeout_s,
              source, via, to, apart_m, arrival_s, fate):  # fmt: skip
    """One transmission by every carrier of an origin's message: a row per neighbour but the origin itself."""
    m = 0
    for i in range(len(origin)):
        h = mix(mix(chance, name[origin[i]]), name[carrier[i]])
        for link in range(ptr[carrier[i]], ptr[carrier[i] + 1]):
            r = neighbour[link]
            if r != origin[i]:  # nobody receives their own
                f, t = _drawn(mix(h, name[r]), loss_p, age_s[i], latency_s, spread_s, timeout_s)
                source[m], via[m], to[m], apart_m[m] = origin[i], carrier[i], r, length_m[link]
                fate[m], arrival_s[m] = f, t
                m += 1
    return m


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
    talks = np.asarray(talks, bool)
    a, b, length_m = neighbours(xy_m, reach_m)
    ptr = ptr_of(a, n)
    how = np.uint64(chance), disk.loss_p, disk.latency_min_s, disk.latency_max_s - disk.latency_min_s, timeout_s
    room = len(a)
    source, to, got, by = (np.empty(room, np.int64) for _ in range(4))
    apart_m, fate, arrival_s, away_m = np.empty(room), np.empty(room, np.int64), np.empty(room), np.empty(room)
    tried, m = _first_hop(
        ptr, b, length_m, talks, name_key, *how, source, to, apart_m, fate, got, by, arrival_s, away_m
    )
    hops = [np.ones(tried, np.int64)]
    frames = [(source[:tried], to[:tried], apart_m[:tried], fate[:tried])]
    at_once = np.zeros(m)
    heard = Heard(got[:m], by[:m], np.ones(m, np.int32), at_once, at_once, arrival_s[:m], away_m[:m])
    n_duplicate = n_relayed = 0
    n_transmissions = talks.astype(int)
    parts = [(heard.receiver, heard.sender, np.ones(m, np.int64), heard.latency_s)]
    origin, carrier, age_s = heard.sender, heard.receiver, heard.latency_s
    reached = [np.flatnonzero(talks) * (n + 1), origin * n + carrier]
    for hop in range(2, relay.max_hops + 1):
        if not len(origin):
            break
        near = np.linalg.norm(xy_m[carrier] - xy_m[origin], axis=1) <= relay.reach_m
        if relay.rule == "probability":
            relaying = rng.keys(chance, np.array([rng.Stream.RELAY]))[0]
            passing = rng.uniforms(relaying, name_key[origin], name_key[carrier])[:, 0]
            near &= passing < relay.forward_p
        origin, carrier, age_s = origin[near], carrier[near], age_s[near]
        n_transmissions += np.bincount(origin, minlength=n)
        n_relayed += len(origin)
        tried = int(np.sum(ptr[carrier + 1] - ptr[carrier]))
        source, via, to, fate = (np.empty(tried, np.int64) for _ in range(4))
        apart_m, arrival_s = np.empty(tried), np.empty(tried)
        tried = _next_hop(
            ptr, b, length_m, origin, carrier, age_s, name_key, *how, source, via, to, apart_m, arrival_s, fate
        )
        source, via, to, fate = source[:tried], via[:tried], to[:tried], fate[:tried]
        apart_m, arrival_s = apart_m[:tried], arrival_s[:tried]
        frames.append((source, to, apart_m, fate))
        hops.append(np.full(tried, hop))
        keep = np.flatnonzero(fate == Fate.RECEIVED)
        # The earliest copy counts; copies of one message at one receiver are told apart by nothing else.
        keep = keep[np.lexsort((via[keep], arrival_s[keep], source[keep] * n + to[keep]))]
        pair = source[keep] * n + to[keep]
        first = np.ones(len(keep), bool)
        first[1:] = pair[1:] != pair[:-1]
        first &= ~np.isin(pair, np.concatenate(reached))
        n_duplicate += int(np.sum(~first))
        keep = keep[first]
        origin, carrier, age_s = source[keep], to[keep], arrival_s[keep]
        reached.append(origin * n + carrier)
        parts.append((carrier, origin, np.full(len(keep), hop), age_s))
    if len(parts) > 1:
        receiver, sender, hop_of, latency_s = (np.concatenate(c) for c in zip(*parts, strict=True))
        at_once = np.zeros(len(sender))
        heard = heard_of(receiver, sender, hop_of, at_once, at_once, latency_s, xy_m)
    tries = [np.concatenate(c) if len(c) > 1 else c[0] for c in zip(*frames, strict=True)]
    view = np.full(len(tries[0]), View.UNKNOWN, np.uint8)
    return heard, Frames(
        tries[0], tries[1], np.concatenate(hops), tries[2], view, tries[3], n_transmissions, n_relayed, n_duplicate,
        float(n_transmissions @ length_bytes), None,
    )  # fmt: skip
