"""World frame of a traffic source: its origin, and the region that actors must be in."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

NETWORK_MARGIN_M = 10_000.0
"""Largest distance of an actor from the bounds of the network [m]."""
TRACE_MARGIN_M = 100_000.0
"""Largest distance of an actor from the median of the first actors, if there is no network [m]."""
LARGEST_Z_M = 10_000.0
LARGEST_SPEED_MPS = 1000.0
LARGEST_COORDINATE_M = 1e8
"""No projection of the Earth has larger coordinates [m]."""
FARTHEST_M = 32_000.0
"""If coordinates are larger, the world gets an origin nearby, because tables store single precision [m]."""

Bounds = tuple[float, float, float, float]
"""West, south, east, north [m]."""


class TrafficError(ValueError):
    """A mistake in the user's scenario or trace that was found during the run. The message is one line."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Origin and region of a traffic source."""

    source: str = "traffic"
    """Key and value of the config that name the source, for error messages."""
    origin_m: tuple[float, float] = (0.0, 0.0)
    """The world's origin in the source's coordinates [m]."""
    bounds_m: Bounds | None = None
    """Bounds of the network in its own coordinates. None if there is no network; see `around`."""
    margin_m: float = NETWORK_MARGIN_M

    @property
    def is_around(self) -> bool:
        """Whether `around` has chosen an origin."""
        return self.margin_m == TRACE_MARGIN_M and any(self.origin_m)

    def around(self, front_m: Float[ndarray, "n 3"]) -> "Frame":
        """If there is no network, set the region around the median of these positions; otherwise return this frame.

        Parameters
        ----------
        front_m
            Positions of actors in the source's coordinates [m].

        Raises
        ------
        TrafficError
            The positions are not on Earth.
        """
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
        """Raise a TrafficError if an actor has a value that is not finite, or is far outside the region.

        Parameters
        ----------
        names
            Names of all actors by number.
        number
            Actor number of each row.
        xyz_m, yaw_rad, speed_mps
            Position in the world frame, heading and speed of each row.
        """
        w, s, e, n = self.bounds_m or (0.0, 0.0, 0.0, 0.0)
        margin_m = self.margin_m if self.bounds_m else LARGEST_COORDINATE_M / 100
        lowest_xy = np.array([w, s]) - self.origin_m - margin_m
        highest_xy = np.array([e, n]) - self.origin_m + margin_m
        low = np.append(lowest_xy, -LARGEST_Z_M)
        high = np.append(highest_xy, LARGEST_Z_M)
        is_within = (low <= xyz_m) & (xyz_m <= high)  # a number that is not finite is outside
        inside = is_within.all(axis=1)
        inside &= np.isfinite(yaw_rad) & (np.abs(speed_mps) <= LARGEST_SPEED_MPS)
        if inside.all():
            return
        row = int(np.argmin(inside))
        shown_m = xyz_m[row] + np.array([*self.origin_m, 0.0])
        bad = []
        for axis, value_m, is_good in zip("xyz", shown_m, is_within[row], strict=True):
            if not is_good:
                bad.append(f"{axis} = {value_m:g} m")
        if not np.isfinite(yaw_rad[row]):
            bad.append("an angle that is not finite")
        if not abs(speed_mps[row]) <= LARGEST_SPEED_MPS:
            bad.append(f"speed = {speed_mps[row]:g} m/s")
        where = "the first actors" if self.bounds_m else "the origin"
        if margin_m == NETWORK_MARGIN_M:
            where = "the network"
        name, what = names[int(number[row])], ", ".join(bad)
        raise TrafficError(
            f"{self.source}: step {step}: {name!r} has {what}. "
            f"Actors should be within {margin_m / 1000:g} km of {where}, "
            f"{LARGEST_Z_M / 1000:g} km of height zero, and slower than {LARGEST_SPEED_MPS:g} m/s."
        )


def origin_of(bounds_m: Bounds) -> tuple[float, float]:
    """The network's own origin. If that is far away, the network's centre, rounded to kilometres."""
    if max(map(abs, bounds_m)) < FARTHEST_M:
        return 0.0, 0.0
    x0, y0, x1, y1 = bounds_m
    x_m, y_m = (x0 + x1) / 2, (y0 + y1) / 2
    return round(x_m, -3), round(y_m, -3)
