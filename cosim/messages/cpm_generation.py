"""When a vehicle generates a detection message, and which objects the message includes.

References
----------
.. [1] ETSI TS 103 324 V2.1.1, "Collective Perception Service", clause 6.1: generation rules.
.. [2] ETSI EN 302 637-2 V1.4.1, "Cooperative Awareness Basic Service": the same rules for the vehicle itself.

Notes
-----
We could not obtain the whole text of [1]_. Its clauses are quoted in the sources of ms-van3t (`CPBasicService.cc`) and
of two forks of Artery (`CpService.cc`), which we follow. Where they differ (4 degrees or more, or more than 4 degrees),
we take the sentence that ms-van3t quotes: more. The README of this folder goes through the clauses one by one.
"""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.plane import wrapped
from cosim.base.ragged import place_in_group, rows_of
from cosim.base.rows import no_rows
from cosim.messages.content import SELF, Detections, velocities
from cosim.messages.cpm_params import MOST_OBJECTS, CpmParams
from cosim.messages.redundancy import Candidates, Heard, redundant
from cosim.world import LABELS

MOVED_M, FASTER_MPS, TURNED_RAD, INTERVAL_S = 4.0, 0.5, np.radians(4.0), 1.0
"""A vehicle is included again if it has moved, changed its speed or turned by more than this, or after this time."""
VULNERABLE_INTERVAL_S = 0.5
"""All people are included if one of them was last included this long ago."""
SENSORS_INTERVAL_S = 1.0
"""A message describes the sensors if the latest one that did is this old: T_AddSensorInformation."""

_LARGEST_M, _LARGEST_MPS, _LARGEST_RAD = 8.0, 1.0, np.radians(8.0)
"""Changes of position, speed and heading with the largest part in the utility."""
_SHORTEST_S, _LONGEST_S = 0.1, 1.0
"""Times since the last inclusion that have no part, and the largest part, in the utility."""
_QUALITIES = 15
_VULNERABLE = np.isin(LABELS, ("pedestrian", "cyclist"))
_FAR_M = 1000.0
"""Distance between objects of different senders or classes on an extra axis; larger than `MOVED_M`."""
_SLACK_S = 1e-9


class Inclusion(IntEnum):
    """What became of a detection when its vehicle's message was put together."""

    INCLUDED = 0
    WITHHELD = 1
    """By an attack or fault; it was no candidate."""
    WAITING = 2
    """The vehicle does not generate a message yet."""
    NOT_DUE = 3
    """The generation rules do not ask for it."""
    REDUNDANT = 4
    OVER_LIMIT = 5
    """Other objects of the message have a larger utility."""


@dataclass(slots=True)
class InclusionMemory:
    """The objects that each sender last included, with pose, speed and time."""

    of: Int[ndarray, "n"] = no_rows(np.int64)
    """Sender (as in `Generators.sender`), class, and whether it is the sender itself, in one number, ascending."""
    xy_m: Float[ndarray, "n 2"] = no_rows(np.float64, 2)
    yaw_rad: Float[ndarray, "n"] = no_rows()
    time_s: Float[ndarray, "n"] = no_rows()
    speed_mps: Float[ndarray, "n"] = no_rows()
    """NaN where it was unknown."""
    velocity_mps: Float[ndarray, "n 2"] = no_rows(np.float64, 2)
    """NaN where it was unknown."""
    track: Int[ndarray, "n"] = no_rows(np.int64)
    """Number of the sender's track of the object; -1 where it tracks none."""
    seen_s: Float[ndarray, "n"] = no_rows()
    """When it was last a candidate. It is forgotten a second later, or a sensing interval where that is longer."""


@dataclass(frozen=True, slots=True)
class Generators:
    """M messages that may be generated in a step."""

    sender: Int[ndarray, "m"]
    """Actor number and identity in one number, as in `Exchange.sender`; each once."""
    actor: Int[ndarray, "m"]
    xy_m: Float[ndarray, "m 2"]
    """Position of the vehicle, as it knows it."""
    gap_s: Float[ndarray, "m"]
    """Least time between two messages that congestion control allows; 0 without it."""
    interval_s: float = INTERVAL_S
    """Longest time between two sweeps of a vehicle."""


