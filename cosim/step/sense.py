"""Vehicles sense: their pseudonyms, what they perceive, where they estimate themselves to be, and their tracks.

A stage that changes a part of the state takes it as an argument and returns its new value before the result.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.attacks.adversary import ActiveAttacks
from cosim.base.plane import wrapped
from cosim.config.config import Config
from cosim.messages.content import FABRICATED, SELF, SENSED
from cosim.messages.pseudonyms import PseudonymState, PseudonymUse
from cosim.step.exchange import Times, Vehicles
from cosim.step.parts import Parts
from cosim.step.perception import Observed
from cosim.step.positioning import as_estimated
from cosim.step.precomputed import Precomputed
from cosim.traffic.position_errors import PositionErrors
from cosim.world import World
from sensors.tracking.track import track
from sensors.tracking.tracks import Found, ObjectStates, Observers, TrackMemory


def identify(
    world: World, pseudonyms: PseudonymState, own_trust: Float[ndarray, "n"] | None, now: Times, parts: Parts
) -> tuple[PseudonymState, Vehicles, PseudonymUse]:
    """Issue pseudonyms to the equipped vehicles on the road.

    A vehicle gets a pseudonym when it enters, and changes it only in steps in which it senses.

    Parameters
    ----------
    world
        All actors.
    pseudonyms
        State of the pseudonyms.
    own_trust
        Trust in each actor, as the actor itself last learned it; None if no attack reads it.
    now
        Times of the step.
    parts
        Components of the run.

    Returns
    -------
    The new state of the pseudonyms, the vehicles with their pseudonyms, and the pseudonyms that have ended.
    """
    row, sensing = np.flatnonzero(world.equipped), parts.sensing(world)
    actor = world.actor[row]
    names = world.name_key[row]
    ended = PseudonymUse.none()
    issued = np.union1d(sensing, row[pseudonyms.of(actor) < 0])
    if len(issued):
        wants = None
        if parts.adversary.renews:
            age_steps = world.step - pseudonyms.begun(world.actor, world.step)
            age_s = age_steps * parts.config.traffic.step_s
            wants = parts.adversary.renewals(world, now.begin_s, own_trust, age_s)[issued]
        pseudonyms, ended = parts.pseudonyms.issue(pseudonyms, world, issued, wants)
    vehicles = Vehicles(
        row=row,
        actor=actor,
        name_key=names,
        pseudonym=pseudonyms.of(actor),
        senses=np.searchsorted(row, sensing),
    )
    return pseudonyms, vehicles, ended


def perceive(world: World, vehicles: Vehicles, precomputed: Precomputed, parts: Parts) -> Observed:
    """What the vehicles perceive that sense in this step."""
    if precomputed.observed is None:
        return parts.perception(world, vehicles.row[vehicles.senses], parts.watch)
    with parts.watch("wait for sensing"):
        return precomputed.observed()


def mislead(observed: Observed, attacks: ActiveAttacks) -> Observed:
    """Add the phantoms that real objects of attackers make detectors report: false positives with a cause."""
    seen = attacks.phantoms(observed.detections)
    if len(seen) == len(observed.detections):
        return observed
    phantom = seen.origin == FABRICATED
    sensed = seen.origin != SELF
    added, n = phantom[sensed], int(sensed.sum())
    is_real = np.zeros(n, bool)
    actor_row = np.zeros(n, observed.actor_row.dtype)
    is_real[~added], actor_row[~added] = observed.is_real, observed.actor_row
    return replace(
        observed,
        detections=replace(seen, origin=np.where(phantom, np.uint8(SENSED), seen.origin), target=seen.observer),
        is_real=is_real,
        actor_row=actor_row,
        caused_by=np.where(added, seen.target[sensed], -1),
    )


@dataclass(frozen=True, slots=True)
class Positioned:
    """What vehicles perceive, at their estimated positions."""

    observed: Observed
    world: World
    """The world with every vehicle at its estimated pose; the true world without `[gnss]`. Vehicles compare received
    boxes with it."""
    error: Float[ndarray, "e 3"] | None
    """Errors of each vehicle, estimated minus true: east [m], north [m], heading [rad]; None without `[gnss]`."""
    objects: ObjectStates | None = None
    """What tracking says about the detector's reports, in the order of the detections; None without tracking."""


