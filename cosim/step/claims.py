"""Evaluations of what messages claim beyond their boxes: that they withhold nothing, and velocities (`trust.claims`).

An evaluator uses what it knows: its own detections and tracks, the messages that it has received, a map of the
buildings, and the sensor that all vehicles have. It asks about each message once, in its own next sweep. Objects move
between the sweeps of sender and evaluator, and both compare them at one time: by velocities, as far as these are known.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.ragged import expand, ptr_of
from cosim.base.rows import Rows
from cosim.config.config import Config
from cosim.messages.content import SENSED
from cosim.step.comparing import Compared
from cosim.step.exchange import Exchange
from cosim.step.known import Known
from cosim.step.parts import Parts
from cosim.world import LABELS
from sensors.boxes import Boxes, extrapolated
from sensors.coverage import at_place
from sensors.neighbours import Neighbours
from sensors.tracking.motion import confirmed_variance
from sensors.tracking.tracks import ObjectStates
from trust.claims import MISSING, N_OBJECTS, SPEED, claim_number, presence_support, velocity_support

_LEAST_VARIANCE = 0.01
"""Of a velocity that a vehicle knows of itself [m2/s2]."""
_PLACED_M = 1.0
"""Largest standard deviation of where an object was, so that vehicles ask for it: half the width of a car [m]."""


@dataclass(frozen=True, slots=True)
class Claims(Rows):
    """What vehicles find about C claims of the messages in their lists, sorted by list, member and number."""

    list: Int[ndarray, "c"]
    """Row of the vehicles that sense."""
    member: Int[ndarray, "c"]
    """Detection that makes the claim, a row of `Known`; the self report claims that the message withholds nothing."""
    number: Int[ndarray, "c"]
    """As `trust.claims.claim_number` gives it."""
    support: Float[ndarray, "c"]
    """Expected evaluation, in [-1, 1]."""


def claims_of(
    exchange: Exchange, messages: Known, compared: Compared, tracks: ObjectStates | None, parts: Parts
) -> Claims | None:
    """What every vehicle that senses finds about the claims of the messages in its list; None if it does not ask.

    Parameters
    ----------
    exchange
        Vehicles of the step.
    messages, compared
        Messages that the vehicles use, and their object lists.
    tracks
        What tracking says about the sensed detections of this step; None without tracking.
    parts
        Components of the run.
    """
    evidence = parts.config.trust.evidence
    found: list[Claims] = []
    if "missing" in evidence:
        steps = np.union1d(messages.step, exchange.now.step).tolist()
        found = [_missing(step, exchange, messages, compared, parts) for step in steps]
    if "speed" in evidence:
        found.append(_speed(exchange, messages, compared, tracks, parts))
    if not found:
        return None
    claims = Claims.concat(found)
    return claims.take(np.lexsort((claims.number, claims.member, claims.list)))


def _missing(step: int, exchange: Exchange, messages: Known, compared: Compared, parts: Parts) -> Claims:
    """Whether messages of a step have the objects that the evaluator sees and their senders should have detected.

    What a sender should have detected is what stood around it in that step. A message with as many objects as
    `cpm.max_objects` allows may lack some for that reason, and is left out.
    """
    assert parts.coverage is not None
    asked = absences_asked(step, exchange, messages, compared, parts.config.cpm.max_objects)
    then, label = _boxes_at(step, exchange, messages, parts.config), messages.detections.label
    near = Neighbours(ptr_of(asked.question, len(asked.carrier)), asked.body)
    recall = parts.coverage.expected_recall(asked.carrier, near, then, label)
    age_s = (exchange.now.step - step) * parts.config.traffic.step_s
    is_placed = _moved_sigma_m(exchange, messages, asked.body, age_s, parts) <= _PLACED_M
    is_target = asked.is_target & is_placed & (messages.detections.detection_index[asked.body] < N_OBJECTS)
    rows = np.flatnonzero(is_target & (recall > 0))
    question, body = asked.question[rows], asked.body[rows]
    reported = _reported(messages, then, messages.detections.message[asked.carrier[question]], body)
    support = presence_support(messages.detections.score[body] * recall[rows], reported)
    number = claim_number(messages.detections.detection_index[body], MISSING)
    return Claims(asked.list[question], asked.carrier[question], number, support)


def _boxes_at(step: int, exchange: Exchange, messages: Known, config: Config) -> Boxes:
    """All boxes at the time of a step, by the velocities that messages claim. The others stay where they are."""
    since = exchange.now.step if config.extrapolate else messages.step[messages.detections.message]
    forward_s = (step - since) * config.traffic.step_s
    return extrapolated(messages.objects.boxes, messages.velocity_mps, forward_s)


def _moved_sigma_m(
    exchange: Exchange, messages: Known, body: Int[ndarray, "k"], age_s: float, parts: Parts
) -> Float[ndarray, "k"]:
    """Standard deviation of the place along its way at which each body was that long ago [m].

    An object without a velocity may have any speed of its class, in either direction.
    """
    p, label = parts.config.tracking, messages.detections.label[body]
    of_track = _of_tracks(exchange, messages, body, label, parts)[:, 0]
    of_class = (np.square(p.along_mean_mps) + np.square(p.along_sigma_mps))[label]
    is_unknown = np.isnan(messages.velocity_mps[body]).any(axis=1)
    velocity_variance = np.where(is_unknown, of_class, of_track)
    acceleration_noise = np.asarray(p.acceleration_noise)[label]
    return np.sqrt(velocity_variance * age_s**2 + acceleration_noise * age_s**3 / 3.0)


def _of_tracks(
    exchange: Exchange, messages: Known, detection: Int[ndarray, "k"], label: UInt8[ndarray, "k"], parts: Parts
) -> Float[ndarray, "k 2"]:
    """Variance of the velocity of an object, along and across, when a track of the detection's sender first has it."""
    sender = messages.vehicle[messages.detections.message[detection]]
    steps, _ = parts.schedule.of_vehicles(exchange.vehicles.name_key[sender])
    intervals, which = np.unique(steps, return_inverse=True)
    interval_s = intervals * parts.config.traffic.step_s
    tables = [confirmed_variance(parts.config.tracking, one) for one in interval_s.tolist()]
    return np.reshape(tables, (len(tables), len(LABELS), 2))[which, label]


