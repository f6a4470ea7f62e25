"""KITTI's object and tracking benchmarks.

Notes
-----
`object/training` holds `velodyne/%06d.bin`, `image_2/%06d.png`, `calib/%06d.txt` and `label_2/%06d.txt`.
`object/results/%06d.txt` are the detections as transmitted, without self reports, in the 16 columns of results. They
are where the LiDAR measured them: the error of the vehicle's own pose does not displace them. Frames
are numbered over all vehicles; `object/frames.csv` says which vehicle and step each one is.

`object/ImageSets` splits the frames by time: the first half of the steps is `train`, the next quarter `val`, the last
quarter `test`; `trainval` is the first two together. The frames of `test` are in `object/testing` too, as links and
without labels, because loaders look for them there.

`tracking/training` has one sequence for each stay of a vehicle on the road (`tracking/sequences.csv`). The track is
the number of the actor. Its clouds are links to those of `object`.

The camera stands where the LiDAR does, with 1,920 x 1,080 pixels on 90 degrees. There are no real images: `image_2`
holds one black image of that size, linked for every frame, because loaders ask for its shape.

An object is labelled if it gave at least one return and is in the image. An object in the image that gave none because
something stands in between is a DontCare region, after all labels of its frame. A frame with neither has one DontCare
region of no area, because common loaders fail at an empty label file. Occlusion is 0, 1 or 2 if up to 20 %, up to 50 %
or more of an object's returns are lost to what stands in between. Where the LiDAR turns (`lidar.rotation_hz`), labels
are of the moment in which it looks ahead; what moves is elsewhere when it looks there, by up to half a turn's way.

Deviations: buses are trucks, motorcycles are cyclists, and the reflectance is 0.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.addons.export.frames import FOCAL_PX, IMAGE_PX, InCamera, in_camera, in_sensor
from results.moments import BOX, NOTHING, Cloud, Clouds, File, Moment, Plan, Selection, Unit, units_of_steps
from results.sensing import interval_steps
from results.spreadsheet import csv_of

TABLES = ("actors", "vehicles", "observability", "detections", "pseudonyms")

TYPE_OF = {
    "car": "Car",
    "van": "Van",
    "truck": "Truck",
    "bus": "Truck",
    "motorcycle": "Cyclist",
    "bicycle": "Cyclist",
    "cyclist": "Cyclist",
    "pedestrian": "Pedestrian",
}
"""KITTI's types by vehicle class and by class of detected objects."""

DONT_CARE = "DontCare -1 -1 -10"
"""Type, truncation, occlusion and alpha of a region without labels, as the benchmark's own files have them."""

NO_REGION = f"{DONT_CARE} 0 0 0 0 -1 -1 -1 -1000 -1000 -1000 -10"
"""The line of a frame without any object: it overlaps nothing."""

NO_TRACK = f"0 -1 {DONT_CARE} 0 0 0 0 -1000 -1000 -1000 -10 -1 -1 -1"
"""The line of a sequence without any object. The last seven columns are in the order of the benchmark's files."""

TEXT_BYTES = 2600
"""Of a frame's labels, results and calibration, roughly."""


FIRST_IMAGE = "object/training/image_2/000000.png"
"""The image that those of all other frames are links to."""


@dataclass(frozen=True, kw_only=True)
class Params:
    """What is written beside clouds, labels and calibration."""

    images: bool = True
    """Whether every frame gets a black image in `image_2`."""


class Kitti:
    """KITTI's object and tracking benchmarks."""

    Params = Params
    TABLES = TABLES

    def __init__(self, params: Params | None = None) -> None:
        self._params = params or Params()

    def plan(self, selection: Selection) -> Plan:
        """The image, frames in blocks of steps, then what links to them, then the sequences."""
        frames, images = selection.presence, self._params.images
        units = []
        if images:
            units.append(Unit("image", lambda clouds: iter([File(FIRST_IMAGE, image)])))
        units += units_of_steps(selection.blocks(), partial(_block, selection))
        units.append(Unit("image sets", partial(_image_sets, selection, images)))
        units.append(Unit("sequences", partial(_sequences, selection)))
        return Plan(tuple(units), len(frames), 16, len(frames) * TEXT_BYTES)


