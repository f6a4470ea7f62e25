"""What each vehicle will say: who sends, under which identities, and the detections of every list.

A stage that changes a part of the state takes it as an argument and returns its new value before the result.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.attacks.adversary import ActiveAttacks
from cosim.attacks.disguise import numbered
from cosim.messages.content import (
    SELF,
    SENSED,
    Detections,
)
from cosim.messages.cpm_generation import CpmContent, CpmState, Generators, generate
from cosim.messages.pseudonyms import PseudonymState
from cosim.radio.medium import gap_s
from cosim.step.accuracy import Reporters, stated
from cosim.step.exchange import Exchange, Senders, Vehicles
from cosim.step.ground_truth import GroundTruth, ground_truth_of, lies_in_detections
from cosim.step.known import for_trust
from cosim.step.parts import Parts
from cosim.step.sense import Positioned
from cosim.world import World
from sensors.tracking.tracks import ObjectStates
from trust import tables


def senders_among(world: World, vehicles: Vehicles) -> Bool[ndarray, "n"] | None:
    """Actors that send messages in this step, by row of the world; None if all equipped vehicles do."""
    if len(vehicles.senses) == len(vehicles):
        return None
    sends = np.zeros(len(world), bool)
    sends[vehicles.row[vehicles.senses]] = True
    return sends


def senders_of(
    world: World, vehicles: Vehicles, attacks: ActiveAttacks, pseudonyms: PseudonymState, parts: Parts
) -> tuple[PseudonymState, Senders]:
    """The messages of one round, one per vehicle that senses and identity, with their pseudonyms."""
    senders = Senders.of(vehicles, attacks.identities()[vehicles.row[vehicles.senses]])
    more = np.flatnonzero(senders.identity)
    if len(more):
        pseudonym = senders.pseudonym.copy()
        pseudonyms, pseudonym[more] = parts.pseudonyms.issue_extra(
            pseudonyms, vehicles.actor[senders.vehicle[more]], senders.identity[more], world.step
        )
        senders = replace(senders, pseudonym=pseudonym)
    is_valid, pseudonyms = parts.revocation.valid(pseudonyms, senders.pseudonym, world.step)
    return pseudonyms, replace(senders, is_valid=is_valid)


@dataclass(frozen=True, slots=True)
class Listed:
    """The detections that every vehicle lists, after attacks, whether it transmits them or not."""

    objects: Detections
    truth: GroundTruth
    detections: tables.SentDetections
    """These detections in the form that `trust` uses, with the message as a row of `Senders`."""
    ptr: Int[ndarray, "m+1"]
    """Row at which the detections of each message begin."""
    withheld: Bool[ndarray, "d"]
    """Whether an attack withholds a detection that the detector made."""
    n_dropped: Int[ndarray, "f"]
    """Number of detections that cannot be sent, by `DetectionFault`."""
    tracks: ObjectStates | None
    """What tracking says about the sensed detections, in their order; None without tracking."""
    content: CpmContent
    """What each message contains."""


def list_objects(
    exchange: Exchange,
    positioned: Positioned,
    acceleration_mps2: Float[ndarray, "n"],
    cpm: CpmState,
    medium: object,
    parts: Parts,
) -> tuple[CpmState, Listed]:
    """Detections as each vehicle lists them, after attacks, generation rules and redundancy mitigation.

    Parameters
    ----------
    exchange
        Vehicles, senders and attacks of the step.
    positioned
        What vehicles perceive, at their estimated positions.
    acceleration_mps2
        Acceleration of every actor.
    cpm
        State of the detection messages.
    medium
        State of the medium. It is read only: its congestion control limits the rate of messages.
    parts
        Components of the run.

    Returns
    -------
    The new state of the detection messages, and the lists.
    """
    world, sensing, senders, attacks = exchange.world, exchange.sensing, exchange.senders, exchange.attacks
    observed, vehicles = positioned.observed, exchange.vehicles
    perceived = _with_motion(observed.detections, world.speed_mps, acceleration_mps2)
    said, n_dropped = attacks.detections(perceived)
    on_purpose = attacks.malicious()
    message = senders.message_of(said, sensing.row)
    gaps_s = np.zeros(len(exchange.stations))
    if parts.config.cpm.rules != "all":
        gaps_s = gap_s(parts.medium, medium, exchange.stations)
    generators = Generators(
        sender=exchange.sender,
        actor=vehicles.actor[senders.vehicle],
        xy_m=positioned.world.boxes.xyz_m[vehicles.row[senders.vehicle], :2],
        gap_s=gaps_s[senders.vehicle],
        interval_s=parts.schedule.longest_steps * parts.config.traffic.step_s,
    )
    is_sensed = said.origin == SENSED
    track = np.full(len(said), -1)
    if positioned.objects is not None:
        track[is_sensed] = positioned.objects.object_id
    begin_s, params = exchange.now.begin_s, parts.config.cpm
    cpm, content = generate(cpm, said, message, generators, begin_s, params, track)
    objects = replace(said, transmitted=content.included)
    lied = lies_in_detections(perceived, said, on_purpose)
    truth = ground_truth_of(objects, world, observed, sensing.row, lied)
    withheld = is_sensed & ~said.transmitted
    was_sensed = np.cumsum(is_sensed) - 1
    objects, order = numbered(objects, world.name_key, parts.config.seed, world.step)
    tracks = positioned.objects
    if tracks is not None:
        tracks = tracks.take(was_sensed[order[objects.origin == SENSED]])
    if parts.config.trust.matching == "gates":
        reporters = Reporters.of(world, objects, sensing.row, observed.sweeps, parts.config)
        limit_mps = parts.limits.at(objects.boxes.xyz_m[:, :2])
        objects = stated(objects, tracks, reporters, limit_mps, parts.accuracy, parts.config)
    detections, ptr = for_trust(objects, message, len(senders))
    return cpm, Listed(
        objects=objects,
        truth=truth.take(order),
        detections=detections,
        ptr=ptr,
        withheld=withheld[order],
        n_dropped=n_dropped,
        content=replace(content, inclusion=content.inclusion[order]),
        tracks=tracks,
    )


def _with_motion(
    listed: Detections, speed_mps: Float[ndarray, "n"], acceleration_mps2: Float[ndarray, "n"]
) -> Detections:
    """The detections, with speeds and accelerations (by row of the world) written into the self reports."""
    speed, acceleration = listed.speed_mps.copy(), listed.acceleration_mps2.copy()
    rows = np.flatnonzero(listed.origin == SELF)
    speed[rows] = speed_mps[listed.observer[rows]]
    acceleration[rows] = acceleration_mps2[listed.observer[rows]]
    return replace(listed, speed_mps=speed, acceleration_mps2=acceleration)
