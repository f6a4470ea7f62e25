"""Boxes of objects that several vehicles detected, by the accuracy that each vehicle states.

The pose errors of the vehicles are estimated together with the positions of the objects, for each receiver alone.

References
----------
.. [1] Y. Lu, Q. Li, B. Liu, M. Dianati, C. Feng, S. Chen, Y. Wang, "Robust Collaborative 3D Object Detection in
   Presence of Pose Errors", ICRA 2023 (CoAlign): a graph of poses of agents and objects, aligned by least squares.
.. [2] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley, 2001.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.kernel import compiled, inlined, kernel
from cosim.base.ragged import offsets
from cosim.base.threads import in_ranges
from sensors.association import bounded
from sensors.boxes import Boxes
from sensors.cholesky import factorise, invert, padded, solve, subtract
from sensors.lanes import COLUMNS

_LEAST_HEADING_VARIANCE, _LEAST_SIZE_VARIANCE, _LEAST_POSE_VARIANCE = 2e-3**2, 2e-3**2, 1e-10
"""Stated variances count as at least this: heading [rad2], logarithm of a size, pose of a vehicle [m2, rad2]."""
_MOST_VARIANCE_M2 = 100.0**2
"""Variances of positions count as at most this along any axis."""
_N_SOLUTIONS = 3
"""Solutions of the least squares; each but the first uses weights from the one before."""
_TAIL = 6.0
"""Squared normalised residual at which a detection has half the weight."""


class StatedAccuracy(NamedTuple):
    """What vehicles state of the accuracy of D detections in M messages."""

    variance_m2: Float[ndarray, "d 3"]
    """Variance of each position relative to its vehicle: xx, xy, yy."""
    heading_variance: Float[ndarray, "d"]
    """Relative to its vehicle [rad2]."""
    size_variance: Float[ndarray, "d"]
    """Variance of the logarithm of length, width and height."""
    origin_m: Float[ndarray, "m 2"]
    """Where the vehicle of each message believes itself to be."""
    pose_variance: Float[ndarray, "m 2"]
    """Variance of that position along each axis [m2], and of the heading [rad2]."""


class ObjectViews(NamedTuple):
    """D detections in M messages."""

    boxes: Boxes
    """In the world's frame, where each vehicle believes it to be."""
    label: UInt8[ndarray, "d"]
    message: Int[ndarray, "d"]
    accuracy: StatedAccuracy


def boxes_of_columns(box: Float[ndarray, "g 7"]) -> Boxes:
    """Boxes from columns x, y, z, length, width, height, heading."""
    xyz_m, lwh_m, yaw_rad = np.split(box, (3, 6), axis=1)
    return Boxes(xyz_m, lwh_m, yaw_rad[:, 0])


class FusedBoxes(NamedTuple):
    """Boxes of G objects in the frame in which their receivers believe themselves to be."""

    boxes: Boxes
    variance_m2: Float[ndarray, "g 3"]
    """Variance of each position relative to the receiver: xx, xy, yy."""

    def columns(self) -> Float[ndarray, "g 7"]:
        """x, y, z, length, width, height, heading."""
        return np.column_stack([self.boxes.xyz_m, self.boxes.lwh_m, self.boxes.yaw_rad])


class ViewLists(NamedTuple):
    """What E receivers know of D detections in M messages."""

    ptr: Int[ndarray, "e+1"]
    """Receiver e knows the detections `member[ptr[e]:ptr[e + 1]]`, those of one message side by side."""
    member: Int[ndarray, "p"]
    owner: Int[ndarray, "e"]
    """Its own message."""
    group: Int[ndarray, "p"]
    """Group of each of `member`. The groups of a receiver are consecutive."""
    seed: Int[ndarray, "g"]
    """Detection that represents each group."""
    received_ptr: Int[ndarray, "e+1"]
    """Receiver e weighs the messages `received[received_ptr[e]:received_ptr[e + 1]]`. Others have weight 1."""
    received: Int[ndarray, "h"]


