"""Content and length of messages."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.codes import DetectionFault, ObjectClass, Origin
from cosim.base.ragged import differs_from_last, place_in_group
from cosim.base.rows import Rows
from cosim.messages import cpm
from cosim.messages.cpm_params import MOST_OBJECTS
from cosim.radio.segmentation import ENVELOPE_BYTES
from cosim.world import World
from sensors.boxes import Boxes

SENSED, SELF, FABRICATED = Origin
"""Origin of a detection: the detector, the vehicle's own pose, or an attack or fault."""


FARTHEST_M = 10_000.0
"""Largest distance of a detection from its observer, along an axis."""
LARGEST_M = 1_000.0
"""Largest length, width or height of a detection."""
FASTEST = 1_000.0
"""Largest speed [m/s] and acceleration [m/s2] that a detection may claim."""
LEAST_ACCURACY_FACTOR, MOST_ACCURACY_FACTOR = 1e-3, 1e3
"""Factors by which stated standard deviations may differ from honest ones. Receivers bound what they believe anyway."""
LARGEST_NUMBER = 2**15 - 1
MOST_RETURNS = 2**31 - 1


@dataclass(frozen=True, slots=True)
class Detections(Rows):
    """D detections of one step in the world frame, sorted by their key (observer, identity, detection_index).

    `observer` is a row of the step's world. Index 0 is the self report; then follow detections by the detector, then
    fabricated ones. A detection with `transmitted` false is not sent. `identity` is 0 for detections under the
    vehicle's own pseudonym; a Sybil attacker has further identities. Only self reports have speed and acceleration;
    otherwise they are NaN. Only tracked objects have a velocity; otherwise it is NaN. `target` is the row of the
    vehicle that an attack aims at with the detection. If there is none, it is the observer.
    """

    observer: Int[ndarray, "d"]
    detection_index: Int[ndarray, "d"]
    label: UInt8[ndarray, "d"]
    boxes: Boxes
    score: Float[ndarray, "d"]
    n_points: Int[ndarray, "d"]
    origin: UInt8[ndarray, "d"]
    transmitted: Bool[ndarray, "d"]
    target: Int[ndarray, "d"] = field(default=None)  # type: ignore[arg-type]  # default: the observer
    identity: Int[ndarray, "d"] = field(default=None)  # type: ignore[arg-type]  # default: the vehicle's own
    speed_mps: Float[ndarray, "d"] = field(default=None)  # type: ignore[arg-type]  # left out: absent
    acceleration_mps2: Float[ndarray, "d"] = field(default=None)  # type: ignore[arg-type]  # left out: absent
    """Acceleration along the heading."""
    velocity_mps: Float[ndarray, "d 2"] = field(default=None)  # type: ignore[arg-type]  # left out: absent
    """Velocity east and north of an object that the observer tracks."""
    variance_m2: Float[ndarray, "d 3"] = field(default=None)  # type: ignore[arg-type]  # left out: exact
    """Stated variance of the position: east, east and north, north."""
    velocity_variance: Float[ndarray, "d 3"] = field(default=None)  # type: ignore[arg-type]  # left out: exact
    """Stated variance of the velocity [m2/s2], in the same order, by which the position becomes less certain."""
    relative_m2: Float[ndarray, "d 3"] = field(default=None)  # type: ignore[arg-type]  # left out: exact
    """Stated variance of the position relative to the observer: `variance_m2` without the error of its own pose, and
    with what the score says about the error."""
    heading_variance: Float[ndarray, "d"] = field(default=None)  # type: ignore[arg-type]  # left out: exact
    """Stated variance of the heading relative to the observer [rad2], modulo pi."""
    size_variance: Float[ndarray, "d"] = field(default=None)  # type: ignore[arg-type]  # left out: exact
    """Stated variance of the logarithms of length, width and height."""
    accuracy_factor: Float[ndarray, "d"] = field(default=None)  # type: ignore[arg-type]  # left out: the truth
    """Factor by which an attacker multiplies all standard deviations that it would state honestly. It is not sent."""

    def __post_init__(self) -> None:
        n = len(self.observer)
        if self.target is None:
            object.__setattr__(self, "target", self.observer)
        if self.identity is None:
            object.__setattr__(self, "identity", np.zeros(n, np.int64))
        for name in ("speed_mps", "acceleration_mps2"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(n, np.nan))
        if self.velocity_mps is None:
            object.__setattr__(self, "velocity_mps", np.full((n, 2), np.nan))
        for name in ("variance_m2", "velocity_variance", "relative_m2"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros((n, 3)))
        for name in ("heading_variance", "size_variance"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(n))
        if self.accuracy_factor is None:
            object.__setattr__(self, "accuracy_factor", np.ones(n))

    def __len__(self) -> int:
        return len(self.observer)

    @staticmethod
    def perceived(
        observer: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        label: UInt8[ndarray, "d"],
        boxes: Boxes,
        score: Float[ndarray, "d"],
        n_points: Int[ndarray, "d"],
        origin: UInt8[ndarray, "d"],
    ) -> "Detections":
        """Detections that are all transmitted, under the vehicles' own identities."""
        sent = np.ones(len(observer), bool)
        return Detections(observer, detection_index, label, boxes, score, n_points, origin, sent)

    @staticmethod
    def by_key(parts: list["Detections"]) -> "Detections":
        """All rows of all parts, sorted by key."""
        joined = Detections.concat(parts)
        return joined.take(np.lexsort((joined.detection_index, joined.identity, joined.observer)))

    def numbers(self) -> Int[ndarray, "d"]:
        """Observer and index of each detection in one number, in the order of both."""
        return self.observer.astype(np.int64) << 32 | self.detection_index


