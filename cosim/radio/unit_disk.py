"""The medium `unit_disk`: every station in range receives a frame, except for a constant loss probability."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim import rng
from cosim.radio.link_budget import neighbours
from cosim.radio.message_round import (
    FrameOutcomes,
    LosState,
    MessageRound,
    Messages,
    Outcome,
    Receptions,
    RoundKind,
    Stations,
    receptions_of,
)
from cosim.radio.params import RadioParams
from cosim.ragged import ptr_of
from sensors.hash_rng import mix, unit
from sensors.kernel import inlined, kernel
from sensors.line_of_sight import LosOfPlaces

_RECEIVED, _LATE, _LOST = (int(outcome) for outcome in (Outcome.RECEIVED, Outcome.LATE, Outcome.PROPAGATION))


class _Rules(NamedTuple):
    rng_key: np.uint64
    loss_p: float
    latency_min_s: float
    latency_spread_s: float
    round_s: float


@inlined
def _attempt(h, rules, since_s):
    """Outcome and arrival of a frame at one receiver. `h` is a hash of message, transmitter and receiver."""
    arrival_s = since_s + rules.latency_min_s + rules.latency_spread_s * unit(mix(h, np.uint64(1)))
    if unit(mix(h, np.uint64(0))) < rules.loss_p:
        return _LOST, arrival_s
    return _RECEIVED if arrival_s <= rules.round_s else _LATE, arrival_s


class _Network(NamedTuple):
    """Stations and their neighbours, compressed rows."""

    ptr: ndarray
    neighbour: ndarray
    length_m: ndarray
    key: ndarray  # of each station's draws


class _Sent(NamedTuple):
    """Messages, by station."""

    first: ndarray  # where each station's begin
    station: ndarray
    key: ndarray  # of each message's draws
    is_sent: ndarray
    delay_s: ndarray


class _Forwarded(NamedTuple):
    """Messages that stations forward: each a message, who forwards it, and when since the round began."""

    message: ndarray
    transmitter: ndarray
    age_s: ndarray


@kernel
def _first_hop(network, sent, rules, rows):
    """The frame of every sender at each of its neighbours, sorted by receiver, then message."""
    message, to, apart_m, outcome, arrival_s = rows
    m = 0
    for r in range(len(network.ptr) - 1):
        for link in range(network.ptr[r], network.ptr[r + 1]):
            s = network.neighbour[link]
            for i in range(sent.first[s], sent.first[s + 1]):
                if sent.is_sent[i]:
                    h = mix(mix(mix(rules.rng_key, sent.key[i]), network.key[s]), network.key[r])
                    message[m], to[m], apart_m[m] = i, r, network.length_m[link]
                    outcome[m], arrival_s[m] = _attempt(h, rules, sent.delay_s[i])
                    m += 1
    return m


@kernel
def _next_hop(network, sent, forwarded, rules, rows, via):
    """One transmission by every station that forwards: a row for each neighbour except the message's sender."""
    message, to, apart_m, outcome, arrival_s = rows
    m = 0
    for i in range(len(forwarded.message)):
        carried, transmitter = forwarded.message[i], forwarded.transmitter[i]
        h = mix(mix(rules.rng_key, sent.key[carried]), network.key[transmitter])
        for link in range(network.ptr[transmitter], network.ptr[transmitter + 1]):
            r = network.neighbour[link]
            if r != sent.station[carried]:
                outcome[m], arrival_s[m] = _attempt(mix(h, network.key[r]), rules, forwarded.age_s[i])
                message[m], via[m], to[m], apart_m[m] = carried, transmitter, r, network.length_m[link]
                m += 1
    return m


def _rows(n: int) -> tuple[ndarray, ...]:
    return np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n), np.empty(n, np.int64), np.empty(n)