def fuse_boxes(
    views: ObjectViews,
    lists: ViewLists,
    weights: Sequence[Float[ndarray, "h"]],
    wanted: Sequence[Bool[ndarray, "g"]],
    align: bool,
) -> "list[FusedBoxes]":
    """Boxes of groups of detections of each receiver, once for each array of weights.

    Parameters
    ----------
    views
        The detections.
    lists
        Those that each receiver knows.
    weights
        Weight of what each of `lists.received` states, in [0, 1]: 0 for those that are not used. A receiver's own
        message and the seed of a group always have weight 1.
    wanted
        Groups whose boxes are asked for, for each array of weights. The others count for the pose errors only.
    align
        Whether the pose errors of the vehicles are estimated. Otherwise those of the sender and of the receiver are
        parts of the variance of each received detection, as if they were independent of those of the others.

    Returns
    -------
    One row per group that is wanted, for each array of weights.

    Notes
    -----
    Vehicle i believes an object at X to be at z = X + H e + n. Its pose error e = (east, north, heading) has the stated
    variances, H = [I, J (X - S)] with its position S and J the turn by 90 degrees, and n has the variance D of the
    detection relative to the vehicle. All e and X of a receiver follow from one weighted least-squares problem, in
    which the pose errors have their stated variances as priors [1]_. The X are eliminated, which leaves three unknowns
    per vehicle. The result is X where the receiver believes it to be, that is X + H e of the receiver's own error.
    Its covariance is (sum D^-1)^-1 + G C G', with the covariance C of all pose errors and G the derivative of the
    result [2]_. So two detections of one vehicle count its pose error once.

    Residuals have the density of a Student-t distribution: a detection of squared normalised residual r counts by
    1 / (1 + r / 6). So a detection of another object or a displaced one moves the rest little.

    Headings are averaged modulo pi, as twice the angle on the circle, and their majority chooses the direction.
    Lengths, widths and heights are averaged as logarithms, over the detections of the seed's class. Where the classes
    differ, half the difference of the sizes counts as a standard deviation of the position along that side.

    Deviations from [1]_: positions only are aligned, not the corners and headings of boxes; the objects' uncertainty
    is what vehicles state, not what a network learns; weights are robust.
    """
    boxes, accuracy = views.boxes, views.accuracy
    table = _Table(
        boxes.xyz_m,
        boxes.lwh_m,
        _logarithms(boxes.lwh_m),
        boxes.yaw_rad,
        np.ascontiguousarray(views.label),
        np.ascontiguousarray(views.message, np.int64),
        bounded(accuracy.variance_m2, _MOST_VARIANCE_M2),
        np.maximum(accuracy.heading_variance, _LEAST_HEADING_VARIANCE),
        np.maximum(accuracy.size_variance, _LEAST_SIZE_VARIANCE),
        np.ascontiguousarray(accuracy.origin_m),
        np.maximum(accuracy.pose_variance, _LEAST_POSE_VARIANCE),
    )
    rows = ViewLists(*(np.ascontiguousarray(column, np.int64) for column in lists))
    asked = np.reshape(wanted, (len(weights), len(lists.seed)))
    out = np.where(asked, np.cumsum(asked).reshape(asked.shape) - 1, -1)
    ends = offsets(asked.sum(axis=1))
    weight = np.reshape(weights, (len(weights), len(lists.received)))
    box = np.empty((ends[-1], 7))
    variance_m2 = np.empty((ends[-1], 3))
    given = table, rows, weight, align, out, box, variance_m2
    in_ranges(lambda begin, end: _fuse(begin, end, *given), len(lists.owner))
    parts = [slice(*both) for both in pairwise(ends.tolist())]
    return [FusedBoxes(boxes_of_columns(box[part]), variance_m2[part]) for part in parts]


