"""Parameters of the equipped fleet. Imports nothing heavy, because every reading of a config imports it."""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

Probability = Annotated[float, Ge(0), Le(1)]
VehicleClass = Literal["car", "van", "truck", "bus", "motorcycle", "bicycle"]
ActorClass = Literal["car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian"]


@dataclass(frozen=True, kw_only=True, slots=True)
class FleetParams:
    """Which vehicles carry a LiDAR and a radio.

    The share is decided vehicle by vehicle from its name: a larger share adds vehicles and changes none.
    """

    penetration_p: Probability = 0.35
    """Share of the vehicles of `equipped_kinds` that carry a LiDAR and a radio."""
    equipped_kinds: tuple[VehicleClass, ...] = ("car", "van")
    """Vehicle classes that can be equipped."""
