"""OPV2V, as OpenCOOD reads it: scenarios of several vehicles, each with a cloud and a YAML file per time stamp.

Notes
-----
`train/SCENARIO/VEHICLE/%06d.{yaml,pcd}`. In a scenario every vehicle has every time stamp: it is cut wherever one of
its vehicles comes or goes. Readers take at most seven vehicles, and the smallest identifier, *as a string*, for the
ego. Up to seven chosen vehicles stay together; more are grouped every ten seconds, each group around the vehicle that
has most others within 70 m. Sensors are level, so the right-handed world of the tables is kept: x east, y north, z up;
yaw counter-clockwise in degrees. `vehicles` holds cars, vans, trucks and buses with at least one return; `location` is
the middle of their underside at the time of the sweep, as in `kitti.py`; `center` leads from there to the middle of the
box, `extent` is half of the size.
`predicted_ego_pos` is what the vehicle reports of itself, if it does. Time stamps are numbers of sweeps, whatever their
interval; readers assume 10 Hz. On request, `%06d_pred.npy` holds the corners of the detected vehicles that the vehicle
transmitted [n, 8, 3], in the frame of its LiDAR, as OpenCOOD saves predictions, and `%06d_score.npy` their scores. The
error of its own pose does not displace them.
Vehicles with other phases of sensing (`sensing_phase = "random"`) never share a time stamp: a scenario has those of one
phase.
Deviations: intensity, the red channel, is 0; no cameras; no planned trajectory.
"""

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.export import kitti
from cosim.addons.export.frames import in_sensor
from results.moments import BOX, NOTHING, Cloud, Clouds, File, Moment, Plan, Selection, Unit, corners_of
from results.sensing import interval_steps, phase_steps

TABLES = kitti.TABLES

MOST = 7
"""Vehicles of a scenario."""

RANGE_M = 70.0
"""Within which readers let vehicles cooperate."""

WINDOW_S = 10.0
"""Length of a scenario where more than `MOST` vehicles are chosen."""

CLASSES = ("car", "van", "truck", "bus")

TEXT_BYTES = 4000
"""Of a vehicle's YAML in a frame, roughly."""


@dataclass(frozen=True, slots=True)
class Opv2vScenario:
    """Vehicles that are on the road together in all of these steps."""

    vehicles: tuple[int, ...]
    steps: Int[ndarray, "s"]

    @property
    def name(self) -> str:
        """Name of its folder: where in the run it is, and whose it is."""
        return f"step_{self.steps[0]:06d}_vehicle_{self.vehicles[0]}"


@dataclass(frozen=True, kw_only=True)
class Params:
    """What is written beside clouds and annotations."""

    detections: bool = False
    """Whether the vehicles' own detections are written, for `cosim evaluate`."""


class Opv2v:
    """OPV2V."""

    Params = Params
    TABLES = TABLES

    def __init__(self, params: Params | None = None) -> None:
        self._params = params or Params()

    def plan(self, selection: Selection) -> Plan:
        """A unit for each scenario."""
        found = scenarios_of(selection)
        if not found:
            raise ValueError(
                "no two of these vehicles sense in the same steps and stay on the road meanwhile, and a scenario needs "
                'two. Choose others, or run with sensing_phase = "common".'
            )
        units = []
        for scenario in found:
            units.append(Unit(scenario.name, partial(_scenario, selection, scenario, self._params.detections)))
        units.append(kitti.names(selection))
        n = sum(len(s.vehicles) * len(s.steps) for s in found)
        return Plan(tuple(units), n, 16, n * TEXT_BYTES)


