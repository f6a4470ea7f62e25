"""Packages that do not know each other use the same codes."""

import pytest

from cosim.base import codes
from cosim.radio.message_round import LosState
from sensors.scene import ObjectClass, Shape


@pytest.mark.parametrize(
    ("recorded", "produced"),
    [(codes.VehicleClass, Shape), (codes.ObjectClass, ObjectClass), (codes.LosState, LosState)],
)
def test_enums_of_two_packages_agree(recorded, produced):
    assert codes.labels(recorded) == codes.labels(produced)