@dataclass(frozen=True, slots=True)
class LatestTimes:
    """When something last happened at each sender."""

    sender: Int[ndarray, "n"] = no_rows(np.int64)
    """Ascending."""
    time_s: Float[ndarray, "n"] = no_rows()

    def elapsed_s(self, sender: Int[ndarray, "m"], time_s: float) -> Float[ndarray, "m"]:
        """Time since then at each of these senders; infinite where it is not known to have happened."""
        if not len(self.sender):
            return np.full(len(sender), np.inf)
        at, is_there = rows_of(sender, self.sender)
        return np.where(is_there, time_s - self.time_s[at], np.inf)

    def noted(self, sender: Int[ndarray, "m"], time_s: float) -> "LatestTimes":
        """These times after it happened at these senders, without times that are older than `INTERVAL_S`."""
        is_recent = time_s - self.time_s < INTERVAL_S - _SLACK_S
        kept = ~np.isin(self.sender, sender) & is_recent
        whole = np.append(self.sender[kept], sender)
        whole_s = np.append(self.time_s[kept], np.full(len(sender), time_s))
        order = np.argsort(whole, kind="stable")
        return LatestTimes(whole[order], whole_s[order])


@dataclass(frozen=True, slots=True)
class CpmState:
    """Everything about detection messages that lasts from step to step. It stays empty where no choice needs it."""

    included: InclusionMemory = field(default_factory=InclusionMemory)
    generated: LatestTimes = field(default_factory=LatestTimes)
    """The latest generation events."""
    described: LatestTimes = field(default_factory=LatestTimes)
    """The latest messages that described the sensors."""
    heard: Heard = field(default_factory=Heard.start)


@dataclass(frozen=True, slots=True)
class CpmContent:
    """The content of M messages with D detections in the lists of their vehicles."""

    inclusion: UInt8[ndarray, "d"]
    """As `Inclusion`."""
    has_sensors: Bool[ndarray, "m"]
    """Whether the message describes the sensors."""

    @property
    def included(self) -> Bool[ndarray, "d"]:
        """Whether each detection is in its message."""
        return self.inclusion == Inclusion.INCLUDED


def generate(
    state: CpmState,
    listed: Detections,
    message: Int[ndarray, "d"],
    generators: Generators,
    time_s: float,
    params: CpmParams,
    track: Int[ndarray, "d"] | None = None,
) -> tuple[CpmState, CpmContent]:
    """Put together the detection messages of a step.

    Parameters
    ----------
    state
        State after the step before.
    listed
        The vehicles' lists of detections; those that are not transmitted are no candidates.
    message
        Row of `generators` of each detection.
    generators
        The messages.
    time_s
        Time of the step.
    params
        The choices.
    track
        Number of its vehicle's track of each detection; -1 where it has none. None: nothing is tracked.

    Returns
    -------
    The state after the step, and what each message contains.

    Notes
    -----
    With `rules = "etsi"`, the time between two generation events of a vehicle is at least `interval_s` or the time that
    congestion control asks for, whichever is longer, but no more than 1 s. Self reports are never redundant, and they
    do not count in the limit of objects.
    Deviations from [1]_: the frequency does not adapt to the value of information. Objects are not predicted to the
    next generation event. There is no container for regions of perception. Without objects no message is sent.
    """
    inclusion = np.where(listed.transmitted, Inclusion.INCLUDED, Inclusion.WITHHELD).astype(np.uint8)
    has_sensors = np.ones(len(generators.sender), bool)
    generated, described, included = state.generated, state.described, state.included
    if params.rules == "etsi":
        least_s = np.clip(generators.gap_s, params.interval_s, INTERVAL_S)
        may = generated.elapsed_s(generators.sender, time_s) >= least_s - _SLACK_S
        generated = generated.noted(generators.sender[may], time_s)
        inclusion[listed.transmitted & ~may[message]] = Inclusion.WAITING
    selects = params.rules != "all" or params.redundancy != "none"
    if selects or params.max_objects < MOST_OBJECTS:
        track = np.full(len(listed), -1) if track is None else track
        inclusion, included = _select(state, listed, inclusion, message, generators, time_s, params, track)
    if params.length == "uper":
        is_sent = np.ones(len(has_sensors), bool)
        if params.rules == "etsi":
            is_sent = np.bincount(message[inclusion == Inclusion.INCLUDED], minlength=len(has_sensors)) > 0
        has_sensors = is_sent & (described.elapsed_s(generators.sender, time_s) >= SENSORS_INTERVAL_S - _SLACK_S)
        described = described.noted(generators.sender[has_sensors], time_s)
    return CpmState(included, generated, described, state.heard), CpmContent(inclusion, has_sensors)


