"""nuScenes, as its development kit reads it: a scene for each vehicle, its sweeps, and annotations around it.

Notes
-----
`v1.0-cosim/*.json` and `samples/LIDAR_TOP/*.pcd.bin`. A scene is one chosen vehicle in consecutive sweeps; each sweep
is a sample (a key frame), whatever the interval; nuScenes itself has one each 0.5 s. The global frame is the world of
the tables, x east, y north, z up. The ego frame lies under the middle of the vehicle on the ground, x forward, y left.
The sensor frame of LIDAR_TOP is that of nuScenes: x right, y forward, z up. Clouds have x, y, z, intensity and ring.
Annotated is every actor with at least one return, where it is at the time of the sweep, as in `kitti.py`; its
visibility is the share of returns that nothing hides. Instances do not outlive a scene. Second 0 of a run is 2025-01-01
00:00 UTC. Time stamps are microseconds; each vehicle's are one more than those of the vehicle before, because the kit
cannot list scenes that begin at the same time. `names.csv` says whose a scene is, and when.   Deviations: intensity and
ring are 0; no cameras, no radars, no sweeps between key frames; the map mask is one black pixel; ego origin is not the
rear axle, which the tables do not have; vans are cars.
"""

import hashlib
import json
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, cast

import numpy as np
import pandas as pd
from jaxtyping import Float32
from numpy import ndarray

from cosim.addons.export import kitti
from cosim.addons.export.pcap import START_S
from results.moments import NOTHING, Cloud, Clouds, File, Moment, Plan, Selection, Unit, units_of_steps
from results.spreadsheet import csv_of

TABLES = kitti.TABLES
VERSION = "v1.0-cosim"

ANNOTATION_BYTES = 450
"""Of an annotation, roughly."""

CATEGORIES = {
    "car": "vehicle.car",
    "van": "vehicle.car",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "motorcycle": "vehicle.motorcycle",
    "bicycle": "vehicle.bicycle",
    "pedestrian": "human.pedestrian.adult",
}
"""nuScenes' categories of the classes of actors."""

ATTRIBUTES = ("vehicle.moving", "vehicle.stopped", "cycle.with_rider", "pedestrian.moving", "pedestrian.standing")
STANDING_MPS = 0.1
"""Slower actors are said to stand."""

VISIBILITY = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
"""Levels of visibility, by token: the visible share [%]."""

Record = dict[str, Any]


@dataclass(frozen=True, slots=True)
class NuScenesScene:
    """A vehicle in consecutive sweeps."""

    vehicle: int
    steps: tuple[int, ...]

    @property
    def name(self) -> str:
        return f"scene-{self.steps[0]:06d}-{self.vehicle}"


class NuScenes:
    """nuScenes."""

    TABLES = TABLES

    def plan(self, selection: Selection) -> Plan:
        """Clouds in blocks of steps, then the tables."""
        units = units_of_steps(selection.blocks(), partial(_clouds, selection))
        units.append(Unit("tables", partial(_tables, selection)))
        n = len(selection.presence)
        return Plan(tuple(units), n, 20, n * 10.0 * ANNOTATION_BYTES)


def token(*words: object) -> str:
    """A name of 32 hexadecimal digits, the same for the same words."""
    return hashlib.md5("/".join(map(str, words)).encode(), usedforsecurity=False).hexdigest()


def scenes_of(selection: Selection) -> list[NuScenesScene]:
    """Scenes, by vehicle and first step."""
    frames = kitti.sequences_of(selection)
    found = []
    for _, rows in frames.groupby("sequence"):
        vehicle = int(rows.vehicle.iloc[0])
        found.append(NuScenesScene(vehicle, tuple(rows.step.tolist())))
    return found


def _cloud_path(step: int, vehicle: int) -> str:
    return f"samples/LIDAR_TOP/{vehicle}__LIDAR_TOP__{step:06d}.pcd.bin"


def _clouds(selection: Selection, steps: Any, clouds: Clouds) -> Iterator[File]:
    here = selection.presence[selection.presence.step.isin(steps.tolist())]
    for step, rows in here.groupby("step"):
        number, vehicles = int(cast(int, step)), rows.vehicle.tolist()
        for vehicle, cloud in zip(vehicles, clouds(number, vehicles), strict=True):
            yield File(_cloud_path(number, vehicle), partial(_points, cloud))


def _points(cloud: Cloud) -> bytes:
    return in_lidar_top(cloud()).astype("<f4").tobytes()


