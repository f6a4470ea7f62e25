"""Collective perception messages (CPM) of ETSI ITS, release 2: their fields, encoding and length.

Notes
-----
Modules `CPM-...` are those of TS 103 324 v2.1.1.

`ConstraintWrappedCpmContainers` puts a constraint that PER does not see on an extensible list. asn1c takes the result
as not extensible, because the last constraint has no extension marker, and so do we. A codec that ignores the last
constraint would expect one more bit.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.codes import ObjectClass
from cosim.messages.etsi import (
    PROTOCOL,
    RELEASE_2,
    Confidences,
    cdd,
    header,
    maybe,
    place,
    reference_position,
    up,
    with_confidence,
)
from cosim.messages.uper import (
    Encoded,
    Enumerated,
    Integer,
    ListOf,
    Member,
    Record,
    Type,
    UperChoice,
    Wrapped,
    encode,
    least,
    n_bits,
    rows,
)

CPM_MODULE = "CPM-PDU-Descriptions"
CPM_ID, LIDAR_ID, LIDAR = 14, 1, 2
"""Identifiers of the message and of the sensor, and type of the sensor."""

_ANGLE = with_confidence(
    "CartesianAngle", cdd("CartesianAngleValue", low=0, high=3601), cdd("AngleConfidence", low=1, high=127)
)
_COORDINATE = with_confidence(
    "CartesianCoordinateWithConfidence",
    cdd("CartesianCoordinateLarge", low=-131072, high=131071),
    cdd("CoordinateConfidence", low=1, high=4096),
)
_VELOCITY = with_confidence(
    "VelocityComponent", cdd("VelocityComponentValue", low=-16383, high=16383), cdd("SpeedConfidence", low=1, high=127)
)
_DIMENSION = with_confidence(
    "ObjectDimension", cdd("ObjectDimensionValue", low=1, high=256), cdd("ObjectDimensionConfidence", low=1, high=32)
)
_LENGTH = cdd("StandardLength12b", low=0, high=4095)
_IDENTIFIER = cdd("Identifier1B", low=0, high=255)
_CONFIDENCE = cdd("ConfidenceLevel", low=1, high=101)

_PEDESTRIAN = Enumerated("VruSubProfilePedestrian", RELEASE_2, (0, 1, 2, 3, 15))
_BICYCLIST = Enumerated("VruSubProfileBicyclist", RELEASE_2, (*range(9), 15))
_VRU_CLASS = {
    "pedestrian": _PEDESTRIAN,
    "bicyclistAndLightVruVehicle": _BICYCLIST,
    "motorcyclist": None,
    "animal": None,
}
_OBJECT_CLASS: dict[str, Type | None] = {
    "vehicleSubClass": cdd("TrafficParticipantType", low=0, high=14),
    "vruSubClass": UperChoice("VruProfileAndSubprofile", RELEASE_2, _VRU_CLASS, True),
    "groupSubClass": None,
    "otherSubClass": None,
}
_CLASSIFICATION = (
    Member("objectClass", UperChoice("ObjectClass", RELEASE_2, _OBJECT_CLASS, True)),
    Member("confidence", _CONFIDENCE),
)

_POSITION = (
    Member("xCoordinate", _COORDINATE),
    Member("yCoordinate", _COORDINATE),
    maybe("zCoordinate", _COORDINATE),
)
_CARTESIAN = (
    Member("xVelocity", _VELOCITY),
    Member("yVelocity", _VELOCITY),
    maybe("zVelocity", _VELOCITY),
)
_VELOCITIES = {"polarVelocity": None, "cartesianVelocity": Record("VelocityCartesian", RELEASE_2, _CARTESIAN)}
_ANGLES = (Member("zAngle", _ANGLE), maybe("yAngle", _ANGLE), maybe("xAngle", _ANGLE))
_OBJECT = (
    maybe("objectId", cdd("Identifier2B", low=0, high=65535)),
    Member("measurementDeltaTime", cdd("DeltaTimeMilliSecondSigned", low=-2048, high=2047)),
    Member("position", Record("CartesianPosition3dWithConfidence", RELEASE_2, _POSITION)),
    maybe("velocity", UperChoice("Velocity3dWithConfidence", RELEASE_2, _VELOCITIES)),
    maybe("acceleration"),
    maybe("angles", Record("EulerAnglesWithConfidence", RELEASE_2, _ANGLES)),
    maybe("zAngularVelocity"),
    maybe("lowerTriangularCorrelationMatrices"),
    maybe("objectDimensionZ", _DIMENSION),
    maybe("objectDimensionY", _DIMENSION),
    maybe("objectDimensionX", _DIMENSION),
    maybe("objectAge", cdd("DeltaTimeMilliSecondSigned", low=0, high=2047)),
    maybe("objectPerceptionQuality", cdd("ObjectPerceptionQuality", low=0, high=15)),
    maybe("sensorIdList", ListOf("SequenceOfIdentifier1B", RELEASE_2, _IDENTIFIER, 1, 128, True)),
    maybe(
        "classification",
        ListOf(
            "ObjectClassDescription", RELEASE_2, Record("ObjectClassWithConfidence", RELEASE_2, _CLASSIFICATION), 1, 8
        ),
    ),
    maybe("mapPosition"),
)
OBJECT = Record("PerceivedObject", RELEASE_2, _OBJECT, True)
"""One perceived object of a CPM."""

_ORIENTATION = with_confidence(
    "Wgs84Angle", cdd("Wgs84AngleValue", low=0, high=3601), cdd("Wgs84AngleConfidence", low=1, high=127)
)
_VEHICLE = (
    Member("orientationAngle", _ORIENTATION),
    maybe("pitchAngle", _ANGLE),
    maybe("rollAngle", _ANGLE),
    maybe("trailerDataSet"),
)

_CIRCLE = (
    maybe("shapeReferencePoint"),
    Member("radius", _LENGTH),
    maybe("height", _LENGTH),
)
_SHAPES = {
    "rectangular": None,
    "circular": Record("CircularShape", RELEASE_2, _CIRCLE),
    "polygonal": None,
    "elliptical": None,
    "radial": None,
    "radialShapes": None,
}
_SENSOR_MODULE = "CPM-SensorInformationContainer"
_SENSOR = (
    Member("sensorId", _IDENTIFIER),
    Member("sensorType", cdd("SensorType", low=0, high=31)),
    maybe("perceptionRegionShape", UperChoice("Shape", RELEASE_2, _SHAPES, True)),
    maybe("perceptionRegionConfidence", _CONFIDENCE),
    Member("shadowingApplies", Integer("BOOLEAN", "X.680", 0, 1)),
)
_SENSOR_INFORMATION = Record("SensorInformation", _SENSOR_MODULE, _SENSOR, True)

_OBJECT_MODULE = "CPM-PerceivedObjectContainer"
_PERCEIVED = (
    Member("numberOfPerceivedObjects", cdd("CardinalNumber1B", low=0, high=255)),
    Member("perceivedObjects", ListOf("PerceivedObjects", _OBJECT_MODULE, OBJECT, 0, 255, True)),
)
_OBJECTS = Record("PerceivedObjectContainer", _OBJECT_MODULE, _PERCEIVED, True)

VEHICLE, SENSORS, OBJECTS = 1, 3, 5
"""Identifiers of containers."""

_CONTAINER: dict[int, Type] = {
    VEHICLE: Record("OriginatingVehicleContainer", "CPM-OriginatingStationContainers", _VEHICLE, True),
    SENSORS: ListOf("SensorInformationContainer", _SENSOR_MODULE, _SENSOR_INFORMATION, 1, 128, True),
    OBJECTS: _OBJECTS,
}
_CONTAINER_ID = Integer("CpmContainerId", CPM_MODULE, 1, 16)
_WRAPPED = Wrapped("WrappedCpmContainer", CPM_MODULE, _CONTAINER_ID, _CONTAINER)
_SEGMENT = (
    Member("totalMsgNo", cdd("CardinalNumber3b", low=1, high=8)),
    Member("thisMsgNo", cdd("OrdinalNumber3b", low=1, high=8)),
)
_MANAGEMENT = (
    Member("referenceTime", cdd("TimestampIts", low=0, high=2**42 - 1)),
    Member("referencePosition", reference_position(RELEASE_2)),
    maybe("segmentationInfo", Record("MessageSegmentationInfo", RELEASE_2, _SEGMENT)),
    maybe("messageRateRange"),
)
_PAYLOAD = (
    Member("managementContainer", Record("ManagementContainer", CPM_MODULE, _MANAGEMENT, True)),
    Member("cpmContainers", ListOf("ConstraintWrappedCpmContainers", CPM_MODULE, _WRAPPED, 1, 8)),
)
_CPM = (
    Member("header", header(RELEASE_2)),
    Member("payload", Record("CpmPayload", CPM_MODULE, _PAYLOAD, True)),
)
CPM = Record("CollectivePerceptionMessage", CPM_MODULE, _CPM)
"""Collective perception message of TS 103 324."""


CLASSES: dict[ObjectClass, tuple[str, Any]] = {
    ObjectClass.CAR: ("vehicleSubClass", 5),
    ObjectClass.PEDESTRIAN: ("vruSubClass", ("pedestrian", 1)),
    ObjectClass.CYCLIST: ("vruSubClass", ("bicyclistAndLightVruVehicle", 1)),
    ObjectClass.TRUCK: ("vehicleSubClass", 8),
}
"""Classes as CPMs state them: passenger car, ordinary pedestrian, bicyclist, heavy truck."""

FILLED = (
    "objectId",
    "zCoordinate",
    "angles",
    "objectDimensionZ",
    "objectDimensionY",
    "objectDimensionX",
    "sensorIdList",
    "classification",
)
"""Optional members of an object that `CpmObjects` fills; it fills the velocity, too, where that is known."""


def object_bits(members: Collection[str] = FILLED) -> Int[ndarray, "4"]:
    """Length of one perceived object of each `ObjectClass` [bit].

    Parameters
    ----------
    members
        Optional members of `OBJECT` that the object has, and `zCoordinate`. Velocity is cartesian and has no z
        component; there are one sensor and one class.

    Raises
    ------
    ValueError
        In one line: no such optional member, or one that is never written.
    """
    optional = {m.name: m.of for m in OBJECT.members if m.is_optional} | {"zCoordinate": _COORDINATE}
    whole = least(OBJECT)
    for name in members:
        kind = optional.get(name)
        if kind is None:
            known = ", ".join(name for name, kind in optional.items() if kind is not None)
            raise ValueError(f"members: {name} is no optional member of an object that is written. There are: {known}.")
        (whole["position"] if name == "zCoordinate" else whole)[name] = least(kind)
    bits = []
    for label in ObjectClass:
        if "classification" in members:
            whole["classification"] = [{"objectClass": CLASSES[label], "confidence": 1}]
        bits.append(n_bits(OBJECT, whole))
    return np.array(bits)


def cpm_bytes(
    n_objects: Int[ndarray, "m 4"],
    is_segment: bool = False,
    *,
    n_moving: Int[ndarray, "m 4"] | int = 0,
    has_sensors: Bool[ndarray, "m"] | bool = True,
) -> Int[ndarray, "m"]:
    """Length of CPMs with a vehicle container, without headers of the network and security [B].

    Parameters
    ----------
    n_objects
        Number of objects without velocity in each message, by `ObjectClass`; at most 255 objects in a message.
    is_segment
        Whether the messages state that they are segments.
    n_moving
        Number of further objects, which have a velocity.
    has_sensors
        Whether each message describes a LiDAR.

    Raises
    ------
    ValueError
        In one line: more than 255 objects in a message.
    """
    n_objects = np.asarray(n_objects, np.int64)
    n_moving = np.broadcast_to(np.asarray(n_moving, np.int64), n_objects.shape)
    is_negative = np.minimum(n_objects, n_moving) < 0
    n_all = (n_objects + n_moving).sum(axis=1)
    if is_negative.any() or (n_all > 255).any():
        raise ValueError("n_objects: a message has 0 to 255 objects. Split what is longer into segments.")
    still, moving = _filled_bits()
    n_empty, without, with_sensors = _frame_bits(is_segment)
    content = _whole_bytes(n_empty + n_objects @ still + n_moving @ moving)
    length = 1 + (content > 127)
    frame_bits = np.where(has_sensors, with_sensors, without)
    return _whole_bytes(frame_bits + 8 * (length + content))


def _whole_bytes(bits: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Bytes that hold so many bits."""
    return -(-bits // 8)


@cache
def _filled_bits() -> Int[ndarray, "2 4"]:
    """Length of one object of each `ObjectClass`, without and with a velocity [bit]."""
    return np.stack([object_bits(), object_bits((*FILLED, "velocity"))])


@cache
def _frame_bits(is_segment: bool) -> tuple[int, int, int]:
    """Bits of the container of objects without objects, and of a CPM without that container and its length.

    The latter are without and with the container of sensors.
    """
    empty = least(_OBJECTS) | {"perceivedObjects": []}
    less = 8 * (1 + len(encode(_OBJECTS, empty)))
    segment = (8, 1) if is_segment else None
    whole = []
    for has_sensors in (False, True):
        head = CpmHead(0, 0, 0, 0, 0, 0.0, segment, has_sensors)
        whole.append(n_bits(CPM, _cpm(head, empty)) - less)
    return n_bits(_OBJECTS, empty), whole[0], whole[1]


@dataclass(frozen=True, slots=True)
class CpmObjects:
    """Perceived objects, encoded: bits, and which of them belong to the object."""

    bits: UInt8[ndarray, "n b"]
    is_used: Bool[ndarray, "n b"]

    @staticmethod
    def of(
        number: Int[ndarray, "n"],
        label: Int[ndarray, "n"],
        xyz_m: Float[ndarray, "n 3"],
        lwh_m: Float[ndarray, "n 3"],
        angle_rad: Float[ndarray, "n"],
        score: Float[ndarray, "n"],
        velocity_mps: Float[ndarray, "n 2"] | None = None,
        confidences: Confidences | None = None,
    ) -> "CpmObjects":
        """Encode objects.

        Parameters
        ----------
        number
            `objectId`, 0 to 65535.
        label
            `ObjectClass`.
        xyz_m
            Centre of the box, to the east, north and above the reference position. Beyond 1.31 km: "out of range".
        lwh_m
            Length, width and height. Above 25.4 m: "out of range".
        angle_rad
            Of the length, counter-clockwise from east.
        score
            Confidence in the class, 0 to 1.
        velocity_mps
            To the east and north. It is absent where it is NaN, or None. Above 163.81 m/s: "out of range".
        confidences
            What the sender states of the accuracy. None: unavailable.

        Raises
        ------
        ValueError
            In one line: a number out of range.
        """
        centimetres = up(xyz_m.ravel(), 0.01, -131072, 131071)
        x, y, z = centimetres.reshape(-1, 3).T
        length, width, height = up(lwh_m.ravel(), 0.1, 1, 255).reshape(-1, 3).T
        angle_deg = np.degrees(np.mod(angle_rad, 2 * np.pi))
        angle = up(angle_deg, 0.1, 0, 3600) % 3600
        sure = np.clip(np.round(100 * score), 1, 100).astype(np.int64)
        confidences = confidences or Confidences.unavailable(len(label))
        number = np.asarray(number, np.int64)
        columns = (number, x, y, z, angle, length, width, height, sure)
        moves = np.zeros(len(label), np.int64)
        velocity = np.zeros((len(label), 2), np.int64)
        if velocity_mps is not None:
            moves = np.isfinite(velocity_mps).all(axis=1).astype(np.int64)
            velocity = up(velocity_mps.ravel(), 0.01, -16383, 16382, 16383).reshape(-1, 2)
        widths = _filled_bits()
        n_used = widths[moves, label]
        longest = widths.max()
        bits = np.zeros((len(label), longest), np.uint8)
        for kind in ObjectClass:
            for has_velocity in (0, 1):
                mine = np.flatnonzero((label == kind) & (moves == has_velocity))
                if len(mine):
                    stated = Confidences(*(column[mine] for column in confidences))
                    value = _object(kind, stated, [column[mine] for column in columns])
                    if has_velocity:
                        value |= _velocity(velocity[mine], stated)
                    width = widths[has_velocity, kind]
                    bits[mine, :width] = rows(OBJECT, value, len(mine))
        return CpmObjects(bits, np.arange(longest) < n_used[:, None])

    def between(self, begin: int, end: int) -> Encoded:
        """These objects, one after another."""
        bits = self.bits[begin:end][self.is_used[begin:end]]
        whole = int.from_bytes(np.packbits(bits).tobytes())
        return Encoded(end - begin, whole >> -len(bits) % 8, len(bits))


def _object(
    kind: ObjectClass,
    of: Confidences,
    columns: Sequence[ndarray],
) -> dict[str, Any]:
    number, x, y, z, angle, length, width, height, sure = columns
    return {
        "objectId": number,
        "measurementDeltaTime": 0,
        "position": {
            "xCoordinate": {"value": x, "confidence": of.x},
            "yCoordinate": {"value": y, "confidence": of.y},
            "zCoordinate": {"value": z, "confidence": 4096},
        },
        "angles": {"zAngle": {"value": angle, "confidence": of.angle}},
        "objectDimensionZ": {"value": height, "confidence": of.height},
        "objectDimensionY": {"value": width, "confidence": of.width},
        "objectDimensionX": {"value": length, "confidence": of.length},
        "sensorIdList": [LIDAR_ID],
        "classification": [{"objectClass": CLASSES[kind], "confidence": sure}],
    }


def _velocity(east_north: Any, stated: Any) -> dict[str, Any]:
    axes = {"xVelocity": {"value": east_north[:, 0], "confidence": stated.velocity_x}}
    axes |= {"yVelocity": {"value": east_north[:, 1], "confidence": stated.velocity_y}}
    return {"velocity": ("cartesianVelocity", axes)}


@dataclass(frozen=True, slots=True)
class CpmHead:
    """What a CPM says of its sender."""

    station: int
    time_ms: int
    """`TimestampIts`; see `its_ms`."""
    latitude: int
    """1e-7 degrees."""
    longitude: int
    """1e-7 degrees."""
    heading: int
    """Tenths of a degree, clockwise from north."""
    range_m: float
    """Of the LiDAR."""
    segment: tuple[int, int] | None = None
    """Number of segments and number of this one, from 1."""
    has_sensors: bool = True
    """Whether the message describes the LiDAR."""


def _cpm(head: CpmHead, objects: dict[str, Any]) -> dict[str, Any]:
    management: dict[str, Any] = {
        "referenceTime": head.time_ms,
        "referencePosition": place(head.latitude, head.longitude),
    }
    if head.segment:
        management["segmentationInfo"] = dict(zip(("totalMsgNo", "thisMsgNo"), head.segment, strict=True))
    region = ("circular", {"radius": min(round(10 * head.range_m), 4095)})
    sensor = {
        "sensorId": LIDAR_ID,
        "sensorType": LIDAR,
        "perceptionRegionShape": region,
        "shadowingApplies": 1,
    }
    vehicle = {"orientationAngle": {"value": head.heading, "confidence": 127}}
    sensors = [(SENSORS, [sensor])] if head.has_sensors else []
    return {
        "header": {"protocolVersion": PROTOCOL, "messageId": CPM_ID, "stationId": head.station},
        "payload": {
            "managementContainer": management,
            "cpmContainers": [(VEHICLE, vehicle), *sensors, (OBJECTS, objects)],
        },
    }


def cpm(head: CpmHead, n_objects: int, objects: Encoded) -> bytes:
    """A collective perception message: its sender, how many objects it perceives, and those in this message.

    Raises
    ------
    ValueError
        In one line: a number out of range, or more than 255 objects.
    """
    return encode(CPM, _cpm(head, {"numberOfPerceivedObjects": n_objects, "perceivedObjects": objects}))
