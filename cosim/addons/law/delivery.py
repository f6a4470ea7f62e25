"""Delivery of broadcast messages between equipped vehicles, from their positions and the parameters of the radio."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray
from scipy.special import gammainc

from cosim.base import rng
from cosim.base.codes import ObjectClass
from cosim.base.ragged import owner_of_rows, rows_of
from cosim.config.config import Config
from cosim.messages import cpm
from cosim.messages.cellular import CellularParams
from cosim.messages.content import NETWORK_BYTES, SIGNATURE_BYTES, cpm_bytes
from cosim.messages.cpm_params import CpmParams
from cosim.radio import link_budget
from cosim.radio.medium import Medium
from cosim.radio.message_round import MessageRound, Messages, RoundKind, Stations
from cosim.radio.params import RadioParams
from cosim.radio.phy import CURVES, MAC_OVERHEAD_BYTES, ReceiverParams
from cosim.radio.propagation import fading_quantiles
from cosim.radio.rsu import NO_RSUS
from cosim.radio.segmentation import segments
from cosim.step.exchange import stations_of
from cosim.world import World
from sensors.line_of_sight import LosOfPlaces

_DB_STEP = 0.25
"""Step of the table of success over mean power [dB]."""


class LinkPairs(NamedTuple):
    """Pairs of a sender and a receiver with a link; rows of the equipped vehicles."""

    sender: Int[ndarray, "p"]
    receiver: Int[ndarray, "p"]
    delivered_p: Callable[[Float[ndarray, "e"]], Float[ndarray, "p"]]
    """From the length of each vehicle's message [B]: the probability that each link delivers it on an idle channel."""
    crowd: Int[ndarray, "p"]
    """Class of each link by its mean power, and by the number of stations that its receiver hears."""
    stations: Stations
    """The vehicles as stations of the radio."""


_POWER_DB, _POWERS, _CROWDS, _LENGTHS = 4.0, 12, 12, 4
_CLASSES = _POWERS * _CROWDS * _LENGTHS
_SAMPLE_EVERY, _SAMPLE_STEPS = 10, 3
"""Of ten sensing steps, the channel is simulated in three: congestion control remembers earlier steps. All of the first
three count, then every third. Where messages outlast their step, it is simulated until they end, once in 20 steps."""
_IDLE_LINKS = 30.0
"""Weight of an idle channel in the estimate of `Load`, in links: a class with few links counts as idle."""


class _SentMessages(NamedTuple):
    """Messages of a step that counts, of which some may arrive later."""

    station: UInt64[ndarray, "n"]
    """Keys of the stations, ascending, and the row of each."""
    row: Int[ndarray, "n"]
    until: Int[ndarray, "n"]
    """By row: sensing step in which the station uses what it has received."""
    pair: Int[ndarray, "p"]
    """Links as sender << 32 | receiver, ascending, and the class of each."""
    of: Int[ndarray, "p"]


