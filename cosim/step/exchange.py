"""The participants of a step's message exchange: vehicles, stations, times and identities."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int, UInt64
from numpy import ndarray

from cosim.attacks.adversary import ActiveAttacks
from cosim.attacks.attack import Sending
from cosim.base import rng
from cosim.base.ragged import differs_from_last, expand, place_in_group
from cosim.config.config import Config
from cosim.messages.content import Detections
from cosim.radio.bodies import Bodies
from cosim.radio.message_round import (
    ChannelAbuse,
    LinkReceptions,
    MessageRound,
    Messages,
    Receptions,
    Stations,
    by_link,
)
from cosim.radio.rsu import RsuAntennas
from cosim.radio.segmentation import ENVELOPE_BYTES
from cosim.world import World


@dataclass(frozen=True, slots=True)
class Times:
    """Times within a step [s]."""

    step: int
    begin_s: float
    evaluated_s: float
    """When detection messages have arrived and evaluation messages are sent."""
    fused_s: float
    """When evaluation messages have arrived and vehicles fuse."""

    @staticmethod
    def of(step: int, config: Config) -> "Times":
        """Times of the step with this number."""
        begin_s = step * config.traffic.step_s
        return Times(step, begin_s, begin_s + config.round_s, begin_s + 2 * config.round_s)


@dataclass(frozen=True, slots=True)
class Vehicles:
    """Equipped vehicles on the road, sorted by actor number."""

    row: Int[ndarray, "e"]
    """Row of the world."""
    actor: Int[ndarray, "e"]
    name_key: UInt64[ndarray, "e"]
    pseudonym: Int[ndarray, "e"]
    """Pseudonym of each vehicle's own identity."""
    senses: Int[ndarray, "s"]
    """Rows of those that sense in this step, ascending."""

    def __len__(self) -> int:
        return len(self.row)

    def sensing(self) -> "Vehicles":
        """The vehicles that sense in this step; the same object if all do."""
        if len(self.senses) == len(self):
            return self
        at = self.senses
        return Vehicles(
            row=self.row[at],
            actor=self.actor[at],
            name_key=self.name_key[at],
            pseudonym=self.pseudonym[at],
            senses=np.arange(len(at)),
        )


@dataclass(frozen=True, slots=True)
class Senders:
    """Messages of one kind in a step, one per vehicle that senses and identity, sorted by vehicle with the own identity
    first."""

    vehicle: Int[ndarray, "m"]
    """Row of `Vehicles`, and of the sending station."""
    source: Int[ndarray, "m"]
    """Row of the vehicles that sense: of their sweeps and their lists."""
    identity: Int[ndarray, "m"]
    """0 for the vehicle's own identity."""
    pseudonym: Int[ndarray, "m"]
    own: Int[ndarray, "s"]
    """Message row of the own identity of each vehicle that senses."""
    key: UInt64[ndarray, "m"]
    """Random key of each message; for the own identity, the vehicle's key."""
    is_valid: Bool[ndarray, "m"]
    """False if the pseudonym has been revoked; receivers then drop the message."""

    def __len__(self) -> int:
        return len(self.vehicle)

    @staticmethod
    def of(vehicles: Vehicles, n_extra: Int[ndarray, "s"]) -> "Senders":
        """Messages of the vehicles that sense: of each own identity, and of `n_extra` further identities of each.

        The further identities have no pseudonyms yet; they carry that of the vehicle.
        """
        n = len(vehicles.senses)
        source = np.repeat(np.arange(n), 1 + n_extra)
        own = np.searchsorted(source, np.arange(n))
        identity = np.arange(len(source)) - own[source]
        vehicle = source if n == len(vehicles) else vehicles.senses[source]
        key = vehicles.name_key[vehicle]
        more = np.flatnonzero(identity)
        if len(more):
            of_identities = rng.key(0, rng.Stream.SENDER)
            key[more] = rng.keys(of_identities, key[more], identity[more])
        pseudonym = vehicles.pseudonym[vehicle]
        return Senders(
            vehicle=vehicle,
            source=source,
            identity=identity,
            pseudonym=pseudonym,
            own=own,
            key=key,
            is_valid=np.ones(len(vehicle), bool),
        )

    def message_of(self, listed: Detections, observers: Int[ndarray, "e"]) -> Int[ndarray, "d"]:
        """Message row of each detection.

        Parameters
        ----------
        listed
            Detections of these vehicles, under identities that have a message.
        observers
            Row of the world of each vehicle that senses, ascending.
        """
        return self.own[np.searchsorted(observers, listed.observer)] + listed.identity


Refused = tuple[Int[ndarray, "p"], Int[ndarray, "p"]]
"""Rows of `Senders` and of `Vehicles`: messages that a vehicle does not forward."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """The participants, positions and times of the two rounds of messages of a step."""

    world: World
    now: Times
    vehicles: Vehicles
    """All equipped vehicles on the road. They receive."""
    sensing: Vehicles
    """Those that sense, send, evaluate and fuse in this step."""
    senders: Senders
    stations: Stations
    """Antennas of the vehicles, then of the roadside units."""
    attacks: ActiveAttacks
    """Attacks that are carried out in this step."""
    sending: Sending | None
    """How vehicles delay, copy, flood or jam, by row of `vehicles`; None if no vehicle does."""
    refused: Refused | None = None
    """None without relay control."""

    @staticmethod
    def of(
        world: World, now: Times, vehicles: Vehicles, senders: Senders, stations: Stations, attacks: ActiveAttacks
    ) -> "Exchange":
        """Apply the effects of this step's attacks on the channel and on the sending of messages."""
        sending = attacks.sending().take(vehicles.row)
        if sending.abuses_channel().any():
            stations = replace(stations, abuse=abuse_of(sending, len(stations) - len(vehicles)))
        return Exchange(
            world=world,
            now=now,
            vehicles=vehicles,
            sensing=vehicles.sensing(),
            senders=senders,
            stations=stations,
            attacks=attacks,
            sending=sending if sending.attacks().any() else None,
        )

    @property
    def n_rsus(self) -> int:
        """Number of roadside units with an antenna."""
        return len(self.stations) - len(self.vehicles)

    @property
    def sender(self) -> Int[ndarray, "m"]:
        """The sender's actor number and identity in one number, per message; the same in every step."""
        actor = self.vehicles.actor[self.senders.vehicle]
        return actor.astype(np.int64) << 16 | self.senders.identity