def in_lidar_top(points: Float32[ndarray, "k 3"]) -> Float32[ndarray, "k 5"]:
    """Points of the sensor frame (x forward, y left) in that of LIDAR_TOP (x right, y forward), with two zeros."""
    out = np.zeros((len(points), 5), np.float32)
    forward, left, up = points.T
    out[:, :3] = np.column_stack([-left, forward, up])
    return out


def quaternion(yaw_rad: float) -> list[float]:
    """A turn about the vertical axis: w, x, y, z."""
    half_rad = 0.5 * yaw_rad
    return [float(np.cos(half_rad)), 0.0, 0.0, float(np.sin(half_rad))]


def _tables(selection: Selection, clouds: Clouds) -> Iterator[File]:
    scenes = scenes_of(selection)
    tables = _fixed() | _of_vehicles(selection)
    tables |= {"scene": [_scene(s) for s in scenes]}
    tables |= _frames(selection, scenes)
    for name, records in tables.items():
        yield File(f"{VERSION}/{name}.json", partial(_json, records))
    yield File("maps/empty.png", partial(kitti.image, (1, 1)))
    rows = []
    for scene in scenes:
        steps = scene.steps
        rows.append((scene.name, scene.vehicle, steps[0], steps[-1]))
    names = pd.DataFrame(rows, columns=["scene", "vehicle", "first_step", "last_step"])
    yield File("names.csv", partial(csv_of, names))


def _json(records: list[Record]) -> bytes:
    return json.dumps(records, indent=0).encode()


def _fixed() -> dict[str, list[Record]]:
    """Tables that are the same for every run."""
    kinds = list(dict.fromkeys(CATEGORIES.values()))
    return {
        "category": [
            {"token": token("category", k), "name": k, "description": "", "index": i + 1} for i, k in enumerate(kinds)
        ],
        "attribute": [{"token": token("attribute", a), "name": a, "description": ""} for a in ATTRIBUTES],
        "visibility": [{"token": t, "level": level, "description": ""} for t, level in VISIBILITY.items()],
        "sensor": [{"token": token("sensor"), "channel": "LIDAR_TOP", "modality": "lidar"}],
    }


def _of_vehicles(selection: Selection) -> dict[str, list[Record]]:
    """A log, a calibration and a map for each vehicle."""
    vehicles = sorted(set(selection.presence.vehicle.tolist()))
    heights = selection.bodies.height_m
    logs = [
        {
            "token": token("log", v),
            "logfile": selection.run.name,
            "vehicle": str(v),
            "date_captured": "2025-01-01",
            "location": "cosim",
        }
        for v in vehicles
    ]
    calibrations = []
    for vehicle in vehicles:
        height_m = float(heights[vehicle]) + selection.above_roof_m
        calibrations.append(
            {
                "token": token("calibrated_sensor", vehicle),
                "sensor_token": token("sensor"),
                "translation": [0.0, 0.0, height_m],
                "rotation": quaternion(-0.5 * np.pi),
                "camera_intrinsic": [],
            }
        )
    maps = [
        {
            "token": token("map"),
            "log_tokens": [log["token"] for log in logs],
            "category": "semantic_prior",
            "filename": "maps/empty.png",
        }
    ]
    return {"log": logs, "calibrated_sensor": calibrations, "map": maps}


def _scene(scene: NuScenesScene) -> Record:
    first, last = scene.steps[0], scene.steps[-1]
    return {
        "token": token("scene", scene.name),
        "log_token": token("log", scene.vehicle),
        "nbr_samples": len(scene.steps),
        "first_sample_token": token("sample", first, scene.vehicle),
        "last_sample_token": token("sample", last, scene.vehicle),
        "name": scene.name,
        "description": "",
    }


def _frames(selection: Selection, scenes: list[NuScenesScene]) -> dict[str, list[Record]]:
    """Samples, their data, poses, annotations and instances."""
    of = {(step, s.vehicle): s for s in scenes for step in s.steps}
    found: dict[str, list[Record]] = {
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
        "sample_annotation": [],
    }
    instances: dict[tuple[str, int], list[Record]] = {}
    kinds: dict[int, str] = {}
    for steps in selection.blocks():
        for moment in selection.moments(steps):
            kinds |= dict(zip(moment.actor.tolist(), moment.vehicle_class.tolist(), strict=True))
            for vehicle in selection.vehicles:
                if (scene := of.get((moment.step, vehicle))) is None:
                    continue
                _sample(found, selection, scene, moment)
                for annotation, actor in _annotations(moment, vehicle):
                    found["sample_annotation"].append(annotation)
                    instances.setdefault((scene.name, actor), []).append(annotation)
    found["instance"] = []
    for (name, actor), chain in instances.items():
        found["instance"].append(_instance(name, actor, kinds[actor], chain))
    return found