@dataclass(slots=True)
class Load:
    """What other frames on the channel cost: messages received over messages expected on an idle channel.

    It is measured with the radio alone, from stations and lengths of messages, in some of the sensing steps.
    """

    medium: Medium
    state: Any
    goes_on: int = 0
    """In how many further sensing steps a message may arrive."""
    sent: dict[tuple[RoundKind, int], _SentMessages] = field(default_factory=dict)
    """Messages that count, by round and sensing step."""
    received: Float[ndarray, "2 c"] = field(default_factory=lambda: np.zeros((2, _CLASSES)))
    expected: Float[ndarray, "2 c"] = field(default_factory=lambda: np.zeros((2, _CLASSES)))

    def delivered_p(
        self,
        kind: RoundKind,
        number: int,
        begin_s: float,
        links: LinkPairs,
        length_bytes: Float[ndarray, "e"],
        wait_steps: Int[ndarray, "e"] | None = None,
    ) -> Float[ndarray, "p"]:
        """Probability that each link delivers a message of a round before its receiver senses next.

        Parameters
        ----------
        kind
            Round of the step.
        number
            Number of the sensing step.
        begin_s
            When the round begins [s].
        links
            Links of the step.
        length_bytes
            Expected length of each vehicle's message; 0 for those that send none.
        wait_steps
            Sensing steps until each vehicle senses next, 0 for those that do now. None: all do.
        """
        p = links.delivered_p(length_bytes)
        length = np.where(length_bytes > 0, _whole(length_bytes), 0)
        n_frames, _ = segments(length)
        many = np.minimum(np.log2(n_frames), _LENGTHS - 1).astype(np.int64)
        of = links.crowd * _LENGTHS + many[links.sender]
        every = _SAMPLE_EVERY * (2 if self.goes_on else 1)
        if number % every < _SAMPLE_STEPS + self.goes_on:
            self.state, happened = self.medium.broadcast(
                self.state, kind, number, begin_s, links.stations, Messages.one_each(length)
            )
            if number < _SAMPLE_STEPS or number % every == _SAMPLE_STEPS - 1:
                self._count(kind, number, links, of, p, wait_steps)
            for of_kind, sent_in, messages in _rounds(kind, number, happened):
                self._receive(of_kind, sent_in, number, messages, links.stations)
        kept = (self.received[kind] + _IDLE_LINKS) / (self.expected[kind] + _IDLE_LINKS)
        return np.minimum(p * kept[of], 1.0)

    def _count(
        self,
        kind: RoundKind,
        number: int,
        links: LinkPairs,
        of: Int[ndarray, "p"],
        p: Float[ndarray, "p"],
        wait_steps: Int[ndarray, "e"] | None,
    ) -> None:
        """Add the messages that would be received on an idle channel, by class `of` the link."""
        self.expected[kind] += np.bincount(of, p, _CLASSES)
        until = np.full(len(links.stations), number) + (0 if wait_steps is None else wait_steps)
        pair = links.sender << 32 | links.receiver
        order, row = np.argsort(pair, kind="stable"), np.argsort(links.stations.key)
        for one in [one for one in self.sent if one[1] < number - self.goes_on]:
            del self.sent[one]
        keys = links.stations.key[row]
        sent = _SentMessages(keys, row, until, pair[order], of[order])
        self.sent[kind, number] = sent

    def _receive(self, kind: RoundKind, sent_in: int, number: int, happened: MessageRound, stations: Stations) -> None:
        """Add the messages of a step that were received in one, if they count and their receivers can use them."""
        sent = self.sent.get((kind, sent_in))
        if sent is None:
            return
        got = happened.receptions
        at_sender, sends = rows_of(stations.key[happened.station[got.message]], sent.station)
        at_receiver, is_there = rows_of(stations.key[got.receiver], sent.station)
        sender, receiver = sent.row[at_sender], sent.row[at_receiver]
        used = np.flatnonzero(sends & is_there & (number <= sent.until[receiver]))
        pair = sender[used] << 32 | receiver[used]
        at, is_link = rows_of(pair, sent.pair)
        self.received[kind] += np.bincount(sent.of[at[is_link]], minlength=_CLASSES)


def _rounds(kind: RoundKind, number: int, happened: MessageRound) -> Iterator[tuple[RoundKind, int, MessageRound]]:
    """What happened to the messages of a round, and to those of earlier ones: round, sensing step, and messages."""
    yield kind, number, happened
    for one in happened.earlier:
        for step in np.unique(one.step).tolist():
            yield one.kind, step, one.round.only(one.step == step)


