"""Time-correlated errors of positioning: estimated minus true position and heading."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int, UInt64
from numpy import ndarray

from cosim.base import rng
from cosim.base.bounds import NotNegative1000
from cosim.base.rows import no_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class GnssParams:
    """Errors of the position and heading that equipped vehicles estimate."""

    std_m: NotNegative1000 = 0.0
    """Standard deviation of the error, for east and for north [m]. 0 means no error. Typical values are some decimetres
    if positioning is fused with inertial sensors and a map, and metres for a receiver alone."""
    heading_std_deg: Annotated[float, Ge(0), Le(180)] = 0.0
    """Standard deviation of the error of the heading [degrees]. 0 means no error. Receivers that are fused with
    inertial sensors reach some tenths of a degree."""
    correlation_s: Annotated[float, Gt(0), Le(1e6)] = 60.0
    """Time after which the autocorrelation of the errors has fallen to 1 / e [s]."""

    @property
    def is_exact(self) -> bool:
        """Whether vehicles know their positions and headings exactly."""
        return self.std_m <= 0 and self.heading_std_deg <= 0


@dataclass(frozen=True, slots=True)
class PositionErrors:
    """First-order Gauss-Markov processes, one per equipped vehicle and component, by actor number.

    Notes
    -----
    e(t + d) = r e(t) + s sqrt(1 - r²) n with r = exp(-d / correlation_s). s is the standard deviation, and n is a
    standard normal number keyed by vehicle and step. The first error of a vehicle is s n. The standard deviation is
    therefore s at all times, and a vehicle's error does not depend on other vehicles.
    """

    error: Float[ndarray, "capacity 3"] = no_rows(np.float64, 3)
    """East [m], north [m] and heading, counter-clockwise [rad]."""
    step: Int[ndarray, "capacity"] = no_rows(np.int64)

    def next(
        self,
        step: int,
        actor: Int[ndarray, "e"],
        name_key: UInt64[ndarray, "e"],
        params: GnssParams,
        dt_s: float,
        seed: int,
    ) -> tuple["PositionErrors", Float[ndarray, "e 3"]]:
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
        The processes after this step, and the errors of these vehicles: east and north [m], heading [rad].
        """
        n_actors = int(actor.max(initial=-1)) + 1
        more = max(0, n_actors - len(self.step))
        more = max(more, len(self.step)) if more else 0
        errors = np.concatenate([self.error, np.zeros((more, 3))])
        steps = np.concatenate([self.step, np.full(more, -1)])
        since = steps[actor]
        decay = np.exp(-(step - since) * dt_s / params.correlation_s)
        kept = np.where(since >= 0, decay, 0.0)[:, None]
        of_position = rng.normals(rng.key(seed, rng.Stream.POSITIONING, step), name_key, n=2)
        of_heading = rng.normals(rng.key(seed, rng.Stream.HEADING, step), name_key, n=1)
        noise = np.column_stack([of_position, of_heading])
        std = np.array([params.std_m, params.std_m, np.deg2rad(params.heading_std_deg)])
        std_of_new = std * np.sqrt(1.0 - kept**2)
        error = kept * errors[actor] + std_of_new * noise
        errors[actor], steps[actor] = error, step
        return PositionErrors(errors, steps), error
