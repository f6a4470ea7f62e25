"""Pose errors of the vehicles that share objects, by one weighted least-squares problem per receiver."""

import numpy as np

from cosim.base.kernel import compiled, inlined, kernel
from sensors.box_fusion.information import between, mean_of_group, pull_of, row_of, sum_of_group, times, without_error
from sensors.cholesky import factorise, invert, padded, solve, subtract
from sensors.lanes import COLUMNS

LEAST_POSE_VARIANCE = 1e-10
"""Stated variances of the pose of a vehicle count as at least this [m2, rad2]."""
_N_SOLUTIONS = 3
"""Solutions of the least squares; each but the first uses weights from the one before."""
_TAIL = 6.0
"""Squared normalised residual at which a detection has half the weight."""


@compiled
def estimate_pose_errors(table, ego, messages, n_slots, align):
    """Pose errors of the numbered vehicles, and their covariance."""
    errors = np.zeros(3 * n_slots)
    system = np.empty((len(errors), padded(len(errors))))
    room = np.zeros((4, system.shape[1]))
    for solution in range(_N_SOLUTIONS):
        _assemble(table, ego, messages, n_slots, align, room, system, errors)
        factorise(system)
        solve(system, errors)
        if solution < _N_SOLUTIONS - 1:
            _reweigh(ego, errors)
    covariance = np.empty_like(system)
    invert(system, covariance)
    return errors, covariance


@kernel
def set_information(owner, table, ego, align):
    """The information that each detection has."""
    for k in range(len(ego.row)):
        xx, xy, yy = row_of(ego.variance, k)
        if ego.slot[k] < 0:  # the pose error counts as noise of this detection
            d = ego.row[k]
            xx, xy, yy = _with_pose(d, table.message[d], table, xx, xy, yy)
            if not align:
                xx, xy, yy = _with_pose(d, owner, table, xx, xy, yy)
        per = ego.trust[k] / (xx * yy - xy * xy)
        ego.given.xx[k] = per * yy
        ego.given.xy[k] = -per * xy
        ego.given.yy[k] = per * xx


@inlined
def _with_pose(d, m, table, xx, xy, yy):
    """A variance with that of the pose of the vehicle of a message."""
    x, y = between(table.xyz, d, table.origin, m)
    of_place = table.pose[m, 0]
    of_heading = table.pose[m, 1]
    xx += of_place + of_heading * y * y
    xy -= of_heading * x * y
    yy += of_place + of_heading * x * x
    return xx, xy, yy


@kernel
def _assemble(table, ego, messages, n_slots, align, room, system, right):
    """Normal equations of the pose errors, after the objects are eliminated; the upper triangle is filled."""
    system[:] = 0.0
    given, info = ego.given, ego.info
    for k in range(len(ego.row)):
        weight = ego.weight[k]
        info.xx[k] = weight * given.xx[k]
        info.xy[k] = weight * given.xy[k]
        info.yy[k] = weight * given.yy[k]
    for i in range(3 * n_slots):
        m, component = messages[i // 3], i % 3 // 2
        variance = table.pose[m, component]
        system[i, i] = 1.0 / (variance if align else LEAST_POSE_VARIANCE)
        right[i] = 0.0
    for g in range(len(ego.begin) - 1):
        begin, end = ego.begin[g], ego.begin[g + 1]
        if end > begin + np.uint64(1):
            _add_group(begin, end, ego, room, system, right)


@kernel
def _add_group(begin, end, ego, room, system, right):
    """Add a group to the normal equations, of which the upper triangle is filled.

    `room` has the columns of the system. Its rows 0 and 1 are zero before and after.
    """
    info = ego.info
    xx, xy, yy = sum_of_group(begin, end, info)
    pull, share = room[:2], room[2:]
    x = y = 0.0
    low, high = len(system), 0
    for k in range(begin, end):
        a, b, c = row_of(info, k)
        u, v = ego.x[k], ego.y[k]
        u, v = times(a, b, c, u, v)
        x += u
        y += v
        s = 3 * ego.slot[k]
        if s >= 0:
            low, high = min(low, s), max(high, s + 3)
            for c in range(3):
                a, b = pull_of(c, k, info, ego)
                pull[0, s + c] += a
                pull[1, s + c] += b
    x, y = times(xx, xy, yy, x, y)
    first = low // COLUMNS * COLUMNS
    for i in range(np.uint64(first), np.uint64(padded(high))):
        x_pull, y_pull = pull[0, i], pull[1, i]
        a, b = times(xx, xy, yy, x_pull, y_pull)
        share[0, i] = a
        share[1, i] = b
    # The rows are changed as a whole long after their first entries: a processor waits if it reads what it just wrote.
    for k in range(begin, end):
        if k == begin or ego.slot[k] != ego.slot[k - np.uint64(1)]:
            _add_detection(k, x, y, ego, system, right)
    for k in range(begin, end):
        s = 3 * ego.slot[k]
        if s < 0 or ego.weight[k] <= 0.0:
            continue
        if k != begin and ego.slot[k] == ego.slot[k - np.uint64(1)]:
            _add_detection(k, x, y, ego, system, right)
        east, north = pull[0], pull[1]
        factors = (
            *(east[s], east[s + 1], east[s + 2]),
            *(north[s], north[s + 1], north[s + 2]),
        )
        subtract(system, s, share, 0, factors, s, high)
        for c in range(s, s + 3):  # another detection of this vehicle has been added, too
            pull[0, c] = pull[1, c] = 0.0


@inlined
def _add_detection(k, x, y, ego, system, right):
    """Add what a detection says of the pose of its vehicle, given that the object is at x and y."""
    s = 3 * ego.slot[k]
    if s >= 0 and ego.weight[k] > 0.0:
        u = ego.x[k] - x
        v = ego.y[k] - y
        left, up = ego.left[k], ego.up[k]
        for c in range(3):
            a, b = pull_of(c, k, ego.info, ego)
            right[s + c] += a * u + b * v
            system[s, s + c] += a
            system[s + 1, s + c] += b
            turned = b * left - a * up
            system[s + 2, s + c] += turned


@kernel
def _reweigh(ego, errors):
    """Weights by the residuals. Those that are not used stay so."""
    given = ego.given
    for g in range(len(ego.begin) - 1):
        begin, end = ego.begin[g], ego.begin[g + 1]
        if end <= begin + np.uint64(1):
            continue
        x, y, _, _, _ = mean_of_group(begin, end, ego, errors)
        for k in range(begin, end):
            if ego.weight[k] > 0.0:
                u, v = without_error(k, ego, errors)
                u, v = u - x, v - y
                a, b, c = row_of(given, k)
                p, q = times(a, b, c, u, v)
                square = u * p + v * q
                ego.weight[k] = 1.0 / (1.0 + square / _TAIL)
