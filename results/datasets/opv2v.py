"""OPV2V, V2XSet and V2V4Real, as OpenCOOD reads them.

Notes
-----
`SCENARIO/AGENT/%06d.yaml`, in a folder `train`, `validate` or `test` or not. `lidar_pose` is x, y, z, roll, yaw and
pitch in degrees, and then the objects of `vehicles` are in the world; or it is a matrix, as in V2V4Real, and then they
are in the frame of the agent's LiDAR. `location` and `center` add up to the middle of the box, `extent` is half of its
size, `angle` is roll, yaw and pitch. The same object has one number (`ass_id`, else its key) for all agents. The ego is
the agent whose name comes first as text.

Detections: `%06d_pred.npy` with corners [n, 8, 3] in the frame of the agent's LiDAR, as OpenCOOD saves predictions, and
`%06d_score.npy` [n] beside them.   Deviations: pitch and roll of objects are left out; all are of the class car.
"""

import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray

from results.datasets.recorded import (
    MOST_BOXES,
    MOST_FRAMES,
    Boxes,
    Recorded,
    array_of,
    box_of_corners,
    matrix,
    moved,
    numbers,
    pose_of,
    read_text,
)

_ON_FOOT = "pedestrian"


def stamps(folder: Path) -> dict[tuple[Path, str], dict[str, Path]]:
    """Annotation files by scenario and time stamp, then by agent."""
    found: dict[tuple[Path, str], dict[str, Path]] = defaultdict(dict)
    for path in sorted(folder.rglob("*.yaml")):
        if path.stem.isdigit() and len(path.relative_to(folder).parts) >= 2:
            found[path.parent.parent, path.stem][path.parent.name] = path
    if len(found) > MOST_FRAMES:
        raise ValueError(f"{folder} has {len(found):,} time stamps, more than {MOST_FRAMES:,}. Name one scenario.")
    return found


def read(folder: Path, detections: Path | None = None) -> Recorded:
    """A folder of scenarios.

    Parameters
    ----------
    detections
        Folder with the same tree that holds the detections; left out, they lie beside the annotations.
    """
    found = stamps(folder)
    frames, agents, poses, turns, clouds, truth, boxes = [], [], [], [], [], [], []
    for number, ((scenario, stamp), files) in enumerate(
        sorted(found.items(), key=lambda item: (item[0][0], item[0][1]))
    ):
        names, here, turn = tuple(sorted(files)), [], []
        objects: dict[str, ndarray] = {}
        for k, name in enumerate(names):
            about = _yaml(files[name])
            world_from_agent, is_local = _pose(about, files[name])
            here.append(pose_of(world_from_agent))
            turn.append(world_from_agent)
            for key, box in _objects(about, files[name]):
                objects.setdefault(key, moved(box[None], world_from_agent)[0] if is_local else box)
            place = files[name].relative_to(folder)
            beside = (detections or folder) / place.parent / f"{place.stem}_pred.npy"
            if beside.exists():
                corner = array_of(beside, (None, 8, 3))
                score = array_of(beside.with_name(f"{place.stem}_score.npy"), (len(corner),))
                for box, value in zip(
                    moved(box_of_corners(corner, beside), world_from_agent), score.tolist(), strict=True
                ):
                    boxes.append((number, k, "car", box, value))
        own = set(names)
        truth += [(number, -1, "car", box, 1.0) for key, box in objects.items() if key not in own]
        frames.append(f"{scenario.name}/{stamp}")
        agents.append(names)
        poses.append(np.array(here))
        turns.append(np.array(turn))
        clouds.append(tuple(files[name].with_suffix(".pcd") for name in names))
    return Recorded(
        "opv2v",
        tuple(frames),
        tuple(agents),
        tuple(poses),
        Boxes.of(truth),
        Boxes.of(boxes),
        tuple(turns),
        tuple(clouds),
    )


def _yaml(path: Path) -> dict[str, Any]:
    """A YAML file of plain data."""
    text = read_text(path)
    try:
        found = yaml.load(text, Loader=_Plain)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark is not None else ""
        raise ValueError(f"{path} is no plain YAML: {getattr(error, 'problem', None) or error}{where}.") from None
    except (RecursionError, ValueError, TypeError):
        raise ValueError(f"{path} is no plain YAML.") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path} should hold keys and values.")
    return found


class _Plain(yaml.SafeLoader):
    """Plain data without aliases, of which a small file can make a large value."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "it refers to another place of itself", event.start_mark)
        return super().compose_node(parent, index)


def _pose(about: dict[str, Any], path: Path) -> tuple[Float[ndarray, "4 4"], bool]:
    """The LiDAR's pose in the world, and whether objects are in its frame."""
    value = about.get("lidar_pose")
    if isinstance(value, list) and value and isinstance(value[0], list):
        return matrix(value, 4, 4, "lidar_pose", path), True
    x, y, z, roll, yaw, pitch = numbers(value, 6, "lidar_pose", path)
    return _transform(x, y, z, *np.radians([roll, yaw, pitch])), False


def _transform(x: float, y: float, z: float, roll: float, yaw: float, pitch: float) -> Float[ndarray, "4 4"]:
    """`x_to_world` of OpenCOOD."""
    c_y, s_y, c_r, s_r = math.cos(yaw), math.sin(yaw), math.cos(roll), math.sin(roll)
    c_p, s_p = math.cos(pitch), math.sin(pitch)
    return np.array(
        [
            [c_p * c_y, c_y * s_p * s_r - s_y * c_r, -c_y * s_p * c_r - s_y * s_r, x],
            [s_y * c_p, s_y * s_p * s_r + c_y * c_r, -s_y * s_p * c_r + c_y * s_r, y],
            [s_p, -c_p * s_r, c_p * c_r, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _objects(about: dict[str, Any], path: Path) -> list[tuple[str, Float[ndarray, "7"]]]:
    """Number and box of each object, in the frame in which the file has them."""
    listed = about.get("vehicles") or {}
    if not isinstance(listed, dict) or len(listed) > MOST_BOXES:
        raise ValueError(f"{path}: vehicles should be objects by number, at most {MOST_BOXES:,}.")
    found = []
    for key, one in listed.items():
        what = f"vehicles.{str(key)[:40]}"
        if not isinstance(one, dict):
            raise ValueError(f"{path}: {what} should hold angle, center, extent and location.")
        if str(one.get("obj_type", "car")).lower() == _ON_FOOT:
            continue
        angle, center, extent, location = (
            numbers(one.get(name), 3, f"{what}.{name}", path) for name in ("angle", "center", "extent", "location")
        )
        if (extent <= 0).any():
            raise ValueError(f"{path}: {what}.extent should be above 0.")
        same = one.get("ass_id", key)
        name = str(same if not isinstance(same, int) or same >= 0 else f"{path.parent.name}:{key}")
        found.append((name, np.array([*(location + center), *(2 * extent), math.radians(angle[1])])))
    return found