@dataclass(frozen=True, slots=True)
class Delivery:
    """Links of the radio that a config names."""

    params: RadioParams
    seed: int
    los: LosOfPlaces

    @staticmethod
    def of(config: Config, los: LosOfPlaces) -> "Delivery":
        """The radio of a config.

        Raises
        ------
        ValueError
            If the law does not cover it.
        """
        if config.radio.model not in ("csma", "unit_disk"):
            raise ValueError(
                f'radio.model = "{config.radio.model}": the law knows the delivery of "csma" and "unit_disk" only. '
                "Set radio.model to one of them."
            )
        return Delivery(config.radio, config.seed, los)

    def links(
        self,
        world: World,
        row: Int[ndarray, "e"],
        sends: Bool[ndarray, "e"] | None = None,
    ) -> LinkPairs:
        """Links between the vehicles in these rows of the world, from those that send; None if all do."""
        stations = stations_of(world, row, NO_RSUS, self.params.antenna_above_roof_m)
        sends = np.ones(len(row), bool) if sends is None else sends
        if self.params.model == "unit_disk":
            xy_m = stations.xyz_m[:, :2]
            sender, receiver, _ = link_budget.neighbours(xy_m, self.params.range_m)
            sender, receiver = sender[sends[sender]], receiver[sends[sender]]
            p = np.full(len(sender), 1.0 - self.params.unit_disk.loss_p)
            return LinkPairs(sender, receiver, lambda length: p, np.zeros(len(sender), np.int64), stations)
        return self._csma(stations, sends)

    def _csma(self, stations: Stations, sends: Bool[ndarray, "e"]) -> LinkPairs:
        """Links of the medium `csma`: path loss, shadowing and blockage are those of the run, fading is averaged.

        `Load` adds the effect of other frames on the channel.
        """
        p, xyz_m = self.params.propagation, stations.xyz_m
        shadowing = rng.key(self.seed, rng.Stream.SHADOWING)
        links = link_budget.links_between(
            xyz_m, stations.key, p, shadowing, self.los, above_street_m=stations.above_street_m
        )
        sender = owner_of_rows(np.diff(links.ptr))
        between_m = xyz_m[sender, :2] - xyz_m[links.receiver, :2]
        in_range = np.hypot(*between_m.T) <= self.params.range_m
        detectable_dbm = self.params.receiver.detectable_dbm
        power_dbm = 10 * np.log10(links.power_mw)
        strongest_dbm = power_dbm + 10 * np.log10(fading_quantiles()[links.fading, -1])
        near = np.flatnonzero(sends[sender] & in_range & (strongest_dbm >= detectable_dbm))
        sender, receiver = sender[near], links.receiver[near].astype(np.int64)
        power_dbm, fading = power_dbm[near], links.fading[near]

        def delivered_p(length_bytes: Float[ndarray, "e"]) -> Float[ndarray, "p"]:
            n, each = segments(_whole(length_bytes))
            frame = received_p(power_dbm, fading, each[sender] + MAC_OVERHEAD_BYTES, self.params.receiver)
            return frame ** n[sender]

        heard = np.bincount(receiver, minlength=len(stations))[receiver]
        level = (power_dbm - detectable_dbm) / _POWER_DB + 2
        strength = np.clip(level, 0, _POWERS - 1).astype(np.int64)
        doublings = np.log2(np.maximum(heard, 1))
        crowd = np.minimum(doublings, _CROWDS - 1).astype(np.int64)
        return LinkPairs(sender, receiver, delivered_p, strength * _CROWDS + crowd, stations)


def expected_cpm_bytes(params: CpmParams, n_objects: Float[ndarray, "m"]) -> Float[ndarray, "m"]:
    """Expected lengths of detection messages with expected numbers of objects [B].

    With `cpm.length = "uper"`, all objects count as moving cars and all messages describe the sensors. Objects of other
    classes differ by less than a byte, and those without velocity are 6 bytes shorter.
    """
    if params.length == "linear":
        return cpm_bytes(n_objects)  # type: ignore[arg-type]  # expected numbers
    cars = np.zeros((2, len(ObjectClass)), np.int64)
    cars[1, ObjectClass.CAR] = 200
    empty, full = cpm.cpm_bytes(np.zeros_like(cars), n_moving=cars)
    return NETWORK_BYTES + SIGNATURE_BYTES + empty + n_objects * (full - empty) / 200


