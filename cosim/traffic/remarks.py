"""Counts of a run's traffic for its summary, and notes about traffic that a user may not expect."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.traffic.georeference import FAR_M
from cosim.world import World
from sensors.boxes import Boxes
from sensors.scene import Shape
from sumo_nets.levels import LEVEL_M

STANDING_MPS = 0.1
"""A vehicle below this speed counts as standing, as in SUMO."""
JUMP_M = 5.0
"""Vehicles jump if they move this much farther between two steps than at the larger of their two speeds [m]."""
INSIDE_M = 1.0
"""Vehicles overlap if one reaches farther than this into the other [m]."""
_APART_M = 8.0
"""Vehicles whose centres are farther apart do not count as overlapping [m]."""
FEWEST = 5
"""Fewer vehicles that no road can have, summed over the steps, get no note."""
_MANY, _FILLING_P = 20, 0.25
"""Streets were filling if at least so many vehicles were there on the mean, and a smaller share of them at first."""

MOST_STANDING_P = 0.5
"""If the share of standing vehicles is larger, the run gets a note."""
MOST_STANDING = 10.0
"""If fewer vehicles stand on average, they wait at a light or a stop."""
MOST_WAITING_P = 0.1
"""If the vehicles that wait to enter are more than this share of those on the road, and more than ten, the run gets a
note."""
MOST_AT_ONE_POINT_P = 0.01
"""If the share of vehicles at the exact position of another one is larger, the run gets a note."""
MOST_OVERLAPPING_P = 0.002
"""If the share of vehicles inside another one is larger, the run gets a note. SUMO's junctions reach a third of it."""
MOST_JUMPING_P = 0.001
"""If the share of vehicles that move farther than their speed allows is larger, the run gets a note."""
MOST_AT_BEGIN_P = 0.2
"""A trace does not begin on empty streets if it begins with more than this share of the mean number of actors."""
_NAMED = 5
"""Types that a note names."""


@dataclass(slots=True)
class FlowCounts:
    """Numbers of vehicles, summed over steps: on the road, standing, and where no two vehicles can be.

    Pedestrians do not count.
    """

    dt_s: float
    """Length of a step."""
    n_steps: int = 0
    n_vehicles: int = 0
    n_first: int = 0
    """Vehicles in the first step."""
    n_standing: int = 0
    n_pedestrians: int = 0
    n_at_one_point: int = 0
    """At the exact position of another vehicle."""
    n_overlapping: int = 0
    """Inside another vehicle, and not at its exact position."""
    n_jumping: int = 0
    """Vehicles that have moved farther since the step before than their speed allows."""
    _before: World | None = None

    def add(self, world: World) -> None:
        """Count the vehicles of a step."""
        is_vehicle = world.shape != Shape.PEDESTRIAN
        n_vehicles = int(np.count_nonzero(is_vehicle))
        if not self.n_steps:
            self.n_first = n_vehicles
        self.n_steps += 1
        self.n_vehicles += n_vehicles
        self.n_pedestrians += int(np.count_nonzero(~is_vehicle))
        stands = np.abs(world.speed_mps) < STANDING_MPS
        self.n_standing += int(np.count_nonzero(is_vehicle & stands))
        if self._before is not None:
            self.n_jumping += len(jumping(self._before, world, self.dt_s))
        self._before = world
        boxes = world.boxes.take(is_vehicle)
        east_m = np.sort(boxes.xyz_m[:, 0])
        if (east_m[1:] == east_m[:-1]).any():  # otherwise no two are at one point
            _, row, n = np.unique(boxes.xyz_m, axis=0, return_index=True, return_counts=True)
            self.n_at_one_point += int(n[n > 1].sum())
            boxes = boxes.take(row)
        self.n_overlapping += len(overlapping(boxes))

    def report(self) -> dict[str, Any]:
        """Shares of vehicles over all steps, or that only pedestrians or nobody was on the road."""
        if not self.n_vehicles:
            return {"pedestrians_only": True} if self.n_pedestrians else {"nobody_on_road": True}
        found = {"vehicles_standing_p": round(self.n_standing / self.n_vehicles, 3)}
        mean = self.n_vehicles / self.n_steps
        if mean >= _MANY and self.n_first < _FILLING_P * mean:
            found["vehicles_on_road_first"] = self.n_first
        odd = {
            "vehicles_at_one_point_p": self.n_at_one_point,
            "vehicles_overlapping_p": self.n_overlapping,
            "vehicles_jumping_p": self.n_jumping,
        }
        for name, n in odd.items():
            if n >= FEWEST:
                found[name] = round(n / self.n_vehicles, 5)
        return found


