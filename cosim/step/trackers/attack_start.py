"""When each vehicle began to attack."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray


@dataclass(frozen=True, slots=True)
class AttackStartTracker:
    """Step of the first message of each actor with a fabricated detection."""

    step_of: dict[int, int] = field(default_factory=dict)

    def next(self, step: int, attacker: Int[ndarray, "k"]) -> "AttackStartTracker":
        """The same after one more step; `attacker` are actor numbers, any number of times each."""
        new = [actor for actor in np.unique(attacker).tolist() if actor not in self.step_of]
        return AttackStartTracker(self.step_of | dict.fromkeys(new, step)) if new else self

    def first_steps(self, n: int) -> tuple[Int[ndarray, "n"], Bool[ndarray, "n"]]:
        """Of actors 0 to n - 1: the step, and whether there was one."""
        step, attacked = np.zeros(n, np.int32), np.zeros(n, bool)
        for actor, first in self.step_of.items():
            step[actor], attacked[actor] = first, True
        return step, attacked