def _block(selection: Selection, steps: Int[ndarray, "b"], clouds: Clouds) -> Iterator[File]:
    number = _numbers(selection)
    for moment in selection.moments(steps):
        here = [v for v in selection.vehicles if (moment.step, v) in number]
        for vehicle, cloud in zip(here, clouds(moment.step, here), strict=True):
            name = f"{number[moment.step, vehicle]:06d}"
            pose = selection.pose(moment, vehicle)
            yield File(f"object/training/velodyne/{name}.bin", partial(velodyne, cloud))
            yield File(f"object/training/calib/{name}.txt", lambda: calibration().encode())
            yield File(f"object/training/label_2/{name}.txt", partial(_labels, moment, vehicle, pose))
            believed = selection.believed_pose(moment, vehicle)
            yield File(f"object/results/{name}.txt", partial(_results, moment, vehicle, believed))


def image(size_px: tuple[int, int] = IMAGE_PX) -> bytes:
    """A black image, of the camera's size by default, as PNG with 8 bits for each of red, green and blue."""
    width, height = size_px
    rows = bytes(height * (1 + 3 * width))  # each row begins with the number of its filter, 0
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks:
        content += struct.pack(">I", len(data)) + kind + data
        content += struct.pack(">I", zlib.crc32(kind + data))
    return content


