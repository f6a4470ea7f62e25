"""Time-correlated errors of satellite positioning: estimated minus true position."""

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
    """Standard deviation of the error, for east and for north [m]. 0 means no error. Typical values are some decimetres
    if positioning is fused with inertial sensors and a map, and metres for a receiver alone."""
    correlation_s: Annotated[float, Gt(0), Le(1e6)] = 60.0
    """Time after which the autocorrelation of the error has fallen to 1 / e [s]."""


@dataclass(frozen=True, slots=True)
class PositionErrors:
    """First-order Gauss-Markov processes, one per equipped vehicle and axis, by actor number.

    Notes
    -----
    e(t + d) = r e(t) + s sqrt(1 - r²) n with r = exp(-d / correlation_s). s is the standard deviation, and n is a
    standard normal number keyed by vehicle and step. The first error of a vehicle is s n. The standard deviation is
    therefore s at all times, and a vehicle's error does not depend on other vehicles.
    """

    error_m: Float[ndarray, "capacity 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))

    def next(
        self, step: int, actor: Int[ndarray, "e"], name_key: UInt64[ndarray, "e"], params: GnssParams, dt_s: float,
        seed: int,
    ) -> tuple["PositionErrors", Float[ndarray, "e 2"]]:  # fmt: skip
        """Advance the processes by one step.

        Parameters
        ----------
        actor
            Actor numbers of the equipped vehicles in this step.
        name_key
            Keys of their names, for random draws.
        dt_s
            Length of one step [s].

        Returns
        -------
        The processes after this step, and the errors of these vehicles, east and north [m].
        """
        more = max(0, int(actor.max(initial=-1)) + 1 - len(self.step))
        more = max(more, len(self.step)) if more else 0
        errors_m = np.concatenate([self.error_m, np.zeros((more, 2))])
        steps = np.concatenate([self.step, np.full(more, -1)])
        since = steps[actor]
        kept = np.where(since >= 0, np.exp(-(step - since) * dt_s / params.correlation_s), 0.0)[:, None]
        noise = rng.normals(rng.key(seed, rng.Stream.POSITIONING, step), name_key, n=2)
        error_m = kept * errors_m[actor] + params.std_m * np.sqrt(1.0 - kept**2) * noise
        errors_m[actor], steps[actor] = error_m, step
        return PositionErrors(errors_m, steps), error_m
