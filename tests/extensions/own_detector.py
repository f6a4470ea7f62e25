"""A detector of one's own: every actor with enough returns, exactly, with a score that grows with them."""

from dataclasses import dataclass

import numpy as np

from cosim.extend import Reports


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [detector] that belong to this detector."""

    enough_returns: int = 20
    """Returns from which an actor is found."""


class Threshold:
    """Finds what has returned enough of the light."""

    Params = Params

    def __init__(self, params):
        self.params = params

    def detect(self, sweeps, seen, boxes, label, draws):
        rows = np.flatnonzero(seen.n_returns >= self.params.enough_returns)
        actor = seen.actor[rows]
        score = 1 - 1 / (1 + seen.n_returns[rows] / self.params.enough_returns)
        return Reports.of_actors(seen, rows, label[actor], boxes.take(actor), score)
