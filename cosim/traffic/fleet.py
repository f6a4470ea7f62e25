"""Parameters of the equipped fleet. Imports nothing heavy, because every reading of a config imports it."""

from dataclasses import dataclass
from typing import Literal

from cosim.base.bounds import Share

VehicleClass = Literal["car", "van", "truck", "bus", "motorcycle", "bicycle"]
ActorClass = Literal["car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian"]


@dataclass(frozen=True, kw_only=True, slots=True)
class FleetParams:
    """Which vehicles are equipped with a LiDAR and a radio.

    Whether a vehicle is equipped is drawn from its name. A larger share therefore adds equipped vehicles and removes
    none.
    """

    penetration_p: Share = 0.35
    """Share of the vehicles of `equipped_kinds` that are equipped with a LiDAR and a radio."""
    equipped_kinds: tuple[VehicleClass, ...] = ("car", "van")
    """Vehicle classes that can be equipped."""
