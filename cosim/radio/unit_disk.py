"""The medium `unit_disk`: every station in range receives a frame, except for a constant loss probability."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base import rng
from cosim.base.codes import LosState
from cosim.base.ragged import differs_from_last, expand, order_by_two, ptr_of
from cosim.radio.link_budget import neighbours
from cosim.radio.message_round import (
    FrameOutcomes,
    MessageRound,
    Messages,
    Outcome,
    Receptions,
    RoundKind,
    Stations,
    receptions_of,
)
from cosim.radio.params import RadioParams
from sensors.line_of_sight import LosOfPlaces


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
        ignores copies. A station that receives a message for the first time forwards it, if hops remain, if the
        message's sender is within the forwarding range, and if it does not refuse it.
        """
        p, relay, disk = self.params, self.params.relay, self.params.unit_disk
        streams = rng.Stream.RADIO_DETECTIONS, rng.Stream.RADIO_EVALUATIONS
        rng_key = rng.key(self.seed, streams[kind], step)
        n = len(stations)
        n_messages = len(messages)
        xy_m = stations.xyz_m[:, :2]
        key = stations.key
        station, message_key = messages.station, messages.keys(stations)
        delay_s = np.zeros(n_messages) if messages.delay_s is None else messages.delay_s
        sender, neighbour, length_m = neighbours(xy_m, p.range_m)
        ptr = ptr_of(sender, n)

        message = np.flatnonzero(messages.length_bytes > 0)
        transmitter, age_s = station[message], delay_s[message]
        attempts, received, known = [], [], [message * n + transmitter]
        n_transmissions, n_duplicate, n_relayed = np.zeros(n_messages, np.int64), 0, 0
        for hop in range(1, relay.max_hops + 1):
            if hop > 1:
                away_m = np.linalg.norm(xy_m[transmitter] - xy_m[station[message]], axis=1)
                forwards = away_m <= relay.forward_range_m
                if relay.rule == "probability":
                    draw_key = rng.keys(rng_key, np.array([rng.Stream.RELAY]))[0]
                    draw = rng.uniforms(draw_key, message_key[message], key[transmitter])[:, 0]
                    forwards &= draw < relay.forward_p
                if messages.refused is not None:
                    forwards &= ~np.isin(message << 32 | transmitter, messages.refused)
                message, transmitter, age_s = message[forwards], transmitter[forwards], age_s[forwards]
                n_relayed += len(message)
            n_transmissions += np.bincount(message, minlength=n_messages)
            link, which = expand(ptr[transmitter], ptr[transmitter + 1])
            others = neighbour[link] != station[message[which]]  # not the message's sender
            link, which = link[others], which[others]
            if hop == 1:
                order = order_by_two(neighbour[link], message[which], max(n, n_messages))
                link, which = link[order], which[order]
            message = message[which]
            via = transmitter[which]
            to = neighbour[link]
            apart_m = length_m[link]
            draws = rng.uniforms(rng_key, message_key[message], key[via], key[to], n=2)
            spread_s = disk.latency_max_s - disk.latency_min_s
            arrival_s = age_s[which] + disk.latency_min_s + spread_s * draws[:, 1]
            outcome = np.where(arrival_s <= self.round_s, int(Outcome.RECEIVED), int(Outcome.LATE))
            outcome[draws[:, 0] < disk.loss_p] = Outcome.PROPAGATION
            attempts.append((message, to, np.full(len(to), hop), apart_m, outcome))
            keep = np.flatnonzero(outcome == Outcome.RECEIVED)
            if hop > 1:
                keep, new = _first_copies(message, to, via, arrival_s, outcome, n, known)
                n_duplicate += int(np.sum(~new))
                keep = keep[new]
            message, transmitter, age_s = message[keep], to[keep], arrival_s[keep]
            known.append(message * n + transmitter)
            received.append((transmitter, message, np.full(len(keep), hop), age_s))
            if not len(message):
                break
        receiver, message, hops, age_s = map(np.concatenate, zip(*received, strict=True))
        offset_s, zero = delay_s[message], np.zeros(len(message))
        latency_s = age_s - offset_s
        if len(received) == 1:  # in order already
            hops = hops.astype(np.int32)
            receptions = Receptions(receiver, message, hops, offset_s, zero, latency_s, apart_m[keep])
        else:
            receptions = receptions_of(receiver, message, hops, offset_s, zero, latency_s, station, xy_m)
        message, to, hop_of, apart_m, outcome = map(np.concatenate, zip(*attempts, strict=True))
        frames = FrameOutcomes(
            message,
            to,
            hop_of,
            apart_m,
            np.full(len(to), LosState.UNKNOWN, np.uint8),
            outcome,
            n_transmissions,
            n_relayed,
            n_duplicate,
            float(n_transmissions @ messages.length_bytes),
            None,
        )
        return None, MessageRound(station, receptions, frames)


def _first_copies(
    message: Int[ndarray, "t"],
    to: Int[ndarray, "t"],
    via: Int[ndarray, "t"],
    arrival_s: Float[ndarray, "t"],
    outcome: Int[ndarray, "t"],
    n: int,
    known: list[Int[ndarray, "k"]],
) -> tuple[Int[ndarray, "g"], ndarray]:
    """Received frames, sorted by message, receiver, arrival and transmitter, and which of them bring a new message."""
    keep = np.flatnonzero(outcome == Outcome.RECEIVED)
    pair = message[keep] * n + to[keep]
    order = np.lexsort((via[keep], arrival_s[keep], pair))
    keep, pair = keep[order], pair[order]
    is_known = np.isin(pair, np.concatenate(known))
    return keep, differs_from_last(pair) & ~is_known
