"""Tracks, and what their observers sense: the rows that tracking takes and returns."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.rows import Rows, no_rows

PLACE, VELOCITY, XX, XV, VV = range(5)
"""Columns of `Tracks.motion`."""


@dataclass(frozen=True, slots=True)
class Tracks(Rows):
    """N tracks, in the frame of the detections."""

    observer: Int[ndarray, "n"]
    """Any number that identifies the observer, the same in every call."""
    object_id: Int[ndarray, "n"]
    """Number of the object among those of its observer, from 0; never used twice."""
    label: UInt8[ndarray, "n"]
    """`ObjectClass` of the last detection."""
    n_hits: Int[ndarray, "n"]
    """Number of detections."""
    time_s: Float[ndarray, "n"]
    """Time of the estimates: when the observer last sensed."""
    first_s: Float[ndarray, "n"]
    """Time of the first detection."""
    last_s: Float[ndarray, "n"]
    """Time of the last detection."""
    axis: Float[ndarray, "n 2"]
    """Unit vector along the heading of the first detection. Errors along and across it are independent."""
    motion_p: Float[ndarray, "n 2"]
    """Probabilities that the object keeps its velocity, and that it does not."""
    motion: Float[ndarray, "n 2 2 5"]
    """For each of these cases, along and across `axis`: place, velocity, variance of the place, covariance of both,
    and variance of the velocity."""
    existence: Float[ndarray, "n"]
    """Log-odds that the object exists, at the last detection."""

    def __len__(self) -> int:
        return len(self.observer)

    @staticmethod
    def none() -> Tracks:
        """No tracks."""
        number = np.zeros(0, np.int64)
        real = np.zeros(0)
        return Tracks(
            observer=number,
            object_id=number,
            label=np.zeros(0, np.uint8),
            n_hits=number,
            time_s=real,
            first_s=real,
            last_s=real,
            axis=np.zeros((0, 2)),
            motion_p=np.zeros((0, 2)),
            motion=np.zeros((0, 2, 2, 5)),
            existence=real,
        )


@dataclass(frozen=True, slots=True)
class TrackMemory:
    """What the tracking of all observers passes on from one moment to the next."""

    tracks: Tracks = field(default_factory=Tracks.none)
    known: Int[ndarray, "k"] = no_rows(np.int64)
    """Observers that have ever had a track, sorted."""
    n_objects: Int[ndarray, "k"] = no_rows(np.int64)
    """Number of objects that each of them has numbered."""


@dataclass(frozen=True, slots=True)
class Observers:
    """E observers that sense now, sorted by number, each once."""

    number: Int[ndarray, "e"]
    time_s: Float[ndarray, "e"]
    """When each of them senses."""
    speed_mps: Float[ndarray, "e"]
    """How fast each of them drives."""


@dataclass(frozen=True, slots=True)
class Found(Rows):
    """D detections of the observers that sense now, sorted by observer."""

    observer: Int[ndarray, "d"]
    label: UInt8[ndarray, "d"]
    """`ObjectClass`."""
    xy_m: Float[ndarray, "d 2"]
    yaw_rad: Float[ndarray, "d"]
    score: Float[ndarray, "d"]
    limit_mps: Float[ndarray, "d"]
    """Speed limit of the road there; NaN where it is not known."""
    after_s: Float[ndarray, "d"]
    """When the object was there, after the time at which its observer senses: a sweep takes time."""

    def __len__(self) -> int:
        return len(self.observer)


@dataclass(frozen=True, slots=True)
class ObjectStates(Rows):
    """What tracking says about each detection, in the order of the detections."""

    object_id: Int[ndarray, "d"]
    """Number of the object among those of its observer."""
    age_s: Float[ndarray, "d"]
    """Time since the first detection of the object."""
    velocity_mps: Float[ndarray, "d 2"]
    """Velocity along x and y; NaN until the object has been detected `confirm_hits` times."""
    existence_p: Float[ndarray, "d"]
    """Probability that there is an object."""
    axis: Float[ndarray, "d 2"]
    """As in `Tracks`."""
    variance: Float[ndarray, "d 2"]
    """Variance of the velocity, along and across `axis` [m2/s2]."""
