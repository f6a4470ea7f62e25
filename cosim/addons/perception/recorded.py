"""What a recorded data set holds, whatever its layout, and how files of strangers are read."""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.rows import Rows
from results.moments import corners_of

LARGEST_BYTES = 16_000_000
"""Largest file that is read. The largest annotation files of the data sets are a few hundred kilobytes."""
MOST_FRAMES, MOST_BOXES = 200_000, 10_000
"""Frames of a data set, and boxes of one file."""
_FARTHEST_M = 1e7
"""Largest coordinate: DAIR-V2X's world has coordinates of some thousand metres, UTM of millions."""

_LARGEST_M = 200.0
"""Largest side of a box."""
_RIGID = 0.01
"""By how much the columns of a rotation may differ from unit vectors at right angles."""
_STEEPEST = math.cos(math.radians(60.0))
"""Cosine of the largest tilt of a LiDAR: all boxes are upright."""

CLASS_OF = {
    "car": "car",
    "van": "car",
    "vehicle": "car",
    "policecar": "car",
    "truck": "truck",
    "bus": "truck",
    "tram": "truck",
    "longvehicle": "truck",
    "pedestrian": "pedestrian",
    "person": "pedestrian",
    "roadworker": "pedestrian",
    "personsitting": "person_sitting",
    "cyclist": "cyclist",
    "bicycle": "cyclist",
    "motorcyclist": "cyclist",
    "motorcycle": "cyclist",
    "tricyclist": "cyclist",
    "barrowlist": "cyclist",
    "scooterrider": "cyclist",
    "bicyclerider": "cyclist",
    "motorcyclerider": "cyclist",
    "dontcare": "dontcare",
}
"""Our class by a data set's name of it, in lower case without blanks and signs; other names keep their own."""


@dataclass(frozen=True, slots=True)
class RecordedBoxes(Rows):
    """Boxes of many frames, world frame."""

    frame: Int[ndarray, "n"]
    agent: Int[ndarray, "n"]
    """Number of the agent in its frame that reports the box; -1 for annotations."""
    label: ndarray
    """Class names [n]."""
    box: Float[ndarray, "n 7"]
    """Centre x, y, z (up), length, width, height, yaw."""
    score: Float[ndarray, "n"]

    @staticmethod
    def of(
        rows: Sequence[tuple[int, int, str, Float[ndarray, "7"], float]],
    ) -> "RecordedBoxes":
        """Of rows (frame, agent, label, box, score) in any order; sorted by frame, then agent."""
        rows = sorted(rows, key=lambda row: row[:2])
        columns = zip(*rows, strict=True) if rows else ((),) * 5
        frame, agent, label, box, score = columns
        return RecordedBoxes(
            frame=np.array(frame, np.int64),
            agent=np.array(agent, np.int64),
            label=np.array(label, object),
            box=np.array(box, float).reshape(-1, 7),
            score=np.array(score, float),
        )

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True)
class Recorded:
    """A data set: frames with one or more agents, annotated objects, and detections of each agent."""

    layout: str
    frames: tuple[str, ...]
    """Name of each frame."""
    agents: tuple[tuple[str, ...], ...]
    """Names of the agents of each frame; the first one is the ego."""
    pose: tuple[Float[ndarray, "k 4"], ...]
    """Per frame, x, y, z and yaw of each agent's LiDAR, world frame."""
    truth: RecordedBoxes
    aside: RecordedBoxes
    """The cooperating vehicles themselves, where they are annotated. They are no objects, and boxes on them count
    neither as right nor as false."""
    found: RecordedBoxes
    has_classes: bool
    """Whether detections have a class. If not, all are of the class car."""
    classes: Mapping[tuple[str, str], int]
    """Number of annotations by the class that the files say, and ours."""
    remarks: tuple[str, ...]
    """What a reader of the figures should know, one sentence each."""
    world_from: tuple[Float[ndarray, "k 4 4"], ...]
    """Per frame, transformation from each agent's LiDAR to the world."""
    clouds: tuple[tuple[Path, ...], ...]
    """Per frame, where each agent's point cloud would be."""


def read_bytes(path: Path) -> bytes:
    """The content of a file of bounded size.

    Raises
    ------
    ValueError
        In one line, if it is too large or cannot be read.
    """
    try:
        if not path.is_file():
            raise ValueError(f"{path} is not a file.")
        if (size := path.stat().st_size) > LARGEST_BYTES:
            raise ValueError(f"{path} has {size:,} bytes, more than the {LARGEST_BYTES:,} that are read.")
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}.") from None


def read_text(path: Path) -> str:
    """The text of a file of bounded size."""
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no text in UTF-8.") from None


def read_json(path: Path) -> Any:
    """A JSON file of bounded size, in which no object has a key twice."""
    try:
        return json.loads(read_text(path), parse_int=_integer, object_pairs_hook=partial(_once, path))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is no JSON: {error.msg} in line {error.lineno}.") from None
    except RecursionError:
        raise ValueError(f"{path} is nested too deeply.") from None


