"""Where vehicles believe to be: errors of satellite positioning that last, and what they do to what is transmitted."""

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.perception import Observed
from cosim.world import World


@dataclass(frozen=True, kw_only=True, slots=True)
class GnssParams:
    """Position error of equipped vehicles."""

    std_m: Annotated[float, Ge(0), Le(1000)] = 0.0
    """Standard deviation of the error, east and north each [m]; 0: none. Fused with inertial sensors and a map, some
    decimetres; a receiver alone, metres."""
    correlation_s: Annotated[float, Gt(0), Le(1e6)] = 60.0
    """Time after which the correlation of the error with itself has fallen to 1 / e [s]."""


@dataclass(slots=True)
class PositionErrors:
    """First-order Gauss-Markov processes, one per equipped vehicle and axis, by actor number.

    Notes
    -----
    e(t + d) = r e(t) + s sqrt(1 - r²) n with r = exp(-d / correlation_s), s the standard deviation and n a standard
    normal keyed by vehicle and step; the first error of a vehicle is s n. Hence the standard deviation is s at all
    times, whenever a vehicle appears, and no vehicle's error depends on who else is there.
    """

    _error_m: Float[ndarray, "capacity 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    _step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))

    def update(
        self, step: int, actor: Int[ndarray, "e"], name_key: UInt64[ndarray, "e"], params: GnssParams, dt_s: float,
        seed: int,
    ) -> Float[ndarray, "e 2"]:  # fmt: skip
        """Errors of these vehicles now, east and north [m]."""
        if (more := int(actor.max(initial=-1)) + 1 - len(self._step)) > 0:
            more = max(more, len(self._step))
            self._error_m = np.concatenate([self._error_m, np.zeros((more, 2))])
            self._step = np.concatenate([self._step, np.full(more, -1)])
        since = self._step[actor]
        kept = np.where(since >= 0, np.exp(-(step - since) * dt_s / params.correlation_s), 0.0)[:, None]
        noise = rng.normals(rng.key(seed, rng.Stream.POSITIONING, step), name_key, n=2)
        error = kept * self._error_m[actor] + params.std_m * np.sqrt(1.0 - kept**2) * noise
        self._error_m[actor], self._step[actor] = error, step
        return error


def as_believed(observed: Observed, rows: Int[ndarray, "e"], error_m: Float[ndarray, "e 2"]) -> Observed:
    """What vehicles perceived, in the world as they believe it: their sensors, their reports of themselves and all that
    they detect are displaced by their own errors.

    A vehicle's own view of its surroundings stays right; what it hears is displaced against it by the difference of
    two errors. `rows` are the vehicles' rows of the world.
    """
    sweeps, detections = observed.sweeps, observed.detections
    origin_m, xyz_m = sweeps.poses.origin_m.copy(), detections.boxes.xyz_m.copy()
    origin_m[:, :2] += error_m
    xyz_m[:, :2] += error_m[np.searchsorted(rows, detections.observer)]
    return replace(
        observed, sweeps=replace(sweeps, poses=replace(sweeps.poses, origin_m=origin_m)),
        detections=replace(detections, boxes=replace(detections.boxes, xyz_m=xyz_m)),
    )  # fmt: skip


def believed_world(world: World, rows: Int[ndarray, "e"], error_m: Float[ndarray, "e 2"]) -> World:
    """The world with equipped vehicles where they believe to be: what they compare received boxes with."""
    xyz_m = world.boxes.xyz_m.copy()
    xyz_m[rows, :2] += error_m
    return replace(world, boxes=replace(world.boxes, xyz_m=xyz_m))
