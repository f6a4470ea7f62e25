"""KITTI's object and tracking benchmarks.

Notes
-----
`object/training`: `velodyne/%06d.bin`, `calib/%06d.txt`, `label_2/%06d.txt`; `object/results/%06d.txt` are detections
as transmitted, self reports left out, in the 16 columns of results. Frames are numbered over all vehicles;
`object/frames.csv` says which is which. `tracking/training`: a sequence is one vehicle while it is on the road
(`tracking/sequences.csv`), the track is the number of the actor; its clouds are those of `object`, as links. There
are no images: the camera stands where the LiDAR does, with 1,920 x 1,080 pixels on 90 degrees. Labelled is what gave
at least one return and is in the image. Occlusion 0, 1, 2: up to 20 %, up to 50 % and more of its returns are lost to
what stands in between.   Deviations: buses are trucks, motorcycles are cyclists; no reflectance (0).
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from results.export.frames import FOCAL_PX, IMAGE_PX, InCamera, in_camera, in_sensor
from results.export.moments import BOX, NOTHING, Cloud, Clouds, File, Moment, Plan, Selection, Unit
from results.spreadsheet import csv_of

TABLES = ("actors", "vehicles", "observability", "detections", "pseudonyms")

TYPE_OF = {
    "car": "Car", "van": "Van", "truck": "Truck", "bus": "Truck", "motorcycle": "Cyclist", "bicycle": "Cyclist",
    "cyclist": "Cyclist", "pedestrian": "Pedestrian",
}  # fmt: skip
"""KITTI's types by vehicle class and by class of detected objects."""

TEXT_BYTES = 2600
"""Of a frame's labels, results and calibration, roughly."""


class Kitti:
    """KITTI's object and tracking benchmarks."""

    TABLES = TABLES

    def plan(self, selection: Selection) -> Plan:
        """Frames in blocks of steps, then the sequences."""
        frames = selection.presence
        units = [
            Unit(f"steps {b[0]} to {b[-1]}", partial(_block, selection, b)) for b in selection.blocks()
        ] + [Unit("sequences", partial(_sequences, selection))]  # fmt: skip
        return Plan(tuple(units), len(frames), 16, len(frames) * TEXT_BYTES)


def _block(selection: Selection, steps: Int[ndarray, "b"], clouds: Clouds) -> Iterator[File]:
    number = _numbers(selection)
    for moment in selection.moments(steps):
        here = [v for v in selection.vehicles if (moment.step, v) in number]
        for vehicle, cloud in zip(here, clouds(moment.step, here), strict=True):
            name, pose = f"{number[moment.step, vehicle]:06d}", selection.pose(moment, vehicle)
            yield File(f"object/training/velodyne/{name}.bin", partial(velodyne, cloud))
            yield File(f"object/training/calib/{name}.txt", lambda: calibration().encode())
            yield File(f"object/training/label_2/{name}.txt", partial(_labels, moment, vehicle, pose))
            yield File(f"object/results/{name}.txt", partial(_results, moment, vehicle, pose))