def overlap_p(fused: FusedBoxes, least_iou: float) -> Float[ndarray, "g"]:
    """Probability that each box overlaps its object by more than an IoU, by the variance of its position.

    Notes
    -----
    Two equal boxes with axes in parallel, displaced by the share a of their length and by the share b of their width,
    have the IoU u / (2 - u) with u = (1 - a) (1 - b). It exceeds t if u exceeds c = 2 t / (1 + t), that is, if
    a < 1 - c and b < 1 - c / (1 - a). For normal errors, the probability of the first is an error function. That of the
    second is averaged over a by a Gauss-Legendre rule in the probability of a. Deviations: the correlation of errors
    along and across the box, heading, size and height are left out.
    """
    xx, xy, yy = fused.variance_m2.T
    turn = 2.0 * fused.boxes.yaw_rad
    twice = xx + yy
    cos, sin = np.cos(turn), np.sin(turn)
    spread = (xx - yy) * cos + 2.0 * xy * sin
    length_m, width_m, _ = fused.boxes.lwh_m.T
    length = length_m / np.sqrt(twice + spread)
    width = width_m / np.sqrt(twice - spread)
    least = 2.0 * least_iou / (1.0 + least_iou)
    first = scipy.special.erf(length * (1.0 - least))
    second = np.zeros(len(first))
    for place, weight in zip(*_RULE, strict=True):
        a = np.minimum(scipy.special.erfinv(place * first) / length, 1.0 - least)
        within = width * (1.0 - least / (1.0 - a))
        second += weight * scipy.special.erf(within)
    return first * second


_RULE = (0.1127016654, 0.5, 0.8872983346), (5 / 18, 8 / 18, 5 / 18)
"""Places in (0, 1) and weights of the Gauss-Legendre rule of three points."""


class _Table(NamedTuple):
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


class _Ego(NamedTuple):
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
    variance: "_Information"
    """Variance of the position relative to the vehicle, of the object that the seed says there is."""
    given: "_Information"
    """Information of the position, times the first weight."""
    info: "_Information"
    """Information of the position, times both weights."""
    listed: ndarray
    """Room for the slots of the vehicles of a group."""


class _Information(NamedTuple):
    """Symmetric matrices of two by two."""

    xx: ndarray
    xy: ndarray
    yy: ndarray


@compiled
def _logarithms(lwh):
    """Logarithms of sizes."""
    log_lwh = np.empty_like(lwh)
    for d in range(len(lwh)):
        for c in range(3):
            log_lwh[d, c] = np.log(lwh[d, c])
    return log_lwh


@compiled
def _fuse(begin, end, table, lists, weight, align, out, box, variance):
    """Fill the boxes and variances of the groups of the receivers `begin` to `end` at the rows `out`, if not -1."""
    known = np.ones(len(table.origin))
    for e in range(begin, end):
        if lists.ptr[e + 1] > lists.ptr[e]:
            _of_ego(e, table, lists, weight, known, align, out, box, variance)


