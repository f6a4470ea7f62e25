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
MOST_STANDING = 10.0
"""If fewer vehicles stand on average, they wait at a light or a stop."""
MOST_WAITING_P = 0.1
"""If the vehicles that wait to enter are more than this share of those on the road, and more than ten, the run gets a
note."""

_NAMED = 5
"""Types that a note names."""


@dataclass(slots=True)
class FlowCounts:
    """Numbers of vehicles on the road and of standing vehicles, summed over steps. Pedestrians do not count."""

    n_steps: int = 0
    n_vehicles: int = 0
    n_standing: int = 0
    n_pedestrians: int = 0

    def add(self, world: World) -> World:
        """Count the vehicles of a step, and return its world."""
        vehicle = world.shape != Shape.PEDESTRIAN
        self.n_steps += 1
        self.n_vehicles += int(np.count_nonzero(vehicle))
        self.n_pedestrians += int(np.count_nonzero(~vehicle))
        self.n_standing += int(np.count_nonzero(vehicle & (world.speed_mps < STANDING_MPS)))
        return world

    def report(self) -> dict[str, Any]:
        """The share of standing vehicles over all steps, or that only pedestrians were on the road."""
        if self.n_vehicles:
            return {"vehicles_standing_p": round(self.n_standing / self.n_vehicles, 3)}
        return {"pedestrians_only": True} if self.n_pedestrians else {}


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
    if summary.get("pedestrians_only"):
        found.append("note: only pedestrians were on the road, and no vehicle.")
    found += trace_remarks(summary)
    waiting, on_road = summary.get("vehicles_waiting_to_enter_at_end", 0), summary.get("vehicles_on_road_mean", 0.0)
    standing_p = summary.get("vehicles_standing_p", 0.0)
    if standing_p >= MOST_STANDING_P and standing_p * on_road >= MOST_STANDING:
        found.append(
            f"note: {100 * standing_p:.0f} % of the vehicles stand, averaged over the run: the traffic is jammed. "
            "Lower traffic.scale, or change the demand."
        )
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


def trace_remarks(summary: dict[str, Any]) -> list[str]:
    """Notes about actors and about a replayed trace. Each note is one line."""
    found = []
    if left_out := summary.get("actors_left_out"):
        counts = ", ".join(f"{n} {vehicle_class}" for vehicle_class, n in left_out.items())
        found.append(f"note: left out, because they are not on the road: {counts}.")
    if guessed := summary.get("types_guessed"):
        few = [f"{name} ({vclass})" for name, vclass in guessed.items()]
        more = f" and {len(few) - _NAMED} more" if len(few) > _NAMED else ""
        found.append(
            f"note: no file defines the types {', '.join(few[:_NAMED])}{more}: their classes are guessed from the "
            "names. Name the .sumocfg or the city that defines them as the scenario."
        )
    if n := summary.get("vehicles_without_type"):
        found.append(
            f"note: the trace says no type of {n} vehicles: they are taken for cars of 5 m. Record it with "
            "--fcd-output.attributes x,y,z,angle,type,speed, or without that option."
        )
    if placed := summary.get("trace_placed"):
        found.append(f"note: the positions of the trace are {placed}.")
    if lost := summary.get("trace_lost"):
        found.append(
            f"note: the trace lacks timesteps, at {lost['first_s']:g} s for the first time: {lost['steps']} steps are "
            "interpolated."
        )
    if again := summary.get("names_again"):
        found.append(
            f"note: {again['n']} names come back as another type, or farther away than a vehicle can have driven. "
            f"They are actors of their own, the first of them {again['first']}."
        )
    if ratio := summary.get("trace_travel_ratio"):
        found.append(
            f"note: vehicles of the trace move {ratio:.2g} times as far as their speeds say. Are positions in metres, "
            "times in seconds and speeds in m/s?"
        )
    return found
