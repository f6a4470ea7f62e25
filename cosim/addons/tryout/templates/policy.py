"""A pseudonym policy: a vehicle changes its pseudonym at random, after it has used it for some time."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [pseudonyms] that belong to this policy."""

    least_s: float = 3.0  # shortest time under one pseudonym [s]
    change_p: float = 0.5  # probability of a change in each step after that


class MyPolicy:
    Params = Params

    def __init__(self, params):
        self.params = params

    def changes(self, ages):  # one row for each vehicle: age_s, distance_m, n_messages, n_changes
        # step_draws: uniform in [0, 1), new in every step; trip_draws: the same as long as the pseudonym
        return (ages.age_s >= self.params.least_s) & (ages.step_draws < self.params.change_p)