def _once(path: Path, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"{path} has the key {key[:40]!r} twice in one place.")
        found[key] = value
    return found


def _integer(digits: str) -> int | float:
    """A whole number; one of many digits is a float, because Python refuses to read it."""
    return int(digits) if len(digits) < 20 else float(digits)


def numbers(value: Any, n: int, what: str, path: Path) -> Float[ndarray, "n"]:
    """A list of `n` finite numbers.

    Raises
    ------
    ValueError
        In one line: `what` in the file is something else.
    """
    is_list = isinstance(value, list | tuple) and len(value) == n
    if not is_list or not all(map(_is_number, value)):
        raise ValueError(f"{path}: {what} should be a list of {n} numbers.")
    return np.array(value, float)


def number(value: Any, what: str, path: Path) -> float:
    """A finite number, which may be written as text, as DAIR-V2X does."""
    try:
        found = float(value) if not isinstance(value, bool | list | dict) else math.nan
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not abs(found) <= _FARTHEST_M:
        raise ValueError(f"{path}: {what} should be a number.")
    return found


def matrix(value: Any, rows: int, columns: int, what: str, path: Path) -> Float[ndarray, "r c"]:
    """A nested list of finite numbers."""
    if not isinstance(value, list | tuple) or len(value) != rows:
        raise ValueError(f"{path}: {what} should have {rows} rows.")
    return np.array([numbers(row, columns, what, path) for row in value])


