"""Packages that do not know each other use the same codes."""

from cosim.base import codes
from sensors.scene import Shape


def test_the_recorded_vehicle_classes_are_the_shapes_of_the_scene():
    assert codes.labels(codes.VehicleClass) == codes.labels(Shape)