def _select(
    state: CpmState,
    listed: Detections,
    inclusion: UInt8[ndarray, "d"],
    message: Int[ndarray, "d"],
    generators: Generators,
    time_s: float,
    params: CpmParams,
    track: Int[ndarray, "d"],
) -> tuple[UInt8[ndarray, "d"], InclusionMemory]:
    """What becomes of the detections that are included so far, and the memory after the step."""
    inclusion = inclusion.copy()
    rows = np.flatnonzero(inclusion == Inclusion.INCLUDED)
    seen = listed.take(rows)
    sender = generators.sender[message[rows]]
    now = Remembered.beside(state.included, seen, sender, track[rows], time_s)
    if params.rules == "etsi":
        inclusion[rows[~due(now, seen.label, sender)]] = Inclusion.NOT_DUE
    others = np.flatnonzero((inclusion[rows] == Inclusion.INCLUDED) & (seen.origin != SELF))
    mine = message[rows[others]]
    candidates = Candidates(
        generators.actor[mine],
        generators.xy_m[mine],
        seen.label[others].astype(np.int64),
        now.xy_m[others],
        now.speed_mps[others],
    )
    left_out = redundant(state.heard, candidates, time_s, params)
    inclusion[rows[others[left_out]]] = Inclusion.REDUNDANT
    others = others[~left_out]
    number = listed.detection_index[rows[others]]
    use = utility(now, seen.score)[others]
    over = beyond_limit(message[rows[others]], use, number, params.max_objects)
    inclusion[rows[others[over]]] = Inclusion.OVER_LIMIT
    kept_s = max(INTERVAL_S, generators.interval_s)
    return inclusion, now.memory_after(inclusion[rows] == Inclusion.INCLUDED, kept_s)


