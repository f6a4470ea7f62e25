"""What a recorded data set holds, whatever its layout, and how files of strangers are read."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

LARGEST_BYTES = 16_000_000
"""Largest file that is read. The largest annotation files of the data sets are a few hundred kilobytes."""
MOST_FRAMES, MOST_BOXES = 200_000, 10_000
"""Frames of a data set, and boxes of one file."""
_FARTHEST_M = 1e7
"""Largest coordinate: DAIR-V2X's world has coordinates of some thousand metres, UTM of millions."""

CLASS_OF = {
    "car": "car", "van": "car", "vehicle": "car", "truck": "truck", "bus": "truck", "tram": "truck",
    "pedestrian": "pedestrian", "person_sitting": "person_sitting", "cyclist": "cyclist", "bicycle": "cyclist",
    "motorcyclist": "cyclist", "motorcycle": "cyclist", "tricyclist": "cyclist", "barrowlist": "cyclist",
}  # fmt: skip
"""Our class by a data set's name of it, in lower case; other names keep their own."""


@dataclass(frozen=True, slots=True)
class Boxes:
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
    def of(rows: Sequence[tuple[int, int, str, Float[ndarray, "7"], float]]) -> "Boxes":
        """Of rows (frame, agent, label, box, score) in any order; sorted by frame, then agent."""
        rows = sorted(rows, key=lambda row: row[:2])
        return Boxes(
            np.array([row[0] for row in rows], np.int64), np.array([row[1] for row in rows], np.int64),
            np.array([row[2] for row in rows], object), np.array([row[3] for row in rows], float).reshape(-1, 7),
            np.array([row[4] for row in rows], float),
        )  # fmt: skip

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
    truth: Boxes
    found: Boxes
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
    """A JSON file of bounded size."""
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is no JSON: {error.msg} in line {error.lineno}.") from None
    except RecursionError:
        raise ValueError(f"{path} is nested too deeply.") from None


def numbers(value: Any, n: int, what: str, path: Path) -> Float[ndarray, "n"]:
    """A list of `n` finite numbers.

    Raises
    ------
    ValueError
        In one line: `what` in the file is something else.
    """
    if not isinstance(value, list | tuple) or len(value) != n or not all(map(_is_number, value)):
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


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _FARTHEST_M


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
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, MemoryError):
        raise ValueError(f"{path} is no array of numbers in NumPy's format.") from None
    fits = isinstance(found, np.ndarray) and found.ndim == len(shape) and found.dtype.kind in "fiu"
    if not fits or any(
        n > MOST_BOXES if want is None else n != want for n, want in zip(found.shape, shape, strict=True)
    ):
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise ValueError(f"{path} should be an array of numbers of shape ({wanted}).")
    values = np.array(found, float)
    if not (np.abs(values) <= _FARTHEST_M).all():
        raise ValueError(f"{path} has a number that is not finite or too large.")
    return values


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
    ahead = corner[:, [0, 1, 4, 5]].mean(axis=1) - corner[:, [2, 3, 6, 7]].mean(axis=1)
    aside = corner[:, [1, 2, 5, 6]].mean(axis=1) - corner[:, [0, 3, 4, 7]].mean(axis=1)
    up = corner[:, 4:].mean(axis=1) - corner[:, :4].mean(axis=1)
    size = np.column_stack([np.linalg.norm(ahead, axis=1), np.linalg.norm(aside, axis=1), np.linalg.norm(up, axis=1)])
    box = np.column_stack([corner.mean(axis=1), size, np.arctan2(ahead[:, 1], ahead[:, 0])])
    odd = np.flatnonzero((_off(corner, box) > 0.02 * np.linalg.norm(size, axis=1) + 0.02) | (size <= 0).any(axis=1))
    for row in odd.tolist():
        box[row] = _in_any_order(corner[row])
        if (
            not box[row, 3:6].min() > 0
            or _off(corner[[row]], box[[row]])[0] > 0.05 * np.linalg.norm(box[row, 3:6]) + 0.05
        ):
            raise ValueError(f"{path}: the corners of box {row} are not those of an upright box.")
    return box


def _off(corner: Float[ndarray, "n 8 3"], box: Float[ndarray, "n 7"]) -> Float[ndarray, "n"]:
    """Largest distance from a corner of a box to the nearest of the given ones [m]."""
    apart = np.linalg.norm(corners_of(box)[:, :, None] - corner[:, None], axis=3)
    return apart.min(axis=2).max(axis=1) if len(box) else np.zeros(0)


def _in_any_order(corner: Float[ndarray, "8 3"]) -> Float[ndarray, "7"]:
    """The box of eight corners in any order; its length is the longer side."""
    low, high = np.split(corner[np.argsort(corner[:, 2], kind="stable")], 2)
    middle = low[:, :2].mean(axis=0)
    round_ = low[np.argsort(np.arctan2(*(low[:, :2] - middle).T[::-1])), :2]
    one, other = round_[1] - round_[0], round_[2] - round_[1]
    along, across = (one, other) if np.linalg.norm(one) >= np.linalg.norm(other) else (other, one)
    return np.array([
        *corner.mean(axis=0), np.linalg.norm(along), np.linalg.norm(across), high[:, 2].mean() - low[:, 2].mean(),
        math.atan2(along[1], along[0]),
    ])  # fmt: skip


def corners_of(box: Float[ndarray, "n 7"]) -> Float[ndarray, "n 8 3"]:
    """The corners that `box_of_corners` takes."""
    along = 0.5 * np.array([[1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, -1],
                            [1, -1, 1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1]])  # fmt: skip
    local = along * box[:, None, 3:6]
    cos, sin = np.cos(box[:, 6])[:, None], np.sin(box[:, 6])[:, None]
    turned = np.stack(
        [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1], local[..., 2]], axis=-1
    )
    return turned + box[:, None, :3]


def moved(box: Float[ndarray, "n 7"], world_from_agent: Float[ndarray, "4 4"]) -> Float[ndarray, "n 7"]:
    """Boxes of an agent's frame in the world; the boxes stay upright."""
    turn = world_from_agent[:3, :3]
    heading = np.column_stack([np.cos(box[:, 6]), np.sin(box[:, 6]), np.zeros(len(box))]) @ turn.T
    out = box.copy()
    out[:, :3] = box[:, :3] @ turn.T + world_from_agent[:3, 3]
    out[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    return out


def pose_of(world_from_agent: Float[ndarray, "4 4"]) -> Float[ndarray, "4"]:
    """x, y, z and yaw of a transformation."""
    return np.array([*world_from_agent[:3, 3], math.atan2(world_from_agent[1, 0], world_from_agent[0, 0])])


def class_of(name: Any) -> str:
    """Our class for a data set's name of one."""
    plain = str(name)[:40].lower()
    return CLASS_OF.get(plain, plain)
