"""Point clouds of recorded data sets, and how many points lie in boxes."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.perception.recorded import read_bytes
from cosim.base.plane import turned_by

_TYPES = {
    ("F", 4): "<f4",
    ("F", 8): "<f8",
    ("U", 1): "<u1",
    ("U", 2): "<u2",
    ("U", 4): "<u4",
    ("I", 1): "<i1",
    ("I", 2): "<i2",
    ("I", 4): "<i4",
}
_LONGEST_HEAD = 4096
_FARTHEST_M = 1e6
"""Largest coordinate of a point."""


def points_of(path: Path) -> Float[ndarray, "n 3"]:
    """x, y, z of the finite points of a .pcd file, in text or binary.

    Raises
    ------
    ValueError
        In one line, if the file is wrong, or compressed, which is not read. A file with another number of points than
        it says is wrong.
    """
    content = read_bytes(path)
    head, sign, _ = content[:_LONGEST_HEAD].partition(b"\nDATA ")
    line = content[len(head) + len(sign) :].split(b"\n", 1)
    if not sign or len(line) < 2:
        raise ValueError(f"{path} is no point cloud in the format of PCL.")
    kind, body = line[0].strip().decode("ascii", "replace"), line[1]
    lines = head.decode("ascii", "replace").splitlines()
    rows = dict(text.split(" ", 1) for text in lines if " " in text)
    try:
        names, n = rows["FIELDS"].split(), int(rows["POINTS"])
        sizes = [int(word) for word in rows["SIZE"].split()]
        types = rows["TYPE"].split()
        counts = [1] * len(names)
        if "COUNT" in rows:
            counts = [int(word) for word in rows["COUNT"].split()]
        fields = []
        columns = zip(names, sizes, types, counts, strict=True)
        for k, (name, size, of, count) in enumerate(columns):
            fields.append((f"{k}{name}", _TYPES[of, size], (count,)))
        layout = np.dtype(fields)
        axes = [f"{names.index(axis)}{axis}" for axis in "xyz"]
        if kind == "binary":
            there = len(body) // layout.itemsize
        elif kind == "ascii":
            rows_of_text = [line for line in body.splitlines() if line.strip()]
            there = len(rows_of_text)
        else:
            raise ValueError(kind)
    except (KeyError, ValueError, IndexError, MemoryError, OverflowError, ZeroDivisionError):
        raise ValueError(f"{path} is no point cloud of kind ascii or binary with x, y and z.") from None
    if n != there:
        raise ValueError(f"{path} says that it has {str(n)[:20]} points, and has {there:,}.")
    try:
        if kind == "binary":
            points = np.frombuffer(body, layout, n)
            columns_m = [points[axis][:, 0] for axis in axes]
            xyz = np.column_stack(columns_m).astype(float)
        else:
            at = [sum(counts[: names.index(axis)]) for axis in "xyz"]
            values = np.array(b" ".join(rows_of_text).split(), dtype=float)
            xyz = values.reshape(n, sum(counts))[:, at]
    except (ValueError, IndexError, MemoryError):
        raise ValueError(f"{path} is no point cloud of kind ascii or binary with x, y and z.") from None
    if (np.abs(xyz[np.isfinite(xyz)]) > _FARTHEST_M).any():
        raise ValueError(f"{path} has a point beyond {_FARTHEST_M / 1000:g} km.")
    return xyz[np.isfinite(xyz).all(axis=1)]


def points_in(
    points: Float[ndarray, "n 3"],
    box: Float[ndarray, "b 7"],
) -> Int[ndarray, "b"]:
    """Number of points strictly inside each box; both in one frame."""
    found = np.zeros(len(box), np.int64)
    if not len(points) or not len(box):
        return found
    tree = cKDTree(points[:, :2])
    reach_m = 0.5 * np.hypot(box[:, 3], box[:, 4])
    for k in range(len(box)):  # one after another, because large boxes may share most of the points
        rows = tree.query_ball_point(box[k, :2], reach_m[k])
        away = points[rows] - box[k, :3]
        away[:, :2] = turned_by(-box[k, 6], away)
        is_inside = np.abs(away) < box[k, 3:6] / 2
        found[k] = int(is_inside.all(axis=1).sum())
    return found
