"""Frames of two worlds as one data set, in the shares that give a mean speed."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.perception.matched import Found, Truth

Rows = tuple[ndarray, ...]


def frames_at_speed(
    slow_mps: Float[ndarray, "a"], fast_mps: Float[ndarray, "b"], mean_mps: float
) -> tuple[Int[ndarray, "c"], Int[ndarray, "d"]]:
    """Frames of a slow and of a fast world, evenly over each and as many as possible, that have a mean speed together.

    Parameters
    ----------
    slow_mps, fast_mps
        Speed of the ego in each frame.

    Raises
    ------
    ValueError
        If the mean speed is not between those of the two worlds.
    """
    low, high = slow_mps.mean(), fast_mps.mean()
    if not low < mean_mps < high:
        raise ValueError(f"No shares of worlds with {low:.1f} and {high:.1f} m/s give {mean_mps:.1f} m/s.")
    fast_p = (mean_mps - low) / (high - low)
    slow_p = 1 - fast_p
    n_frames = min(len(slow_mps) / slow_p, len(fast_mps) / fast_p)
    slow = _even(len(slow_mps), n_frames * slow_p)
    fast = _even(len(fast_mps), n_frames * fast_p)
    return slow, fast


def in_turn(parts: Sequence[tuple[ndarray, Truth, Found]]) -> tuple[Truth, Found]:
    """Objects and boxes of some frames of several data sets, whose frames take turns in proportion to their numbers.

    Parameters
    ----------
    parts
        Frames, objects and boxes of each.
    """
    counts = [len(frames) for frames, _, _ in parts]
    place = np.concatenate([(np.arange(n) + 0.5) / n for n in counts])
    number = np.empty(len(place), np.int64)
    number[np.argsort(place, kind="stable")] = np.arange(len(place))
    borders = np.cumsum([0, *counts])
    truths = []
    founds = []
    for (frames, truth, found), first in zip(parts, borders.tolist(), strict=False):
        truths.append(_numbered(truth, frames, number[first:]))
        founds.append(_numbered(found, frames, number[first:]))
    frame, box = (np.concatenate(column) for column in zip(*truths, strict=True))
    of, boxes, score = (np.concatenate(column) for column in zip(*founds, strict=True))
    return (frame, box), (of, boxes, score)


def _numbered(rows: Rows, frames: Int[ndarray, "c"], number: Int[ndarray, "m"]) -> Rows:
    """The rows of some frames, with new numbers of frames."""
    frame, *columns = rows
    at = np.searchsorted(frames, frame)
    inside = np.append(frames, -1)[at] == frame
    return number[at[inside]], *(column[inside] for column in columns)


def _even(n: int, k: float) -> Int[ndarray, "k"]:
    """About `k` of `n` numbers at equal distances."""
    count = round(k)
    return np.arange(count) * n // count
