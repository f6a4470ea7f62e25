"""Counts of a run's traffic for its summary, and notes about traffic that a user may not expect."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.world import World
from sensors.scene import Shape

STANDING_MPS = 0.1
"""A vehicle below this speed counts as standing, as in SUMO."""
MOST_STANDING_P = 0.5
"""If the share of standing vehicles is larger, the run gets a note."""
MOST_WAITING_P = 0.1
"""If the vehicles that wait to enter are more than this share of those on the road, and more than ten, the run gets a
note."""


@dataclass(slots=True)
class FlowCounts:
    """Numbers of vehicles on the road and of standing vehicles, summed over steps. Pedestrians do not count."""

    n_steps: int = 0
    n_vehicles: int = 0
    n_standing: int = 0

    def add(self, world: World) -> World:
        """Count the vehicles of a step, and return its world."""
        vehicle = world.shape != Shape.PEDESTRIAN
        self.n_steps += 1
        self.n_vehicles += int(np.count_nonzero(vehicle))
        self.n_standing += int(np.count_nonzero(vehicle & (world.speed_mps < STANDING_MPS)))
        return world

    def report(self) -> dict[str, Any]:
        """The share of standing vehicles over all steps. Empty if there were no vehicles."""
        return {"vehicles_standing_p": round(self.n_standing / self.n_vehicles, 3)} if self.n_vehicles else {}


def traffic_remarks(summary: dict[str, Any]) -> list[str]:
    """Notes about the traffic of a finished run, from the summary in its manifest. Each note is one line."""
    found = []
    if "ended_early" in summary:
        found.append(f"note: {summary['ended_early']}.")
    if (first_s := summary.get("first_departure_s")) is not None:
        found.append(
            f"note: no vehicle was on the road: the first of the scenario departs at {first_s:g} s. "
            f"Set traffic.begin_s = {max(0.0, first_s - summary.get('warmup_s', 0.0)):g}."
        )
    if left_out := summary.get("actors_left_out"):
        counts = ", ".join(f"{n} {vehicle_class}" for vehicle_class, n in left_out.items())
        found.append(f"note: left out, because they are not on the road: {counts}.")
    if (standing_p := summary.get("vehicles_standing_p", 0.0)) >= MOST_STANDING_P:
        found.append(
            f"note: {100 * standing_p:.0f} % of the vehicles stand, averaged over the run: the traffic is jammed. "
            "Lower traffic.scale, or change the demand."
        )
    waiting, on_road = summary.get("vehicles_waiting_to_enter_at_end", 0), summary.get("vehicles_on_road_mean", 0.0)
    if waiting > max(10.0, MOST_WAITING_P * on_road):
        found.append(
            f"note: {waiting} vehicles wait to enter at the end, while {on_road:.0f} are on the road: the demand "
            "exceeds the capacity of the network. Lower traffic.scale, or change the demand."
        )
    if changed := summary.get("inputs_changed"):
        found.append(
            f"note: changed since the replayed run was recorded: {', '.join(changed)}. "
            "Buildings and streets may differ from that run's."
        )
    found += [f"note: SUMO continued after this error: {error}" for error in summary.get("sumo_errors", [])]
    return found
