"""Errors of satellite positioning, which last: estimated minus true position."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int, UInt64
from numpy import ndarray

from cosim import rng


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
