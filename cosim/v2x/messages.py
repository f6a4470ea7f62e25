"""What is perceived and said in one step."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from sensors.boxes import Boxes

SENSED, SELF, FABRICATED = range(3)
ORIGINS = ("sensed", "self", "fabricated")
"""Where a detection comes from, by code: the detector, the vehicle's own pose, an invention."""


@dataclass(frozen=True, slots=True)
class Detections:
    """D detections of one step, world frame, sorted by (observer, k): the key for life with the step.

    `observer` is a row of the step's world. k = 0 is the self report, then what the detector found, then
    inventions. A detection with `said` false is kept to itself; a fabricated one nobody believes in, not even
    its author.
    """

    observer: Int[ndarray, "d"]
    k: Int[ndarray, "d"]
    label: UInt8[ndarray, "d"]
    boxes: Boxes
    score: Float[ndarray, "d"]
    n_points: Int[ndarray, "d"]
    origin: UInt8[ndarray, "d"]
    said: Bool[ndarray, "d"]

    def __len__(self) -> int:
        return len(self.observer)

    def take(self, rows: ndarray) -> "Detections":
        """These rows, in this order."""
        return Detections.of([c.take(rows) if isinstance(c, Boxes) else c[rows] for c in self.columns()])

    def columns(self) -> list[Any]:
        """All columns, in the order of the fields."""
        return [getattr(self, f.name) for f in fields(self)]

    @staticmethod
    def of(columns: list[Any]) -> "Detections":
        """Detections from all columns, in the order of the fields."""
        return Detections(*columns)

    @staticmethod
    def concat(parts: list["Detections"]) -> "Detections":
        """All rows of all parts, sorted by key."""
        columns = zip(*(part.columns() for part in parts), strict=True)
        joined = Detections.of([Boxes.concat(c) if isinstance(c[0], Boxes) else np.concatenate(c) for c in columns])
        return joined.take(np.lexsort((joined.k, joined.observer)))


def detections_bytes(n_objects: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Length of a detection message, as a collective perception message [B].

    GeoNetworking and BTP 44, signature and digest 96, header 37, one sensor 9, and 29 per object, as in Artery's
    model of ETSI TS 103 324.
    """
    return ENVELOPE_BYTES + 29 * n_objects


def verdicts_bytes(n_verdicts: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Length of a message of verdicts, our own format [B].

    The same envelope, a header of 16, and 12 per verdict: vehicle 4, detection 2, e 1, visibility 1, time 2, flags 2.
    """
    return 44 + report_bytes(n_verdicts)


def report_bytes(n_verdicts: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Length of verdicts as the server gets them, signed, without the headers of the way there [B]."""
    return 96 + riding_bytes(n_verdicts)


def riding_bytes(n_verdicts: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """What verdicts add to a detection message that they ride on [B]."""
    return 16 + 12 * n_verdicts


def trust_bytes(n_vehicles: int) -> int:
    """Length of a broadcast of trust values: the envelope and header of verdicts, and vehicle 4, trust 1, age 1 [B]."""
    return 44 + 96 + 16 + 6 * n_vehicles


def is_sound(said: Detections) -> Bool[ndarray, "d"]:
    """Detections that can be what they claim: a finite pose, a positive size, a score in [0, 1]."""
    xyz, lwh, yaw = said.boxes.xyz_m, said.boxes.lwh_m, said.boxes.yaw_rad
    return (
        np.isfinite(xyz).all(axis=1) & np.isfinite(lwh).all(axis=1) & np.isfinite(yaw) & (lwh > 0).all(axis=1)
        & (said.score >= 0) & (said.score <= 1)
    )  # fmt: skip


FRAME_BYTES = 1398
"""Longest payload of one frame: GeoNetworking's itsGnMaxSduSize [B]."""
ENVELOPE_BYTES = 44 + 96 + 37 + 9
"""What each segment of a long message carries again [B]."""


def segments(length_bytes: Int[ndarray, "n"]) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """How many frames each message takes, and how long each of them is [B]; every segment stands for itself."""
    n = np.where(length_bytes <= FRAME_BYTES, 1, -(-(length_bytes - ENVELOPE_BYTES) // (FRAME_BYTES - ENVELOPE_BYTES)))
    each = ENVELOPE_BYTES - (ENVELOPE_BYTES - length_bytes) // n
    return n, np.where(n == 1, length_bytes, each)


def ptr_of(sorted_rows: Int[ndarray, "m"], n: int) -> Int[ndarray, "n+1"]:
    """Where the rows of each of `n` owners begin in an array sorted by owner."""
    return np.searchsorted(sorted_rows, np.arange(n + 1)).astype(np.int64)


def expand(starts: Int[ndarray, "m"], stops: Int[ndarray, "m"]) -> tuple[ndarray, ndarray]:
    """All integers of the ranges [start, stop), range after range, and the range of each."""
    counts = stops - starts
    which = np.repeat(np.arange(len(starts)), counts)
    offset = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return starts[which] + offset, which
