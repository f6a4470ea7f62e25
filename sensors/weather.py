"""What weather, sun and dirt take from a sweep, and the false returns that rain adds to it.

A return of a surface of reflectivity rho at range R has the power rho exp(-2 alpha R) / R^2, and is lost if that is
less than the noise floor [1]_. The noise floor is the power of a surface of reflectivity 0.1 at `clear_range_m` in
clear air.

References
----------
.. [1] V. Kilic et al., "Lidar light scattering augmentation (LISA): physics-based simulation of adverse weather
   conditions for 3D object detection", arXiv:2107.07004, 2021, and its code, velatkilic/LISA: range equation, noise
   floor, rain drops.
.. [2] M. Hahner et al., "Fog simulation on real LiDAR point clouds for 3D object detection in adverse weather", ICCV
   2021, and its code, MartinHahner/LiDAR_fog_sim: alpha = ln(20) / meteorological optical range.
.. [3] J. S. Marshall, W. M. Palmer, "The distribution of raindrops with size", J. Meteorology 5, 1948.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np
import scipy
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, UInt64
from numpy import ndarray

from cosim.base.bounds import Share
from cosim.base.hash_rng import GOLDEN, mix_rows, splitmix64, uniforms, unit
from cosim.base.kernel import compiled
from sensors.lidar import Sweeps
from sensors.range_steps import NO_RETURN
from sensors.scene import Hit

DARK = 0.1
"""Reflectivity of the road, and of the darkest vehicles; data sheets state ranges for targets of 10 and 80 percent."""
BRIGHT = 0.8
"""Reflectivity of the brightest vehicles and people; it is uniform between the two."""
WALL = 0.3
"""Reflectivity of buildings and trees."""

DROPS_PER_M3_MM = 8000.0
"""Number density of rain drops at diameter zero [3]_."""
DROP_REFLECTIVITY = ((1.328 - 1.0) / (1.328 + 1.0)) ** 2
"""Reflection of water at normal incidence, refractive index 1.328 [1]_."""
DIVERGENCE_RAD = 3e-3
"""Divergence of a beam [1]_."""

NEAREST_M = 1.5
"""A drop that is nearer returns nothing: transmitter and receiver look past each other there [1]_."""

_OF_RAIN = np.uint64(3 * int(GOLDEN) % 2**64)
_OF_LOSS = np.uint64(4 * int(GOLDEN) % 2**64)
_NOTHING, _NO_RETURN = np.int64(Hit.NOTHING), np.int64(NO_RETURN)
_S54, _LOW = np.uint64(54), np.uint64(0xFFFFFFFF)

Degrees = Annotated[float, Ge(-360), Le(360)]


@dataclass(frozen=True, kw_only=True, slots=True)
class WeatherParams:
    """Fog, rain, sun and dirt, and what they take from every LiDAR. Radio is not affected."""

    visibility_m: Annotated[float, Ge(1), Le(1e6)] | None = None
    """Meteorological optical range in fog [m]. none: no fog."""
    rain_mm_h: Annotated[float, Ge(0), Le(300)] = 0.0
    """Rain rate [mm/h]. Rain weakens returns, and drops near the sensor cause false returns."""
    clear_range_m: Annotated[float, Gt(0), Le(10_000)] | None = None
    """Range at which a surface of reflectivity 0.1 falls to the noise floor in clear air [m], at least
    lidar.max_range_m. none: lidar.max_range_m."""
    sun: tuple[Degrees, Annotated[float, Gt(0), Le(180)], Share] | None = None
    """Glare: direction of the sun, counter-clockwise from east [deg]; half width of the sector around it in which
    returns are lost [deg]; probability that one is lost."""
    dirt: tuple[tuple[Degrees, Degrees, Share], ...] = ()
    """Dirty sectors of the sensor's window: from and to, counter-clockwise from straight ahead [deg], and the
    probability that a return is lost."""
    dirty_p: Share = 1.0
    """Share of the equipped vehicles whose sensors are dirty."""
    known: bool = True
    """Whether vehicles know how far they see in fog and rain. If so, they evaluate nothing farther away than the road
    returns. If not, they take a place without returns for free space, and deny what is there."""

    @property
    def is_clear(self) -> bool:
        """Whether nothing is lost."""
        return self.visibility_m is None and self.rain_mm_h == 0.0 and self.sun is None and not self.dirt


CLEAR = WeatherParams()


def check_weather(params: WeatherParams, max_range_m: float) -> None:
    """Raise a ValueError, in one line, if the sensor would lose returns in clear air or a sector is empty."""
    if params.clear_range_m is not None and params.clear_range_m < max_range_m:
        raise ValueError(
            f"weather.clear_range_m = {params.clear_range_m:g} m is less than lidar.max_range_m = {max_range_m:g} m, "
            "up to which every surface returns in clear air. Set it to that or more."
        )
    for number, (first, last, _) in enumerate(params.dirt):
        if not 0 < last - first <= 360:
            raise ValueError(
                f"weather.dirt.{number}: a sector from {first:g} to {last:g} degrees is empty or more than a turn. "
                "Give its ends counter-clockwise, for example [-30, 30, 0.5] or [170, 190, 1]."
            )


def extinction_per_m(params: WeatherParams) -> float:
    """Extinction coefficient alpha of the air [1/m].

    Notes
    -----
    Fog: ln(20) / visibility, the law of Koschmieder for the contrast of 5 % that defines the meteorological optical
    range [2]_. Rain: the integral over diameters D of N(D) Q pi D^2 / 4 with the drops of [3]_, N(D) = 8000 exp(-L D)
    per m3 and mm, L = 4.1 rate^-0.21 per mm, and Q = 2 for drops much larger than the wavelength: pi 8000e-6 / L^3.
    Deviations: [2]_ none. Near infrared light is taken for as weak in haze as visible light. [1]_ sums Mie
    efficiencies, which approach 2.
    """
    fog = 0.0 if params.visibility_m is None else np.log(20.0) / params.visibility_m
    rain = np.pi * DROPS_PER_M3_MM * 1e-6 * drop_scale_mm(params.rain_mm_h) ** 3
    return float(fog + rain)


def drop_scale_mm(rain_mm_h: float) -> float:
    """Mean diameter 1 / L of the drops of Marshall and Palmer [mm]; 0 without rain."""
    return rain_mm_h**0.21 / 4.1 if rain_mm_h > 0 else 0.0


def reach_m(clear_m: Float[ndarray, "..."] | float, extinction: float) -> Float[ndarray, "..."]:
    """Largest range at which a surface returns.

    Parameters
    ----------
    clear_m
        The same in clear air [m].
    extinction
        Extinction coefficient [1/m].

    Notes
    -----
    Of exp(-2 alpha R) / R^2 = 1 / clear^2 the solution is R = W(alpha clear) / alpha, with Lambert's W.
    """
    clear_m = np.asarray(clear_m, float)
    return clear_m if extinction == 0.0 else scipy.special.lambertw(extinction * clear_m).real / extinction


def road_range_m(params: WeatherParams, max_range_m: float) -> float:
    """Range to which the road returns, and everything that is no darker [m]; at most that of the sensor."""
    clear_m = max_range_m if params.clear_range_m is None else params.clear_range_m
    return min(max_range_m, float(reach_m(clear_m, extinction_per_m(params))))


class Rain(NamedTuple):
    """Drops that return more than a hard surface, for one beam."""

    n: float
    """Mean number of drops that exceed the noise floor."""
    diameter_mm: Float[ndarray, "1024"]
    """Diameters of those drops, at equally likely levels."""
    per_mm: float
    """Range to which a drop of 1 mm exceeds the noise floor [m]; it grows with the square root of the diameter."""


@lru_cache(maxsize=8)
def rain_of(rain_mm_h: float, clear_range_m: float) -> Rain:
    """Rain as one beam meets it.

    Notes
    -----
    A drop of diameter D at range r returns rho_w (D / (phi r))^2 / r^2, with rho_w the reflection of water and phi the
    divergence of the beam [1]_. It exceeds a power P up to r(D) = (rho_w D^2 / (phi^2 P))^(1/4). Integrated over the
    cone of the beam and the diameters, n = N pi phi^2 / 12 r(1 mm)^3 gamma(5/2) / L^(5/2); the diameters of these drops
    have a gamma distribution of shape 5/2. Against a hard return of power q P the number is n q^(-3/4).   Deviations
    from [1]_: no extinction on the way to a drop, no drop fills the beam; of several drops one counts.
    """
    scale_mm = drop_scale_mm(rain_mm_h)
    floor = DARK / clear_range_m**2
    per_mm = (DROP_REFLECTIVITY * 1e-6 / (DIVERGENCE_RAD**2 * floor)) ** 0.25
    n = DROPS_PER_M3_MM * np.pi * DIVERGENCE_RAD**2 / 12 * per_mm**3
    n = n * scipy.special.gamma(2.5) * scale_mm**2.5
    level = (np.arange(1024) + 0.5) / 1024
    return Rain(float(n), scale_mm * scipy.special.gammaincinv(2.5, level), float(per_mm))


def weaken(
    sweeps: Sweeps,
    params: WeatherParams,
    keys: UInt64[ndarray, "m"],
    names: UInt64[ndarray, "n"],
    reflectivity_key: np.uint64,
    dirt_key: np.uint64,
) -> None:
    """Take from sweeps, in place, what weather, sun and dirt take, and add false returns of rain.

    Parameters
    ----------
    sweeps
        Sweeps of M observers. A lost return has no range and meets nothing; a drop has a range and meets nothing.
    keys
        Key of each sweep; what is lost is a function of it.
    names
        Key of every actor's name, for its reflectivity and its dirt.
    reflectivity_key, dirt_key
        Prefixes of those draws.
    """
    clear_m = sweeps.max_range_m if params.clear_range_m is None else params.clear_range_m
    alpha = extinction_per_m(params)
    own = DARK + (BRIGHT - DARK) * _uniform(reflectivity_key, names)
    rho = np.concatenate([[DARK, DARK, WALL], own])  # nothing, ground, building, actors: the order of `Hit`
    limit_m = reach_m(clear_m * np.sqrt(rho / DARK), alpha)
    lost_p = _lost_p(sweeps, params, names, dirt_key)
    rain = rain_of(params.rain_mm_h, clear_m)
    power = rho / DARK * clear_m**2, 2 * alpha
    _weaken(sweeps.range_steps, sweeps.hit, sweeps.step_m, keys, limit_m, power, rain, lost_p)


def _uniform(prefix: np.uint64, names: UInt64[ndarray, "k"]) -> Float[ndarray, "k"]:
    """A uniform draw of each name."""
    return uniforms(mix_rows(np.full(len(names), prefix), names), 1)[:, 0]


def _lost_p(
    sweeps: Sweeps, params: WeatherParams, names: UInt64[ndarray, "n"], dirt_key: np.uint64
) -> Float[ndarray, "m a"]:
    """Probability that sun or dirt takes a return, by observer and column."""
    azimuth = np.degrees(sweeps.beams.azimuth_rad)
    kept = np.ones((len(sweeps.observers), len(azimuth)))
    if params.dirt:
        is_dirty = _uniform(dirt_key, names[sweeps.observers]) < params.dirty_p
        for first, last, lost in params.dirt:
            in_sector = (azimuth - first) % 360 <= last - first
            kept *= 1.0 - lost * (is_dirty[:, None] & in_sector)
    if params.sun is not None:
        east, half, lost = params.sun
        away = azimuth + np.degrees(sweeps.poses.yaw_rad)[:, None] - east
        is_glare = np.abs((away + 180) % 360 - 180) <= half
        kept *= 1.0 - lost * is_glare
    return 1.0 - kept


@compiled
def _weaken(range_steps, hits, step_m, keys, limit_m, power, rain, lost_p):
    """One hash per ray for drops, one for losses by direction."""
    per_clear, twice_alpha = power
    n = np.uint64(range_steps.shape[1])
    m = np.uint64(range_steps.shape[2])
    most = 1.0 - np.exp(-rain.n)
    for o in range(len(range_steps)):
        of_rain = splitmix64(keys[o] + _OF_RAIN)
        of_loss = splitmix64(keys[o] + _OF_LOSS)
        for c in range(n):
            for r in range(m):
                steps = np.int64(range_steps[o, c, r])
                code = np.int64(hits[o, c, r])
                d = steps * step_m
                if steps != NO_RETURN and d > limit_m[code]:
                    steps = _NO_RETURN
                ray = (c * m + r) * GOLDEN
                drop = splitmix64(of_rain + ray)
                u = unit(drop)
                if u < most:
                    q = 1.0
                    if steps != NO_RETURN and d > 0.0:
                        passed = np.exp(-twice_alpha * d)
                        excess = per_clear[code] * passed / (d * d)
                        q = max(1.0, excess)
                    if u < 1.0 - np.exp(-rain.n * q**-0.75):
                        other = splitmix64(drop + GOLDEN)
                        wide = rain.diameter_mm[other >> _S54]
                        share = (other & _LOW) / 4294967296.0
                        cube_root = share ** (1.0 / 3.0)
                        near = rain.per_mm * np.sqrt(wide) * q**-0.25 * cube_root
                        if near >= NEAREST_M and (steps == NO_RETURN or near < d):
                            steps = np.int64(near / step_m + 0.5)
                            code = _NOTHING
                if lost_p[o, c] > 0.0 and steps != NO_RETURN:
                    if unit(splitmix64(of_loss + ray)) < lost_p[o, c]:
                        steps = _NO_RETURN
                range_steps[o, c, r] = steps
                hits[o, c, r] = _NOTHING if steps == NO_RETURN else code
