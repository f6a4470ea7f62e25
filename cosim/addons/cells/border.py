"""Which vehicle belongs to which cell, and what a cell sees beyond its border."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

_PER_NEIGHBOUR = 0.06
"""Work that an actor makes for an observer near it, in units of what the observer makes by itself."""
_MOST_SQUARES = 1000
"""Of the grid, along each axis."""


def cells_of(xy_m: Float[ndarray, "n 2"], cost: Float[ndarray, "n"], n_cells: int) -> Int[ndarray, "n"]:
    """Cut the plane into cells of about equal cost, by recursive bisection across the longer side.

    Parameters
    ----------
    xy_m
        Positions.
    cost
        Cost of each, above 0.
    n_cells
        Number of cells, 1 or more.

    Returns
    -------
    Cell of each position, from 0. Cells are empty only if there are fewer positions than cells.
    """
    cell = np.zeros(len(xy_m), np.int64)
    parts = [(np.arange(len(xy_m)), 0, n_cells)]
    while parts:
        rows, first, n = parts.pop()
        cell[rows] = first
        if n == 1 or not len(rows):
            continue
        axis = int(np.argmax(np.ptp(xy_m[rows], axis=0)))
        rows = rows[np.argsort(xy_m[rows, axis], kind="stable")]
        so_far = np.cumsum(cost[rows])
        cut = int(np.searchsorted(so_far, so_far[-1] * (n // 2) / n, "right"))
        cut = min(max(cut, n // 2), len(rows) - (n - n // 2)) if len(rows) >= n else min(n // 2, len(rows))
        parts += [(rows[:cut], first, n // 2), (rows[cut:], first + n // 2, n - n // 2)]
    return cell


def costs(xy_m: Float[ndarray, "n 2"], observers: Int[ndarray, "e"], reach_m: float) -> Float[ndarray, "e"]:
    """How much work each observer makes, about: a share for itself, and one for each actor around it.

    Actors are counted in the square of a grid with the mesh `reach_m` in which the observer is, and in the eight around
    it. The weight of an actor was fitted to the processor time of 2 and 8 cells in Luxembourg.
    """
    mesh_m = max(reach_m, float(np.ptp(xy_m, axis=0).max()) / _MOST_SQUARES)
    place = np.floor((xy_m - xy_m.min(axis=0)) / mesh_m).astype(np.int64) + 1  # with an empty margin
    rows, columns = place.max(axis=0) + 2
    n = np.bincount(place[:, 0] * columns + place[:, 1], minlength=rows * columns).reshape(rows, columns)
    n = n[:-2] + n[1:-1] + n[2:]
    n = n[:, :-2] + n[:, 1:-1] + n[:, 2:]
    return 1.0 + _PER_NEIGHBOUR * n[tuple((place[observers] - 1).T)]


def within_reach(xy_m: Float[ndarray, "n 2"], of: Int[ndarray, "k"], reach_m: float) -> Int[ndarray, "h"]:
    """Rows of the positions in the rectangle around the rows `of` and `reach_m` beyond it, ascending."""
    low, high = xy_m[of].min(axis=0) - reach_m, xy_m[of].max(axis=0) + reach_m
    return np.flatnonzero(((xy_m >= low) & (xy_m <= high)).all(axis=1))
