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
RADIUS_M = 6_378_137 / (1 + N) * (1 + N**2 / 4 + N**4 / 64)
"""A quarter of the meridian, divided by a right angle."""
E = math.sqrt(FLATTENING * (2 - FLATTENING))
"""Eccentricity."""

ALPHA = (
    N / 2 - 2 * N**2 / 3 + 5 * N**3 / 16 + 41 * N**4 / 180, 13 * N**2 / 48 - 3 * N**3 / 5 + 557 * N**4 / 1440,
    61 * N**3 / 240 - 103 * N**4 / 140, 49561 * N**4 / 161280,
)  # fmt: skip
BETA = (
    N / 2 - 2 * N**2 / 3 + 37 * N**3 / 96 - N**4 / 360, N**2 / 48 + N**3 / 15 - 437 * N**4 / 1440,
    17 * N**3 / 480 - 37 * N**4 / 840, 4397 * N**4 / 161280,
)  # fmt: skip
DELTA = (
    2 * N - 2 * N**2 / 3 - 2 * N**3 + 116 * N**4 / 45, 7 * N**2 / 3 - 8 * N**3 / 5 - 227 * N**4 / 45,
    56 * N**3 / 15 - 136 * N**4 / 35, 4279 * N**4 / 630,
)  # fmt: skip


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
        try:
            if given.get("ellps", given.get("datum")) not in ("WGS84", "GRS80") or given.get("units", "m") != "m":
                raise KeyError
            if any(float(v) for v in given.get("towgs84", "0").split(",")):
                raise KeyError
            if given["proj"] == "utm" and 1 <= (zone := int(given["zone"])) <= 60:
                south_m = 1e7 if "south" in given else 0.0
                return Projection(0.0, 6.0 * zone - 183, 0.9996, east_m - 5e5, north_m - south_m)
            if given["proj"] != "tmerc":
                raise KeyError
            lat, lon, x, y = (float(given.get(name, 0)) for name in ("lat_0", "lon_0", "x_0", "y_0"))
            return Projection(lat, lon, float(given.get("k", given.get("k_0", 1))), east_m - x, north_m - y)
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
        xi = (xy[:, 1] + self.north_m) / stretch + _rectified(math.radians(self.latitude_deg))
        eta = (xy[:, 0] + self.east_m) / stretch
        j = 2 * np.arange(1, 5)[:, None]
        beta, delta = (np.array(c)[:, None] for c in (BETA, DELTA))
        north = xi - (beta * np.sin(j * xi) * np.cosh(j * eta)).sum(axis=0)
        east = eta - (beta * np.cos(j * xi) * np.sinh(j * eta)).sum(axis=0)
        chi = np.arcsin(np.sin(north) / np.cosh(east))
        lat = chi + (delta * np.sin(j * chi)).sum(axis=0)
        away = np.arctan2(np.sinh(east), np.cos(north))
        return OnEarth(
            np.degrees(lat), np.mod(self.longitude_deg + np.degrees(away) + 180, 360) - 180,
            np.arctan(np.tan(away) * np.sin(lat)), self.scale * np.cosh(east),
        )  # fmt: skip

    def to_world(self, latitude_deg: Float[ndarray, "n"], longitude_deg: Float[ndarray, "n"]) -> Float[ndarray, "n 2"]:
        """World coordinates, east and north [m], of places on Earth: the inverse of `of_world`.

        Parameters
        ----------
        latitude_deg, longitude_deg
            At most 3,000 km from the central meridian.
        """
        lat, away = np.radians(latitude_deg), np.radians(np.asarray(longitude_deg, float) - self.longitude_deg)
        t = np.sinh(np.arctanh(np.sin(lat)) - E * np.arctanh(E * np.sin(lat)))
        xi, eta = np.arctan2(t, np.cos(away)), np.arcsinh(np.sin(away) / np.hypot(t, np.cos(away)))
        j, alpha = 2 * np.arange(1, 5)[:, None], np.array(ALPHA)[:, None]
        north = xi + (alpha * np.sin(j * xi) * np.cosh(j * eta)).sum(axis=0)
        east = eta + (alpha * np.cos(j * xi) * np.sinh(j * eta)).sum(axis=0)
        stretch = self.scale * RADIUS_M
        origin = _rectified(math.radians(self.latitude_deg))
        return np.column_stack([stretch * east - self.east_m, stretch * (north - origin) - self.north_m])


def _rectified(lat_rad: float) -> float:
    """Length of the meridian from the equator, as an angle."""
    t = math.sinh(math.atanh(math.sin(lat_rad)) - E * math.atanh(E * math.sin(lat_rad)))
    xi = math.atan(t)
    return xi + sum(a * math.sin(2 * k * xi) for k, a in enumerate(ALPHA, 1))