def position(
    world: World, vehicles: Vehicles, observed: Observed, errors: PositionErrors, config: Config
) -> tuple[PositionErrors, Positioned]:
    """Apply position errors to what vehicles perceive; return the new state of the errors and the result.

    Sensors, self-reports and detections are displaced and turned by the errors of their vehicle. The surroundings keep
    their position relative to the vehicle. Received objects are displaced relative to them by the difference of two
    errors.
    """
    row, gnss, step_s = vehicles.row, config.gnss, config.traffic.step_s
    if gnss.is_exact:
        return errors, Positioned(observed, world, None)
    actor, name_key = vehicles.actor, vehicles.name_key
    errors, error = errors.next(world.step, actor, name_key, gnss, step_s, config.seed)
    if config.roadside:  # where a unit stands is known
        error = np.where(world.is_roadside[row, None], 0.0, error)
    xyz_m, yaw_rad = world.boxes.xyz_m, world.boxes.yaw_rad
    sensing, of_sensing = row[vehicles.senses], error[vehicles.senses]
    detections = observed.detections
    observer = np.searchsorted(sensing, detections.observer)
    boxes = as_estimated(detections.boxes, observer, xyz_m[sensing], of_sensing)
    observed = replace(
        observed, sweeps=observed.sweeps.displaced(of_sensing), detections=replace(detections, boxes=boxes)
    )
    xyz_m = xyz_m.copy()
    xyz_m[row, :2] += error[:, :2]
    if error[:, 2].any():
        yaw_rad = yaw_rad.copy()
        yaw_rad[row] = wrapped(yaw_rad[row] + error[:, 2])
    estimated = replace(world, boxes=replace(world.boxes, xyz_m=xyz_m, yaw_rad=yaw_rad))
    return errors, Positioned(observed, estimated, error)


def track_objects(
    world: World, vehicles: Vehicles, positioned: Positioned, memory: TrackMemory, now: Times, parts: Parts
) -> tuple[TrackMemory, Positioned]:
    """Give the objects that the detector reports velocities, numbers, ages and probabilities of existence.

    Parameters
    ----------
    world
        All actors at their true positions.
    vehicles
        Equipped vehicles. The tracks of those that do not sense in this step stay as they are.
    positioned
        What those perceive that sense.
    memory
        The tracks of all vehicles.
    now
        Times of the step.
    parts
        Components of the run.

    Returns
    -------
    The tracks after the step, and what vehicles perceive with the velocities of objects. Where the velocity is known,
    boxes are moved by it from the moment at which the sensor looked there to the time of the sweep. Sizes, headings and
    scores stay those of the detector.
    """
    if parts.config.tracking.model == "none":
        return memory, positioned
    detections, rows = positioned.observed.detections, vehicles.row[vehicles.senses]
    sensed = np.flatnonzero(detections.origin == SENSED)
    boxes, sweeps = detections.boxes.take(sensed), positioned.observed.sweeps
    after_s = sweeps.seen_after_s(np.searchsorted(rows, detections.observer[sensed]), boxes.xyz_m)
    actor = world.actor[rows].astype(np.int64)
    time_s = np.full(len(rows), now.begin_s)
    memory, objects = track(
        memory,
        Observers(actor, time_s, world.speed_mps[rows]),
        Found(
            observer=world.actor[detections.observer[sensed]].astype(np.int64),
            label=detections.label[sensed],
            xy_m=boxes.xyz_m[:, :2],
            yaw_rad=boxes.yaw_rad,
            score=detections.score[sensed],
            limit_mps=parts.limits.at(boxes.xyz_m[:, :2]),
            after_s=after_s,
        ),
        parts.config.tracking,
    )
    velocity_mps = detections.velocity_mps.copy()
    velocity_mps[sensed] = objects.velocity_mps
    xyz_m = detections.boxes.xyz_m.copy()
    moved_m = after_s[:, None] * np.nan_to_num(objects.velocity_mps)
    xyz_m[sensed, :2] -= moved_m
    at_sweep = replace(detections, velocity_mps=velocity_mps, boxes=replace(detections.boxes, xyz_m=xyz_m))
    observed = replace(positioned.observed, detections=at_sweep)
    return memory, replace(positioned, observed=observed, objects=objects)
