"""Accelerations of actors, from their speeds in two successive steps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.rows import no_rows


@dataclass(frozen=True, slots=True)
class LastSpeeds:
    """The last speed of every actor, and the step of this speed, by actor number."""

    speed_mps: Float[ndarray, "capacity"] = no_rows()
    step: Int[ndarray, "capacity"] = no_rows(np.int64)

    def next(
        self, step: int, actor: Int[ndarray, "n"], speed_mps: Float[ndarray, "n"], dt_s: float
    ) -> tuple["LastSpeeds", Float[ndarray, "n"]]:
        """Add the speeds of one step.

        Parameters
        ----------
        step
            Number of the step.
        actor, speed_mps
            Actor numbers and speeds.
        dt_s
            Length of a step [s].

        Returns
        -------
        The new speeds, and each actor's acceleration since the last step [m/s2]. The acceleration of an actor that was
        not on the road in the last step is 0.
        """
        n_actors = int(actor.max(initial=-1)) + 1
        more = max(0, n_actors - len(self.speed_mps))
        more = max(more, len(self.speed_mps)) if more else 0
        speeds = np.concatenate([self.speed_mps, np.zeros(more)])
        steps = np.concatenate([self.step, np.full(more, -2)])
        there = steps[actor] == step - 1
        acceleration_mps2 = np.where(there, (speed_mps - speeds[actor]) / dt_s, 0.0)
        speeds[actor], steps[actor] = speed_mps, step
        return LastSpeeds(speeds, steps), acceleration_mps2
