"""Reference vectors of the published code, outside the repository."""

import gzip
import json
from functools import cache

import numpy as np
import pytest

from tests import SHARED
from trust.tables import Groups, ObjectLists, SentDetections

ROOT = SHARED / "reference" / "trupercept"
LABELS = {"Car": 0, "Pedestrian": 1, "Cyclist": 2, "Truck": 3}


@cache
def _load(name: str) -> dict:
    return json.loads(gzip.decompress((ROOT / f"{name}.json.gz").read_bytes()))


def load(name: str) -> dict:
    """One file of vectors; skips the test where the folder is absent."""
    if not (ROOT / f"{name}.json.gz").exists():
        pytest.skip(f"no reference vectors: {ROOT / name}.json.gz is absent")
    return _load(name)


def detections_of(objects: list[dict], rows: dict[int, int]) -> tuple[SentDetections, np.ndarray]:
    """Objects as a table sorted by (message, detection_index), and the row of each object.

    A false detection comes after the real detections whose number it has in these vectors.
    """
    false = [bool(o.get("false_det", False)) for o in objects]
    message = np.array([rows[o["det_id"]] for o in objects], np.int64)
    index = np.array([o["det_idx"] + 1000 * f for o, f in zip(objects, false, strict=True)], np.int64)
    order = np.lexsort((index, message))
    at = np.empty(order.size, np.int64)
    at[order] = np.arange(order.size)
    table = SentDetections(
        message[order],
        index[order],
        np.array([LABELS[o["type"]] for o in objects], np.uint8)[order],
        np.array([o["score"] for o in objects], float)[order],
        np.array([o["det_idx"] == 0 and not f for o, f in zip(objects, false, strict=True)])[order],
    )
    return table, at


def one_view(groups: list[list[dict]], owner: int, others: list[int]):
    """An object list that consists of the given groups, in the given order.

    Returns
    -------
    Detections, ObjectLists, Groups, and the objects by position.
    """
    objects = [o for group in groups for o in group]
    rows = {vehicle: row for row, vehicle in enumerate([owner, *sorted(set(others) - {owner})])}
    table, at = detections_of(objects, rows)
    starts = np.cumsum([0, *(len(g) for g in groups)])
    seed = np.repeat(starts[:-1], np.diff(starts))
    lists = ObjectLists(np.array([0, at.size]), at, np.array([0]))
    return table, lists, Groups(seed, table.message[at[seed]] == 0), objects