@dataclass(frozen=True, slots=True)
class UnitDiskMedium:
    """Range-limited broadcast without collisions."""

    params: RadioParams
    round_s: float
    """Duration of one round [s]."""
    seed: int
    los: LosOfPlaces | None = None
    """Not used: buildings have no effect."""

    def start(self) -> None:
        """Nothing lasts from round to round."""

    def broadcast(
        self, state: None, kind: RoundKind, step: int, begin_s: float, stations: Stations, messages: Messages
    ) -> tuple[None, MessageRound]:
        """One round of messages, all generated at its beginning, over at most `relay.max_hops` hops.

        Each hop of each message is lost at each receiver with a draw of its own. A station that already has a message
        ignores copies. A station that receives a message for the first time forwards it, if hops remain and if the
        message's sender is within the forwarding range.
        """
        p, relay = self.params, self.params.relay
        stream = (rng.Stream.RADIO_DETECTIONS, rng.Stream.RADIO_EVALUATIONS)[kind]
        rng_key = rng.key(self.seed, stream, step)
        disk = p.unit_disk
        spread_s = disk.latency_max_s - disk.latency_min_s
        rules = _Rules(rng_key, disk.loss_p, disk.latency_min_s, spread_s, self.round_s)
        n, n_messages, xy_m, key = len(stations), len(messages), stations.xyz_m[:, :2], stations.key
        station, message_key, sends = messages.station, messages.keys(stations), messages.length_bytes > 0
        delay_s = np.zeros(n_messages) if messages.delay_s is None else messages.delay_s
        sender, b, length_m = neighbours(xy_m, p.range_m)
        ptr = ptr_of(sender, n)
        network = _Network(ptr, b, length_m, key)
        sent = _Sent(ptr_of(station, n), station, message_key, sends, delay_s)

        tried = int(((ptr[1:] - ptr[:-1])[station]).sum())
        rows = _rows(tried)
        tried = _first_hop(network, sent, rules, rows)
        message, to, apart_m, outcome, arrival_s = (column[:tried] for column in rows)
        attempts = [(message, to, np.ones(tried, np.int64), apart_m, outcome)]
        n_duplicate = n_relayed = 0
        n_transmissions = sends.astype(int)
        got = np.flatnonzero(outcome == _RECEIVED)
        message, transmitter, age_s = message[got], to[got], arrival_s[got]
        received = [(transmitter, message, np.ones(len(got), np.int64), age_s)]
        known = [np.flatnonzero(sends) * n + station[sends], message * n + transmitter]
        for hop in range(2, relay.max_hops + 1):
            if not len(message):
                break
            source = station[message]
            forwards = np.linalg.norm(xy_m[transmitter] - xy_m[source], axis=1) <= relay.forward_range_m
            if relay.rule == "probability":
                draw_key = rng.keys(rng_key, np.array([rng.Stream.RELAY]))[0]
                forwards &= rng.uniforms(draw_key, message_key[message], key[transmitter])[:, 0] < relay.forward_p
            message, transmitter, age_s = message[forwards], transmitter[forwards], age_s[forwards]
            n_transmissions += np.bincount(message, minlength=n_messages)
            n_relayed += len(message)
            tried = int(np.sum(ptr[transmitter + 1] - ptr[transmitter]))
            rows, via = _rows(tried), np.empty(tried, np.int64)
            tried = _next_hop(network, sent, _Forwarded(message, transmitter, age_s), rules, rows, via)
            message, to, apart_m, outcome, arrival_s = (column[:tried] for column in rows)
            attempts.append((message, to, np.full(tried, hop), apart_m, outcome))
            keep, new = _first_copies(message, to, via[:tried], arrival_s, outcome, n, known)
            n_duplicate += int(np.sum(~new))
            keep = keep[new]
            message, transmitter, age_s = message[keep], to[keep], arrival_s[keep]
            known.append(message * n + transmitter)
            received.append((transmitter, message, np.full(len(keep), hop), age_s))
        receiver, message, hops, age_s = (np.concatenate(c) for c in zip(*received, strict=True))
        offset_s, zero = delay_s[message], np.zeros(len(message))
        if len(received) == 1:  # in order already
            away_m = attempts[0][3][got]
            receptions = Receptions(receiver, message, hops.astype(np.int32), offset_s, zero, age_s - offset_s, away_m)
        else:
            receptions = receptions_of(receiver, message, hops, offset_s, zero, age_s - offset_s, station, xy_m)
        message, to, hop_of, apart_m, outcome = (np.concatenate(c) for c in zip(*attempts, strict=True))
        frames = FrameOutcomes(
            message, to, hop_of, apart_m, np.full(len(to), LosState.UNKNOWN, np.uint8), outcome, n_transmissions,
            n_relayed, n_duplicate, float(n_transmissions @ messages.length_bytes), None,
        )  # fmt: skip
        return None, MessageRound(station, receptions, frames)


def _first_copies(
    message: Int[ndarray, "t"], to: Int[ndarray, "t"], via: Int[ndarray, "t"], arrival_s: Float[ndarray, "t"],
    outcome: Int[ndarray, "t"], n: int, known: list[Int[ndarray, "k"]],
) -> tuple[Int[ndarray, "g"], ndarray]:  # fmt: skip
    """Received frames, sorted by message, receiver, arrival and transmitter, and which of them bring a new message."""
    keep = np.flatnonzero(outcome == Outcome.RECEIVED)
    keep = keep[np.lexsort((via[keep], arrival_s[keep], message[keep] * n + to[keep]))]
    pair = message[keep] * n + to[keep]
    new = np.ones(len(keep), bool)
    new[1:] = pair[1:] != pair[:-1]
    return keep, new & ~np.isin(pair, np.concatenate(known))
