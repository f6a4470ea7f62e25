"""Holds codes that two packages must say alike against each other, by name, when it is imported."""

from enum import IntEnum

from cosim.radio.message_round import LosState
from results import codes
from sensors.scene import ObjectClass, Shape

_SAME: dict[type[IntEnum], type[IntEnum]] = {
    codes.VehicleClass: Shape,
    codes.ObjectClass: ObjectClass,
    codes.LosState: LosState,
}

for _recorded, _produced in _SAME.items():
    assert codes.labels(_recorded) == codes.labels(_produced), f"{_recorded.__name__} and {_produced} differ"
