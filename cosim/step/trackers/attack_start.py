"""When each vehicle began to attack."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray


@dataclass(frozen=True, slots=True)
class AttackStartTracker:
    """The step in which each actor first attacked."""

    step_of: dict[int, int] = field(default_factory=dict)

    def next(self, step: int, attacker: Int[ndarray, "k"]) -> "AttackStartTracker":
        """Add one step; `attacker` holds actor numbers, which may repeat."""
        new = [actor for actor in np.unique(attacker).tolist() if actor not in self.step_of]
        return AttackStartTracker(self.step_of | dict.fromkeys(new, step)) if new else self

    def first_steps(self, n: int) -> tuple[Int[ndarray, "n"], Bool[ndarray, "n"]]:
        """For actors 0 to n - 1, the step of the first attack, and whether there was one."""
        step, attacked = np.zeros(n, np.int32), np.zeros(n, bool)
        for actor, first in self.step_of.items():
            step[actor], attacked[actor] = first, True
        return step, attacked
