"""Weather against closed forms, numerical integrals and the drop-by-drop experiment of LISA."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import gamma as gamma_law

from sensors.boxes import Boxes
from sensors.evidence import observability
from sensors.lidar import LidarParams, scan
from sensors.scene import Hit, Scene, Shape
from sensors.weather import (
    DIVERGENCE_RAD,
    DROP_REFLECTIVITY,
    WeatherParams,
    check_weather,
    drop_scale_mm,
    extinction_per_m,
    rain_of,
    reach_m,
    road_range_m,
    weaken,
)
from tests.sensors.town import boxes_at

LIDAR = LidarParams(profile="vlp16", range_sigma_m=0.0)


def seen(weather: WeatherParams, boxes: Boxes, yaw: float = 0.0, scene: Scene | None = None, lidar=LIDAR):
    """A sweep of a car at the origin among boxes, after weather."""
    own = boxes_at((0.0, 0.0, 0.75), (4.5, 1.8, 1.5), yaw)
    every = Boxes.concat([own, boxes])
    shape, keys = np.full(len(every), Shape.BUS, np.uint8), np.array([7], np.uint64)
    sweeps = scan(every, shape, np.zeros(1, int), scene or Scene.empty(), lidar, keys)
    names = np.arange(len(every), dtype=np.uint64)
    weaken(sweeps, weather, keys, names, np.uint64(1), np.uint64(2))
    return sweeps, observability(sweeps, every, shape)


NOBODY = Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


@pytest.mark.parametrize("visibility_m", [20, 50, 200, 1000])
@pytest.mark.parametrize("clear_m", [80.0, 226.3])
def test_reach_solves_the_range_equation(visibility_m, clear_m):
    """Slow twin: bisection of exp(-2 alpha R) (clear / R)^2 = 1. By hand for 50 m of visibility and 80 m in clear air:
    alpha = 2.9957 / 50 = 0.05991; x = alpha 80 = 4.793; W(x) = 1.3010, for 1.3010 e^1.3010 = 4.78; R = 21.7 m."""
    alpha = extinction_per_m(WeatherParams(visibility_m=visibility_m))
    root = brentq(lambda r: np.exp(-2 * alpha * r) * (clear_m / r) ** 2 - 1, 1e-3, clear_m)
    assert reach_m(clear_m, alpha) == pytest.approx(root, rel=1e-9)
    if (visibility_m, clear_m) == (50, 80.0):
        assert reach_m(clear_m, alpha) == pytest.approx(21.7, abs=0.1)


def test_reach_in_clear_air_is_that_of_the_sensor():
    assert reach_m(80.0, 0.0) == 80.0
    assert reach_m(80.0, 1e-9) == pytest.approx(80.0, abs=1e-4)


@pytest.mark.parametrize("rate", [1.0, 10.0, 50.0])
def test_extinction_of_rain_is_the_integral_over_drops(rate):
    density = lambda d: 8000 * np.exp(-4.1 * rate**-0.21 * d)  # noqa: E731
    expected = quad(lambda d: density(d) * 2 * np.pi / 4 * d * d * 1e-6, 0, 30)[0]
    assert extinction_per_m(WeatherParams(rain_mm_h=rate)) == pytest.approx(expected, rel=1e-6)


def test_extinctions_of_fog_and_rain_add_up():
    fog, rain = WeatherParams(visibility_m=100), WeatherParams(rain_mm_h=20)
    both = extinction_per_m(replace(fog, rain_mm_h=20))
    assert both == pytest.approx(extinction_per_m(fog) + extinction_per_m(rain))


def test_a_sweep_reaches_as_far_as_the_equation_says():
    """The road has reflectivity 0.1: its farthest return is the last ring before the closed form."""
    for visibility_m in (30.0, 80.0):
        sweeps, _ = seen(WeatherParams(visibility_m=visibility_m), NOBODY)
        limit = float(reach_m(80.0, np.log(20) / visibility_m))
        clear, _ = seen(WeatherParams(), NOBODY)
        rings = np.unique(clear.range_m[np.isfinite(clear.range_m)])
        assert np.array_equal(np.unique(sweeps.range_m[np.isfinite(sweeps.range_m)]), rings[rings <= limit])
        assert (sweeps.hit[~np.isfinite(sweeps.range_m)] == Hit.NOTHING).all()


def test_the_road_returns_up_to_a_range_that_vehicles_may_know():
    """Fog of 50 m before a sensor of 80 m: 21.7 m, by hand above. A weaker sensor reaches less far."""
    fog = WeatherParams(visibility_m=50.0)
    assert road_range_m(fog, 80.0) == pytest.approx(21.7, abs=0.1)
    assert road_range_m(fog, 15.0) < 15.0 < road_range_m(replace(fog, clear_range_m=80.0), 80.0)
    assert road_range_m(WeatherParams(clear_range_m=300.0), 80.0) == 80.0


def test_an_object_loses_all_returns_beyond_its_own_reach():
    """Reflectivity is drawn between 0.1 and 0.8, so the reach lies between those of both."""
    far = np.linspace(8, 60, 27)
    at = np.column_stack([far * np.cos(far), far * np.sin(far), np.full(27, 1.6)])
    boxes = boxes_at(at, (1.0, 1.0, 3.2))
    _, found = seen(WeatherParams(visibility_m=60.0), boxes)
    returned = set(found.actor[found.n_returns > 0].tolist())
    alpha = np.log(20) / 60
    dark, bright = float(reach_m(80.0, alpha)), float(reach_m(80.0 * np.sqrt(8), alpha))
    near = np.flatnonzero(far < dark - 2) + 1
    assert set(near.tolist()) <= returned and not (set((np.flatnonzero(far > bright + 2) + 1).tolist()) & returned)
    assert returned - set(near.tolist()), "bright ones are seen farther"


def test_drops_are_as_many_and_as_far_as_in_an_experiment_of_single_drops():
    """The loop of LISA: drops uniform in the cone of a beam, diameters exponential; which exceed the floor?"""
    rate, clear, rng = 40.0, 80.0, np.random.default_rng(3)
    rain, scale, limit = rain_of(rate, clear), drop_scale_mm(rate), 12.0
    volume = np.pi / 3 * limit * (DIVERGENCE_RAD * limit / 2) ** 2
    n_beams = 40_000
    n = rng.poisson(8000 * scale * volume * n_beams)
    r, d = limit * rng.random(n) ** (1 / 3), rng.exponential(scale, n)
    power = DROP_REFLECTIVITY * (d / (1e3 * DIVERGENCE_RAD * r)) ** 2 / r**2
    loud = power > 0.1 / clear**2
    assert loud.sum() / n_beams == pytest.approx(rain.n, rel=0.03)
    assert np.median(d[loud]) == pytest.approx(np.median(rain.diameter_mm), rel=0.03)
    against = power > 5 * 0.1 / clear**2
    assert against.sum() / n_beams == pytest.approx(rain.n * 5**-0.75, rel=0.04)


def test_false_returns_of_rain_in_a_sweep():
    """Rays into the sky meet nothing, so 1 - exp(-n) of them would return a drop, were there no nearest range."""
    rain = WeatherParams(rain_mm_h=40)
    sweeps, _ = seen(rain, NOBODY)
    sky = sweeps.beams.elevation_rad > 0
    false = np.isfinite(sweeps.range_m[0][:, sky])
    law = rain_of(40.0, 80.0)
    d = law.diameter_mm
    near = np.clip((1.5 / (law.per_mm * np.sqrt(d))) ** 3, 0, 1).mean()  # of drops to the floor, nearer than 1.5 m
    assert false.mean() == pytest.approx((1 - np.exp(-law.n)) * (1 - near), rel=0.08)
    assert (sweeps.hit[0][:, sky] == Hit.NOTHING).all()
    assert gamma_law(2.5, scale=drop_scale_mm(40.0)).median() == pytest.approx(np.median(d), rel=1e-3)


def test_sun_stands_in_the_world_and_dirt_sits_on_the_sensor():
    road = LidarParams(profile="vlp16", range_sigma_m=0.0, elevation_deg=(-10.0,))
    for yaw in (0.0, 1.2):
        sunny, _ = seen(WeatherParams(sun=(90.0, 20.0, 1.0)), NOBODY, yaw, lidar=road)
        world = np.degrees(sunny.beams.azimuth_rad + yaw)
        glare = np.abs((world - 90 + 180) % 360 - 180) <= 20
        assert np.array_equal(~np.isfinite(sunny.range_m[0, :, 0]), glare)
        dirty, _ = seen(WeatherParams(dirt=((170.0, 200.0, 1.0),)), NOBODY, yaw, lidar=road)
        behind = (np.degrees(dirty.beams.azimuth_rad) - 170) % 360 <= 30
        assert np.array_equal(~np.isfinite(dirty.range_m[0, :, 0]), behind)
    half, _ = seen(WeatherParams(dirt=((-180.0, 180.0, 0.3),)), NOBODY, lidar=road)
    assert np.isfinite(half.range_m).mean() == pytest.approx(0.7, abs=0.04)
    clean, _ = seen(WeatherParams(dirt=((-180.0, 180.0, 1.0),), dirty_p=0.0), NOBODY, lidar=road)
    assert np.isfinite(clean.range_m).all()


def test_weather_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"weather.clear_range_m = 50 m is less than lidar.max_range_m = 80 m"):
        check_weather(WeatherParams(clear_range_m=50), 80.0)
    with pytest.raises(ValueError, match=r"weather.dirt.0: a sector from 30 to -30 degrees"):
        check_weather(WeatherParams(dirt=((30, -30, 0.5),)), 80.0)