def scenarios_of(selection: Selection) -> list[Opv2vScenario]:
    """Scenarios with constant membership, in the order of their first steps."""
    vehicles = np.unique(selection.presence.vehicle)
    schedule = np.column_stack([of(selection.run, vehicles) for of in (interval_steps, phase_steps)])
    found = []
    for interval, phase in np.unique(schedule, axis=0).tolist():
        together = vehicles[(schedule == (interval, phase)).all(axis=1)]
        steps = selection.steps[selection.steps % interval == phase]
        presence = selection.presence[selection.presence.vehicle.isin(together)]
        if len(selection.vehicles) <= MOST:
            found += _runs(presence, steps, interval)
        else:
            found += _windows(selection, presence, steps, interval)
    return sorted(found, key=lambda scenario: (scenario.steps[0], scenario.vehicles))


def _windows(
    selection: Selection, presence: pd.DataFrame, steps: Int[ndarray, "s"], interval: int
) -> list[Opv2vScenario]:
    """Scenarios of `WINDOW_S` of vehicles that sense together, every `interval` steps."""
    found, parts = [], []
    width = max(1, round(WINDOW_S / (interval * selection.run.dt_s)))
    gaps = np.flatnonzero(np.diff(steps) != interval) + 1
    for span in np.split(steps, gaps):
        begins = range(0, len(span), width)
        parts += [span[at : at + width] for at in begins]
    for part in parts:
        here = presence[presence.step.isin(part.tolist())]
        counts = here.vehicle.value_counts()
        throughout = np.sort(counts.index[counts == len(part)].to_numpy())
        if len(throughout) > 1:
            found += [Opv2vScenario(group, part) for group in _groups(selection, throughout, part)]
    return found


def _runs(presence: pd.DataFrame, steps: Int[ndarray, "s"], interval: int) -> list[Opv2vScenario]:
    """Maximal spans of sweeps, one every `interval` steps, with the same two vehicles or more on the road."""
    found: list[Opv2vScenario] = []
    members = {}
    for step, vehicles in presence.groupby("step").vehicle:
        members[int(cast(int, step))] = tuple(sorted(vehicles))
    of_sweep = [members.get(step, ()) for step in steps.tolist()]
    begin = 0
    for i in range(1, len(steps) + 1):
        who = of_sweep[begin]
        next_step = steps[i - 1] + interval
        follows = i < len(steps) and steps[i] == next_step
        if follows and of_sweep[i] == who:
            continue
        if len(who) > 1:
            found.append(Opv2vScenario(tuple(map(int, who)), steps[begin:i]))
        begin = i
    return found


