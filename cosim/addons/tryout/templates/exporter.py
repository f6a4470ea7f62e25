"""An exporter: one CSV file for each vehicle, with its position in every step."""

from dataclasses import dataclass
from functools import partial

from cosim.extend import File, Plan


@dataclass(frozen=True, kw_only=True)
class Params:
    """Given on the command line: cosim export ... --set digits=3"""

    digits: int = 2  # number of decimals


class MyExporter:
    Params = Params
    TABLES = ("actors",)  # tables that the run must have; results/TABLES.md describes all of them

    def __init__(self, params):
        self.params = params

    def plan(self, selection):  # selection: the run, and the requested vehicles and steps
        return Plan.of_files(
            File(f"vehicle-{vehicle}.csv", partial(self._csv, selection, vehicle)) for vehicle in selection.vehicles
        )

    def _csv(self, selection, vehicle):  # the content of one file, as bytes
        actors = selection.run.table("actors", ["step", "actor", "x_m", "y_m"])  # a pandas data frame
        rows = actors[(actors.actor == vehicle) & actors.step.isin(selection.steps)]
        return rows.sort_values("step").round(self.params.digits).to_csv(index=False).encode()
