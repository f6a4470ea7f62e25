"""Latitude and longitude of places on a transverse Mercator map, such as UTM.

Notes
-----
Series in the third flattening to its fourth power (L. Krüger 1912; coefficients as in C. F. F. Karney 2011,
doi:10.1007/s00190-011-0445-3), on the ellipsoid of WGS84.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

FLATTENING = 1 / 298.257223563
N = FLATTENING / (2 - FLATTENING)
"""Third flattening."""
N2, N3, N4 = N**2, N**3, N**4
RADIUS_M = 6_378_137 / (1 + N) * (1 + N2 / 4 + N4 / 64)
"""A quarter of the meridian, divided by a right angle."""
E = math.sqrt(FLATTENING * (2 - FLATTENING))
"""Eccentricity."""

ALPHA = (
    N / 2 - 2 * N2 / 3 + 5 * N3 / 16 + 41 * N4 / 180,
    13 * N2 / 48 - 3 * N3 / 5 + 557 * N4 / 1440,
    61 * N3 / 240 - 103 * N4 / 140,
    49561 * N4 / 161280,
)
BETA = (
    N / 2 - 2 * N2 / 3 + 37 * N3 / 96 - N4 / 360,
    N2 / 48 + N3 / 15 - 437 * N4 / 1440,
    17 * N3 / 480 - 37 * N4 / 840,
    4397 * N4 / 161280,
)
DELTA = (
    2 * N - 2 * N2 / 3 - 2 * N3 + 116 * N4 / 45,
    7 * N2 / 3 - 8 * N3 / 5 - 227 * N4 / 45,
    56 * N3 / 15 - 136 * N4 / 35,
    4279 * N4 / 630,
)


@dataclass(frozen=True, slots=True)
class OnEarth:
    """Places in degrees, and how the map is turned and stretched there."""

    latitude_deg: Float[ndarray, "n"]
    longitude_deg: Float[ndarray, "n"]
    turn_rad: Float[ndarray, "n"]
    """Clockwise angle from true north to the map's north."""
    scale: Float[ndarray, "n"]
    """Metres on the map per metre on the ellipsoid."""


@dataclass(frozen=True, slots=True)
class Projection:
    """A transverse Mercator map, shifted: `east_m` and `north_m` are the world's origin seen from the map's."""

    latitude_deg: float
    """Where the map's origin is."""
    longitude_deg: float
    """Of the central meridian."""
    scale: float = 1.0
    """On the central meridian."""
    east_m: float = 0.0
    north_m: float = 0.0

    @staticmethod
    def of(text: str, east_m: float, north_m: float) -> "Projection":
        """The projection that PROJ would make of a text such as `+proj=utm +zone=35 +ellps=WGS84`.

        Parameters
        ----------
        east_m, north_m
            Coordinates of the world's origin on that map.

        Raises
        ------
        ValueError
            In one line: it is no transverse Mercator map of WGS84.
        """
        given = dict(part.lstrip("+").partition("=")[::2] for part in text.split())
        ellipsoid = given.get("ellps", given.get("datum"))
        shift = given.get("towgs84", "0").split(",")
        try:
            if ellipsoid not in ("WGS84", "GRS80") or given.get("units", "m") != "m":
                raise KeyError
            if any(float(part) for part in shift):
                raise KeyError
            if given["proj"] == "utm" and 1 <= (zone := int(given["zone"])) <= 60:
                south_m = 1e7 if "south" in given else 0.0
                return Projection(0.0, 6.0 * zone - 183, 0.9996, east_m - 5e5, north_m - south_m)
            if given["proj"] != "tmerc":
                raise KeyError
            names = ("lat_0", "lon_0", "x_0", "y_0")
            lat, lon, x, y = (float(given.get(name, 0)) for name in names)
            scale = float(given.get("k", given.get("k_0", 1)))
            return Projection(lat, lon, scale, east_m - x, north_m - y)
        except (KeyError, ValueError):
            raise ValueError(f"the projection {text!r} is no transverse Mercator map of WGS84, such as UTM.") from None

    def of_world(self, xy_m: Float[ndarray, "n 2"]) -> OnEarth:
        """Where places of the world frame are on Earth.

        Parameters
        ----------
        xy_m
            East and north [m], at most 3,000 km from the central meridian.
        """
        xy = np.asarray(xy_m, float)
        stretch = self.scale * RADIUS_M
        origin = _rectified(math.radians(self.latitude_deg))
        xi = (xy[:, 1] + self.north_m) / stretch + origin
        eta = (xy[:, 0] + self.east_m) / stretch
        of_xi, of_eta = _series(BETA, xi, eta)
        north, east = xi - of_xi, eta - of_eta
        chi = np.arcsin(np.sin(north) / np.cosh(east))
        of_chi, _ = _series(DELTA, chi, np.zeros(1))
        lat = chi + of_chi
        away = np.arctan2(np.sinh(east), np.cos(north))
        longitude_deg = self.longitude_deg + np.degrees(away)
        return OnEarth(
            latitude_deg=np.degrees(lat),
            longitude_deg=np.mod(longitude_deg + 180, 360) - 180,
            turn_rad=np.arctan(np.tan(away) * np.sin(lat)),
            scale=self.scale * np.cosh(east),
        )

    def to_world(
        self,
        latitude_deg: Float[ndarray, "n"],
        longitude_deg: Float[ndarray, "n"],
    ) -> Float[ndarray, "n 2"]:
        """World coordinates, east and north [m], of places on Earth: the inverse of `of_world`.

        Parameters
        ----------
        latitude_deg, longitude_deg
            At most 3,000 km from the central meridian.
        """
        sin_lat = np.sin(np.radians(latitude_deg))
        away = np.radians(np.asarray(longitude_deg, float) - self.longitude_deg)
        cos_away = np.cos(away)
        isometric = np.arctanh(sin_lat) - E * np.arctanh(E * sin_lat)
        t = np.sinh(isometric)
        xi = np.arctan2(t, cos_away)
        eta = np.arcsinh(np.sin(away) / np.hypot(t, cos_away))
        of_xi, of_eta = _series(ALPHA, xi, eta)
        north, east = xi + of_xi, eta + of_eta
        stretch = self.scale * RADIUS_M
        origin = _rectified(math.radians(self.latitude_deg))
        east_m = stretch * east - self.east_m
        north_m = stretch * (north - origin) - self.north_m
        return np.column_stack([east_m, north_m])


def _series(
    coefficients: tuple[float, ...], xi: Float[ndarray, "n"], eta: Float[ndarray, "m"]
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Sums over k of c_k sin(2k xi) cosh(2k eta), and of c_k cos(2k xi) sinh(2k eta)."""
    j = 2 * np.arange(1, 5)[:, None]
    c = np.array(coefficients)[:, None]
    j_xi, j_eta = j * xi, j * eta
    of_xi = c * np.sin(j_xi) * np.cosh(j_eta)
    of_eta = c * np.cos(j_xi) * np.sinh(j_eta)
    return of_xi.sum(axis=0), of_eta.sum(axis=0)


def _rectified(lat_rad: float) -> float:
    """Length of the meridian from the equator, as an angle."""
    sin = math.sin(lat_rad)
    isometric = math.atanh(sin) - E * math.atanh(E * sin)
    xi = math.atan(math.sinh(isometric))
    terms = []
    for k, alpha in enumerate(ALPHA, 1):
        terms.append(alpha * math.sin(2 * k * xi))
    return xi + sum(terms)
