"""Vehicle types by name: SUMO's vehicle class and size."""

from __future__ import annotations

from collections.abc import Iterable
from math import nan
from pathlib import Path
from typing import NamedTuple

from sumo_nets.xml import Attributes, stream


class VehicleType(NamedTuple):
    """SUMO's vehicle class, and length, width and height in metres."""

    vclass: str
    lwh_m: tuple[float, float, float]


_CAR = (5.0, 1.8, 1.5)
_VAN = (6.5, 2.16, 2.86)
SIZES_M = {
    **dict.fromkeys(("ignoring", "private", "authority", "army", "vip", "passenger", "hov", "taxi", "evehicle",
                     "custom1", "custom2", "cable_car"), _CAR),
    "emergency": _VAN, "delivery": _VAN,
    "bus": (12.0, 2.5, 3.4), "coach": (14.0, 2.6, 4.0), "tram": (22.0, 2.4, 3.2),
    "truck": (7.1, 2.4, 2.4), "trailer": (16.5, 2.55, 4.0),
    "rail_urban": (109.5, 3.0, 3.6), "subway": (109.5, 3.0, 3.6), "rail": (135.0, 2.84, 3.75),
    "rail_electric": (200.0, 2.95, 3.89), "rail_fast": (200.0, 2.95, 3.89),
    "motorcycle": (2.2, 0.9, 1.5), "moped": (2.1, 0.78, 1.7), "bicycle": (1.6, 0.65, 1.7),
    "scooter": (1.2, 0.5, 1.7), "pedestrian": (0.215, 0.478, 1.719), "wheelchair": (1.2, 0.72, 1.2),
    "ship": (17.0, 4.0, 4.0), "container": (6.096, 2.438, 2.591), "aircraft": (72.7, 79.8, 1.5),
    "drone": (0.5, 0.5, 1.5),
}  # fmt: skip
"""Length, width and height that SUMO 1.28 gives to a class by default [m]."""

_DEFAULT = {
    "DEFAULT_VEHTYPE": "passenger", "DEFAULT_PEDTYPE": "pedestrian", "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_CONTAINERTYPE": "container", "DEFAULT_TAXITYPE": "taxi", "DEFAULT_RAILTYPE": "rail",
}  # fmt: skip
_HINTS = {
    "motorcycle": "motorcycle", "moped": "moped", "bicycle": "bicycle", "bike": "bicycle", "cyclist": "bicycle",
    "ped": "pedestrian", "person": "pedestrian", "walk": "pedestrian", "coach": "coach", "bus": "bus",
    "trailer": "trailer", "truck": "truck", "lorry": "truck", "hgv": "truck", "delivery": "delivery",
    "van": "delivery", "emergency": "emergency", "tram": "tram", "subway": "subway", "rail": "rail",
    "train": "rail", "ship": "ship", "container": "container", "taxi": "taxi",
}  # fmt: skip
"""Substring of a type's name, and the class that it suggests; the first match is used."""


LARGEST_M = {"length": 1000.0, "width": 100.0, "height": 100.0}
"""Largest size of an actor; trains, ships and aircraft are left out before they are placed."""
SMALLEST_M = 0.001
"""Smallest size of an actor; positions are kept to the millimetre, sizes in single precision."""


def check_size(where: str, what: str, value: str | float) -> float:
    """A length, width or height [m]; ValueError where it is not a positive number of a possible size."""
    try:
        size_m = float(value)
    except ValueError:
        size_m = nan
    if not SMALLEST_M <= size_m <= LARGEST_M[what]:
        raise ValueError(f"{where}: {what} = {value} m should be {SMALLEST_M:g} to {LARGEST_M[what]:g} m.")
    return size_m


def read(paths: Iterable[Path]) -> dict[str, VehicleType]:
    """The types that additional or route files define."""
    found: dict[str, VehicleType] = {}
    for path in paths:

        def start(name: str, attributes: Attributes, path: Path = path) -> None:
            if name == "vType":
                vclass = attributes.get("vClass", "passenger")
                sizes = SIZES_M.get(vclass, _CAR)
                named = zip(("length", "width", "height"), sizes, strict=True)
                where = f"{path}: vType {attributes.get('id', '?')!r}"
                length, width, height = (check_size(where, what, attributes.get(what, size)) for what, size in named)
                found[attributes.get("id", "")] = VehicleType(vclass, (length, width, height))

        stream(path, start)
    return found


def guess(name: str) -> VehicleType:
    """The most likely class of a type that no file defines, by its name; a passenger car without a match."""
    vclass = _DEFAULT.get(name) or next((c for hint, c in _HINTS.items() if hint in name.lower()), "passenger")
    return VehicleType(vclass, SIZES_M[vclass])