def claims_to_be_own(listed: Detections) -> Bool[ndarray, "d"]:
    """Whether each detection is a self report, as messages say: further identities of a vehicle send theirs first."""
    return (listed.origin == SELF) | ((listed.identity > 0) & (listed.detection_index == 0))


def velocities(listed: Detections) -> Float[ndarray, "d 2"]:
    """Velocity east and north that each detection claims; NaN where it claims none.

    A self report claims a speed along its heading, a tracked object a velocity.
    """
    found = listed.velocity_mps.copy()
    is_nan = np.isnan(found)
    rows = np.flatnonzero(is_nan[:, 0] | is_nan[:, 1])
    yaw_rad = listed.boxes.yaw_rad[rows]
    heading = np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad)])
    along_mps = listed.speed_mps[rows, None] * heading
    stated = found[rows]
    found[rows] = np.where(np.isnan(stated), along_mps, stated)
    return found


NETWORK_BYTES, SIGNATURE_BYTES = 44, 96
"""Of GeoNetworking and BTP, and of signature and digest."""


def cpm_bytes(n_objects: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Length of a detection message, sent as a collective perception message, with `cpm.length = "linear"` [B].

    It is the sum of GeoNetworking and BTP 44, signature and digest 96, header 37, one sensor 9, and 29 per object, as
    in Artery's model of ETSI TS 103 324.
    """
    return ENVELOPE_BYTES + 29 * n_objects


def encoded_cpm_bytes(
    objects: Detections, message: Int[ndarray, "d"], has_sensors: Bool[ndarray, "m"]
) -> tuple[Int[ndarray, "m"], Int[ndarray, "m"]]:
    """Lengths of detection messages with `cpm.length = "uper"`, and of what each of their segments repeats [B].

    Parameters
    ----------
    objects
        The objects in the messages, of known classes.
    message
        Row of the message of each object.
    has_sensors
        Whether each message describes the sensors.

    Notes
    -----
    The length is that of the encoded CPM (`cosim.messages.cpm.cpm_bytes`), with headers of the network and a
    signature. The self report counts as an object, with a velocity where its speed is known. In a standardised system
    it would be a message of its own (CAM). Only the first segment describes the sensors.
    """
    n, n_classes = len(has_sensors), len(ObjectClass)
    moves = np.isfinite(objects.velocity_mps).all(axis=1) | np.isfinite(objects.speed_mps)
    of = (message * n_classes + objects.label) * 2 + moves
    count = np.bincount(of, minlength=2 * n * n_classes).reshape(n, n_classes, 2)
    outside = NETWORK_BYTES + SIGNATURE_BYTES
    length = cpm.cpm_bytes(count[:, :, 0], n_moving=count[:, :, 1], has_sensors=has_sensors)
    empty = cpm.cpm_bytes(np.zeros((1, n_classes), np.int64), is_segment=True, has_sensors=False)
    return outside + length, np.repeat(outside + empty, n)


def evaluation_bytes(n_evaluations: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Length of an evaluation message [B]. No standard defines its format.

    It has the envelope of a detection message, a header of 16, and 12 per evaluation: vehicle 4, detection 2,
    evaluation 1, visibility 1, time 2, flags 2.
    """
    return 44 + report_bytes(n_evaluations)


def report_bytes(n_evaluations: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Length of a signed report of evaluations to the server, without headers of the link [B]."""
    return 96 + piggyback_bytes(n_evaluations)


def piggyback_bytes(n_evaluations: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Length that piggybacked evaluations add to a detection message [B]."""
    return 16 + 12 * n_evaluations


def trust_broadcast_bytes(n_vehicles: int) -> int:
    """Length of a trust broadcast [B]: the envelope and header of an evaluation message, and 6 per vehicle."""
    return 44 + 96 + 16 + 6 * n_vehicles


def faults(listed: Detections, xyz_m: Float[ndarray, "w 3"]) -> Int[ndarray, "d"]:
    """Why each detection cannot be sent, as a `DetectionFault`; -1 if it can.

    A message has at most 255 objects (ETSI TS 103 324). Objects must be of known classes, have unique numbers of 15
    bits, and be within `FARTHEST_M` of the observer. Only one fault of each detection is given.

    Parameters
    ----------
    listed
        Detections in any order.
    xyz_m
        Positions of all actors by row of the world.
    """
    n, boxes = len(listed), listed.boxes
    with np.errstate(invalid="ignore", over="ignore"):
        away_m = np.abs(boxes.xyz_m - xyz_m[listed.observer]).max(axis=1, initial=0.0)
        number = np.asarray(listed.detection_index)
        box = np.column_stack([boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad, listed.score])
        motion = np.abs(np.column_stack([listed.speed_mps, listed.acceleration_mps2, listed.velocity_mps]))
        is_finite = np.isfinite(box).all(axis=1)
        is_finite &= ~np.isinf(motion).any(axis=1)
        is_turned = np.abs(boxes.yaw_rad) <= 2 * np.pi
        is_size = (boxes.lwh_m > 0) & (boxes.lwh_m <= LARGEST_M)
        is_number = (number >= 0) & (number <= LARGEST_NUMBER)
        is_count = (listed.n_points >= 0) & (listed.n_points <= MOST_RETURNS)
        wrong = {
            DetectionFault.NOT_FINITE: ~is_finite,
            DetectionFault.TOO_FAR: ~((away_m <= FARTHEST_M) & is_turned),
            DetectionFault.BAD_SIZE: ~is_size.all(axis=1),
            DetectionFault.BAD_SCORE: ~((listed.score >= 0) & (listed.score <= 1)),
            DetectionFault.UNKNOWN_CLASS: np.asarray(listed.label).astype(np.int64) >= len(ObjectClass),
            DetectionFault.BAD_MOTION: (motion > FASTEST).any(axis=1),
            DetectionFault.BAD_NUMBER: ~(is_number & is_count),
        }
    found = np.full(n, -1)
    message = listed.observer.astype(np.int64) << 16 | listed.identity
    for fault in reversed(wrong):
        found[wrong[fault]] = fault
    order = np.lexsort((listed.origin, number, message))
    order = order[found[order] < 0]
    is_new = differs_from_last(message[order]) | differs_from_last(number[order])
    found[order[~is_new]] = DetectionFault.REPEATED_NUMBER
    order = order[is_new]
    is_over = place_in_group(message[order]) >= MOST_OBJECTS
    found[order[is_over]] = DetectionFault.TOO_MANY
    return found


def self_reports(world: World, observers: Int[ndarray, "o"]) -> Detections:
    """The self reports of the vehicles in these rows of the world: their true boxes, with index 0 and score 1.

    `cosim.step.listing` adds speeds and accelerations.
    """
    n = len(observers)
    return Detections.perceived(
        observers,
        np.zeros(n, int),
        world.label[observers],
        world.boxes.take(observers),
        np.ones(n),
        np.zeros(n, np.int32),
        np.full(n, SELF, np.uint8),
    )
