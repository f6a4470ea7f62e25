"""A metric: the mean speed of each class of actors, without standing ones."""

from dataclasses import dataclass

from cosim.extend import MetricRow


@dataclass(frozen=True, kw_only=True)
class Params:
    """Given on the command line: cosim measure ... --set least_mps=1.0"""

    least_mps: float = 0.5  # slower actors count as standing


class MyMetric:
    Params = Params

    def __init__(self, params):
        self.params = params

    def rows(self, run):
        run.require("actors", "vehicles")  # a clear error if the run does not have these tables
        actors = run.table("actors", ["actor", "speed_mps"])  # a pandas data frame; see results/TABLES.md
        moving = actors[actors.speed_mps >= self.params.least_mps]
        of_class = moving.actor.map(run.vehicles.set_index("vehicle").vehicle_class).astype(str)
        mean = moving.groupby(of_class).speed_mps.mean()
        return [
            MetricRow("my_speed.mean", value, group=name, unit="m/s", label="Mean speed of those that move")
            for name, value in mean.items()
        ]
