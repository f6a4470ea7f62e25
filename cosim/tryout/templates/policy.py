"""A pseudonym policy: a vehicle changes its pseudonym by chance, but not before it has used it for some time."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [pseudonyms] that belong to this policy."""

    least_s: float = 3.0  # shortest life of a pseudonym [s]
    change_p: float = 0.5  # chance of a change in each step after that


class MyPolicy:
    Params = Params

    def __init__(self, params):
        self.params = params

    def changes(self, ages):  # a row for each vehicle: age_s, distance_m, n_messages, n_changes
        # step_draws are uniform in [0, 1), new in every step; trip_draws last as long as the pseudonym
        return (ages.age_s >= self.params.least_s) & (ages.step_draws < self.params.change_p)