def stations_of(world: World, row: Int[ndarray, "v"], rsus: RsuAntennas, above_roof_m: float) -> Stations:
    """Antennas of the vehicles in these rows of the world, then of the roadside units.

    `above_roof_m` is the height of the vehicles' antennas above their roofs.
    """
    key = np.concatenate([world.name_key[row], rsus.key])
    height_m = world.boxes.lwh_m[row, 2]
    xyz_m = np.concatenate([world.boxes.xyz_m[row], rsus.xyz_m])
    xyz_m[: len(row), 2] += height_m / 2 + above_roof_m
    above_street_m = np.concatenate([height_m + above_roof_m, rsus.above_street_m])
    own = np.concatenate([row, np.full(len(rsus.key), -1)])
    lwh_m = world.boxes.lwh_m
    if world.is_roadside.any():  # a mast obstructs no link
        lwh_m = np.where(world.is_roadside[:, None], 0.0, lwh_m)
    bodies = Bodies(world.boxes.xyz_m, lwh_m, world.boxes.yaw_rad, own)
    return Stations(key, xyz_m, len(row), above_street_m, bodies=bodies)


def abuse_of(sending: Sending, n_rsus: int) -> ChannelAbuse:
    """Effects of attacks on the channel, per station: vehicles, then roadside units, which never attack."""
    every = Sending.concat([sending, Sending.plain(n_rsus)])
    return ChannelAbuse(every.jam_dbm, every.react_dbm, every.ignores_dcc)


@dataclass(frozen=True, slots=True)
class OnAir:
    """Frames to be sent in a round, one per message and copy; those of roadside units are last."""

    messages: Messages
    message: Int[ndarray, "a"]
    """Row of `Senders`; the numbers of roadside units follow."""

    @staticmethod
    def of(
        exchange: Exchange,
        length_bytes: Int[ndarray, "m"],
        rsu_bytes: int = 0,
        sending: Sending | None = None,
        envelope_bytes: Int[ndarray, "m"] | None = None,
    ) -> "OnAir":
        """Frames of vehicles and roadside units.

        Parameters
        ----------
        length_bytes
            Length of each message of the vehicles; 0 if it is not sent.
        rsu_bytes
            Length of the one message of each roadside unit.
        sending
            How vehicles send, by row of `Vehicles`. None if all send honestly.
        envelope_bytes
            What each segment of the vehicles' messages repeats, as in `Messages`.
        """
        vehicle, n_rsus = exchange.senders.vehicle, exchange.n_rsus
        length = np.append(length_bytes, np.full(n_rsus, rsu_bytes))
        station = np.append(vehicle, len(exchange.vehicles) + np.arange(n_rsus))
        message = np.arange(len(station))
        envelope = None
        if envelope_bytes is not None:
            envelope = np.append(envelope_bytes, np.full(n_rsus, ENVELOPE_BYTES))
        if sending is None:
            return OnAir(Messages(station, length, envelope_bytes=envelope), message)
        delay_s = np.append(sending.delay_s[vehicle], np.zeros(n_rsus))
        n_copies = np.append(sending.n_copies[vehicle], np.zeros(n_rsus, np.int64))
        row = np.repeat(message, 1 + n_copies)
        # Copies come after all original messages of the station.
        order = np.lexsort((row, place_in_group(row), station[row]))
        row = row[order]
        if envelope is not None:
            envelope = envelope[row]
        return OnAir(Messages(station[row], length[row], delay_s[row], envelope), row)

    def without(self, refused: Refused | None) -> "OnAir":
        """These frames without the forwarding that vehicles refuse, as in `Exchange.refused`."""
        if refused is None:
            return self
        order = np.argsort(self.message, kind="stable")
        ordered = self.message[order]
        message, vehicle = refused
        begin = np.searchsorted(ordered, message, "left")
        end = np.searchsorted(ordered, message, "right")
        at, which = expand(begin, end)
        pairs = np.sort(order[at] << 32 | vehicle[which])
        return replace(self, messages=replace(self.messages, refused=pairs))

    def links(self, found: MessageRound, n_vehicles: int) -> LinkReceptions:
        """Receptions by kind of link, with messages as rows of `Senders`. The first copy to arrive counts."""
        links = by_link(found, n_vehicles)
        if (np.diff(self.message) == 1).all():
            return links
        return LinkReceptions(*(self._once(received) for received in links))

    def _once(self, found: Receptions) -> Receptions:
        """The first reception of each message by each receiver, among all copies."""
        found = replace(found, message=self.message[found.message])
        found = found.take(np.lexsort((found.received_s, found.message, found.receiver)))
        pair = found.receiver.astype(np.int64) << 32 | found.message
        return found.take(differs_from_last(pair))
