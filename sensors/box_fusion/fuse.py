"""Fuses the boxes of each receiver's objects.

The pose errors of the vehicles are estimated together with the positions of the objects, for each receiver alone.

References
----------
.. [1] Y. Lu, Q. Li, B. Liu, M. Dianati, C. Feng, S. Chen, Y. Wang, "Robust Collaborative 3D Object Detection in
   Presence of Pose Errors", ICRA 2023 (CoAlign): a graph of poses of agents and objects, aligned by least squares.
.. [2] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley, 2001.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from cosim.base.kernel import compiled, inlined, kernel
from cosim.base.ragged import offsets
from cosim.base.threads import in_ranges
from sensors.association import bounded
from sensors.box_fusion.information import Ego, Information, StatedDetections, between
from sensors.box_fusion.place_and_shape import fuse_place, fuse_shape
from sensors.box_fusion.pose_errors import LEAST_POSE_VARIANCE, estimate_pose_errors, set_information
from sensors.box_fusion.views import FusedBoxes, ObjectViews, ViewLists, boxes_of_columns

_LEAST_HEADING_VARIANCE = _LEAST_SIZE_VARIANCE = 2e-3**2
"""Stated variances count as at least this: heading [rad2], logarithm of a size."""
_MOST_VARIANCE_M2 = 100.0**2
"""Variances of positions count as at most this along any axis."""


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
    table = StatedDetections(
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
        np.maximum(accuracy.pose_variance, LEAST_POSE_VARIANCE),
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
    ego = Ego(
        np.zeros(n_groups + 1, np.uint64),
        np.empty(n, np.uint64),
        number[0],
        real[0],
        real[1],
        real[2],
        real[3],
        real[4],
        real[5],
        Information(real[6], real[7], real[8]),
        Information(real[9], real[10], real[11]),
        Information(real[12], real[13], np.empty(n)),
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
            set_information(owner, table, ego, align)
            errors, covariance = estimate_pose_errors(table, ego, messages, n_slots, align)
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
            fuse_place(low, high, seed, owner, table, ego, errors, covariance, slope, filled, variance[row])
            fuse_shape(low, high, seed, own_turn, table, ego, errors, covariance, filled)


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


@inlined
def _locate(k, d, s, message, table, ego):
    """Position of a detection relative to the seed s and to its vehicle, and its variance."""
    x, y = between(table.xyz, d, table.xyz, s)
    ego.x[k], ego.y[k] = x, y
    left, up = between(table.xyz, d, table.origin, message)
    ego.left[k], ego.up[k] = left, up
    row = table.variance[d]
    xx, xy, yy = row[0], row[1], row[2]
    if table.label[d] != table.label[s]:
        xx, xy, yy = _with_size(d, s, table, xx, xy, yy)
    ego.variance.xx[k] = xx
    ego.variance.xy[k] = xy
    ego.variance.yy[k] = yy


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
