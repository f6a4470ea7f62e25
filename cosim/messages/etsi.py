"""What the messages of ETSI ITS have in common: types of their data dictionaries, rounding, times and places.

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
