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


class Bits:
    """Numbers one after another in bytes."""

    def __init__(self, content: bytes) -> None:
        self._text = "".join(f"{byte:08b}" for byte in content)
        self._at = 0

    def take(self, bits: int, low: int = 0) -> int:
        self._at += bits
        assert self._at <= len(self._text)
        return int(self._text[self._at - bits : self._at] or "0", 2) + low

    def rest(self) -> str:
        return self._text[self._at :]


def pcap(path: Path) -> list[dict]:
    """Ethernet frames with GeoNetworking and BTP-B, as EN 302 636-4-1 and -5-1 lay them out."""
    content, at, found = path.read_bytes(), 24, []
    assert content[:4] == bytes.fromhex("d4c3b2a1") and content[20] == 1
    while at < len(content):
        second, micro, n, length = (int.from_bytes(content[at + i : at + i + 4], "little") for i in (0, 4, 8, 12))
        frame = content[at + 16 : at + 16 + n]
        assert n == length == len(frame) and frame[12:14] == bytes.fromhex("8947")
        geo = Bits(frame[14:])
        assert [geo.take(b) for b in (4, 4, 8, 6, 2, 8)] == [1, 1, 0, 1, 1, 1]
        assert [geo.take(b) for b in (4, 4, 4, 4)] == [2, 0, 5, 0]
        traffic_class, flags, payload, hops, _ = (geo.take(b) for b in (8, 8, 16, 8, 8))
        manual, kind, _ = geo.take(1), geo.take(5), geo.take(10)
        mac, stamp = geo.take(48), geo.take(32)
        lat, lon = (v - 2**32 if v >= 2**31 else v for v in (geo.take(32), geo.take(32)))
        _, speed, heading, medium = geo.take(1), geo.take(15), geo.take(16), geo.take(32)
        port, info = geo.take(16), geo.take(16)
        assert (flags, hops, manual, medium, info) == (0x80, 1, 1, 0, 0) and payload == n - 54
        assert mac == int.from_bytes(frame[6:12])
        found.append({
            "time_s": second + micro / 1e6, "type": kind, "station": mac & 0xFFFFFFFF, "stamp_ms": stamp, "lat": lat,
            "lon": lon, "speed": speed - 2**15 if speed >= 2**14 else speed, "heading": heading, "port": port,
            "traffic_class": traffic_class, "message": frame[58:],
        })  # fmt: skip
        at += 16 + n
    return found


def _place(bits: Bits) -> dict:
    lat, lon = bits.take(31, -900000000), bits.take(32, -1800000000)
    assert [bits.take(b) for b in (12, 12, 12, 20, 4)] == [4095, 4095, 3601, 900001, 15]
    return {"lat": lat, "lon": lon}


def cam(message: bytes) -> dict:
    """A CAM without optional containers, by the widths of EN 302 637-2."""
    bits = Bits(message)
    assert [bits.take(8), bits.take(8)] == [2, 2]
    out = {"station": bits.take(32), "delta_ms": bits.take(16)}
    assert bits.take(3) == 0 and bits.take(1) == 0
    out |= {"type": bits.take(8), **_place(bits)}
    assert bits.take(2) == 0 and bits.take(7) == 0
    out |= {"heading": bits.take(12), "heading_sure": bits.take(7, 1), "speed": bits.take(14)}
    out |= {"speed_sure": bits.take(7, 1), "direction": bits.take(2)}
    out |= {"length": bits.take(10, 1), "trailer": bits.take(3)}
    out |= {"width": bits.take(6, 1), "acceleration": bits.take(9, -160), "acceleration_sure": bits.take(7)}
    out |= {"curvature": bits.take(11, -1023), "curvature_sure": bits.take(3), "mode": bits.take(3)}
    out |= {"yaw_rate": bits.take(16, -32766), "yaw_rate_sure": bits.take(4)}
    assert set(bits.rest()) <= {"0"} and len(bits.rest()) < 8
    return out


def cpm(message: bytes) -> dict:
    """A CPM with vehicle, sensor and object containers, by the widths of TS 103 324."""
    bits = Bits(message)
    assert [bits.take(8), bits.take(8)] == [2, 14]
    out = {"station": bits.take(32)}
    assert bits.take(1) == 0 and bits.take(1) == 0
    is_segment = bits.take(1)
    assert bits.take(1) == 0
    out |= {"time_ms": bits.take(42), **_place(bits)}
    out["segment"] = (bits.take(3, 1), bits.take(3, 1)) if is_segment else None
    n_containers = bits.take(3, 1)
    assert bits.take(4, 1) == 1 and bits.take(8) == 3 and bits.take(4) == 0
    out |= {"heading": bits.take(12), "heading_sure": bits.take(7, 1)}
    assert bits.take(1) == 0
    out["range"] = None
    if n_containers == 3:
        assert bits.take(4, 1) == 3 and bits.take(8) == 6
        assert [bits.take(b) for b in (8, 3, 8, 5, 4, 2)] == [0, 0b010, 1, 2, 1, 0]
        out["range"] = bits.take(12)
        assert bits.take(1) == 1 and bits.take(5) == 0
    else:
        assert n_containers == 2
    assert bits.take(4, 1) == 5
    length = bits.take(15) if bits.take(1) else bits.take(7)
    assert len(bits.rest()) // 8 == length
    assert bits.take(1) == 0
    out["n_objects"] = bits.take(8)
    assert bits.take(1) == 0
    out["objects"] = [_object(bits) for _ in range(bits.take(8))]
    assert set(bits.rest()) <= {"0"} and len(bits.rest()) < 16
    return out


def _object(bits: Bits) -> dict:
    assert bits.take(1) == 0
    there = bits.take(14)
    assert there & ~(1 << 12) == 0b10010011100110 & ~(1 << 12)
    out = {"number": bits.take(16), "delta_ms": bits.take(12, -2048)}
    assert bits.take(1) == 1
    sure = {}
    for axis in "xyz":
        out[axis] = bits.take(18, -131072)
        sure[axis] = bits.take(12, 1)
    out["velocity"] = None
    if there >> 12 & 1:
        assert bits.take(2) == 0b10
        axes = [(bits.take(15, -16383), bits.take(7, 1)) for _ in "xy"]
        out["velocity"], sure["velocity"] = zip(*axes, strict=True)
    assert bits.take(2) == 0
    out["angle"] = bits.take(12)
    sure["angle"] = bits.take(7, 1)
    for side in ("height", "width", "length"):
        out[side] = bits.take(8, 1)
        sure[side] = bits.take(5, 1)
    if sure != {"x": 4096, "y": 4096, "z": 4096, "angle": 127, "height": 32, "width": 32, "length": 32} | (
        {"velocity": (127, 127)} if out["velocity"] else {}
    ):  # not all unavailable
        out["confidence"] = sure
    assert [bits.take(b) for b in (1, 7, 8, 3, 1)] == [0, 0, 1, 0, 0]
    if bits.take(2) == 0:
        out["class"] = {5: "car", 8: "truck"}[bits.take(4)]
    else:
        assert bits.take(1) == 0
        out["class"], value = ("cyclist", bits.take(4)) if bits.take(2) else ("pedestrian", bits.take(3))
        assert value == 1
    out["sure"] = bits.take(7, 1)
    return out
