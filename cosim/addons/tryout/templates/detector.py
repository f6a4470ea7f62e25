"""A detector: it detects actors with enough LiDAR returns, with a small position error."""

from dataclasses import dataclass, replace

from cosim.extend import Reports


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [detector] that belong to this detector."""

    enough_returns: int = 20  # smallest number of returns for a detection
    error_m: float = 0.2  # largest position error, to the east [m]


class MyDetector:
    Params = Params

    def __init__(self, params):
        self.params = params

    def detect(self, sweeps, seen, boxes, label, draws):
        # seen: one row for each (observer, actor) that could be detected, with the number of returns
        found = (seen.n_returns >= self.params.enough_returns).nonzero()[0]
        actor = seen.actor[found]
        box = boxes.take(actor)  # the true boxes at the time of the sweep
        noise = draws.uniforms(seen)[found, 0]  # a random number for each (observer, actor), new in every step
        xyz_m = box.xyz_m + sweeps.moved_m(seen.observer[found], boxes, actor)  # where the turning sensor saw them
        xyz_m[:, 0] += self.params.error_m * (2 * noise - 1)
        score = 1 - 1 / (1 + seen.n_returns[found] / self.params.enough_returns)
        return Reports.of_actors(seen, found, label[actor], replace(box, xyz_m=xyz_m), score)
