"""KITTI's object benchmark: labels and results as text.

Notes
-----
`training/label_2/%06d.txt` with 15 columns, in `object` or not. Results of 16 columns in `results`, beside `training`,
or in the folder of detections. Boxes are in the camera's frame: x right, y down, z forward; here x forward, y left, z
up.
"""

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.addons.perception.kitti import LabelledObjects
from cosim.addons.perception.recorded import MOST_BOXES, MOST_FRAMES, class_of, number, once, read_text

_COLUMNS = 15
Row = tuple[int, str, list[float]]
"""Frame, class and columns of an object."""


def labels_in(folder: Path) -> Path | None:
    """The folder of label files, if there is one."""
    for place in (folder / "object/training/label_2", folder / "training/label_2", folder / "label_2"):
        if place.is_dir():
            return place
    return None


@dataclass(frozen=True, slots=True)
class KittiFolder:
    """Labels and results of all frames, as KITTI's metric takes them; frames are those of the label files."""

    truth: LabelledObjects
    found: LabelledObjects
    n_frames: int
    classes: Counter[tuple[str, str]]
    """Number of labels by the class that the files say, and ours."""
    remarks: tuple[str, ...]
    """What a reader of the figures should know, one sentence each."""


def read(folder: Path, detections: Path | None = None) -> KittiFolder:
    """Labels and results of a folder.

    Raises
    ------
    ValueError
        In one line, if there are no label files or a line is wrong.
    """
    place = labels_in(folder)
    paths = [] if place is None else list(place.glob("*.txt"))
    numbered = [path for path in paths if path.stem.isascii() and path.stem.isdigit()]
    files = list(once(numbered).values())
    if place is None or not files:
        raise ValueError(f"{folder} holds no label files training/label_2/000000.txt.")
    if len(files) > MOST_FRAMES:
        raise ValueError(f"{place} has {len(files):,} files, more than {MOST_FRAMES:,}.")
    results = detections or place.parents[1] / "results"
    classes: Counter[tuple[str, str]] = Counter()
    truth, found, missing = [], [], 0
    for frame, path in enumerate(files):
        truth += _rows(path, frame, False, classes)
        result = results / path.name
        if result.exists():
            found += _rows(result, frame, True, Counter())
        else:
            missing += 1
    remark = f"{missing:,} of {len(files):,} frames have no file in {results}: they count as if nothing was detected."
    remarks = (remark,) if 0 < missing < len(files) else ()
    return KittiFolder(_objects(truth), _objects(found), len(files), classes, remarks)


def _rows(
    path: Path,
    frame: int,
    scored: bool,
    classes: Counter[tuple[str, str]],
) -> list[Row]:
    """The objects of a file, whose classes are counted."""
    lines = read_text(path).splitlines()
    if len(lines) > MOST_BOXES:
        raise ValueError(f"{path} has {len(lines):,} lines, more than {MOST_BOXES:,}.")
    rows = []
    for n, line in enumerate(lines, 1):
        if line.strip():
            name, values, said = _line(line.split(), f"{path}, line {n}", scored)
            rows.append((frame, name, values))
            classes[said, name] += 1
    return rows


def _objects(rows: list[Row]) -> LabelledObjects:
    numbers = [values for _, _, values in rows]
    columns = np.array(numbers, float).reshape(-1, 15).T
    truncation, hidden, _, _, top, _, bottom = columns[:7]
    height, width, length, right, down, forward, turn, score = columns[7:]
    yaw = np.pi - (1.5 * np.pi + turn) % (2 * np.pi)  # wraps -turn - pi / 2
    up = 0.5 * height - down
    return LabelledObjects(
        frame=np.array([frame for frame, _, _ in rows], int),
        label=np.array([name for _, name, _ in rows], object),
        box=np.column_stack([forward, -right, up, length, width, height, yaw]),
        height_px=bottom - top,
        occlusion=np.where(hidden < 0, 3, hidden).astype(int),
        truncation=np.maximum(truncation, 0.0),
        score=score,
    )


def _line(
    words: list[str],
    where: str,
    scored: bool,
) -> tuple[str, list[float], str]:
    """Our class, the numbers, and the class that the line says."""
    if len(words) < _COLUMNS + scored:
        raise ValueError(f"{where} has {len(words)} columns and should have {_COLUMNS + scored}.")
    columns = enumerate(words[1 : _COLUMNS + scored], 2)
    values = [number(word, f"column {n}", Path(where)) for n, word in columns]
    length, turn = values[9], values[13]
    if length > 0 and abs(turn) > 2 * math.pi + 0.1:
        raise ValueError(f"{where}: rotation_y is {turn:g}; radians are right, from -3.14 to 3.14.")
    if not scored:
        values.append(1.0)
    said = words[0][:40]
    name = said.lower()
    return name if name == "van" else class_of(name), values, said
