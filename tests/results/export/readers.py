"""Readers of the export layouts, written from their conventions and sharing no code with the exporters."""

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image


def kitti_labels(path: Path) -> list[dict]:
    """Lines of a label or result file as numbers."""
    found = []
    for line in path.read_text().splitlines():
        word = line.split()
        number = [float(w) for w in word[1:]]
        found.append({
            "type": word[0], "truncated": number[0], "occluded": number[1], "alpha": number[2], "rect": number[3:7],
            "h": number[7], "w": number[8], "l": number[9], "t": number[10:13], "ry": number[13], "rest": number[14:],
        })  # fmt: skip
    return found


def openpcdet_info(root: Path, split: str, name: str) -> dict:
    """A frame as OpenPCDet's `KittiDataset.get_infos` reads it, with its asserts and its silent assumptions.

    Notes
    -----
    Of `pcdet/datasets/kitti/kitti_dataset.py`, `pcdet/utils/object3d_kitti.py` and `calibration_kitti.py`: the four
    files exist, lines 2 to 5 of the calibration are P2, P3, R0 and Tr whatever their names, words are parted by one
    blank, and there is at least one label, DontCare regions coming last.
    """
    folder = root / ("testing" if split == "test" else "training")
    cloud, picture = folder / f"velodyne/{name}.bin", folder / f"image_2/{name}.png"
    calib, label = folder / f"calib/{name}.txt", folder / f"label_2/{name}.txt"
    assert cloud.exists()
    assert picture.exists()
    assert calib.exists()
    rows = [np.array(line.strip().split(" ")[1:], np.float32) for line in calib.read_text().splitlines(keepends=True)]
    out = {"points": np.fromfile(cloud, np.float32).reshape(-1, 4), "P2": rows[2].reshape(3, 4)}
    out |= {"P3": rows[3].reshape(3, 4), "R0": rows[4].reshape(3, 3), "Tr": rows[5].reshape(3, 4)}
    with Image.open(picture) as opened:
        opened.load()
        assert opened.mode == "RGB"
        out["image_shape"] = (opened.height, opened.width)
    if split == "test":
        return out
    assert label.exists()
    objects = [line.strip().split(" ") for line in label.read_text().splitlines()]
    out["names"] = np.array([words[0] for words in objects])
    out["bbox"] = np.concatenate([np.array(words[4:8], np.float32).reshape(1, 4) for words in objects], axis=0)
    out["location"] = np.concatenate([np.array(words[11:14], np.float32).reshape(1, 3) for words in objects], axis=0)
    n_objects = sum(words[0] != "DontCare" for words in objects)
    kept = [i for i, words in enumerate(objects) if words[0] != "DontCare"]
    assert kept == list(range(n_objects)), "the first rows are taken for the objects"
    homogeneous = np.hstack([out["location"][:n_objects], np.ones((n_objects, 1))])
    velo_to_rect = np.vstack([out["R0"] @ out["Tr"], [0, 0, 0, 1]])
    out["lidar_m"] = (homogeneous @ np.linalg.inv(velo_to_rect).T)[:, :3]
    out["lidar_m"][:, 2] += np.array([float(words[8]) for words in objects[:n_objects]]) / 2
    return out


def kitti_in_velodyne(label: dict, calib: Path) -> list[float]:
    """Centre, size and heading of a label in the LiDAR's frame, by way of the calibration file."""
    rows = dict(line.split(":", 1) for line in calib.read_text().splitlines() if line)
    turn = np.array(rows["Tr_velo_to_cam"].split(), float).reshape(3, 4)
    bottom = turn[:, :3].T @ (np.array(label["t"]) - turn[:, 3])
    # rotation_y turns the length axis from the camera's x towards -z; the camera looks along the LiDAR's x
    along = turn[:, :3].T @ np.array([math.cos(label["ry"]), 0.0, -math.sin(label["ry"])])
    centre = [bottom[0], bottom[1], bottom[2] + label["h"] / 2]
    return [*centre, label["l"], label["w"], label["h"], math.atan2(along[1], along[0])]


def velodyne(path: Path) -> np.ndarray:
    """Points of a .bin file."""
    return np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 4)


def to_world(box: list[float], pose: list[float]) -> np.ndarray:
    """A box of the LiDAR's frame in the world's; pose is x, y, z, yaw."""
    x, y, z = box[:3]
    turn = complex(math.cos(pose[3]), math.sin(pose[3])) * complex(x, y)
    return np.array([pose[0] + turn.real, pose[1] + turn.imag, pose[2] + z, *box[3:6], box[6] + pose[3]])


def pcd(path: Path) -> np.ndarray:
    """Points of a binary .pcd with four floats each."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    rows = dict(line.split(" ", 1) for line in head.decode().splitlines())
    assert rows["FIELDS"] == "x y z rgb" and rows["SIZE"] == "4 4 4 4"
    return np.frombuffer(body, "<f4").reshape(int(rows["POINTS"]), 4)


def opv2v_yaml(path: Path) -> dict:
    """A file of one time stamp, for the few forms of YAML in it."""
    out: dict = {}
    vehicle: dict = {}
    for line in path.read_text().splitlines():
        key, _, value = line.strip().partition(":")
        depth = len(line) - len(line.lstrip())
        parsed = json.loads(value) if value.strip() else {}
        if depth == 0:
            out[key] = parsed
        elif depth == 2:
            vehicle = out["vehicles"][int(key)] = {}
        else:
            vehicle[key] = parsed
    return out


def opv2v_box(vehicle: dict) -> np.ndarray:
    """Centre, whole size and yaw of a vehicle, as OpenCOOD composes them (roll and pitch 0)."""
    roll, yaw, pitch = np.radians(vehicle["angle"])
    assert roll == pitch == 0
    cos, sin = math.cos(yaw), math.sin(yaw)
    offset = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.array(vehicle["center"])
    return np.array([*(np.array(vehicle["location"]) + offset), *(2 * np.array(vehicle["extent"])), yaw])


def trupercept_to_world(label: dict, position: Path) -> np.ndarray:
    """Underside and heading of a label in the world, as the published code turns them."""
    rows = np.array([[float(w) for w in line.split()] for line in position.read_text().splitlines()])
    camera, forward, right, up = rows[1], rows[2], rows[3], rows[4]
    x, y, z = label["t"]
    at = camera + x * right + z * forward - y * up
    along = math.cos(label["ry"]) * right - math.sin(label["ry"]) * forward
    return np.array([*at, math.atan2(along[1], along[0])])


def json_lines(path: Path) -> list[dict]:
    """One object per line."""
    return [json.loads(line) for line in path.read_text().splitlines()]