def jumping(before: World, now: World, dt_s: float) -> Int[ndarray, "n"]:
    """Rows of `now` of the vehicles that have moved farther than they can at the larger of their two speeds."""
    _, was, row = np.intersect1d(before.actor, now.actor, assume_unique=True, return_indices=True)
    way_m = now.boxes.xyz_m[row] - before.boxes.xyz_m[was]
    moved_m = np.hypot(way_m[:, 0], way_m[:, 1])
    before_mps = np.abs(before.speed_mps[was])
    now_mps = np.abs(now.speed_mps[row])
    most_m = np.maximum(before_mps, now_mps) * dt_s + JUMP_M
    return row[(moved_m > most_m) & (now.shape[row] != Shape.PEDESTRIAN)]


def overlapping(boxes: Boxes) -> Int[ndarray, "n"]:
    """Rows of the boxes that reach farther than `INSIDE_M` into another one.

    Two boxes are apart if they are so along the vertical, or along an axis of one of them (separating axes).
    """
    xy_m, z_m = boxes.xyz_m[:, :2], boxes.xyz_m[:, 2]
    height_m, radius_m = boxes.lwh_m[:, 2], boxes.circumradius_m
    a, b = scipy.spatial.cKDTree(xy_m).query_pairs(_APART_M, output_type="ndarray").T
    distance_m = np.hypot(*(xy_m[b] - xy_m[a]).T)
    is_near = distance_m <= radius_m[a] + radius_m[b]
    a, b = a[is_near], b[is_near]
    between_m = xy_m[b] - xy_m[a]
    above_m = np.abs(z_m[a] - z_m[b])
    heights_m = height_m[a] + height_m[b]
    is_apart = above_m > heights_m / 2 - INSIDE_M / 2
    for of_axis in (a, b):
        for turn_rad in (0.0, np.pi / 2):
            axis_rad = boxes.yaw_rad[of_axis] + turn_rad
            axis = np.column_stack([np.cos(axis_rad), np.sin(axis_rad)])
            apart_m = np.abs((between_m * axis).sum(axis=1))
            reach_m = _reach_m(boxes.take(a), axis_rad) + _reach_m(boxes.take(b), axis_rad)
            is_apart |= apart_m > reach_m - INSIDE_M
    return np.unique(np.concatenate([a[~is_apart], b[~is_apart]]))