@dataclass(frozen=True, slots=True)
class Asked:
    """Q questions: does this message, in this list, lack an object? And the bodies that the evaluator knows, if any."""

    list: Int[ndarray, "q"]
    """List of the evaluator."""
    carrier: Int[ndarray, "q"]
    """Self report of the message."""
    question: Int[ndarray, "k"]
    """Ascending."""
    body: Int[ndarray, "k"]
    """Detection that stands for an object of the list, but not for the sender of the message."""
    is_target: Bool[ndarray, "k"]
    """Whether the evaluator itself detected the object, or is the object."""


def absences_asked(step: int, exchange: Exchange, messages: Known, compared: Compared, max_objects: int) -> Asked:
    """The questions about missing objects that messages of a step raise, in the lists of those to whom they are new."""
    lists, groups, of = compared.lists, compared.groups, compared.lists.of_member()
    message, is_self = messages.detections.message, messages.detections.is_self
    is_object = messages.objects.transmitted & ~is_self
    is_full = np.bincount(message[is_object], minlength=len(messages.step)) >= max_objects
    by = message[lists.member]
    foreign = messages.vehicle[by] != exchange.vehicles.senses[of]
    is_asked = foreign & (messages.step[by] == step)
    is_asked &= messages.is_new(of, lists.member)
    at = np.flatnonzero(is_self[lists.member] & is_asked & ~is_full[by])
    list_ = of[at]
    seeds = groups.seeds()
    begins = np.searchsorted(seeds, lists.ptr)
    row, question = expand(begins[list_], begins[list_ + 1])
    body = seeds[row]
    others = np.flatnonzero(body != groups.seed[at[question]])
    question, body = question[others], body[others]
    return Asked(
        list=list_,
        carrier=lists.member[at],
        question=question,
        body=lists.member[body],
        is_target=groups.ego_detected[body],
    )


def _reported(
    messages: Known,
    boxes: Boxes,
    message: Int[ndarray, "k"],
    body: Int[ndarray, "k"],
) -> Bool[ndarray, "k"]:
    """Whether each message has a detection at the place of the body in the same row, with boxes at one time."""
    objects = messages.objects
    row, of = expand(messages.ptr[message], messages.ptr[message + 1])
    some = np.flatnonzero(objects.transmitted[row] & ~messages.detections.is_self[row])
    row, of = row[some], of[some]
    there = at_place(boxes.xyz_m[row], boxes.take(body[of]))
    return np.bincount(of[there], minlength=len(body)) > 0


