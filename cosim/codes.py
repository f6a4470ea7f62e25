"""Holds the codes that producers write against those that the tables render, by name, when it is imported."""

from enum import IntEnum

from cosim.cycle import SOURCES
from cosim.v2x.exchange import View
from cosim.v2x.messages import ORIGINS
from cosim.world import BEHAVIOURS, LABELS
from results import codes
from sensors.scene import Shape

_LOS_STATES = {"open": "los", "wall": "nlos", "unknown": "unknown"}

_PRODUCED: dict[type[IntEnum], tuple[str, ...]] = {
    codes.VehicleClass: codes.labels(Shape),
    codes.ObjectClass: LABELS,
    codes.Role: BEHAVIOURS,
    codes.Origin: ORIGINS,
    codes.TrustSource: SOURCES,
    codes.LosState: tuple(_LOS_STATES[name] for name in codes.labels(View)),
}

for _recorded, _names in _PRODUCED.items():
    assert codes.labels(_recorded) == _names, f"{_recorded.__name__}: tables {codes.labels(_recorded)}, hall {_names}"