@compiled
def _of_ego(e, table, lists, weight, known, align, out, box, variance):
    """Fill the boxes of one receiver's groups. `known` is room for the weight of each message, 1 before and after."""
    begin, end = lists.ptr[e], lists.ptr[e + 1]
    owner = lists.owner[e]
    first = last = lists.group[begin]
    for p in range(begin, end):
        first = min(first, lists.group[p])
        last = max(last, lists.group[p])
    n, n_groups = end - begin, last - first + 1
    real = np.empty((14, n))
    number = np.empty((3, n), np.int64)
    # Unsigned numbers of rows, because signed ones are tested for being negative at each access.
    ego = _Ego(
        np.zeros(n_groups + 1, np.uint64),
        np.empty(n, np.uint64),
        number[0],
        real[0],
        real[1],
        real[2],
        real[3],
        real[4],
        real[5],
        _Information(real[6], real[7], real[8]),
        _Information(real[9], real[10], real[11]),
        _Information(real[12], real[13], np.empty(n)),
        np.empty(n + 1, np.int64),
    )
    vehicle, sender = number[1], number[2]
    messages = np.empty(n + 1, np.int64)
    _sort(begin, end, first, table, lists, ego, vehicle, sender)
    errors, covariance = np.empty(0), np.empty((0, 0))
    own_turn = 0.0 if align else table.pose[owner, 1]
    for v in range(len(weight)):
        is_new = _weigh(e, v, first, lists, weight, known, ego, vehicle, sender)
        is_new |= v == 0
        if is_new:
            n_slots = _number(owner, ego, vehicle, sender, messages, align)
            _prepare(owner, table, ego, align)
            errors, covariance = _pose_errors(table, ego, messages, n_slots, align)
        slope = np.zeros((2, len(errors)))
        for g in range(first, last + 1):
            row = out[v, g]
            if row < 0:
                continue
            same = -1 if is_new else out[v - 1, g]
            if same >= 0:
                for c in range(7):  # Numba takes two seconds to compile an assignment of one row to another
                    box[row, c] = box[same, c]
                for c in range(3):
                    variance[row, c] = variance[same, c]
                continue
            low = ego.begin[g - first]
            high = ego.begin[g - first + 1]
            seed, filled = lists.seed[g], box[row]
            _fuse_place(low, high, seed, owner, table, ego, errors, covariance, slope, filled, variance[row])
            _fuse_shape(low, high, seed, own_turn, table, ego, errors, covariance, filled)


@compiled
def _pose_errors(table, ego, messages, n_slots, align):
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
def _sort(begin, end, first, table, lists, ego, vehicle, sender):
    """Sort the detections of a list by group, then by their places in the list, and number their messages, `sender`."""
    for p in range(begin, end):
        ego.begin[lists.group[p] - first + 1] += np.uint64(1)
    for g in range(len(ego.begin) - 1):
        ego.begin[g + 1] += ego.begin[g]
    n_messages, message = -1, np.int64(-1)
    for p in range(begin, end):
        d = np.uint64(lists.member[p])
        g = lists.group[p] - first
        if table.message[d] != message:
            n_messages += 1
            message = table.message[d]
            sender[n_messages] = message
        k = ego.begin[g]
        ego.begin[g] += np.uint64(1)
        ego.row[k], vehicle[k] = d, n_messages
        _locate(k, d, lists.seed[first + g], message, table, ego)
    for g in range(len(ego.begin) - 1, 0, -1):
        ego.begin[g] = ego.begin[g - 1]
    ego.begin[0] = np.uint64(0)


@kernel
def _weigh(e, v, first, lists, weight, known, ego, vehicle, sender):
    """Set the weights of the detections; returns whether any differs from the one before. If none does, all stays."""
    begin, end = lists.received_ptr[e], lists.received_ptr[e + 1]
    for h in range(end - 1, begin - 1, -1):  # the first weight of a message counts
        known[lists.received[h]] = weight[v, h]
    known[lists.owner[e]] = 1.0
    is_new = False
    for g in range(len(ego.begin) - 1):
        seed = lists.seed[first + g]
        for k in range(ego.begin[g], ego.begin[g + 1]):
            by = sender[vehicle[k]]
            trust = 1.0 if ego.row[k] == seed else known[by]
            is_new |= trust != ego.trust[k]
            ego.trust[k] = trust
    for h in range(begin, end):
        known[lists.received[h]] = 1.0
    if is_new or v == 0:
        for k in range(len(ego.row)):
            ego.weight[k] = 1.0 if ego.trust[k] > 0.0 else 0.0
    return is_new


