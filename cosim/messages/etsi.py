"""What the messages of ETSI ITS have in common: types of their data dictionaries, confidence values, times, places.

Notes
-----
Modules: `ETSI-ITS-CDD` is the common data dictionary of release 2 (TS 102 894-2 v2.1.1), and `ITS-Container` that of
release 1 (v1.3.1). What is written here, in `cosim.messages.cpm` and in `cosim.messages.cam` are names and ranges, and
the values "unavailable" that the modules define.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.codes import ObjectClass
from cosim.messages.uper import Enumerated, Integer, Member, Record, Type

RELEASE_1, RELEASE_2 = "ITS-Container", "ETSI-ITS-CDD"

cdd = partial(Integer, module=RELEASE_2)
its = partial(Integer, module=RELEASE_1)


def maybe(name: str, of: Type | None = None) -> Member:
    """An optional member, written or not."""
    return Member(name, of, True)


def header(module: str) -> Record:
    """The header of all messages, in the types of a release."""
    byte = partial(Integer, module=module, low=0, high=255)
    names = ("INTEGER", "INTEGER", "StationID")
    if module == RELEASE_2:
        names = ("OrdinalNumber1B", "MessageId", "StationId")
    members = (
        Member("protocolVersion", byte(names[0])),
        Member("messageId", byte(names[1])),
        Member("stationId", Integer(names[2], module, 0, 2**32 - 1)),
    )
    return Record("ItsPduHeader", module, members)


def reference_position(module: str) -> Record:
    """Where a sender is, in the types of a release."""
    of = partial(Integer, module=module)
    ellipse = (
        Member("semiMajorConfidence", of("SemiAxisLength", low=0, high=4095)),
        Member("semiMinorConfidence", of("SemiAxisLength", low=0, high=4095)),
        Member("semiMajorOrientation", of("HeadingValue", low=0, high=3601)),
    )
    altitude = (
        Member("altitudeValue", of("AltitudeValue", low=-100000, high=800001)),
        Member("altitudeConfidence", Enumerated("AltitudeConfidence", module, tuple(range(16)))),
    )
    members = (
        Member("latitude", of("Latitude", low=-900000000, high=900000001)),
        Member("longitude", of("Longitude", low=-1800000000, high=1800000001)),
        Member("positionConfidenceEllipse", Record("PosConfidenceEllipse", module, ellipse)),
        Member("altitude", Record("Altitude", module, altitude)),
    )
    return Record("ReferencePosition", module, members)


def with_confidence(name: str, value: Integer, confidence: Integer | Enumerated, module: str = RELEASE_2) -> Record:
    """A value and its confidence, whose names in the modules differ for each type but are not written."""
    return Record(name, module, (Member("value", value), Member("confidence", confidence)))


STATION_TYPE = {ObjectClass.CAR: 5, ObjectClass.PEDESTRIAN: 1, ObjectClass.CYCLIST: 2, ObjectClass.TRUCK: 8}
"""Classes as CAMs and GeoNetworking state them."""

PROTOCOL = 2
"""Version of the messages."""


def its_ms(unix_s: float) -> int:
    """Milliseconds of atomic time since 2004-01-01 00:00 UTC, of a time after 2016: five leap seconds came between."""
    return round((unix_s - 1_072_915_200 + 5) * 1000)


def up(
    value: Float[ndarray, "n"],
    unit: float,
    low: int,
    high: int,
    unknown: int | None = None,
) -> Int[ndarray, "n"]:
    """Multiples of a unit that are not less than the values, as the data dictionary rounds; held within the range.

    A value that is up to a thousandth of a unit above a multiple counts as that multiple. NaN becomes `unknown`.
    """
    value = np.asarray(value, float)
    known = np.isfinite(value) if unknown is not None else np.ones(len(value), bool)
    in_units = np.where(known, value, 0.0) / unit
    whole = np.clip(np.ceil(in_units - 1e-3), low, high).astype(np.int64)
    return np.where(known, whole, 0 if unknown is None else unknown)


def heading(compass_deg: Float[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Angles in tenths of a degree, 0 to 3599."""
    return np.round(np.mod(compass_deg, 360.0) * 10).astype(np.int64) % 3600


def place(latitude: Any, longitude: Any) -> dict[str, Any]:
    """A position whose accuracy and altitude are unavailable."""
    ellipse = {"semiMajorConfidence": 4095, "semiMinorConfidence": 4095, "semiMajorOrientation": 3601}
    altitude = {"altitudeValue": 800001, "altitudeConfidence": 15}
    return {
        "latitude": latitude,
        "longitude": longitude,
        "positionConfidenceEllipse": ellipse,
        "altitude": altitude,
    }


