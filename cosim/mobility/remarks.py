"""Counts of a run's traffic for its summary, and remarks on traffic that is not what a user may expect."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.world import World
from sensors.scene import Shape

STANDING_MPS = 0.1
"""Speed below which a vehicle stands; SUMO's own limit of halting."""
MOST_STANDING_P = 0.5
"""Share of standing vehicles above which a run gets a remark."""
MOST_WAITING_P = 0.1
"""Vehicles that wait to enter, over those on the road, above which a run gets a remark; at least ten."""


@dataclass(slots=True)
class FlowCounts:
    """Vehicles on the road and standing, summed over steps; pedestrians are left out."""

    n_steps: int = 0
    n_vehicles: int = 0
    n_standing: int = 0

    def add(self, world: World) -> World:
        """Count the vehicles of a step; returns it."""
        vehicle = world.shape != Shape.PEDESTRIAN
        self.n_steps += 1
        self.n_vehicles += int(np.count_nonzero(vehicle))
        self.n_standing += int(np.count_nonzero(vehicle & (world.speed_mps < STANDING_MPS)))
        return world

    def report(self) -> dict[str, Any]:
        """The share of standing vehicles, over all steps; nothing without vehicles."""
        return {"vehicles_standing_p": round(self.n_standing / self.n_vehicles, 3)} if self.n_vehicles else {}


def traffic_remarks(summary: dict[str, Any]) -> list[str]:
    """Remarks on the traffic of a finished run, from its manifest's summary; each one line."""
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
            f"note: {waiting} vehicles wait to enter at the end, beside {on_road:.0f} on the road: the demand exceeds "
            "what the network takes. Lower traffic.scale, or change the demand."
        )
    if changed := summary.get("inputs_changed"):
        found.append(
            f"note: changed since the replayed run was recorded: {', '.join(changed)}. "
            "Buildings and streets may differ from that run's."
        )
    found += [f"note: SUMO went on, but: {error}" for error in summary.get("sumo_errors", [])]
    return found