def _whole(length_bytes: Float[ndarray, "e"]) -> Int[ndarray, "e"]:
    """Expected lengths as lengths of messages [B]."""
    return np.maximum(np.rint(length_bytes), 1).astype(np.int64)


def received_p(
    power_dbm: Float[ndarray, "p"],
    fading: Int[ndarray, "p"],
    length_bytes: Int[ndarray, "p"],
    params: ReceiverParams,
) -> Float[ndarray, "p"]:
    """Probability that a frame is received on an idle channel, over fading.

    Parameters
    ----------
    power_dbm
        Mean received power of each link.
    fading
        Class of fading, as a row of `fading_quantiles`.
    length_bytes
        Length of the frame with its MAC overhead.
    params
        The receiver.

    Notes
    -----
    The preamble needs `params.detectable_dbm`, and the payload succeeds with the probability of `phy.CURVES`.
    Success is tabulated over the mean power in steps of 0.25 dB and over lengths in steps of 64 B.
    """
    low, table = _success(params)
    level = np.clip((power_dbm - low) / _DB_STEP, 0, table.shape[2] - 1.001)
    size = np.clip(length_bytes / 64, 0, table.shape[1] - 1)
    size = size.astype(np.int64)
    i = level.astype(np.int64)
    t = level - i
    below = table[fading, size, i]
    above = table[fading, size, i + 1]
    return (1 - t) * below + t * above


@cache
def _success(params: ReceiverParams) -> tuple[float, Float[ndarray, "classes lengths levels"]]:
    """Lowest mean power of the table [dBm], and success by fading class, length and mean power."""
    gains_db = 10 * np.log10(np.maximum(fading_quantiles().astype(float), 1e-30))
    low = params.detectable_dbm - 15.0
    mean_dbm = low + _DB_STEP * np.arange(int(75 / _DB_STEP))
    lengths = 64.0 * np.arange(1, 38)
    x0, w = CURVES[params.error_model][params.rate_mbps]
    table = np.empty((len(gains_db), len(lengths), len(mean_dbm)))
    for fading, gain_db in enumerate(gains_db):
        dbm = mean_dbm[:, None] + gain_db[None, ::8]
        snr_db = dbm - params.noise_dbm
        errors = np.exp(np.minimum((x0 - snr_db) / w, 50.0)) / 336.0
        detected = dbm >= params.detectable_dbm
        for k, length in enumerate(lengths):
            received = detected * np.exp(-length * errors)
            table[fading, k] = np.mean(received, axis=1)
    return low, table


def arrival_p(within_s: Float[ndarray, "n"], loss_p: float, n_retries: int, params: CellularParams) -> ndarray:
    """Probability that a message over the cellular network arrives within a time.

    Parameters
    ----------
    within_s
        Times since sending [s].
    loss_p
        Probability that one attempt fails.
    n_retries
        Number of attempts after the first one.
    params
        Delays of the network.

    Notes
    -----
    Attempt a + 1 succeeds with probability (1 - l) l^a. Its delay is the sum of a + 1 delays: (a + 1) delay_min plus a
    Gamma variable of shape 2 (a + 1) and scale (delay_mean - delay_min) / 2.   Deviations: none.
    """
    within_s = np.asarray(within_s, float)
    scale_s = (params.delay_mean_s - params.delay_min_s) / 2
    total = np.zeros(within_s.shape)
    for a in range(n_retries + 1):
        left_s = within_s - (a + 1) * params.delay_min_s
        if scale_s > 0:
            arrived = gammainc(2 * (a + 1), np.maximum(left_s, 0.0) / scale_s)
        else:
            arrived = (left_s >= 0).astype(float)
        total += (1 - loss_p) * loss_p**a * arrived
    return total