def _reach_m(boxes: Boxes, axis_rad: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """How far each box reaches from its centre along an axis."""
    half_length_m, half_width_m, _ = boxes.lwh_m.T / 2
    turn_rad = boxes.yaw_rad - axis_rad
    along = np.abs(np.cos(turn_rad))
    across = np.abs(np.sin(turn_rad))
    return half_length_m * along + half_width_m * across


def traffic_remarks(summary: dict[str, Any]) -> list[str]:
    """Notes about the traffic of a finished run, from the summary in its manifest. Each note is one line."""
    found = _begin_remarks(summary) + trace_remarks(summary) + _flow_remarks(summary)
    if changed := summary.get("inputs_changed"):
        found.append(
            f"note: changed since the replayed run was recorded: {', '.join(changed)}. "
            "Buildings and streets may differ from that run's."
        )
    found += [f"note: SUMO continued after this error: {error}" for error in summary.get("sumo_errors", [])]
    for warning in summary.get("sumo_warnings", []):
        found.append(f"note: SUMO left out a part of the demand, first with this warning: {warning}")
    return found


def _begin_remarks(summary: dict[str, Any]) -> list[str]:
    """Notes about who is on the road when recording begins, and about runs in which nobody comes."""
    found = []
    if "ended_early" in summary:
        found.append(f"note: {summary['ended_early']}.")
    if (first_s := summary.get("first_departure_s")) is not None:
        begin_s = max(0.0, first_s - summary.get("warmup_s", 0.0))
        found.append(
            f"note: no vehicle was on the road: the first of the scenario departs at {first_s:g} s. "
            f"Set traffic.begin_s = {begin_s:g}."
        )
    elif summary.get("nobody_on_road") and "ended_early" not in summary:
        found.append("note: nobody was on the road. Does the demand contain vehicles, and at this time?")
    if summary.get("pedestrians_only"):
        found.append("note: only pedestrians were on the road, and no vehicle.")
    n_at_begin = summary.get("actors_at_trace_begin", 0)
    on_road = summary.get("vehicles_on_road_mean", 0.0)
    if n_at_begin > max(1.0, MOST_AT_BEGIN_P * on_road):
        found.append(
            f"note: {n_at_begin} actors are on the road when the trace begins. Step 0 is the moment before, so that "
            "they seem to enter the road in step 1, and encounters that have begun already count as whole. Set "
            f"traffic.begin_s = {summary['trace_begin_s']:g}, and recording begins with them."
        )
    elif (n_first := summary.get("vehicles_on_road_first")) is not None:
        found.append(
            f"note: {n_first} vehicles were on the road when recording began, and "
            f"{on_road:.0f} on the mean: the streets were still filling. "
            "Set traffic.warmup_s to the time that this takes, such as 600."
        )
    return found


def _flow_remarks(summary: dict[str, Any]) -> list[str]:
    """Notes about jams, and about vehicles that move as none can."""
    found = []
    on_road = summary.get("vehicles_on_road_mean", 0.0)
    standing_p = summary.get("vehicles_standing_p", 0.0)
    if standing_p >= MOST_STANDING_P and standing_p * on_road >= MOST_STANDING:
        found.append(
            f"note: {100 * standing_p:.0f} % of the vehicles stand, averaged over the run: the traffic is jammed. "
            "Lower traffic.scale, or change the demand."
        )
    if (share := summary.get("vehicles_at_one_point_p", 0.0)) > MOST_AT_ONE_POINT_P:
        found.append(
            f"note: {share:.0%} of the vehicles are at the exact position of another one, averaged over the run, as at "
            'stops with parking="true", or in SUMO\'s mesoscopic model. Encounters are not those of a road. Let '
            "vehicles stop in a parkingArea, and record the traffic without mesosim."
        )
    if (share := summary.get("vehicles_overlapping_p", 0.0)) > MOST_OVERLAPPING_P:
        found.append(
            f"note: {share:.2%} of the vehicles overlap another one by more than {INSIDE_M:g} m, averaged over the "
            "run: they drive through one another. Do streets cross at one height, without bridges or tunnels?"
        )
    if (share := summary.get("vehicles_jumping_p", 0.0)) > MOST_JUMPING_P:
        found.append(
            f"note: {share:.2%} of the vehicles move farther within a step than their speed allows, averaged over the "
            "run: they jump, as in a network without ways through its junctions, or where SUMO teleports out of a jam."
        )
    n_waiting = summary.get("vehicles_waiting_to_enter_at_end", 0)
    if n_waiting > max(10.0, MOST_WAITING_P * on_road):
        found.append(
            f"note: {n_waiting} vehicles wait to enter at the end, while {on_road:.0f} are on the road: the demand "
            "exceeds the capacity of the network. Lower traffic.scale, or change the demand."
        )
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
            f"note: the trace says no type of {n} vehicles: they are taken for cars of 5 m, and positions "
            "for their front bumpers. Record it with --fcd-output.attributes x,y,z,angle,type,speed, or without that "
            "option; positions of centres are for `cosim trace`, with --x and --y."
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
    if share := summary.get("trace_aside_p"):
        found.append(
            f"note: in {share:.0%} of their moves, vehicles of the trace do not go to where their angles point. Are "
            "angles in degrees, clockwise from north? Correct them, or use `cosim trace` with --x and --y, which does "
            "without."
        )
    if share := summary.get("trace_far_from_lanes_p"):
        found.append(
            f"note: {share:.0%} of the vehicles of the trace appear more than {FAR_M:g} m from all lanes of the "
            "network. Is it a trace of another city, or of a larger area?"
        )
    if share := summary.get("trace_off_level_p"):
        found.append(
            f"note: {share:.0%} of the vehicles of the trace appear more than {LEVEL_M:g} m above or below the lanes "
            "of the network, and buildings stand at the height of the lanes. Record the trace with z in this "
            "network, or remove the network's heights: netconvert --flatten."
        )
    return found
