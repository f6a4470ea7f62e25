"""DAIR-V2X-C: vehicle and roadside unit, as OpenDAIRV2X reads it.

Notes
-----
`cooperative/data_info.json` lists pairs of a vehicle's and a roadside unit's cloud with their label, whose
`world_8_points` are corners in the world. `lidar_to_novatel` and `novatel_to_world` lead from the vehicle's LiDAR to
the world, `virtuallidar_to_world` from the roadside unit's, which `system_error_offset` of the pair shifts. The vehicle
is the ego.

Detections: `veh/lidar/ID.json` and `inf/lidar/ID.json` in the folder of detections, with `boxes_3d` [n, 8, 3] in the
frame of the LiDAR, `labels_3d` and `scores_3d`. OpenDAIRV2X writes these fields as pickles. Pickles of strangers run
code, so they are not read: write them as JSON.   Deviations: `labels_3d` may be names; numbers are those of OpenDAIRV2X
(2 is a car).
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.perception.recorded import (
    MOST_BOXES,
    MOST_FRAMES,
    Recorded,
    RecordedBoxes,
    box_of_corners,
    class_of,
    matrix,
    moved,
    number,
    numbers,
    pose_of,
    read_json,
    rigid,
    scores,
    upright,
)

INDEX = "cooperative/data_info.json"
AGENTS = ("vehicle", "roadside unit")
_NAMES = {0: "pedestrian", 1: "cyclist", 2: "car"}


def root_of(folder: Path) -> Path | None:
    """The folder of the cooperative data set, if there is one."""
    for place in (folder, folder / "cooperative-vehicle-infrastructure"):
        if (place / INDEX).is_file():
            return place
    return None


def read(folder: Path, detections: Path | None = None, ego: str | None = None) -> Recorded:
    """The cooperative data set in a folder.

    Parameters
    ----------
    detections
        Folder with `veh/lidar` and `inf/lidar`; left out, `detections` beside the data.
    ego
        The agent that is the ego; left out, the vehicle.
    """
    root = root_of(folder) or folder
    index = read_json(root / INDEX)
    if not isinstance(index, list) or len(index) > MOST_FRAMES:
        raise ValueError(f"{root / INDEX} should be a list of at most {MOST_FRAMES:,} pairs.")
    if ego is not None and ego not in AGENTS:
        raise ValueError(f"--ego {ego}: there is no such agent in {folder}. There are: {', '.join(AGENTS)}.")
    order = [1, 0] if ego == AGENTS[1] else [0, 1]
    beside = detections or root / "detections"
    frames, poses, turns, clouds = [], [], [], []
    truth, found, missing = [], [], []
    classes: Counter[tuple[str, str]] = Counter()
    for frame, pair in enumerate(index):
        car, unit, label = (
            _path(pair, key, root)
            for key in (
                "vehicle_pointcloud_path",
                "infrastructure_pointcloud_path",
                "cooperative_label_path",
            )
        )
        side = root / "vehicle-side/calib"
        world_from = [
            _transform(side / f"novatel_to_world/{car.stem}.json")
            @ _transform(side / f"lidar_to_novatel/{car.stem}.json"),
            _transform(root / f"infrastructure-side/calib/virtuallidar_to_world/{unit.stem}.json"),
        ]
        world_from[1][:2, 3] += _shift(pair, root)
        frames.append(label.as_posix())
        poses.append(np.array([pose_of(world_from[k]) for k in order]))
        turns.append(np.array([world_from[k] for k in order]))
        both = root / car, root / unit
        clouds.append(tuple(both[k] for k in order))
        for name, box in _labels(root / label):
            classes[name, class_of(name)] += 1
            truth.append((frame, -1, class_of(name), box, 1.0))
        paths = beside / f"veh/lidar/{car.stem}.json", beside / f"inf/lidar/{unit.stem}.json"
        for k, agent in enumerate(order):
            if not paths[agent].exists():
                missing.append(paths[agent])
                continue
            for name, box, score in _boxes(paths[agent], world_from[agent]):
                found.append((frame, k, name, box, score))
    if twice := [name for name, n in Counter(frames).items() if n > 1]:
        raise ValueError(f"{root / INDEX} has the label {twice[0]} in two pairs. Each would count twice.")
    remarks = (
        f"{len(missing):,} of {2 * len(index):,} files of detections are missing, such as "
        f"{missing[0] if missing else ''}: these agents count as if they detected nothing."
    )
    return Recorded(
        layout="dair-v2x",
        frames=tuple(Path(name).stem for name in frames),
        agents=(tuple(AGENTS[k] for k in order),) * len(frames),
        pose=tuple(poses),
        truth=RecordedBoxes.of(truth),
        aside=RecordedBoxes.of([]),
        found=RecordedBoxes.of(found),
        has_classes=True,
        classes=classes,
        remarks=(remarks,) * (0 < len(missing) < 2 * len(index)),
        world_from=tuple(turns),
        clouds=tuple(clouds),
    )


def _shift(pair: dict[str, Any], root: Path) -> Float[ndarray, "2"]:
    """By how much the roadside unit of a pair lies beside its calibration: east and north."""
    offset = pair.get("system_error_offset") or {}
    if not isinstance(offset, dict):
        raise ValueError(f"{root / INDEX}: system_error_offset should hold delta_x and delta_y.")
    east_m = number(offset.get("delta_x", 0.0), "delta_x", root / INDEX)
    north_m = number(offset.get("delta_y", 0.0), "delta_y", root / INDEX)
    return np.array([east_m, north_m])


def _path(pair: Any, key: str, root: Path) -> Path:
    """A relative path inside the data set."""
    value = pair.get(key) if isinstance(pair, dict) else None
    path = Path(value) if isinstance(value, str) else Path("/")
    if path.is_absolute() or ".." in path.parts or "\0" in str(path):
        raise ValueError(f"{root / INDEX}: {key} should be a relative path inside the data set.")
    return path


def _transform(path: Path) -> Float[ndarray, "4 4"]:
    about = read_json(path)
    about = about.get("transform", about) if isinstance(about, dict) else {}
    about = about if isinstance(about, dict) else {}
    out = np.eye(4)
    out[:3, :3] = matrix(about.get("rotation"), 3, 3, "rotation", path)
    shift = about.get("translation")
    if isinstance(shift, list):
        shift = list(map(_single, shift))
    out[:3, 3] = numbers(shift, 3, "translation", path)
    return rigid(out, "rotation", path)


def _single(value: Any) -> Any:
    """The number in a list of one number; anything else as it is."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value


