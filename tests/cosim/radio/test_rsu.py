"""Where roadside units stand, and where they cannot."""

import numpy as np
import pytest

from cosim.radio.rsu import NO_RSUS, RsuParams, place_rsus
from sumo_nets.catalogue import find
from sumo_nets.network import Junction, Streets, junctions
from tests.refusals import refused_in_one_line

BOUNDS = (0.0, 0.0, 1000.0, 500.0)


CROSSINGS = [Junction((100.0, 100.0, 7.0), 4), Junction((120.0, 100.0, 7.0), 9), Junction((500.0, 400.0, 2.0), 6)]
TOWN = Streets(CROSSINGS, BOUNDS)


def test_the_busiest_junctions_apart():
    sites = place_rsus(RsuParams(n_at_junctions=2), TOWN)
    assert sites.xyz_m.tolist() == [[120, 100, 13], [500, 400, 8]]  # 6 m above the street
    close = place_rsus(RsuParams(n_at_junctions=2, apart_m=10.0, height_m=5.0), TOWN)
    assert close.xyz_m.tolist() == [[120, 100, 12], [500, 400, 7]]
    assert len(place_rsus(RsuParams(n_at_junctions=3, apart_m=10.0), TOWN)) == 3
    backwards = place_rsus(RsuParams(n_at_junctions=2), Streets(CROSSINGS[::-1], BOUNDS))
    assert np.array_equal(backwards.key, sites.key)


def test_by_hand_above_the_nearest_street():
    sites = place_rsus(RsuParams(at=((480.0, 380.0, 4.0), (110.0, 90.0, 6.0)), n_at_junctions=1), TOWN)
    assert sites.xyz_m.tolist() == [[480, 380, 6], [110, 90, 13], [120, 100, 13]]
    again = place_rsus(RsuParams(at=((110.0, 90.0, 6.0),)), TOWN)
    assert again.key[0] == sites.key[1]  # the same unit, however many there are
    assert place_rsus(RsuParams(), TOWN) is NO_RSUS


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"at": ((1200.0, 60.0, 6.0),)}, r"rsu\.at\[0\] = \[1200, 60\] m lies outside the network"),
        ({"n_at_junctions": 3}, "no more than 2 junctions"),
        ({"at": ((1.0, 1.0, 6.0), (1.0, 1.0, 5.0))}, r"two roadside units stand at \[1\.00, 1\.00\]"),
    ],
)
def test_where_they_cannot_stand(params, words):
    with refused_in_one_line(words):
        place_rsus(RsuParams(**params), TOWN)
    with pytest.raises(ValueError, match="no place for an antenna"):
        RsuParams(at=((1.0, 1.0, 0.0),))


def test_helsinki():
    found, bounds = junctions(find("helsinki").net_path)
    west, south, east, north = bounds
    xyz = np.array([j.xyz_m for j in found])
    assert len(found) > 100 and max(j.n_lanes for j in found) >= 6
    assert ((xyz[:, :2] >= [west, south]) & (xyz[:, :2] <= [east, north])).all()
    sites = place_rsus(RsuParams(n_at_junctions=5), Streets(found, bounds))
    apart = np.linalg.norm(sites.xyz_m[:, None, :2] - sites.xyz_m[None, :, :2], axis=2)
    assert apart[np.triu_indices(5, 1)].min() >= 100