def _labels(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> bytes:
    return "".join(f"{line}\n" for line in labels(moment, vehicle, pose).lines).encode()


def _results(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> bytes:
    return "".join(f"{line}\n" for line in results(moment, vehicle, pose)).encode()


def velodyne(cloud: Cloud) -> bytes:
    """float32 x, y, z, reflectance; sensor frame: x forward, y left, z up."""
    points = cloud()
    return np.column_stack([points, np.zeros(len(points), np.float32)]).astype("<f4").tobytes()


def calibration(end: str = "\n") -> str:
    """The camera at the LiDAR's place: x right, y down, z forward."""
    f, (w, h) = FOCAL_PX, IMAGE_PX
    p = f"{f:g} 0 {w / 2:g} 0 0 {f:g} {h / 2:g} 0 0 0 1 0"
    lines = [f"P{i}: {p}" for i in range(4)]
    lines += ["R0_rect: 1 0 0 0 1 0 0 0 1", "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0"]
    return end.join([*lines, "Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0", ""])


class Labels:
    """Objects in the image of a vehicle's camera, with their lines in a label file."""

    def __init__(self, actor: ndarray, speed_mps: ndarray, n_points: ndarray, lines: list[str]) -> None:
        self.actor, self.speed_mps, self.n_points, self.lines = actor, speed_mps, n_points, lines


def labels(moment: Moment, vehicle: int, pose: Float[ndarray, "4"], hidden: bool = False) -> Labels:
    """What gave a return and is in the image; `hidden` adds what would have if nothing stood in between."""
    seen = moment.visible.get(vehicle, NOTHING)
    rows = np.searchsorted(moment.actor, seen.actor)
    n_points = seen.n_points
    camera = in_camera(in_sensor(moment.box[rows], pose))
    keep = camera.is_in_image & (hidden | (n_points > 0))
    lost = 1 - n_points / np.maximum(seen.n_unoccluded, 1)
    level = np.where(n_points > 0, (lost > 0.2).astype(int) + (lost > 0.5), 3)
    types = [TYPE_OF[c] for c in moment.vehicle_class[rows]]
    lines = lines_of(types, camera, moment.box[rows], keep, level)
    rows = rows[keep]
    return Labels(moment.actor[rows], moment.speed_mps[rows], n_points[keep], lines)


def results(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> list[str]:
    """Lines of a result file: what it transmitted but for its self report."""
    sent = moment.detections.get(vehicle)
    if sent is None:
        return []
    sent = sent[sent.origin != "self"]
    box = sent[BOX].to_numpy(np.float64)
    camera = in_camera(in_sensor(box, pose))
    types = [TYPE_OF[c] for c in sent["class"].astype(object)]
    return lines_of(types, camera, box, camera.is_in_image, None, sent.score.to_numpy(np.float64))


def lines_of(
    types: list[str], camera: InCamera, box: Float[ndarray, "n 7"], keep: Bool[ndarray, "n"],
    occluded: Int[ndarray, "n"] | None = None, score: Float[ndarray, "n"] | None = None,
) -> list[str]:  # fmt: skip
    """The 15 columns of a label, or the 16 of a result."""
    out = []
    for i in np.flatnonzero(keep).tolist():
        numbers = (
            camera.alpha[i], *camera.image_px[i], box[i, 5], box[i, 4], box[i, 3], *camera.bottom_m[i],
            camera.rotation_y[i], *(() if score is None else (score[i],)),
        )  # fmt: skip
        head = "-1 -1" if occluded is None else f"{camera.truncated[i]:.2f} {occluded[i]}"
        out.append(f"{types[i]} {head} " + " ".join(f"{x:.4f}" for x in numbers))
    return out


def _numbers(selection: Selection) -> dict[tuple[int, int], int]:
    frames = selection.presence
    return dict(zip(zip(frames.step.tolist(), frames.vehicle.tolist(), strict=True), range(len(frames)), strict=True))


def sequences_of(selection: Selection) -> pd.DataFrame:
    """Frames by sequence: step, vehicle, number over all, sequence, frame in it."""
    frames = selection.presence.assign(number=np.arange(len(selection.presence)))
    frames = frames.sort_values(["vehicle", "step"], ignore_index=True)
    every = np.searchsorted(selection.steps, frames.step)
    starts = (frames.vehicle.diff() != 0) | (np.diff(every, prepend=-9) != 1)
    sequence = starts.cumsum() - 1
    return frames.assign(sequence=sequence, frame=frames.groupby(sequence).cumcount())


def _sequences(selection: Selection, clouds: Clouds) -> Iterator[File]:
    """Everything of the tracking benchmark, and the tables that say what the numbers are."""
    frames = sequences_of(selection)
    which: dict[tuple[Any, Any], tuple[Any, Any]] = {
        (f.step, f.vehicle): (f.sequence, f.frame) for f in frames.itertuples()
    }
    text: dict[int, list[str]] = {int(s): [] for s in frames.sequence.unique()}
    for steps in selection.blocks():
        for moment in selection.moments(steps):
            for vehicle in selection.vehicles:
                if (moment.step, vehicle) not in which:
                    continue
                sequence, frame = which[moment.step, vehicle]
                found = labels(moment, vehicle, selection.pose(moment, vehicle))
                text[sequence] += [f"{frame} {a} {x}\n" for a, x in zip(found.actor, found.lines, strict=True)]
    for sequence, lines in text.items():
        yield File(f"tracking/training/label_02/{sequence:04d}.txt", partial("".join(lines).encode))
        yield File(f"tracking/training/calib/{sequence:04d}.txt", lambda: calibration().encode())
    for f in frames.itertuples():
        path = f"tracking/training/velodyne/{f.sequence:04d}/{f.frame:06d}.bin"
        yield File(path, lambda: b"", same_as=f"object/training/velodyne/{f.number:06d}.bin")
    columns = ["sequence", "frame", "step", "vehicle"]
    yield File("tracking/sequences.csv", partial(csv_of, frames[columns]))
    whole = frames.sort_values("number").rename(columns={"frame": "_", "number": "frame"})
    yield File("object/frames.csv", partial(csv_of, whole[["frame", "step", "vehicle"]]))
    yield File("vehicles.csv", partial(names_csv, selection))


def names_csv(selection: Selection) -> bytes:
    """Who the numbers of actors are."""
    return csv_of(selection.run.table("vehicles", ["vehicle", "sumo_id", "vehicle_class", "role"]))
