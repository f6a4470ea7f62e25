"""World frame of a traffic source: its origin, and the region in which actors can be."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sensors.kernel import compiled

NETWORK_MARGIN_M = 10_000.0
"""Farthest that an actor may be from the bounds of the network."""
TRACE_MARGIN_M = 100_000.0
"""Farthest that an actor may be from the median of the first actors, where there is no network."""
LARGEST_Z_M = 10_000.0
LARGEST_SPEED_MPS = 1000.0
LARGEST_COORDINATE_M = 1e8
"""Coordinates beyond are none of a place on Earth, in any projection."""
FARTHEST_M = 32_000.0
"""Coordinates beyond this get an origin nearby, because tables keep them in single precision."""

Bounds = tuple[float, float, float, float]
"""West, south, east, north [m]."""


class TrafficError(ValueError):
    """The user's scenario or trace is wrong, found while it ran: one line for the user."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Origin and region of a traffic source."""

    source: str = "traffic"
    """Key and value of the config that name the source, for errors."""
    origin_m: tuple[float, float] = (0.0, 0.0)
    """The world's origin, in the source's coordinates."""
    bounds_m: Bounds | None = None
    """Of the network, in its own coordinates; None where there is no network: see `around`."""
    margin_m: float = NETWORK_MARGIN_M

    @property
    def is_around(self) -> bool:
        """Whether `around` has chosen an origin."""
        return self.margin_m == TRACE_MARGIN_M and any(self.origin_m)

    def around(self, front_m: Float[ndarray, "n 3"]) -> "Frame":
        """This frame, and where there is no network, with a region around the median of these positions."""
        if self.bounds_m is not None or not len(front_m):
            return self
        x, y = np.median(front_m[:, :2], axis=0).tolist()
        if not max(abs(x), abs(y)) < LARGEST_COORDINATE_M:
            raise TrafficError(
                f"{self.source}: its first actors are at x = {x:g} m, y = {y:g} m, which is no place on Earth. "
                "Positions are in metres."
            )
        far = max(abs(x), abs(y)) > FARTHEST_M
        origin_m = (round(x, -3), round(y, -3)) if far else self.origin_m
        return replace(self, origin_m=origin_m, bounds_m=(x, y, x, y), margin_m=TRACE_MARGIN_M)

    def check(
        self,
        step: int,
        names: list[str],
        number: ndarray,
        xyz_m: Float[ndarray, "n 3"],
        yaw_rad: Float[ndarray, "n"],
        speed_mps: Float[ndarray, "n"],
    ) -> None:
        """Refuse a step with an actor that is not finite or far outside; TrafficError names step, actor and value."""
        w, s, e, n = self.bounds_m or (0.0, 0.0, 0.0, 0.0)
        (x0, y0), margin_m = self.origin_m, self.margin_m if self.bounds_m else LARGEST_COORDINATE_M / 100
        low = np.array([w - x0 - margin_m, s - y0 - margin_m, -LARGEST_Z_M])
        high = np.array([e - x0 + margin_m, n - y0 + margin_m, LARGEST_Z_M])
        row = _first_outside(xyz_m, yaw_rad, speed_mps, low, high)
        if row < 0:
            return
        shift = np.array([x0, y0, 0.0])
        given = zip("xyz", (xyz_m[row] + shift).tolist(), low + shift, high + shift, strict=True)
        bad = [f"{axis} = {value:g} m" for axis, value, least, most in given if not least <= value <= most]
        if not np.isfinite(yaw_rad[row]):
            bad.append("an angle that is not finite")
        if not abs(speed_mps[row]) <= LARGEST_SPEED_MPS:
            bad.append(f"speed = {speed_mps[row]:g} m/s")
        where = "the network" if margin_m == NETWORK_MARGIN_M else "the first actors" if self.bounds_m else "the origin"
        raise TrafficError(
            f"{self.source}: step {step}: {names[int(number[row])]!r} has {', '.join(bad)}. Actors should be within "
            f"{margin_m / 1000:g} km of {where}, "
            f"{LARGEST_Z_M / 1000:g} km of height zero, and slower than {LARGEST_SPEED_MPS:g} m/s."
        )


@compiled
def _first_outside(xyz_m, yaw_rad, speed_mps, low, high):
    """The first row that is not within the limits, or -1; a number that is not finite is never within."""
    for row in range(len(xyz_m)):
        inside = np.isfinite(yaw_rad[row]) and abs(speed_mps[row]) <= LARGEST_SPEED_MPS
        for axis in range(3):
            inside = inside and low[axis] <= xyz_m[row, axis] <= high[axis]
        if not inside:
            return row
    return -1


def origin_of(bounds_m: Bounds) -> tuple[float, float]:
    """The network's own origin, or where that is far away, its centre rounded to the kilometre."""
    if max(map(abs, bounds_m)) < FARTHEST_M:
        return 0.0, 0.0
    x0, y0, x1, y1 = bounds_m
    return round((x0 + x1) / 2, -3), round((y0 + y1) / 2, -3)