def _labels(path: Path) -> list[tuple[str, Float[ndarray, "7"]]]:
    listed = read_json(path)
    if not isinstance(listed, list) or len(listed) > MOST_BOXES:
        raise ValueError(f"{path} should be a list of at most {MOST_BOXES:,} objects.")
    found = []
    for n, one in enumerate(listed):
        if not isinstance(one, dict):
            raise ValueError(f"{path}: object {n} should hold type and world_8_points.")
        corner = matrix(one.get("world_8_points"), 8, 3, f"world_8_points of object {n}", path)
        box = upright(box_of_corners(corner[None], path), path)[0]
        found.append((str(one.get("type"))[:40], box))
    return found


def _boxes(
    path: Path,
    world_from_agent: Float[ndarray, "4 4"],
) -> list[tuple[str, Float[ndarray, "7"], float]]:
    about = read_json(path)
    listed = about.get("boxes_3d") if isinstance(about, dict) else None
    if not isinstance(listed, list) or len(listed) > MOST_BOXES:
        raise ValueError(f"{path}: boxes_3d should be a list of at most {MOST_BOXES:,} boxes of 8 corners.")
    corners = [matrix(one, 8, 3, "boxes_3d", path) for one in listed]
    corner = np.array(corners).reshape(-1, 8, 3)
    score = scores(numbers(about.get("scores_3d"), len(listed), "scores_3d", path), path)
    names = about.get("labels_3d")
    if not isinstance(names, list) or len(names) != len(listed):
        raise ValueError(f"{path}: labels_3d should be a list of {len(listed)} classes.")
    boxes = moved(upright(box_of_corners(corner, path), path), world_from_agent)
    kinds = [_NAMES.get(name, "other") if isinstance(name, int) else class_of(name) for name in names]
    return list(zip(kinds, boxes, score.tolist(), strict=True))
