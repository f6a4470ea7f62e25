"""The data set that TruPercept's published code reads: one vehicle's frames, and everybody else's perspective of them.

Notes
-----
`object_tru_percept0/training` is the ego's, the first of the chosen vehicles; `alt_perspective/%07d` are the others'.
Frames are numbered by the steps in which the ego senses. Vehicles with another phase of sensing (`sensing_phase =
"random"`) have no perspective in them. Files, KITTI's columns unless said otherwise, CR LF:

- `velodyne`, `calib`, `label_2` as in `cosim/addons/export/kitti.py`;
- `label_aug_2` also names what is wholly hidden, `label_aug_filtered_2` what gave a return; both have three more
  columns: number of the actor, speed [m/s], returns. Their reader was not published: their order is a guess.
- `predictions`: what the vehicle transmitted, its self report left out, in the 16 columns of results. The frame is the
  true one, so the error of the vehicle's own pose displaces them, as it does in messages (not so in `export kitti`);
- `ego_object`: the vehicle itself, in the camera frame *of the ego*, with the same three columns;
- `position_world`: the true pose: position (underside), camera, forward, right and up, a row each; x east, y north, z
  up.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.export import kitti
from cosim.addons.export.frames import in_camera, in_sensor
from results.moments import Clouds, File, Moment, Plan, Selection, units_of_steps

TABLES = kitti.TABLES

ROOT = "object_tru_percept0/training"
END = "\r\n"
TEXT_BYTES = 6000
"""Of a perspective's text files in a frame, roughly."""


class TruPerceptData:
    """The data set that TruPercept's published code reads."""

    TABLES = TABLES

    def plan(self, selection: Selection) -> Plan:
        """Blocks of the steps in which the ego is on the road."""
        frames = selection.presence
        ego = frames[frames.vehicle == selection.vehicles[0]]
        if ego.empty:
            raise ValueError(f"vehicle {selection.vehicles[0]}, the ego, is on the road in none of these steps.")
        frames = frames[frames.step.isin(ego.step)]
        steps = ego.step.to_numpy()
        blocks = [block[np.isin(block, steps)] for block in selection.blocks()]
        blocks = [block for block in blocks if len(block)]
        units = units_of_steps(blocks, partial(_block, selection, steps))
        units.append(kitti.names(selection))
        return Plan(tuple(units), len(frames), 16, len(frames) * TEXT_BYTES)


def _block(
    selection: Selection, all_steps: Int[ndarray, "s"], steps: Int[ndarray, "b"], clouds: Clouds
) -> Iterator[File]:
    ego = selection.vehicles[0]
    present = selection.presence
    for moment in selection.moments(steps):
        senses = set(present.vehicle[present.step == moment.step])
        here = [v for v in selection.vehicles if v in senses]
        name = f"{np.searchsorted(all_steps, moment.step):06d}"
        ego_pose = selection.pose(moment, ego)
        for vehicle, cloud in zip(here, clouds(moment.step, here), strict=True):
            folder = ROOT if vehicle == ego else f"{ROOT}/alt_perspective/{vehicle:07d}"
            pose = selection.pose(moment, vehicle)
            yield File(f"{folder}/velodyne/{name}.bin", partial(kitti.velodyne, cloud))
            yield File(f"{folder}/calib/{name}.txt", lambda: kitti.calibration(END).encode())
            for what, make in _TEXTS.items():
                seen_from = ego_pose if what == "ego_object" else pose
                text = partial(_text, make, moment, vehicle, seen_from)
                yield File(f"{folder}/{what}/{name}.txt", text)


def _text(make, moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> bytes:  # type: ignore[no-untyped-def]
    return "".join(line + END for line in make(moment, vehicle, pose)).encode()


def _label(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> list[str]:
    return kitti.labels(moment, vehicle, pose).lines


def _label_aug(moment: Moment, vehicle: int, pose: Float[ndarray, "4"], hidden: bool = True) -> list[str]:
    found = kitti.labels(moment, vehicle, pose, hidden)
    columns = found.lines, found.actor, found.speed_mps, found.n_points
    lines = []
    for line, actor, speed, n_points in zip(*columns, strict=True):
        lines.append(f"{line} {actor} {speed:.4f} {n_points}")
    return lines


def _ego_object(moment: Moment, vehicle: int, ego_pose: Float[ndarray, "4"]) -> list[str]:
    row = moment.row(vehicle)
    box = moment.box[[row]]
    camera = in_camera(in_sensor(box, ego_pose))
    kind = kitti.TYPE_OF[moment.vehicle_class[row]]
    flat = camera._replace(image_px=np.nan_to_num(camera.image_px))  # behind the ego it has no rectangle
    is_kept, occluded = np.ones(1, bool), np.zeros(1, int)
    (line,) = kitti.lines_of([kind], flat, box, is_kept, occluded)
    return [f"{line} {vehicle} {moment.speed_mps[row]:.4f} 0"]


def _position(moment: Moment, vehicle: int, pose: Float[ndarray, "4"]) -> list[str]:
    box = moment.box[moment.row(vehicle)]
    cos, sin = np.cos(pose[3]), np.sin(pose[3])
    under = box[:3] - np.array([0, 0, 0.5 * box[5]])
    rows = (
        under,
        pose[:3],
        (cos, sin, 0.0),
        (sin, -cos, 0.0),
        (0.0, 0.0, 1.0),
    )
    return [" ".join(f"{x:.6f}" for x in row) for row in rows]


_TEXTS = {
    "label_2": _label,
    "label_aug_2": _label_aug,
    "label_aug_filtered_2": partial(_label_aug, hidden=False),
    "predictions": kitti.results,
    "ego_object": _ego_object,
    "position_world": _position,
}
"""What makes the lines of the files of each folder."""
