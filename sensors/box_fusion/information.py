"""The detections that one receiver knows, and what each says of the place of its object."""

from typing import NamedTuple

from numpy import ndarray

from cosim.base.kernel import inlined


class StatedDetections(NamedTuple):
    """`ObjectViews` with variances that are large enough."""

    xyz: ndarray
    lwh: ndarray
    log_lwh: ndarray
    yaw: ndarray
    label: ndarray
    message: ndarray
    variance: ndarray
    heading: ndarray
    size: ndarray
    origin: ndarray
    pose: ndarray


class Information(NamedTuple):
    """Symmetric matrices of two by two."""

    xx: ndarray
    xy: ndarray
    yy: ndarray


class Ego(NamedTuple):
    """K detections of one receiver, by group."""

    begin: ndarray
    """First row of each group."""
    row: ndarray
    """Detection."""
    slot: ndarray
    """Number of its vehicle among those whose errors are estimated, the receiver being the last; -1: not estimated."""
    x: ndarray
    """Position relative to the seed."""
    y: ndarray
    left: ndarray
    """Lever arm: position relative to the vehicle, x."""
    up: ndarray
    """Lever arm, y."""
    trust: ndarray
    """Weight of what its vehicle states."""
    weight: ndarray
    """Weight by its residual; 0 if it is not used."""
    variance: Information
    """Variance of the position relative to the vehicle, of the object that the seed says there is."""
    given: Information
    """Information of the position, times the first weight."""
    info: Information
    """Information of the position, times both weights."""
    listed: ndarray
    """Room for the slots of the vehicles of a group."""


@inlined
def between(a, i, b, j):
    """Difference of two positions."""
    x = a[i, 0] - b[j, 0]
    y = a[i, 1] - b[j, 1]
    return x, y


@inlined
def times(xx, xy, yy, x, y):
    """A symmetric matrix times a vector."""
    u = xx * x + xy * y
    v = xy * x + yy * y
    return u, v


@inlined
def row_of(info, k):
    """One matrix."""
    return info.xx[k], info.xy[k], info.yy[k]


@inlined
def pull_of(c, k, info, ego):
    """Row c of H' times the information of a detection."""
    xx, xy, yy = row_of(info, k)
    a = xx if c == 0 else xy
    b = xy if c == 0 else yy
    if c == 2:
        left, up = ego.left[k], ego.up[k]
        a = left * xy - up * xx
        b = left * yy - up * xy
    return a, b


@inlined
def sum_of_group(begin, end, info):
    """Inverse of the summed information of a group."""
    a = b = c = 0.0
    for k in range(begin, end):
        a += info.xx[k]
        b += info.xy[k]
        c += info.yy[k]
    det = a * c - b * b
    return c / det, -b / det, a / det


@inlined
def mean_of_group(begin, end, ego, errors):
    """Position of the object relative to its seed, and its variance, given the pose errors."""
    info = ego.info
    xx, xy, yy = sum_of_group(begin, end, info)
    x = y = 0.0
    for k in range(begin, end):
        u, v = without_error(k, ego, errors)
        a, b, c = row_of(info, k)
        u, v = times(a, b, c, u, v)
        x += u
        y += v
    x, y = times(xx, xy, yy, x, y)
    return x, y, xx, xy, yy


@inlined
def without_error(k, ego, errors):
    """Position of a detection relative to the seed, without its vehicle's pose error."""
    s = 3 * ego.slot[k]
    x, y = ego.x[k], ego.y[k]
    if s >= 0:
        turn = errors[s + 2]
        x -= errors[s] - turn * ego.up[k]
        y -= errors[s + 1] + turn * ego.left[k]
    return x, y