_HALF_WIDTH = 1.96
"""Half the width of the interval that holds 95 % of a normal distribution, in standard deviations."""
_ANGLE_BEYOND, _SPEED_BEYOND = 126, 126
"""The values of AngleConfidence and SpeedConfidence for more than 12.5 degrees and 1.25 m/s."""


class Confidences(NamedTuple):
    """Confidence values of objects: half the width of the interval that holds the truth in 95 % of the cases.

    They are in the units of their data elements. A value above the range becomes "out of range", NaN "unavailable".
    """

    x: Int[ndarray, "n"]
    y: Int[ndarray, "n"]
    angle: Int[ndarray, "n"]
    length: Int[ndarray, "n"]
    width: Int[ndarray, "n"]
    height: Int[ndarray, "n"]
    velocity_x: Int[ndarray, "n"]
    velocity_y: Int[ndarray, "n"]

    @staticmethod
    def of(
        position_std_m: Float[ndarray, "n 2"],
        angle_std_rad: Float[ndarray, "n"],
        lwh_std_m: Float[ndarray, "n 3"],
        velocity_std_mps: Float[ndarray, "n 2"],
    ) -> "Confidences":
        """The confidence values of normal errors with these standard deviations; place and velocity have two each."""
        position = up(_HALF_WIDTH * position_std_m.ravel(), 0.01, 1, 4095, 4096)
        x, y = position.reshape(-1, 2).T
        size = up(_HALF_WIDTH * lwh_std_m.ravel(), 0.1, 1, 31, 32)
        length, width, height = size.reshape(-1, 3).T
        angle = up(_HALF_WIDTH * np.degrees(angle_std_rad), 0.1, 1, _ANGLE_BEYOND, 127)
        velocity = up(_HALF_WIDTH * velocity_std_mps.ravel(), 0.01, 1, _SPEED_BEYOND, 127).reshape(-1, 2)
        return Confidences(x, y, angle, length, width, height, *velocity.T)

    def standard_deviations(self) -> "StatedDeviations":
        """What a receiver reads from confidence values that are available."""
        place = np.column_stack([self.x, self.y])
        angle_deg = np.where(self.angle == _ANGLE_BEYOND, np.nan, 0.1 * self.angle)
        size = np.column_stack([self.length, self.width, self.height])
        velocity = np.column_stack([self.velocity_x, self.velocity_y])
        velocity_mps = np.where(velocity == _SPEED_BEYOND, np.nan, 0.01 * velocity)
        return StatedDeviations(
            position_m=0.01 * place / _HALF_WIDTH,
            angle_rad=np.radians(angle_deg / _HALF_WIDTH),
            lwh_m=0.1 * size / _HALF_WIDTH,
            velocity_mps=velocity_mps / _HALF_WIDTH,
        )

    @staticmethod
    def unavailable(n: int) -> "Confidences":
        """Those of objects whose accuracy is not known."""
        three = np.full((n, 3), np.nan)
        one, two = three[:, 0], three[:, :2]
        return Confidences.of(two, one, three, two)


class StatedDeviations(NamedTuple):
    """Standard deviations of normal errors with given confidence values; NaN where a value is "out of range".

    Positions and sizes that are out of range have the next value, 40.95 and 3.1 m.
    """

    position_m: Float[ndarray, "n 2"]
    angle_rad: Float[ndarray, "n"]
    lwh_m: Float[ndarray, "n 3"]
    velocity_mps: Float[ndarray, "n 2"]


class PositionVectors(NamedTuple):
    """Senders, when and where they are and how they move: the long position vectors of GeoNetworking, before encoding.

    `station`, `time_ms`, `latitude`, `longitude` and `heading` are as in `cosim.messages.cpm.CpmHead`.
    """

    station: Int[ndarray, "n"]
    label: Int[ndarray, "n"]
    """`ObjectClass` of the sender."""
    time_ms: Int[ndarray, "n"]
    latitude: Int[ndarray, "n"]
    longitude: Int[ndarray, "n"]
    heading: Int[ndarray, "n"]
    speed_mps: Float[ndarray, "n"]
    """Along the heading; below 0 is backward, NaN: unavailable."""

    def station_type(self) -> Int[ndarray, "n"]:
        """Class of each sender, as CAMs and GeoNetworking state it."""
        return np.array([STATION_TYPE[kind] for kind in ObjectClass])[self.label]