def _speed(
    exchange: Exchange, messages: Known, compared: Compared, tracks: ObjectStates | None, parts: Parts
) -> Claims:
    """Whether the velocities that messages claim are those of the evaluators' own tracks.

    Velocities of self reports are confirmed or denied. Those of other objects are denied only: the evaluations of the
    detections confirm the objects already, and one false speed would be lost among many right ones. A message without a
    self report says nothing here, because its sender could only be denied.
    """
    lists, groups, of = compared.lists, compared.groups, compared.lists.of_member()
    by = messages.detections.message[compared.lists.member]
    p = parts.config.tracking
    claimed_mps = messages.velocity_mps
    foreign = messages.vehicle[by] != exchange.vehicles.senses[of]
    reports_itself = np.zeros(len(messages.vehicle), bool)
    reports_itself[messages.detections.message[messages.detections.is_self]] = True
    is_asked = groups.ego_detected & foreign & reports_itself[by]
    is_asked &= messages.is_new(of, lists.member)
    has_velocity = ~np.isnan(claimed_mps[lists.member]).any(axis=1)
    at = np.flatnonzero(is_asked & has_velocity)
    own = lists.member[groups.seed[at]]
    claim = lists.member[at]
    known_mps, axis, variance = _own_velocities(exchange, messages, tracks, own, of[at])
    label = messages.detections.label[own]
    of_claim = _of_tracks(exchange, messages, claim, label, parts)
    of_claim[messages.detections.is_self[claim]] = 0.0
    age_s = (exchange.now.step - messages.detection_step(claim)) * parts.config.traffic.step_s
    of_claim += (np.asarray(p.acceleration_noise)[label] * age_s)[:, None]  # it may have accelerated since
    sigma_of_class = np.column_stack([p.along_sigma_mps, p.across_sigma_mps])
    prior = np.square(sigma_of_class)[label]
    east, north = (claimed_mps[claim] - known_mps).T
    cos, sin = axis.T
    along = cos * east + sin * north
    across = cos * north - sin * east
    apart = np.column_stack([along, across])
    tracked = np.flatnonzero(~np.isnan(apart).any(axis=1))
    support = velocity_support(apart[tracked], (variance + of_claim)[tracked], prior[tracked])
    kept = np.flatnonzero(messages.detections.is_self[claim[tracked]] | (support < 0))
    tracked, support = tracked[kept], support[kept]
    of_detection = claim[tracked]
    number = claim_number(messages.detections.detection_index[of_detection], SPEED)
    return Claims(of[at[tracked]], of_detection, number, support)


def _own_velocities(
    exchange: Exchange,
    messages: Known,
    tracks: ObjectStates | None,
    own: Int[ndarray, "c"],
    list_: Int[ndarray, "c"],
) -> tuple[Float[ndarray, "c 2"], Float[ndarray, "c 2"], Float[ndarray, "c 2"]]:
    """Velocity of each object as the evaluator knows it, NaN if it does not; axis and variances along and across it.

    `own` are the evaluator's own detections of the objects, or its self report, and `list_` its list.
    """
    is_sensed = messages.objects.origin == SENSED
    assert tracks is not None, "velocities are held against tracks"
    state = (np.cumsum(is_sensed) - 1)[own]  # of this step's detections, which are the first ones
    tracked = np.flatnonzero(is_sensed[own])
    yaw = exchange.world.boxes.yaw_rad[exchange.sensing.row[list_]]
    axis = np.column_stack([np.cos(yaw), np.sin(yaw)])
    known_mps = exchange.world.speed_mps[exchange.sensing.row[list_], None] * axis
    known_mps[~(is_sensed | messages.detections.is_self)[own]] = np.nan
    variance = np.full((len(own), 2), _LEAST_VARIANCE)
    rows = state[tracked]
    known_mps[tracked] = tracks.velocity_mps[rows]
    axis[tracked] = tracks.axis[rows]
    variance[tracked] = tracks.variance[rows]
    return known_mps, axis, np.maximum(variance, _LEAST_VARIANCE)