def image_sets(step: Int[ndarray, "n"]) -> dict[str, Int[ndarray, "k"]]:
    """Numbers of the frames in each set, by the time of the frames.

    Parameters
    ----------
    step
        Step of each frame, in the order in which the frames are numbered.

    Returns
    -------
    By name of the set, the numbers of its frames, ascending: `train` is the first half of the steps, `val` the next
    quarter, `test` the last quarter, and `trainval` the first two together.
    """
    steps, number = np.unique(step, return_inverse=True)
    half = -(-len(steps) // 2)
    three_quarters = -(-3 * len(steps) // 4)
    part = np.searchsorted([half, three_quarters], number, "right")
    sets = {"train": part == 0, "val": part == 1, "trainval": part < 2, "test": part == 2}
    return {name: np.flatnonzero(inside) for name, inside in sets.items()}


def _image_sets(selection: Selection, images: bool, clouds: Clouds) -> Iterator[File]:
    """The images but the first, the lists of frames, and the frames of the test set once more."""
    sets = image_sets(selection.presence.step.to_numpy(np.int64))
    for number in range(1, len(selection.presence) if images else 0):
        yield File(f"object/training/image_2/{number:06d}.png", lambda: b"", same_as=FIRST_IMAGE)
    for name, numbers in sets.items():
        listed = "".join(f"{number:06d}\n" for number in numbers.tolist())
        yield File(f"object/ImageSets/{name}.txt", listed.encode)
    kinds = ["velodyne/{:06d}.bin", "calib/{:06d}.txt", *(["image_2/{:06d}.png"] if images else [])]
    for number in sets["test"].tolist():
        for path in (kind.format(number) for kind in kinds):
            yield File(f"object/testing/{path}", lambda: b"", same_as=f"object/training/{path}")


def _labels(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> bytes:
    lines = labels(moment, vehicle, pose).lines + [
        f"{DONT_CARE} {_pixels(one)} -1 -1 -1 -1000 -1000 -1000 -10" for one in unlabelled(moment, vehicle, pose)
    ]
    return "".join(f"{line}\n" for line in lines or [NO_REGION]).encode()


def _results(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> bytes:
    return "".join(f"{line}\n" for line in results(moment, vehicle, pose)).encode()


def velodyne(cloud: Cloud) -> bytes:
    """float32 x, y, z, reflectance; sensor frame: x forward, y left, z up."""
    points = cloud()
    reflectance = np.zeros(len(points), np.float32)
    return np.column_stack([points, reflectance]).astype("<f4").tobytes()


def calibration(end: str = "\n") -> str:
    """The camera at the LiDAR's place: x right, y down, z forward."""
    f, (width, height) = FOCAL_PX, IMAGE_PX
    x, y = width / 2, height / 2
    p = f"{f:g} 0 {x:g} 0 0 {f:g} {y:g} 0 0 0 1 0"
    lines = [f"P{i}: {p}" for i in range(4)]
    lines += ["R0_rect: 1 0 0 0 1 0 0 0 1", "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0"]
    return end.join([*lines, "Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0", ""])


class Labels:
    """Objects in the image of a vehicle's camera, with their lines in a label file."""

    def __init__(self, actor: ndarray, speed_mps: ndarray, n_points: ndarray, lines: list[str]) -> None:
        self.actor, self.speed_mps, self.n_points, self.lines = actor, speed_mps, n_points, lines


def labels(moment: Moment, vehicle: int, pose: Float[ndarray, "4"], hidden: bool = False) -> Labels:
    """Objects in the image that gave at least one return, with their labels.

    Parameters
    ----------
    moment, vehicle
        A step, and the number of a vehicle on the road in it.
    pose
        x, y, z and yaw of the vehicle's LiDAR, world frame.
    hidden
        Whether to add objects in the image that gave no return because something stands in between. Their occlusion is
        3.

    Returns
    -------
    The labels, in the order of the actors' numbers.
    """
    seen = moment.visible.get(vehicle, NOTHING)
    rows = np.searchsorted(moment.actor, seen.actor)
    n_points = seen.n_points
    camera = in_camera(in_sensor(moment.box[rows], pose))
    keep = camera.is_in_image & (hidden | (n_points > 0))
    lost = 1 - n_points / np.maximum(seen.n_unoccluded, 1)
    level = (lost > 0.2).astype(int) + (lost > 0.5)
    level = np.where(n_points > 0, level, 3)
    types = [TYPE_OF[c] for c in moment.vehicle_class[rows]]
    lines = lines_of(types, camera, moment.box[rows], keep, level)
    rows = rows[keep]
    return Labels(moment.actor[rows], moment.speed_mps[rows], n_points[keep], lines)


def unlabelled(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> Float[ndarray, "k 4"]:
    """Objects in the image that gave no return because something stands in between.

    Parameters
    ----------
    moment, vehicle
        A step, and the number of a vehicle on the road in it.
    pose
        x, y, z and yaw of the vehicle's LiDAR, world frame.

    Returns
    -------
    Left, top, right and bottom of each object's rectangle inside the image [px].
    """
    seen = moment.visible.get(vehicle, NOTHING)
    rows = np.searchsorted(moment.actor, seen.actor[seen.n_points == 0])
    camera = in_camera(in_sensor(moment.box[rows], pose))
    return camera.image_px[camera.is_in_image]


def _pixels(rectangle: Float[ndarray, "4"]) -> str:
    return " ".join(f"{x:.4f}" for x in rectangle)


def results(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> list[str]:
    """Lines of a result file: the detections that a vehicle transmitted, without its self report.

    Parameters
    ----------
    moment, vehicle
        A step, and the number of a vehicle on the road in it.
    pose
        x, y, z and yaw of the vehicle's LiDAR as the vehicle believes, world frame.

    Returns
    -------
    A line for each detection in the image; none if the vehicle transmitted nothing.
    """
    sent = moment.detections.get(vehicle)
    if sent is None:
        return []
    sent = sent[sent.origin != "self"]
    box = sent[BOX].to_numpy(float)
    camera = in_camera(in_sensor(box, pose))
    types = [TYPE_OF[c] for c in sent["class"].astype(object)]
    return lines_of(types, camera, box, camera.is_in_image, None, sent.score.to_numpy(float))


def lines_of(
    types: list[str],
    camera: InCamera,
    box: Float[ndarray, "n 7"],
    keep: Bool[ndarray, "n"],
    occluded: Int[ndarray, "n"] | None = None,
    score: Float[ndarray, "n"] | None = None,
) -> list[str]:
    """Lines of a label file or of a result file.

    Parameters
    ----------
    types
        KITTI's type of each box.
    camera, box
        The boxes in the camera's view, and in any frame: only their sizes are read.
    keep
        Boxes that get a line.
    occluded
        Level of occlusion of each box. Left out, occlusion and truncation are -1, as in results.
    score
        Score of each box: the last column of a result.

    Returns
    -------
    A line for each kept box, in their order: 15 columns, and 16 with scores.
    """
    out = []
    for i in np.flatnonzero(keep).tolist():
        length, width, height = box[i, 3:6]
        place = (height, width, length, *camera.bottom_m[i], camera.rotation_y[i])
        numbers = [camera.alpha[i], *camera.image_px[i], *place]
        if score is not None:
            numbers.append(score[i])
        head = "-1 -1" if occluded is None else f"{camera.truncated[i]:.2f} {occluded[i]}"
        columns = [f"{number:.4f}" for number in numbers]
        out.append(" ".join([types[i], head, *columns]))
    return out


def _numbers(selection: Selection) -> dict[tuple[int, int], int]:
    frames = selection.presence
    keys = zip(frames.step.tolist(), frames.vehicle.tolist(), strict=True)
    return {key: number for number, key in enumerate(keys)}


def sequences_of(selection: Selection) -> pd.DataFrame:
    """Frames by sequence, which is a vehicle in consecutive sweeps: step, vehicle, number over all, sequence, frame."""
    frames = selection.presence.assign(number=np.arange(len(selection.presence)))
    frames = frames.sort_values(["vehicle", "step"], ignore_index=True)
    every = interval_steps(selection.run, frames.vehicle.to_numpy())
    starts = (frames.vehicle.diff() != 0) | (frames.step.diff() != every)
    sequence = starts.cumsum() - 1
    return frames.assign(sequence=sequence, frame=frames.groupby(sequence).cumcount())


def _sequences(selection: Selection, clouds: Clouds) -> Iterator[File]:
    """Everything of the tracking benchmark, and the tables that say what the numbers are."""
    frames = sequences_of(selection)
    which: dict[tuple[Any, Any], tuple[Any, Any]] = {}
    text: dict[Any, list[str]] = {}
    for f in frames.itertuples():
        which[f.step, f.vehicle] = f.sequence, f.frame
        text[f.sequence] = []
    for steps in selection.blocks():
        for moment in selection.moments(steps):
            for vehicle in selection.vehicles:
                if (moment.step, vehicle) not in which:
                    continue
                sequence, frame = which[moment.step, vehicle]
                pose = selection.pose(moment, vehicle)
                found = labels(moment, vehicle, pose)
                for actor, line in zip(found.actor, found.lines, strict=True):
                    text[sequence].append(f"{frame} {actor} {line}\n")
                for one in unlabelled(moment, vehicle, pose):
                    text[sequence].append(f"{frame} -1 {DONT_CARE} {_pixels(one)} -1000 -1000 -1000 -10 -1 -1 -1\n")
    for sequence, lines in text.items():
        content = "".join(lines) or f"{NO_TRACK}\n"
        yield File(f"tracking/training/label_02/{sequence:04d}.txt", content.encode)
        yield File(f"tracking/training/calib/{sequence:04d}.txt", lambda: calibration().encode())
    for f in frames.itertuples():
        path = f"tracking/training/velodyne/{f.sequence:04d}/{f.frame:06d}.bin"
        yield File(path, lambda: b"", same_as=f"object/training/velodyne/{f.number:06d}.bin")
    columns = ["sequence", "frame", "step", "vehicle"]
    yield File("tracking/sequences.csv", partial(csv_of, frames[columns]))
    whole = frames.sort_values("number").rename(columns={"frame": "_", "number": "frame"})
    yield File("object/frames.csv", partial(csv_of, whole[["frame", "step", "vehicle"]]))
    yield File("vehicles.csv", partial(names_csv, selection))


def names(selection: Selection) -> Unit:
    """The unit of work that writes who the numbers of actors are."""
    return Unit("names", lambda clouds: iter([File("vehicles.csv", partial(names_csv, selection))]))


def names_csv(selection: Selection) -> bytes:
    """Who the numbers of actors are."""
    return csv_of(selection.run.table("vehicles", ["vehicle", "sumo_id", "vehicle_class", "role"]))
