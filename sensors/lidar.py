"""A spinning LiDAR on the roof of each equipped vehicle: its beams, and one sweep of all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from jaxtyping import Bool, Float, Float32, Int, UInt8, UInt16, UInt64
from numpy import ndarray

from cosim.base.bounds import Positive1000
from cosim.base.plane import wrapped
from sensors.boxes import Boxes
from sensors.neighbours import Neighbours, neighbours
from sensors.pairs import Poses
from sensors.range_noise import RangeNoise
from sensors.range_steps import NO_RETURN, metres, step_m
from sensors.raycast import columnar, embree, mesh, open3d
from sensors.raycast.column import cells_of_slopes
from sensors.scene import Hit, Prisms, Scene, prisms

ProfileName = Literal["hdl64e_front", "hdl64e", "vlp16", "vlp32c", "os1_64", "os1_128", "pandar64"]


class Profile(NamedTuple):
    """One LiDAR product, as its public data sheet describes it."""

    elevation_deg: tuple[float, ...]
    n_azimuths: int
    fov_deg: float
    source: str


def _even(low: float, high: float, n: int) -> tuple[float, ...]:
    return tuple(np.linspace(low, high, n))


_HDL64E_LOWER = _even(-8.83 - 31 * 0.5, -8.83, 32)
_HDL64E_UPPER = _even(2.0 - 31 / 3, 2.0, 32)
_HDL64E = _HDL64E_LOWER + _HDL64E_UPPER
_VLP32C = (
    *(-25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667),
    *(-4.0, -3.667, -3.333, -3.0, -2.667, -2.333, -2.0, -1.667),
    *(-1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667, 1.0),
    *(1.333, 1.667, 2.333, 3.333, 4.667, 7.0, 10.333, 15.0),
)
_PANDAR64 = (
    *(-25.0, -19.0, *_even(-14.0, -7.0, 8)),
    *_even(-6.0, 2.0, 49),
    *(3.0, 5.0, 8.0, 11.0, 15.0),
)

PROFILES: dict[str, Profile] = {
    "hdl64e_front": Profile(
        _HDL64E, 520, 90.0, "Velodyne HDL-64E S2 manual; 90 degrees in front of the car, as KITTI labels it"
    ),
    "hdl64e": Profile(
        _HDL64E, 2083, 360.0, "Velodyne HDL-64E S2 manual: 32 beams 1/3 and 32 beams 1/2 degree apart; 0.1728 at 10 Hz"
    ),
    "vlp16": Profile(
        _even(-15.0, 15.0, 16), 1800, 360.0, "Velodyne VLP-16 manual 63-9243: 2 degrees apart; 0.2 at 10 Hz"
    ),
    "vlp32c": Profile(_VLP32C, 1800, 360.0, "Velodyne VLP-32C manual 63-9325, channel table; 0.2 degrees at 10 Hz"),
    "os1_64": Profile(
        _even(-16.6, 16.6, 64), 1024, 360.0, "Ouster OS1 data sheet (first generation), 64 channels: 33.2 degrees"
    ),
    "os1_128": Profile(
        _even(-22.5, 22.5, 128), 1024, 360.0, "Ouster OS1 data sheet (first generation), 128 channels: 45 degrees"
    ),
    "pandar64": Profile(
        _PANDAR64,
        1800,
        360.0,
        "Hesai Pandar64 manual: 1/6 degree from -6 to +2, coarser outside; 0.2 degrees at 10 Hz",
    ),
}


_MOST_RAYS = 2_000_000
"""Rays of one sweep; the largest product has 230,000."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarParams:
    """The LiDAR that every equipped vehicle carries."""

    profile: ProfileName = "hdl64e_front"
    """Product whose beams are used; `elevation_deg`, `n_azimuths` and `fov_deg` replace parts of it."""
    elevation_deg: tuple[float, ...] | None = None
    """Elevation of each beam, ascending [deg]; none means that of the profile."""
    n_azimuths: Annotated[int, Gt(0), Le(100_000)] | None = None
    """Columns of one sweep over the field of view; none means that of the profile."""
    fov_deg: Annotated[float, Gt(0), Le(360)] | None = None
    """Horizontal field of view, centred straight ahead, at most 360 [deg]; none means that of the
    profile."""
    max_range_m: Positive1000 = 80.0
    """Farthest return [m]."""
    mount_above_roof_m: Annotated[float, Ge(0), Le(20)] = 0.23
    """Height of the sensor over the centre of the roof [m]; 1.73 m above the road on a car of 1.50 m, as in KITTI."""
    range_sigma_m: Annotated[float, Ge(0), Le(10)] = 0.02
    """Standard deviation of one range [m]: HDL-64E S2 data sheet, < 2 cm."""
    dropout_p: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Probability that a return is lost."""
    rotation_hz: Positive1000 | Literal["off"] | None = None
    """Turns per second. During a sweep the sensor turns counter-clockwise and looks straight ahead at the time of the
    sweep; other actors move meanwhile. With "off", or unset, the whole sweep happens at one instant."""
    engine: Literal["columnar", "embree", "open3d"] = "columnar"
    """Ray caster; all give the same sweep up to rays that graze an edge. `open3d` must be installed:
    pip install 'cosim-perception[open3d]'."""


class Beams(NamedTuple):
    """The grid of rays: azimuth columns x elevation rows, in the sensor frame (x forward, y left, z up)."""

    azimuth_rad: ndarray
    """float64 [a], ascending, evenly spaced, counter-clockwise from straight ahead."""
    cos_az: ndarray
    sin_az: ndarray
    elevation_rad: ndarray
    """float64 [e], ascending."""
    tan_el: ndarray
    cos_el: ndarray
    sin_el: ndarray
    fov_rad: float
    s_per_rad: float
    """Time in which the sensor turns by one radian; 0 if a sweep takes no time."""
    cells_per_slope: float
    first_row: ndarray
    most_in_cell: int
    """This and the two fields before are those of `sensors.raycast.column.Slopes`: they find the row of a slope."""


@lru_cache(maxsize=32)
def beams(params: LidarParams) -> Beams:
    """The ray grid of a LiDAR. Equal parameters give the same arrays: do not write into them.

    Raises
    ------
    ValueError
        If the beams are not in ascending order, if a sweep has too many rays, if the field of view is not in (0, 360]
        degrees, or if the ray caster cannot cast a sweep that takes time.
    """
    profile = PROFILES[params.profile]
    elevation_deg = profile.elevation_deg if params.elevation_deg is None else params.elevation_deg
    elevation = np.array(elevation_deg, dtype=float)
    n = profile.n_azimuths if params.n_azimuths is None else params.n_azimuths
    fov = profile.fov_deg if params.fov_deg is None else params.fov_deg
    ascends = (np.diff(elevation) > 0).all()
    if len(elevation) == 0 or not ascends or not (np.abs(elevation) < 90).all():
        raise ValueError(
            f"lidar.elevation_deg = {elevation.tolist()}: beams must be given in ascending order, each once, strictly "
            "between -90 and 90 degrees. Sort lidar.elevation_deg."
        )
    if n * len(elevation) > _MOST_RAYS:
        raise ValueError(
            f"lidar.n_azimuths = {n} columns of {len(elevation)} beams are more than {_MOST_RAYS:,} rays per sweep. "
            "Set lidar.n_azimuths lower."
        )
    if not 0 < fov <= 360 or n < 1:
        raise ValueError(
            f"lidar.fov_deg = {fov} degrees in {n} columns is no sweep: set lidar.fov_deg in (0, 360] and "
            "lidar.n_azimuths to 1 or more."
        )
    rotation_hz = None if params.rotation_hz == "off" else params.rotation_hz
    if rotation_hz is not None and params.engine != "columnar":
        raise ValueError(
            f'lidar.rotation_hz = {rotation_hz:g} needs lidar.engine = "columnar": "{params.engine}" casts a whole '
            'sweep at one instant. Set lidar.rotation_hz = "off", or change lidar.engine.'
        )
    el = np.radians(elevation)
    az = np.radians(fov) * ((np.arange(n) + 0.5) / n - 0.5)
    slopes = cells_of_slopes(np.tan(el))
    return Beams(
        azimuth_rad=az,
        cos_az=np.cos(az),
        sin_az=np.sin(az),
        elevation_rad=el,
        tan_el=slopes.tan_el,
        cos_el=np.cos(el),
        sin_el=np.sin(el),
        fov_rad=float(np.radians(fov)),
        s_per_rad=0.0 if rotation_hz is None else 1.0 / (2.0 * np.pi * rotation_hz),
        cells_per_slope=slopes.cells_per_slope,
        first_row=slopes.first_row,
        most_in_cell=slopes.most_in_cell,
    )


def step_of(params: LidarParams) -> float:
    """Step in which a LiDAR reports ranges [m]."""
    return step_m(params.max_range_m, params.range_sigma_m)


def mount(boxes: Boxes, observers: Int[ndarray, "m"], params: LidarParams) -> Poses:
    """Poses of the sensors above the centre of the observers' roofs, looking ahead.

    Parameters
    ----------
    boxes
        Boxes of all actors, world frame.
    observers
        Rows of the actors that carry a sensor.
    params
        Height of the sensor above the roof.

    Returns
    -------
    One pose per observer, in the order of `observers`.
    """
    origin = boxes.xyz_m[observers].copy()
    origin[:, 2] += 0.5 * boxes.lwh_m[observers, 2] + params.mount_above_roof_m
    return Poses(origin, boxes.yaw_rad[observers].copy())


@dataclass(frozen=True, slots=True)
class RangeImages:
    """One organised cloud (range image) per observer, in the frame of the sensor at the time of the sweep."""

    poses: Poses
    observers: Int[ndarray, "m"]
    """Actor row that carries each sensor."""
    ground_m: Float[ndarray, "m"]
    """Height of the road under each sensor."""
    beams: Beams
    max_range_m: float
    range_steps: UInt16[ndarray, "m a e"]
    """Range that the sensor reports, in steps of `step_m`; `NO_RETURN` if the ray has no return."""
    step_m: float

    def displaced(self, error: Float[ndarray, "m 3"]) -> RangeImages:
        """These images, taken for those of sensors with other poses.

        Parameters
        ----------
        error
            How far the other poses are east [m] and north [m], and by how much they are turned [rad].
        """
        return replace(self, poses=self.poses.displaced(error))

    def road_z_m(self) -> Float[ndarray, "m"]:
        """Height of the road under each sensor, in the frame of the sensor."""
        return self.ground_m - self.poses.origin_m[:, 2]

    def seen_after_s(
        self,
        o: Int[ndarray, "k"],
        xyz_m: Float[ndarray, "k 3"],
    ) -> Float[ndarray, "k"]:
        """When sensors look at places, as the function `seen_after_s`."""
        return seen_after_s(self.poses, self.beams.s_per_rad, o, xyz_m)

    @property
    def range_m(self) -> Float32[ndarray, "m a e"]:
        """Range [m]; inf if the ray has no return. It is computed whenever it is read."""
        return metres(self.range_steps, self.step_m)

    def n_returns(self) -> Int[ndarray, "m"]:
        """Number of returns of each sweep."""
        return np.count_nonzero(self.range_steps != NO_RETURN, axis=(1, 2))

    def has_return(self, o: int) -> Bool[ndarray, "a e"]:
        """Which rays of observer o have a return."""
        return self.range_steps[o] != NO_RETURN

    def xyz(self, o: int) -> Float[ndarray, "k 3"]:
        """The returns of observer o in its sensor frame [m], column by column from the lowest beam up."""
        column, row = np.nonzero(self.has_return(o))
        return self.points(np.full(len(column), o), column, row)

    def cloud(self, o: int) -> Float32[ndarray, "k 3"]:
        """The returns of observer o in single precision, as in files of point clouds."""
        return self.xyz(o).astype(np.float32)

    def points(
        self,
        o: Int[ndarray, "k"],
        column: Int[ndarray, "k"],
        row: Int[ndarray, "k"],
    ) -> Float[ndarray, "k 3"]:
        """End points of single rays, which must have a return.

        Parameters
        ----------
        o, column, row
            Observer, azimuth column and elevation row of each ray.

        Returns
        -------
        Point k in the frame of sensor o[k] [m]; meaningless for a ray without a return.
        """
        r = self.range_steps[o, column, row] * self.step_m
        grid = self.beams
        flat = r * grid.cos_el[row]
        forward = flat * grid.cos_az[column]
        left = flat * grid.sin_az[column]
        up = r * grid.sin_el[row]
        return np.column_stack([forward, left, up])


@dataclass(frozen=True, slots=True)
class Sweeps(RangeImages):
    """Range images, and what each ray met."""

    hit: Int[ndarray, "m a e"]
    """`Hit` code of the object that each ray met. Ground truth: no vehicle may use it."""
    unrounded_m: Float32[ndarray, "m a e"]
    """Range before it is rounded to steps [m], inf without a return; empty unless `scan` got `unrounded`."""
    speed_mps: Float[ndarray, "n"]
    """Ground truth: speed of each actor along its heading."""

    def moved_m(
        self,
        o: Int[ndarray, "k"],
        boxes: Boxes,
        a: Int[ndarray, "k"],
    ) -> Float[ndarray, "k 3"]:
        """How far actors had moved when the sensor looked at them, as the function `moved_m`."""
        return moved_m(self.poses, self.beams.s_per_rad, o, boxes, a, self.speed_mps)


def seen_after_s(
    poses: Poses,
    s_per_rad: float,
    o: Int[ndarray, "k"],
    xyz_m: Float[ndarray, "k 3"],
) -> Float[ndarray, "k"]:
    """When sensors look at places, after the time of the sweep.

    Parameters
    ----------
    poses, s_per_rad
        Poses of the sensors, and the time in which they turn by one radian, as in `Beams`.
    o, xyz_m
        Sensor and place, for each pair.

    Returns
    -------
    Seconds; negative to the right of the sensor, and 0 if the sweep takes no time.
    """
    if s_per_rad == 0.0:
        return np.zeros(len(o))
    away_m = xyz_m - poses.origin_m[o]
    bearing = np.arctan2(away_m[:, 1], away_m[:, 0])
    return s_per_rad * wrapped(bearing - poses.yaw_rad[o])


def moved_m(
    poses: Poses,
    s_per_rad: float,
    o: Int[ndarray, "k"],
    boxes: Boxes,
    a: Int[ndarray, "k"],
    speed_mps: Float[ndarray, "n"],
) -> Float[ndarray, "k 3"]:
    """How far actors had moved when a sensor looked at them, from their position at the time of the sweep.

    Parameters
    ----------
    poses, s_per_rad
        True poses of the sensors, and the time in which they turn by one radian, as in `Beams`.
    o, a
        Sensor and row of the actor, for each pair.
    boxes, speed_mps
        Boxes of all actors at the time of the sweep, world frame, and their speeds along their headings.

    Returns
    -------
    Displacement in the world frame [m]; 0 if the sweep takes no time.
    """
    yaw = boxes.yaw_rad[a]
    along_m = speed_mps[a] * seen_after_s(poses, s_per_rad, o, boxes.xyz_m[a])
    level = np.zeros(len(a))
    heading = np.column_stack([np.cos(yaw), np.sin(yaw), level])
    return along_m[:, None] * heading


class SweepMemory(NamedTuple):
    """What `scan` may use of earlier work, to save time: arrays to overwrite, and what is known already."""

    range_steps: ndarray | None = None
    """This array and `hit` are overwritten where they are large enough."""
    hit: ndarray | None = None
    near: Neighbours | None = None
    """`neighbours` of the sensors among the boxes of this sweep."""
    bodies: Prisms | None = None
    """`prisms` of all actors of this sweep."""


NO_MEMORY = SweepMemory()
"""Nothing to use again: everything is computed, and `scan` allocates new arrays."""


ENGINES: dict[str, Callable[..., None]] = {
    "columnar": columnar.cast,
    "embree": partial(mesh.cast, embree.tracer_of),
    "open3d": partial(mesh.cast, open3d.tracer_of),
}


def scan(
    boxes: Boxes,
    shape: UInt8[ndarray, "n"],
    observers: Int[ndarray, "m"],
    scene: Scene,
    params: LidarParams,
    keys: UInt64[ndarray, "m"],
    out: Sweeps | SweepMemory = NO_MEMORY,
    unrounded: bool = False,
) -> Sweeps:
    """One sweep of every observer.

    Parameters
    ----------
    boxes, shape
        All actors, world frame. An observer's own body is transparent to its own sensor.
    observers
        Rows of the actors that carry a sensor.
    keys
        One number per observer. Its range noise and dropouts are a function of it.
    scene
        Buildings and other solids.
    params
        The LiDAR that all observers carry.
    out
        What may be used of earlier work, or an earlier result. The arrays of an earlier result are overwritten if they
        are large enough, which saves allocation and page faults. `rotation_hz` needs bodies with speeds.
    unrounded
        Keep the ranges before rounding too, to compare ray casters.
    Returns
    -------
    Range images of all observers, and the object that each ray met.

    Raises
    ------
    ValueError
        If there is not one key per observer, if an observer is not a row of `boxes`, or if `rotation_hz` is set and
        there are no bodies; or as `beams` and `prisms`.

    Notes
    -----
    With `rotation_hz`, column c is cast at the time `azimuth_rad[c] * s_per_rad` from that of the sweep, as the
    HDL-64E of KITTI turns [1]_. Every actor is where constant speed along its heading has brought it. The cloud is
    compensated for the observer's own motion: all its points refer to the sensor's pose at the time of the sweep, so
    that what stands still is seen where it stands. What the sensor could see is also computed from that pose, not from
    the place that it had reached at each column.
    Level sensors, one return per ray, flat ground at the height of the observer's
    wheels. Range noise is normal (4,096 equiprobable levels) and acts along the ray. Reported ranges are rounded to
    steps, as in `sensors.range_steps`.

    References
    ----------
    .. [1] Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 32(11), 2013: a scan takes 0.1 s and has
       the time at which the scanner faces forward. The readme of the raw data says that it turns counter-clockwise.
    """
    observers = np.asarray(observers, dtype=np.int64)
    if len(keys) != len(observers):
        raise ValueError(f"{len(keys)} keys were given for {len(observers)} observers. Give one key per observer.")
    is_row = (observers >= 0) & (observers < len(boxes))
    if not is_row.all():
        raise ValueError(f"observers {observers.min()} .. {observers.max()} are no rows of {len(boxes)} actors.")
    poses = mount(boxes, observers, params)
    grid = beams(params)
    ground_m = height_of_road_m(boxes, observers)
    size = (len(observers), len(grid.azimuth_rad), len(grid.elevation_rad))
    memory = out if isinstance(out, SweepMemory) else SweepMemory(out.range_steps, out.hit)
    if grid.s_per_rad and memory.bodies is None:
        raise ValueError(
            f"lidar.rotation_hz = {params.rotation_hz:g}: a sweep that takes time needs the speed of every actor. Give "
            "out = SweepMemory(bodies=prisms(shape, boxes, speed_mps))."
        )
    bodies = prisms(shape, boxes) if memory.bodies is None else memory.bodies
    range_steps = buffer(size, np.uint16, memory.range_steps)
    hit = buffer(size, hit_type(len(boxes)), memory.hit)
    sweeps = Sweeps(
        poses=poses,
        observers=observers,
        ground_m=ground_m,
        beams=grid,
        max_range_m=params.max_range_m,
        range_steps=range_steps,
        step_m=step_of(params),
        hit=hit,
        unrounded_m=np.empty(size if unrounded else (0, *size[1:]), np.float32),
        speed_mps=bodies.speed_mps,
    )
    near = neighbours(poses.origin_m, boxes, params.max_range_m) if memory.near is None else memory.near
    noise = RangeNoise.of(keys, params.range_sigma_m, params.dropout_p)
    ENGINES[params.engine](sweeps, boxes, bodies, scene, noise, near)
    return sweeps


def hit_type(n_actors: int) -> type:
    """Narrowest integer type for the `Hit` codes of this number of actors; it saves memory traffic in every sweep."""
    largest = n_actors + Hit.ACTOR
    return np.int16 if largest <= np.iinfo(np.int16).max else np.int32


def height_of_road_m(boxes: Boxes, observers: Int[ndarray, "m"]) -> Float[ndarray, "m"]:
    """Height of the road under some actors: that of the underside of their boxes.

    Parameters
    ----------
    boxes
        Boxes of all actors, world frame.
    observers
        Rows of the actors.

    Returns
    -------
    World height for each of them [m].
    """
    return boxes.xyz_m[observers, 2] - 0.5 * boxes.lwh_m[observers, 2]


def buffer(size: tuple[int, int, int], kind: type, old: ndarray | None) -> ndarray:
    """Memory for an array, taken from an old array where possible.

    Parameters
    ----------
    size, kind
        Shape and type of the array.
    old
        A result of an earlier call, or None.

    Returns
    -------
    An array with any content. It shares the memory of `old` if that suffices; new memory has room for an eighth more
    rows, because fleets grow.
    """
    n, of_each = size[0], size[1:]
    if old is not None and old.dtype == kind and old.shape == size:
        return old
    if old is not None:
        whole = old if old.base is None else old.base
        fits = whole.dtype == kind and whole.shape[1:] == of_each
        if fits and len(whole) >= n:
            return whole[:n]
    return np.empty((n + n // 8, *of_each), kind)[:n]
