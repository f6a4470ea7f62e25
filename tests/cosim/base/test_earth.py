"""Latitude and longitude: a textbook example, symmetry, differences, and SUMO's own projection."""

from pathlib import Path

import numpy as np
import pytest

from cosim.base.earth import Projection
from sumo_nets import network, sumotools

HELSINKI = Path(network.__file__).parent / "helsinki" / "net.net.xml.gz"
UTM = "+proj=utm +zone=35 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"


def test_central_meridian_and_equator():
    """On the equator and on the meridian of zone 31: 500 km east and 0 km north is 3 degrees east."""
    place = Projection.of("+proj=utm +zone=31 +datum=WGS84", 5e5, 0.0).of_world(np.zeros((1, 2)))
    assert place.latitude_deg[0] == pytest.approx(0, abs=1e-12) and place.longitude_deg[0] == pytest.approx(3)
    assert place.turn_rad[0] == pytest.approx(0, abs=1e-12) and place.scale[0] == pytest.approx(0.9996)
    south = Projection.of("+proj=utm +zone=31 +south +datum=WGS84", 5e5, 1e7).of_world(np.zeros((1, 2)))
    assert south.latitude_deg[0] == pytest.approx(0, abs=1e-9)


def test_a_quarter_of_the_meridian():
    """The meridian quadrant of WGS84 is 10,001,965.729 m long, and 45 degrees lie at 4,984,944.378 m."""
    at = Projection(0.0, 0.0).of_world(np.array([[0.0, 10_001_965.729], [0.0, 4_984_944.378]]))
    assert at.latitude_deg == pytest.approx([90, 45], abs=1e-7)
    there = Projection(60.17, 24.94).of_world(np.zeros((1, 2)))
    assert (there.latitude_deg[0], there.longitude_deg[0]) == pytest.approx((60.17, 24.94), abs=1e-9)


def test_turn_and_scale_are_differences():
    """A step to the map's north, as metres on the ellipsoid, points by the turn off true north."""
    projection, far = Projection.of(UTM, 0.0, 6_671_000.0), np.array([[385_000.0, 0.0], [700_000.0, -2e6]])
    here, there = projection.of_world(far), projection.of_world(far + [0.0, 100.0])
    lat = np.radians(here.latitude_deg)
    e2 = 0.00669437999014
    root = np.sqrt(1 - e2 * np.sin(lat) ** 2)
    north = np.radians(there.latitude_deg - here.latitude_deg) * 6378137 * (1 - e2) / root**3
    east = np.radians(there.longitude_deg - here.longitude_deg) * 6378137 * np.cos(lat) / root
    assert np.arctan2(east, north) == pytest.approx(here.turn_rad, abs=1e-5)
    assert 100 / np.hypot(east, north) == pytest.approx(here.scale, abs=3e-6)
    assert here.turn_rad[0] < 0 < here.turn_rad[1], "east of the central meridian the map's north points to the east"


def test_sumo_projects_to_the_same_place():
    text, (east, north) = network.projection(HELSINKI)
    xy = np.array([[0.0, 0.0], [1000.0, 100.0], [500.0, 1600.0], [20.0, 900.0]])
    at = Projection.of(text, -east, -north).of_world(xy)
    ring = np.column_stack([at.longitude_deg, at.latitude_deg])
    (back,) = sumotools.projected([ring], HELSINKI)
    assert back[: len(xy)] == pytest.approx(xy, abs=2e-4)


@pytest.mark.parametrize(
    "text", ["+proj=lcc +datum=WGS84", "+proj=utm +zone=77 +datum=WGS84", "+proj=utm +zone=3 +ellps=bessel", "-", "",
             "+proj=tmerc +ellps=WGS84 +towgs84=1,2,3", "+proj=tmerc +lat_0=x +datum=WGS84"]
)  # fmt: skip
def test_other_maps_are_refused(text):
    with pytest.raises(ValueError, match="no transverse Mercator map of WGS84"):
        Projection.of(text, 0, 0)


@pytest.mark.parametrize(
    "projection", [Projection.of(UTM, 0.0, 6_671_000.0), Projection(41.9, 12.5), Projection(-33.9, 151.2)]
)
def test_there_and_back(projection):
    places = np.array([[0.0, 0.0], [300.0, -20.0], [-90_000.0, 40_000.0]])
    earth = projection.of_world(places)
    np.testing.assert_allclose(projection.to_world(earth.latitude_deg, earth.longitude_deg), places, atol=1e-5)


def test_metres_are_those_of_the_ellipsoid():
    """A degree at 41.9 degrees north by the radii of curvature: 111.07 km of latitude, 82.99 km of longitude."""
    e2, lat = 0.00669437999014, np.radians(41.9)
    root = np.sqrt(1 - e2 * np.sin(lat) ** 2)
    north_m, east_m = 6378137 * (1 - e2) / root**3, 6378137 * np.cos(lat) / root
    xy = Projection(41.9, 12.5).to_world(np.array([41.9005, 41.9]), np.array([12.5, 12.5005]))
    expected = np.radians(0.0005) * np.array([[0, north_m], [east_m, 0]])
    np.testing.assert_allclose(xy, expected, atol=1e-3)
