"""Classes of types that no file defines: whole words of their names."""

import pytest

from sumo_nets.vtypes import guess


@pytest.mark.parametrize(
    ("vclass", "names"),
    [
        ("passenger", "equipped unequipped Personenwagen VANET ownership restrained busy advanced stopped carbon übus "
         "passenger DEFAULT_VEHTYPE car krauss tramp"),
        ("bus", "bus city_bus bus_12 Bus buses BusLine4 bus@b7 articulated-bus"),
        ("truck", "truck3 truck_bus Truck HGVTruck HGV lorry18@a trucks Heavy+Vehicle LKW"),
        ("trailer", "truck_trailer truckTrailer"),
        ("delivery", "DeliveryVan delivery_van van2 vans"),
        ("motorcycle", "motorbike MotorBike motor_bike Motorcycle motorcycles"),
        ("bicycle", "bike DEFAULT_BIKETYPE bicycle_1 eBike cyclist pedestrian/bicycle"),
        ("pedestrian", "DEFAULT_PEDTYPE ped1 pedestrians person_2"),
        ("taxi", "taxi TaxiCab"),
        ("scooter", "scooter Scooter"),
        ("wheelchair", "WHEELCHAIR"),
        ("drone", "Drone"),
    ],
)  # fmt: skip
def test_whole_words_say_a_class_and_parts_of_words_say_none(vclass, names):
    """A blank within a name is written as a plus sign here."""
    split = names.split()
    assert {name: guess(name.replace("+", " ")).vclass for name in split} == dict.fromkeys(split, vclass)