def rigid(motion: Float[ndarray, "4 4"], what: str, path: Path) -> Float[ndarray, "4 4"]:
    """A transformation from a LiDAR to the world, if it is a rotation and a shift that keep up what is up.

    Raises
    ------
    ValueError
        In one line: it scales, mirrors, is transposed, or tips over.
    """
    turn = motion[:3, :3]
    if np.abs(motion[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError(f"{path}: the last row of {what} should be 0, 0, 0, 1. Is the matrix transposed?")
    determinant = np.linalg.det(turn)
    from_identity = np.abs(turn.T @ turn - np.eye(3))
    if from_identity.max() > _RIGID or determinant < 0:
        raise ValueError(
            f"{path}: {what} is no rigid motion (determinant {determinant:.3g}, should be 1): it scales or mirrors."
        )
    if turn[2, 2] < _STEEPEST:
        tilt_deg = math.degrees(math.acos(max(turn[2, 2], -1.0)))
        raise ValueError(
            f"{path}: {what} tilts the LiDAR by {tilt_deg:.0f} degrees. Of six numbers, the last three are roll, yaw "
            "and pitch in degrees."
        )
    return motion


def scores(values: Float[ndarray, "n"], path: Path) -> Float[ndarray, "n"]:
    """Scores of detections, in [0, 1].

    Raises
    ------
    ValueError
        In one line, if one is something else.
    """
    odd = (values < -1e-6) | (values > 1 + 1e-6)
    if odd.any():
        raise ValueError(
            f"{path} has the score {values[odd][0]:g}; scores should be from 0 to 1. Are they percent, or logits?"
        )
    return np.clip(values, 0.0, 1.0)


def upright(box: Float[ndarray, "n 7"], path: Path) -> Float[ndarray, "n 7"]:
    """Boxes, if none has a side that no object on a road has.

    Raises
    ------
    ValueError
        In one line, if one has.
    """
    size_m = box[:, 3:6]
    odd = ~((size_m > 0) & (size_m <= _LARGEST_M)).all(axis=1)
    if odd.any():
        sides = ", ".join(f"{side:g}" for side in size_m[odd][0])
        raise ValueError(
            f"{path}: the sides of box {int(np.argmax(odd))} are {sides} m; above 0 and up to {_LARGEST_M:g} m are "
            "right."
        )
    return box


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= _FARTHEST_M


def array_of(path: Path, shape: tuple[int | None, ...]) -> Float[ndarray, "..."]:
    """An array in a .npy file, without pickled objects.

    Parameters
    ----------
    shape
        Length of each axis; None where any length up to `MOST_BOXES` will do.
    """
    if not read_bytes(path).startswith(b"\x93NUMPY"):  # an archive of arrays would be opened as one
        raise ValueError(f"{path} is no array of numbers in NumPy's format.")
    try:
        found = np.load(path, allow_pickle=False, mmap_mode="r")
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, MemoryError, OverflowError, RecursionError):
        raise ValueError(f"{path} is no array of numbers in NumPy's format.") from None
    if not _has_shape(found, shape):
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise ValueError(f"{path} should be an array of numbers of shape ({wanted}).")
    values = np.array(found, float)
    if not (np.abs(values) <= _FARTHEST_M).all():
        raise ValueError(f"{path} has a number that is not finite or too large.")
    return values


def _has_shape(found: Any, shape: tuple[int | None, ...]) -> bool:
    """Whether something is an array of numbers of this shape."""
    if not isinstance(found, np.ndarray):
        return False
    if found.dtype.kind not in "fiu" or found.ndim != len(shape):
        return False
    for n, wanted in zip(found.shape, shape, strict=True):
        if n > MOST_BOXES if wanted is None else n != wanted:
            return False
    return True


def box_of_corners(corner: Float[ndarray, "n 8 3"], path: Path) -> Float[ndarray, "n 7"]:
    """Boxes of their corners.

    Parameters
    ----------
    corner
        The lower four and the upper four, each with the two front ones first and round the box, as OpenCOOD and
        DAIR-V2X have them. In any other order the heading is that of the longer side, which no overlap depends on.
    path
        File that they are of, for error messages.

    Returns
    -------
    Centre, length, width, height, yaw.

    Raises
    ------
    ValueError
        In one line, if eight corners are none of an upright box.
    """

    def middle(*corners: int) -> Float[ndarray, "n 3"]:
        return corner[:, corners].mean(axis=1)

    ahead = middle(0, 1, 4, 5) - middle(2, 3, 6, 7)
    aside = middle(1, 2, 5, 6) - middle(0, 3, 4, 7)
    up = middle(4, 5, 6, 7) - middle(0, 1, 2, 3)
    lengths_m = [np.linalg.norm(side, axis=1) for side in (ahead, aside, up)]
    size_m = np.column_stack(lengths_m)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    box = np.column_stack([corner.mean(axis=1), size_m, yaw])
    is_off = _off(corner, box) > 0.02 * np.linalg.norm(size_m, axis=1) + 0.02
    odd = np.flatnonzero(is_off | (size_m <= 0).any(axis=1))
    for row in odd.tolist():
        box[row] = _in_any_order(corner[row])
        size = box[row, 3:6]
        off_m = _off(corner[[row]], box[[row]])[0]
        allowed_m = 0.05 * np.linalg.norm(size) + 0.05
        if not size.min() > 0 or off_m > allowed_m:
            raise ValueError(f"{path}: the corners of box {row} are not those of an upright box.")
    return box


def _off(
    corner: Float[ndarray, "n 8 3"],
    box: Float[ndarray, "n 7"],
) -> Float[ndarray, "n"]:
    """Largest distance from a corner of a box to the nearest of the given ones [m]."""
    between = corners_of(box)[:, :, None] - corner[:, None]
    apart_m = np.linalg.norm(between, axis=3)
    return apart_m.min(axis=2).max(axis=1) if len(box) else np.zeros(0)


def _in_any_order(corner: Float[ndarray, "8 3"]) -> Float[ndarray, "7"]:
    """The box of eight corners in any order; its length is the longer side."""
    by_height = np.argsort(corner[:, 2], kind="stable")
    low, high = np.split(corner[by_height], 2)
    xy_m = low[:, :2]
    east_m, north_m = (xy_m - xy_m.mean(axis=0)).T
    ring = xy_m[np.argsort(np.arctan2(north_m, east_m))]
    along, across, *_ = np.diff(ring, axis=0)
    length, width = np.linalg.norm(along), np.linalg.norm(across)
    if length < width:
        along, length, width = across, width, length
    height = high[:, 2].mean() - low[:, 2].mean()
    yaw_rad = math.atan2(along[1], along[0])
    return np.array([*corner.mean(axis=0), length, width, height, yaw_rad])


def moved(
    box: Float[ndarray, "n 7"],
    world_from_agent: Float[ndarray, "4 4"],
) -> Float[ndarray, "n 7"]:
    """Boxes of an agent's frame in the world; the boxes stay upright."""
    turn, yaw = world_from_agent[:3, :3], box[:, 6]
    level = np.zeros(len(box))
    forward = np.column_stack([np.cos(yaw), np.sin(yaw), level])
    heading = forward @ turn.T
    out = box.copy()
    turned = box[:, :3] @ turn.T
    out[:, :3] = turned + world_from_agent[:3, 3]
    out[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    return out


def pose_of(world_from_agent: Float[ndarray, "4 4"]) -> Float[ndarray, "4"]:
    """x, y, z and yaw of a transformation."""
    yaw = math.atan2(world_from_agent[1, 0], world_from_agent[0, 0])
    return np.array([*world_from_agent[:3, 3], yaw])


def class_of(name: Any) -> str:
    """Our class for a data set's name of one, such as `Bus`, `LongVehicle` or `vehicle.car`."""
    own_name = str(name)[:40].lower()
    first, *finer = (re.sub(r"[^a-z0-9]", "", part) for part in own_name.split("."))
    known = [CLASS_OF[part] for part in (*finer, first) if part in CLASS_OF]
    return known[0] if known else own_name


def listed(counts: Mapping[Any, int]) -> str:
    """Numbers of things as a text: `3 Car, 1 Van`."""
    return ", ".join(f"{n:,} {name}" for name, n in counts.items())


def once(paths: Iterable[Path]) -> dict[int, Path]:
    """Files of one folder by the number that is their name, in ascending order.

    Raises
    ------
    ValueError
        In one line, if two files have one number.
    """
    found: dict[int, Path] = {}
    for path in sorted(paths):
        if (number := int(path.stem)) in found:
            raise ValueError(f"{path} and {found[number].name} beside it are of one frame. Remove one of them.")
        found[number] = path
    return dict(sorted(found.items()))
