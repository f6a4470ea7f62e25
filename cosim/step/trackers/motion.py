"""Accelerations of actors, from their speeds in two successive steps."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray


@dataclass(slots=True)
class AccelerationTracker:
    """Last speed of every actor, by actor number."""

    _speed_mps: Float[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0))
    _step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))

    def update(
        self, step: int, actor: Int[ndarray, "n"], speed_mps: Float[ndarray, "n"], dt_s: float
    ) -> Float[ndarray, "n"]:
        """Acceleration of each actor since the last step [m/s2]; 0 for those that were not on the road then."""
        if (more := int(actor.max(initial=-1)) + 1 - len(self._speed_mps)) > 0:
            more = max(more, len(self._speed_mps))
            self._speed_mps = np.concatenate([self._speed_mps, np.zeros(more)])
            self._step = np.concatenate([self._step, np.full(more, -2)])
        there = self._step[actor] == step - 1
        found = np.where(there, (speed_mps - self._speed_mps[actor]) / dt_s, 0.0)
        self._speed_mps[actor], self._step[actor] = speed_mps, step
        return found