@dataclass(frozen=True, slots=True)
class Remembered:
    """Candidates beside the same objects as they were last included."""

    memory: InclusionMemory
    time_s: float
    of: Int[ndarray, "r"]
    """As `InclusionMemory.of`."""
    xy_m: Float[ndarray, "r 2"]
    yaw_rad: Float[ndarray, "r"]
    speed_mps: Float[ndarray, "r"]
    velocity_mps: Float[ndarray, "r 2"]
    track: Int[ndarray, "r"]
    """As `InclusionMemory.track`."""
    near: Int[ndarray, "r"]
    """Row of the same object in the memory; -1 if it is new."""

    @staticmethod
    def beside(
        memory: InclusionMemory,
        seen: Detections,
        sender: Int[ndarray, "r"],
        track: Int[ndarray, "r"],
        time_s: float,
    ) -> "Remembered":
        """Associate candidates with the memory.

        A tracked object is the remembered one of its track. Of the others, the same object is the nearest one of the
        same class within 4 m of its place. A remembered object is expected where its velocity has brought it, if that
        is known.
        """
        is_self = seen.origin == SELF
        sender = sender.astype(np.int64)
        of = (sender * len(LABELS) + seen.label) * 2 + is_self
        xy_m = seen.boxes.xyz_m[:, :2]
        near = _same_track(memory, sender, track)
        untracked = np.flatnonzero(track < 0)
        held = np.flatnonzero(memory.track < 0)
        near[untracked] = _nearest(memory, held, of[untracked], xy_m[untracked], time_s)
        return Remembered(
            memory=memory,
            time_s=time_s,
            of=of,
            xy_m=xy_m,
            yaw_rad=seen.boxes.yaw_rad,
            speed_mps=speeds(seen),
            velocity_mps=velocities(seen),
            track=track,
            near=near,
        )

    def changes(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Distance [m], change of speed [m/s], angle [rad] and time [s] since then.

        All are infinite for a new object. A change of speed is NaN where one of the speeds is unknown.
        """
        moved_m, faster_mps, turned_rad, elapsed_s = np.full((4, len(self.of)), np.inf)
        known = np.flatnonzero(self.near >= 0)
        at, memory = self.near[known], self.memory
        dx, dy = (self.xy_m[known] - memory.xy_m[at]).T
        moved_m[known] = np.hypot(dx, dy)
        faster_mps[known] = np.abs(self.speed_mps[known] - memory.speed_mps[at])
        turn_rad = self.yaw_rad[known] - memory.yaw_rad[at]
        turned_rad[known] = np.abs(wrapped(turn_rad))
        elapsed_s[known] = self.time_s - memory.time_s[at]
        return moved_m, faster_mps, turned_rad, elapsed_s

    def memory_after(self, included: Bool[ndarray, "r"], kept_s: float) -> InclusionMemory:
        """The memory after some of the candidates were included. It keeps what was a candidate in the last `kept_s`."""
        memory, now = self.memory, self.time_s
        seen_s = memory.seen_s.copy()
        seen_s[self.near[self.near >= 0]] = now
        old = now - seen_s < kept_s - _SLACK_S
        old[self.near[(self.near >= 0) & included]] = False
        columns = {}
        for name in ("of", "xy_m", "yaw_rad", "speed_mps", "velocity_mps", "track"):
            both = getattr(memory, name)[old], getattr(self, name)[included]
            columns[name] = np.concatenate(both)
        now_s = np.full(int(included.sum()), now)
        columns["time_s"] = np.append(memory.time_s[old], now_s)
        columns["seen_s"] = np.append(seen_s[old], now_s)
        x_m, y_m = columns["xy_m"].T
        order = np.lexsort((columns["time_s"], y_m, x_m, columns["of"]))
        return InclusionMemory(**{name: column[order] for name, column in columns.items()})


def speeds(seen: Detections) -> Float[ndarray, "d"]:
    """Speed of each object: of self reports as stated, of others by their velocity; NaN where it is unknown [m/s]."""
    is_unstated = np.isnan(seen.speed_mps)
    vx, vy = seen.velocity_mps.T
    return np.where(is_unstated, np.hypot(vx, vy), np.abs(seen.speed_mps))


def due(
    now: Remembered,
    label: UInt8[ndarray, "r"],
    sender: Int[ndarray, "r"],
) -> Bool[ndarray, "r"]:
    """Which candidates the generation rules include.

    Parameters
    ----------
    now
        Candidates and what is remembered of them.
    label, sender
        Class and sender of each candidate.

    Notes
    -----
    Vehicles (type B) are included if they are new, if they have moved by more than 4 m, changed their speed by more
    than 0.5 m/s or turned by more than 4 degrees, or after 1 s [1]_. People (type A) are included if they are new. If
    one of them was last included 0.5 s ago or longer, all are included. Self reports follow the same rules [2]_.
    Deviations: without tracking, objects are associated by place. The angle is that of the box, not of the velocity.
    There is no rule on speed where it is unknown. The threshold of quality is met by all that was just detected.
    """
    moved_m, faster_mps, turned_rad, elapsed_s = now.changes()
    is_new, is_person = now.near < 0, _VULNERABLE[label]
    is_faster = faster_mps > FASTER_MPS  # false where a speed is unknown
    has_changed = (moved_m > MOVED_M) | is_faster | (turned_rad > TURNED_RAD)
    interval_s = np.where(is_person, VULNERABLE_INTERVAL_S, INTERVAL_S)
    is_late = elapsed_s >= interval_s - _SLACK_S
    is_of_all = np.isin(sender, sender[is_person & is_late & ~is_new])
    return is_new | np.where(is_person, is_of_all, has_changed | is_late)


def utility(now: Remembered, score: Float[ndarray, "r"]) -> Float[ndarray, "r"]:
    """Utility of each candidate, by which a message takes the first ones if it cannot take all.

    Parameters
    ----------
    now
        Candidates and what is remembered of them.
    score
        Confidence of each detection, 0 to 1.

    Notes
    -----
    The sum of five numbers from 0 to 1 [1]_ (clause 6.1.3.2): quality, and the changes of position (of 8 m), speed (of
    1 m/s) and heading (of 8 degrees) and the time (of 0.1 to 1 s) since the last inclusion.
    Deviations: the quality is the detector's score in fifteenths, without age and success of detection. All changes of
    a new object are the largest; the change of an unknown speed is 0.
    """
    moved_m, faster_mps, turned_rad, elapsed_s = now.changes()
    is_unknown = np.isnan(faster_mps) | ((now.near < 0) & np.isnan(now.speed_mps))
    faster_mps = np.where(is_unknown, 0.0, faster_mps)
    quality = np.floor(_QUALITIES * score) / _QUALITIES
    waited = (elapsed_s - _SHORTEST_S) / (_LONGEST_S - _SHORTEST_S)
    changes = np.clip(moved_m / _LARGEST_M, 0.0, 1.0)
    changes += np.clip(faster_mps / _LARGEST_MPS, 0.0, 1.0)
    changes += np.clip(turned_rad / _LARGEST_RAD, 0.0, 1.0)
    changes += np.clip(waited, 0.0, 1.0)
    return quality + changes


def beyond_limit(
    message: Int[ndarray, "r"],
    utility: Float[ndarray, "r"],
    number: Int[ndarray, "r"],
    limit: int,
) -> Bool[ndarray, "r"]:
    """Which objects are not among the `limit` objects of largest utility in their messages.

    Parameters
    ----------
    message, utility, number
        Message of each object, its utility, and its number in the list of its vehicle, by which equal objects are
        ordered.
    limit
        Largest number of objects in a message.
    """
    order = np.lexsort((number, -utility, message))
    over = np.zeros(len(order), bool)
    over[order] = place_in_group(message[order]) >= limit
    return over


def _same_track(
    memory: InclusionMemory,
    sender: Int[ndarray, "r"],
    track: Int[ndarray, "r"],
) -> Int[ndarray, "r"]:
    """Row of the object of the same track of the same sender; -1 if it is not remembered, or is not tracked."""
    near = np.full(len(sender), -1)
    rows = np.flatnonzero(track >= 0)
    held = np.flatnonzero(memory.track >= 0)
    if not len(rows) or not len(held):
        return near
    of_sender = memory.of[held] // (2 * len(LABELS))
    remembered = np.column_stack([of_sender, memory.track[held]])
    asked = np.column_stack([sender[rows], track[rows]])
    _, number = np.unique(np.concatenate([remembered, asked]), axis=0, return_inverse=True)
    number = number.reshape(-1)
    row_of = np.full(int(number.max()) + 1, -1)
    row_of[number[: len(held)]] = held
    near[rows] = row_of[number[len(held) :]]
    return near


def _nearest(
    memory: InclusionMemory,
    held: Int[ndarray, "k"],
    of: Int[ndarray, "r"],
    xy_m: Float[ndarray, "r 2"],
    time_s: float,
) -> Int[ndarray, "r"]:
    """Row of the nearest object of the same `of` within `MOVED_M` of its expected place; -1 if there is none.

    Only the rows `held` of the memory are compared.
    """
    if not len(held) or not len(of):
        return np.full(len(of), -1)
    of_held = memory.of[held]
    kinds = np.unique(of_held)
    is_found = np.isin(of, kinds)
    elapsed_s = time_s - memory.time_s[held]
    moved_m = np.nan_to_num(memory.velocity_mps[held]) * elapsed_s[:, None]
    # Objects of different `of` lie on different floors, far from each other.
    floor_m, held_floor_m = (_FAR_M * np.searchsorted(kinds, of_some) for of_some in (of, of_held))
    known = np.column_stack([memory.xy_m[held] + moved_m, held_floor_m])
    tree = scipy.spatial.cKDTree(known)
    places = np.column_stack([xy_m, floor_m])
    _, near = tree.query(places, distance_upper_bound=MOVED_M + 1e-9)
    is_found &= near < len(held)
    return np.where(is_found, held[np.minimum(near, len(held) - 1)], -1)