@compiled
def _number(owner, ego, vehicle, sender, messages, align):
    """Number the vehicles whose pose errors are estimated: those with an object that others have, then the receiver.

    It shares objects with most of the others, so that few entries become nonzero when the matrix is factorised.
    """
    slots = np.full(len(ego.row) + 1, -1)
    messages[0] = owner
    n_slots = 1
    for g in range(len(ego.begin) - 1):
        n_used = 0
        for k in range(ego.begin[g], ego.begin[g + 1]):
            n_used += ego.weight[k] > 0.0
        for k in range(ego.begin[g], ego.begin[g + 1]):
            message = sender[vehicle[k]]
            is_used = ego.weight[k] > 0.0
            if message == owner:
                slots[vehicle[k]] = 0
            elif align and n_used > 1 and is_used and slots[vehicle[k]] < 0:
                slots[vehicle[k]] = n_slots
                messages[n_slots] = message
                n_slots += 1
    for k in range(len(ego.row)):
        slot = slots[vehicle[k]]
        ego.slot[k] = n_slots - 1 - slot if slot >= 0 else -1
    for i in range(n_slots // 2):
        other = n_slots - 1 - i
        messages[i], messages[other] = messages[other], messages[i]
    return n_slots


@inlined
def _locate(k, d, s, message, table, ego):
    """Position of a detection relative to the seed s and to its vehicle, and its variance."""
    x, y = _between(table.xyz, d, table.xyz, s)
    ego.x[k], ego.y[k] = x, y
    left, up = _between(table.xyz, d, table.origin, message)
    ego.left[k], ego.up[k] = left, up
    row = table.variance[d]
    xx, xy, yy = row[0], row[1], row[2]
    if table.label[d] != table.label[s]:
        xx, xy, yy = _with_size(d, s, table, xx, xy, yy)
    ego.variance.xx[k] = xx
    ego.variance.xy[k] = xy
    ego.variance.yy[k] = yy


@kernel
def _prepare(owner, table, ego, align):
    """The information that each detection has."""
    for k in range(len(ego.row)):
        xx, xy, yy = _row(ego.variance, k)
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
def _between(a, i, b, j):
    """Difference of two positions."""
    x = a[i, 0] - b[j, 0]
    y = a[i, 1] - b[j, 1]
    return x, y


@inlined
def _with_size(d, s, table, xx, xy, yy):
    """A variance with half the differences of two sizes as standard deviations along the box of the seed."""
    yaw = table.yaw[s]
    cos, sin = np.cos(yaw), np.sin(yaw)
    along = 0.5 * (table.lwh[d, 0] - table.lwh[s, 0])
    across = 0.5 * (table.lwh[d, 1] - table.lwh[s, 1])
    along, across = along * along, across * across
    xx += along * cos * cos + across * sin * sin
    xy += (along - across) * cos * sin
    yy += along * sin * sin + across * cos * cos
    return xx, xy, yy


@inlined
def _with_pose(d, m, table, xx, xy, yy):
    """A variance with that of the pose of the vehicle of a message."""
    x, y = _between(table.xyz, d, table.origin, m)
    of_place = table.pose[m, 0]
    of_heading = table.pose[m, 1]
    xx += of_place + of_heading * y * y
    xy -= of_heading * x * y
    yy += of_place + of_heading * x * x
    return xx, xy, yy


@inlined
def _times(xx, xy, yy, x, y):
    """A symmetric matrix times a vector."""
    u = xx * x + xy * y
    v = xy * x + yy * y
    return u, v


@inlined
def _pull(c, k, info, ego):
    """Row c of H' times the information of a detection."""
    xx, xy, yy = _row(info, k)
    a = xx if c == 0 else xy
    b = xy if c == 0 else yy
    if c == 2:
        left, up = ego.left[k], ego.up[k]
        a = left * xy - up * xx
        b = left * yy - up * xy
    return a, b


@inlined
def _row(info, k):
    """One matrix."""
    return info.xx[k], info.xy[k], info.yy[k]


@inlined
def _sum_of_group(begin, end, info):
    """Inverse of the summed information of a group."""
    a = b = c = 0.0
    for k in range(begin, end):
        a += info.xx[k]
        b += info.xy[k]
        c += info.yy[k]
    det = a * c - b * b
    return c / det, -b / det, a / det


@inlined
def _mean_of_group(begin, end, ego, errors):
    """Position of the object relative to its seed, and its variance, given the pose errors."""
    info = ego.info
    xx, xy, yy = _sum_of_group(begin, end, info)
    x = y = 0.0
    for k in range(begin, end):
        u, v = _without_error(k, ego, errors)
        a, b, c = _row(info, k)
        u, v = _times(a, b, c, u, v)
        x += u
        y += v
    x, y = _times(xx, xy, yy, x, y)
    return x, y, xx, xy, yy


@inlined
def _without_error(k, ego, errors):
    """Position of a detection relative to the seed, without its vehicle's pose error."""
    s = 3 * ego.slot[k]
    x, y = ego.x[k], ego.y[k]
    if s >= 0:
        turn = errors[s + 2]
        x -= errors[s] - turn * ego.up[k]
        y -= errors[s + 1] + turn * ego.left[k]
    return x, y


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
        system[i, i] = 1.0 / (variance if align else _LEAST_POSE_VARIANCE)
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
    xx, xy, yy = _sum_of_group(begin, end, info)
    pull, share = room[:2], room[2:]
    x = y = 0.0
    low, high = len(system), 0
    for k in range(begin, end):
        a, b, c = _row(info, k)
        u, v = ego.x[k], ego.y[k]
        u, v = _times(a, b, c, u, v)
        x += u
        y += v
        s = 3 * ego.slot[k]
        if s >= 0:
            low, high = min(low, s), max(high, s + 3)
            for c in range(3):
                a, b = _pull(c, k, info, ego)
                pull[0, s + c] += a
                pull[1, s + c] += b
    x, y = _times(xx, xy, yy, x, y)
    first = low // COLUMNS * COLUMNS
    for i in range(np.uint64(first), np.uint64(padded(high))):
        x_pull, y_pull = pull[0, i], pull[1, i]
        a, b = _times(xx, xy, yy, x_pull, y_pull)
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
            a, b = _pull(c, k, ego.info, ego)
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
        x, y, _, _, _ = _mean_of_group(begin, end, ego, errors)
        for k in range(begin, end):
            if ego.weight[k] > 0.0:
                u, v = _without_error(k, ego, errors)
                u, v = u - x, v - y
                a, b, c = _row(given, k)
                p, q = _times(a, b, c, u, v)
                square = u * p + v * q
                ego.weight[k] = 1.0 / (1.0 + square / _TAIL)


@kernel
def _fuse_place(begin, end, seed, owner, table, ego, errors, covariance, slope, box, variance):
    """Write place and variance of one group. `slope` is room, zero before and after."""
    x, y, xx, xy, yy = _mean_of_group(begin, end, ego, errors)
    x += table.xyz[seed, 0]
    y += table.xyz[seed, 1]
    # where the receiver believes it to be
    left = x - table.origin[owner, 0]
    up = y - table.origin[owner, 1]
    own = len(errors) - 3
    turn = errors[own + 2]
    box[0] = x + errors[own] - turn * up
    box[1] = y + errors[own + 1] + turn * left
    slope[0, own] = slope[1, own + 1] = 1.0
    slope[0, own + 2] = -up
    slope[1, own + 2] = left
    for k in range(begin, end):
        s = 3 * ego.slot[k]
        if s >= 0:
            for c in range(3):
                a, b = _pull(c, k, ego.info, ego)
                a, b = _times(xx, xy, yy, a, b)
                slope[0, s + c] -= a
                slope[1, s + c] -= b
    listed = ego.listed[: _list_vehicles(begin, end, own // 3, ego)]
    a, b, c = _spread(listed, slope, covariance)
    variance[0] = xx + a
    variance[1] = xy + b
    variance[2] = yy + c
    for slot in listed:
        for c in range(3 * slot, 3 * slot + 3):
            slope[0, c] = slope[1, c] = 0.0


@kernel
def _list_vehicles(begin, end, own, ego):
    """Slots of the vehicles of a group, each once, behind that of the receiver; returns how many there are."""
    ego.listed[0] = own
    n = 1
    for k in range(begin, end):
        slot = ego.slot[k]
        is_new = slot >= 0
        for j in range(n):
            is_new &= ego.listed[j] != slot
        if is_new:
            ego.listed[n] = slot
            n += 1
    return n


@kernel
def _spread(listed, slope, covariance):
    """G C G' of the listed vehicles: xx, xy, yy. Each pair of vehicles is looked at once."""
    xx = xy = yy = 0.0
    for m in range(len(listed)):
        s = 3 * listed[m]
        first = covariance[s]
        second = covariance[s + 1]
        third = covariance[s + 2]
        x = y = v = w = p = q = 0.0
        for j in listed[: m + 1]:
            t = 3 * j
            share = 0.5 if t == s else 1.0
            for i in range(t, t + 3):
                a = share * slope[0, i]
                b = share * slope[1, i]
                x += first[i] * a
                y += first[i] * b
                v += second[i] * a
                w += second[i] * b
                p += third[i] * a
                q += third[i] * b
        a, d = slope[0, s], slope[1, s]
        b, e = slope[0, s + 1], slope[1, s + 1]
        c, f = slope[0, s + 2], slope[1, s + 2]
        xx += 2.0 * (a * x + b * v + c * p)
        xy += a * y + b * w + c * q
        xy += d * x + e * v + f * p
        yy += 2.0 * (d * y + e * w + f * q)
    return xx, xy, yy


@kernel
def _fuse_shape(begin, end, seed, own_turn, table, ego, errors, covariance, box):
    """Write height above the ground, size and heading of a group into its box.

    `own_turn` is the variance of the receiver's own heading where its pose error is not estimated.
    """
    cos = sin = bottom = of_bottom = of_size = 0.0
    length = width = height = 0.0
    for k in range(begin, end):
        d = ego.row[k]
        w = ego.weight[k] * ego.trust[k]
        if w <= 0.0 or table.label[d] != table.label[seed]:
            continue
        angle, spread = _heading_of(k, d, own_turn, table, ego, errors, covariance)
        cos += w / spread * np.cos(2.0 * angle)
        sin += w / spread * np.sin(2.0 * angle)
        w_size = w / table.size[d]
        of_size += w_size
        length += w_size * table.log_lwh[d, 0]
        width += w_size * table.log_lwh[d, 1]
        height += w_size * table.log_lwh[d, 2]
        w /= table.variance[d, 0] + table.variance[d, 2]
        of_bottom += w
        under = 0.5 * table.lwh[d, 2]
        bottom += w * (table.xyz[d, 2] - under)
    axis, ahead = 0.5 * np.arctan2(sin, cos), 0.0
    for k in range(begin, end):
        d = ego.row[k]
        if table.label[d] == table.label[seed]:
            w = ego.weight[k] * ego.trust[k]
            ahead += w * np.cos(table.yaw[d] - axis)
    if ahead < 0.0:
        axis += np.pi if axis <= 0.0 else -np.pi
    box[3] = np.exp(length / of_size)
    box[4] = np.exp(width / of_size)
    box[5] = np.exp(height / of_size)
    box[2] = bottom / of_bottom + 0.5 * box[5]
    box[6] = axis


@inlined
def _heading_of(k, d, own_turn, table, ego, errors, covariance):
    """Heading of a detection as the receiver has it, and its variance."""
    angle, spread = table.yaw[d], table.heading[d]
    own = len(errors) - 1
    its = 3 * ego.slot[k] + 2
    if its != own:
        angle += errors[own]
        spread += covariance[own, own] + own_turn
        if its > 0:
            angle -= errors[its]
            spread += covariance[its, its]
        else:
            spread += table.pose[table.message[d], 1]
    return angle, spread