def _groups(
    selection: Selection,
    vehicles: Int[ndarray, "v"],
    steps: Int[ndarray, "s"],
) -> list[tuple[int, ...]]:
    """Disjoint groups of up to `MOST`, by distance in the middle of the steps; who is alone is left out."""
    moment = next(selection.moments(steps[[len(steps) // 2]]))
    xy = moment.box[[moment.row(v) for v in vehicles.tolist()], :2]
    left = np.ones(len(vehicles), bool)
    groups: list[tuple[int, ...]] = []
    tree = cKDTree(xy)
    near = [np.array(rows) for rows in tree.query_ball_point(xy, RANGE_M)]
    while True:
        n_near = np.array([left[rows].sum() for rows in near]) * left
        centre = int(np.argmax(n_near))
        if n_near[centre] < 2:
            return groups
        rows = near[centre][left[near[centre]]]
        away = np.linalg.norm(xy[rows] - xy[centre], axis=1)
        rows = rows[np.lexsort((vehicles[rows], away))][:MOST]
        left[rows] = False
        groups.append(tuple(sorted(vehicles[rows].tolist())))


def _scenario(selection: Selection, scenario: Opv2vScenario, detections: bool, clouds: Clouds) -> Iterator[File]:
    for at, moment in enumerate(selection.moments(scenario.steps)):
        for vehicle, cloud in zip(scenario.vehicles, clouds(moment.step, scenario.vehicles), strict=True):
            path = f"train/{scenario.name}/{vehicle}/{at:06d}"
            yield File(f"{path}.pcd", partial(pcd, cloud))
            pose = selection.pose(moment, vehicle)
            yield File(f"{path}.yaml", partial(_yaml, moment, vehicle, pose))
            if detections:
                believed = selection.believed_pose(moment, vehicle)
                yield File(f"{path}_pred.npy", partial(_npy, partial(_corners, moment, vehicle, believed)))
                yield File(f"{path}_score.npy", partial(_npy, partial(_scores, moment, vehicle)))


def pcd(cloud: Cloud) -> bytes:
    """Point Cloud Library's binary format with colours, which readers take for intensity; sensor frame."""
    points = cloud()
    n = len(points)
    head = [
        "VERSION 0.7",
        "FIELDS x y z rgb",
        "SIZE 4 4 4 4",
        "TYPE F F F F",
        "COUNT 1 1 1 1",
        f"WIDTH {n}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {n}",
        "DATA binary",
        "",
    ]
    rows = np.column_stack([points, np.zeros(n, np.float32)])
    return "\n".join(head).encode() + rows.astype("<f4").tobytes()


def _detected(moment: Moment, vehicle: int):  # type: ignore[no-untyped-def]
    """Detections of vehicles that a vehicle transmitted, without its self report."""
    sent = moment.detections.get(vehicle)
    if sent is None:
        return None
    is_vehicle = sent["class"].isin(("car", "truck"))
    return sent[(sent.origin != "self") & is_vehicle]


def _corners(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> Float[ndarray, "n 8 3"]:
    sent = _detected(moment, vehicle)
    if sent is None:
        return np.zeros((0, 8, 3))
    return corners_of(in_sensor(sent[BOX].to_numpy(float), pose))


def _scores(moment: Moment, vehicle: int) -> Float[ndarray, "n"]:
    sent = _detected(moment, vehicle)
    return np.zeros(0) if sent is None else sent.score.to_numpy(float)


def _npy(make: Callable[[], ndarray]) -> bytes:
    """An array in NumPy's format."""
    content = io.BytesIO()
    np.save(content, make(), allow_pickle=False)
    return content.getvalue()


def _yaml(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> bytes:
    row = moment.row(vehicle)
    box = moment.box[row]
    under = _under(box)
    sent = moment.detections.get(vehicle)
    own = None if sent is None else sent[(sent.origin == "self")]
    lines = [f"ego_speed: {3.6 * moment.speed_mps[row]:.4f}"]
    lines.append(f"lidar_pose: {_pose(pose[:3], pose[3])}")
    if own is not None and len(own):
        told = own[BOX].to_numpy(float)[0]
        lines.append(f"predicted_ego_pos: {_pose(_under(told), told[6])}")
    lines.append(f"true_ego_pos: {_pose(under, box[6])}")
    seen = moment.visible.get(vehicle, NOTHING)
    rows = np.searchsorted(moment.actor, seen.actor[seen.n_points > 0])
    rows = rows[np.isin(moment.vehicle_class[rows], CLASSES)]
    lines.append("vehicles:" if len(rows) else "vehicles: {}")
    for i in rows.tolist():
        b = moment.box[i]
        lines += [
            f"  {moment.actor[i]}:",
            f"    angle: {_numbers((0, np.degrees(b[6]), 0))}",
            f"    center: {_numbers((0, 0, 0.5 * b[5]))}",
            f"    extent: {_numbers(0.5 * b[3:6])}",
            f"    location: {_numbers(_under(b))}",
            f"    speed: {3.6 * moment.speed_mps[i]:.4f}",
        ]
    return ("\n".join(lines) + "\n").encode()


def _under(box: Float[ndarray, "7"]) -> list[float]:
    """Middle of the underside of a box."""
    return [*box[:2], box[2] - 0.5 * box[5]]


def _pose(xyz, yaw_rad: float) -> str:  # type: ignore[no-untyped-def]
    """x, y, z, roll, yaw, pitch; in degrees."""
    return _numbers((*xyz, 0, np.degrees(yaw_rad), 0))


def _numbers(values) -> str:  # type: ignore[no-untyped-def]
    return "[" + ", ".join(f"{float(x):.6f}" for x in values) + "]"