def _sample(found: dict[str, list[Record]], selection: Selection, scene: NuScenesScene, moment: Moment) -> None:
    """Append a sample, its cloud and its pose."""
    step, vehicle = moment.step, scene.vehicle
    at = bisect_left(scene.steps, step)
    before = scene.steps[at - 1] if at else None
    after = scene.steps[at + 1] if at + 1 < len(scene.steps) else None

    def linked(kind: str) -> dict[str, str]:
        """The tokens of the records before and after."""
        previous = "" if before is None else token(kind, before, vehicle)
        following = "" if after is None else token(kind, after, vehicle)
        return {"prev": previous, "next": following}

    since_1970_s = START_S + step * selection.run.dt_s
    time_us = round(since_1970_s * 1e6) + selection.vehicles.index(vehicle)
    sample, box = token("sample", step, vehicle), moment.box[moment.row(vehicle)]
    underside = [box[0], box[1], box[2] - 0.5 * box[5]]
    found["sample"].append(
        {
            "token": sample,
            "timestamp": time_us,
            **linked("sample"),
            "scene_token": token("scene", scene.name),
        }
    )
    found["ego_pose"].append(
        {
            "token": token("ego_pose", step, vehicle),
            "timestamp": time_us,
            "rotation": quaternion(box[6]),
            "translation": list(map(float, underside)),
        }
    )
    found["sample_data"].append(
        {
            "token": token("sample_data", step, vehicle),
            "sample_token": sample,
            "ego_pose_token": token("ego_pose", step, vehicle),
            "calibrated_sensor_token": token("calibrated_sensor", vehicle),
            "timestamp": time_us,
            "fileformat": "pcd",
            "is_key_frame": True,
            "height": 0,
            "width": 0,
            "filename": _cloud_path(step, vehicle),
            **linked("sample_data"),
        }
    )


def _annotations(moment: Moment, vehicle: int) -> Iterator[tuple[Record, int]]:
    """Annotations of a sample, and whom they are of. Chains of annotations are tied together later."""
    seen = moment.visible.get(vehicle, NOTHING)
    for i in np.flatnonzero(seen.n_points > 0).tolist():
        actor = int(seen.actor[i])
        row = moment.row(actor)
        box, kind = moment.box[row], str(moment.vehicle_class[row])
        length_m, width_m, height_m = box[3:6].tolist()
        share = seen.n_points[i] / max(1, seen.n_unoccluded[i])
        yield (
            {
                "token": token("sample_annotation", moment.step, vehicle, actor),
                "sample_token": token("sample", moment.step, vehicle),
                "instance_token": "",
                "visibility_token": str(1 + int(np.searchsorted([0.4, 0.6, 0.8], share, side="right"))),
                "attribute_tokens": [token("attribute", _attribute(kind, float(moment.speed_mps[row])))],
                "translation": box[:3].tolist(),
                "size": [width_m, length_m, height_m],
                "rotation": quaternion(box[6]),
                "prev": "",
                "next": "",
                "num_lidar_pts": int(seen.n_points[i]),
                "num_radar_pts": 0,
            },
            actor,
        )


def _attribute(kind: str, speed_mps: float) -> str:
    stands = speed_mps < STANDING_MPS
    if kind == "pedestrian":
        return "pedestrian.standing" if stands else "pedestrian.moving"
    if kind in ("bicycle", "motorcycle"):
        return "cycle.with_rider"
    return "vehicle.stopped" if stands else "vehicle.moving"


def _instance(name: str, actor: int, kind: str, chain: list[Record]) -> Record:
    """An instance; its annotations get their links."""
    mine = token("instance", name, actor)
    for annotation in chain:
        annotation["instance_token"] = mine
    for one, other in pairwise(chain):
        one["next"], other["prev"] = other["token"], one["token"]
    return {
        "token": mine,
        "category_token": token("category", CATEGORIES[kind]),
        "nbr_annotations": len(chain),
        "first_annotation_token": chain[0]["token"],
        "last_annotation_token": chain[-1]["token"],
    }
