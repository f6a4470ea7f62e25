"""Which detections of different observers may be of one object, by the accuracy that is stated of each.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley, 2001,
   chapter 3: the gate of a measurement by its squared Mahalanobis distance.
"""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.kernel import compiled, inlined, kernel
from cosim.base.threads import in_ranges
from sensors.boxes import Boxes, Pairs, iou_of

LEAST_VARIANCE_M2, MOST_VARIANCE_M2 = 0.02**2, 2.0**2
"""Stated variances count as at least and at most this along any axis. Nobody escapes a comparison by stating that a
detection may be anywhere; 2 m is what a car that was last seen half a second ago may be off."""
_GROUPS = ((0, 3), (1, 2))
"""Detectors confuse cars with trucks, and pedestrians with cyclists."""
_N_CLASSES = 4
"""Labels from this on are no classes, and they go with none."""


class Gate(NamedTuple):
    """When two detections may be of one object."""

    miss_p: float
    """Probability that two detections of one object are farther apart than the gate, if their accuracies are true."""
    least_iou: float
    """Boxes that overlap by more than this may be of one object, too."""

    @property
    def reach(self) -> float:
        """Radius of the gate in standard deviations: P(d^2 > x) = exp(-x / 2) in two dimensions."""
        return float(np.sqrt(-2.0 * np.log(self.miss_p)))


def bounded(variance_m2: Float[ndarray, "n 3"], most_m2: float = MOST_VARIANCE_M2) -> Float[ndarray, "n 3"]:
    """Variances (xx, xy, yy) with eigenvalues within `LEAST_VARIANCE_M2` and a largest one.

    What is no variance (not finite, not positive) becomes the largest one.
    """
    found = np.empty((len(variance_m2), 3))
    _bound(np.ascontiguousarray(variance_m2, np.float64), LEAST_VARIANCE_M2, most_m2, found)
    return found


@compiled
def _bound(variance, least, most, found):
    """Write the bounded variances."""
    for d in range(len(variance)):
        xx, xy, yy = variance[d]
        mean = 0.5 * (xx + yy)
        half = 0.5 * (xx - yy)
        spread = np.hypot(half, xy)
        low, high = mean - spread, mean + spread
        turn_x, turn_y = 1.0, 0.0
        if not (np.isfinite(high) and low >= -1e-9 * abs(high)):
            low = high = most
        elif spread > 0:
            turn_x, turn_y = half / spread, xy / spread
        low = min(max(low, least), most)
        high = min(max(high, least), most)
        mean = 0.5 * (high + low)
        spread = 0.5 * (high - low)
        found[d, 0] = mean + spread * turn_x
        found[d, 1] = spread * turn_y
        found[d, 2] = mean - spread * turn_x


def certainty(variance_m2: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """How much of the region in which each detection may be is inside the bounds, in (0, 1].

    It is the ratio of the areas of two ellipses: of the bounded variance, and of the variance itself.
    """
    xx, xy, yy = variance_m2.T
    b_xx, b_xy, b_yy = bounded(variance_m2).T
    with np.errstate(invalid="ignore", divide="ignore"):
        bounded_det = b_xx * b_yy - b_xy * b_xy
        share = np.sqrt(bounded_det / (xx * yy - xy * xy))
    return np.where(np.isfinite(share), np.minimum(share, 1.0), 1.0)


def pairs_within(
    boxes: Boxes,
    label: UInt8[ndarray, "n"],
    variance_m2: Float[ndarray, "n 3"],
    owner: Int[ndarray, "n"],
    gate: Gate,
) -> Pairs:
    """All pairs i < j of different owners that may be of one object.

    Parameters
    ----------
    boxes, label
        Detections in one frame.
    variance_m2
        Variance of each position (xx, xy, yy), as `bounded` returns it.
    owner
        The vehicle that reports each.
    gate
        When two detections may be of one object.

    Notes
    -----
    The agreement of a pair is the probability that two detections of one object are at least as far apart, exp(-d^2/2)
    with the squared Mahalanobis distance d^2 of their centres under the sum of both variances [1]_. If the boxes
    overlap by more than `least_iou`, it is at least their IoU. Where one box is longer or wider, half the difference is
    not counted as distance: a truck of which a vehicle sees the rear as a car is where that car is. Boxes with more
    than 1 m of height between them, as on a bridge and below, are no pair.
    """
    detections = _Detections(boxes, label, variance_m2, owner)
    return _agreeing(detections, detections, gate)


def pairs_across(
    a: Boxes,
    a_label: UInt8[ndarray, "n"],
    a_variance_m2: Float[ndarray, "n 3"],
    b: Boxes,
    b_label: UInt8[ndarray, "m"],
    b_variance_m2: Float[ndarray, "m 3"],
    gate: Gate,
) -> Pairs:
    """All pairs of a detection of `a` and one of `b` that may be of one object; as `pairs_within`."""
    nobody = np.zeros(0, np.int64)
    return _agreeing(
        _Detections(a, a_label, a_variance_m2, nobody), _Detections(b, b_label, b_variance_m2, nobody), gate
    )


class _Detections(NamedTuple):
    """Detections in one frame, as `pairs_within` takes them."""

    boxes: Boxes
    label: ndarray
    variance_m2: ndarray
    owner: ndarray  # empty where pairs of one owner count, too


class _Places(NamedTuple):
    """Detections as the search reads them, in the order of their cells: those near each other are compared together."""

    xyz: ndarray
    lwh: ndarray
    yaw: ndarray
    cos: ndarray
    sin: ndarray
    variance: ndarray
    radius: ndarray  # circumradius
    label: ndarray
    owner: ndarray  # as in `_Detections`
    side: ndarray  # of the cells of each class
    cell: ndarray  # column and row of the cell of each
    row: ndarray  # of the detections, by bucket of their cells and classes
    start: ndarray  # where each bucket begins
    at: ndarray  # where in this order each detection is

    @staticmethod
    def of(detections: _Detections, side_m: ndarray) -> "_Places":
        """In cells of these sides, one for each class."""
        boxes, label, variance_m2, owner = detections
        label = np.minimum(label, _N_CLASSES)
        n_buckets = 1 << max(len(boxes), 1).bit_length()
        cell = np.empty((len(boxes), 2), np.int64)
        order, start = _by_bucket(boxes.xyz_m, label, side_m, n_buckets, cell)
        at = np.empty(len(boxes), np.int64)
        at[order] = np.arange(len(boxes))
        boxes = boxes.take(order)
        owner = np.asarray(owner, np.int64)
        return _Places(
            xyz=boxes.xyz_m,
            lwh=boxes.lwh_m,
            yaw=boxes.yaw_rad,
            cos=np.cos(boxes.yaw_rad),
            sin=np.sin(boxes.yaw_rad),
            variance=variance_m2.take(order, axis=0),
            radius=boxes.circumradius_m,
            label=label[order],
            owner=owner[order] if len(owner) else owner,
            side=side_m,
            cell=cell.take(order, axis=0),
            row=order,
            start=start,
            at=at,
        )


_ROOM_BETWEEN_M = 1.0
"""Boxes with more height between them are on different roads. A moved box may be a little above a steep road."""
_FARTHEST = 2.0**40
"""Cells farther away count as this one."""


@compiled
def _by_bucket(xyz, label, side, n_buckets, cell):
    """Rows by bucket of their cells and classes, and where each bucket begins; the cells are written."""
    start = np.zeros(n_buckets + 1, np.int64)
    for row in range(len(cell)):
        side_m = side[label[row]]
        cell[row, 0] = _cell(xyz[row, 0], side_m)
        cell[row, 1] = _cell(xyz[row, 1], side_m)
        bucket = _bucket(cell[row, 0], cell[row, 1], label[row], n_buckets)
        start[bucket + 1] += 1
    for bucket in range(n_buckets):
        start[bucket + 1] += start[bucket]
    at = start.copy()
    order = np.empty(len(cell), np.int64)
    for row in range(len(cell)):
        bucket = _bucket(cell[row, 0], cell[row, 1], label[row], n_buckets)
        order[at[bucket]] = row
        at[bucket] += 1
    return order, start


@kernel
def _cell(x, side):
    """Column or row of a coordinate."""
    return np.int64(np.floor(min(max(x / side, -_FARTHEST), _FARTHEST)))


@kernel
def _bucket(column, row, label, n_buckets):
    """Bucket of a cell and a class. Others may share it; `n_buckets` is a power of two."""
    return (column * 73856093 ^ row * 19349663 ^ np.int64(label) * 83492791) & (n_buckets - 1)


def _reach_m(a: _Detections, b: _Detections, gate: Gate) -> Float[ndarray, "5 5"]:
    """How far apart the centres of detections of two classes are compared; -1 for classes that do not go together."""
    reach_m = np.full((_N_CLASSES + 1, _N_CLASSES + 1), -1.0)
    largest_of_a, largest_of_b = _largest_of(a), _largest_of(b)
    for group in _GROUPS:
        for of_a, of_b in product(group, group):
            one, other = largest_of_a[of_a], largest_of_b[of_b]
            if one[0] >= 0 and other[0] >= 0:
                by_accuracy_m = gate.reach * np.sqrt(one[1] + other[1])
                by_accuracy_m += _largest_difference_m(one, other)
                reach_m[of_a, of_b] = max(one[0] + other[0], by_accuracy_m)
    return reach_m


def _largest_of(detections: _Detections) -> Float[ndarray, "4 6"]:
    """Largest circumradius, variance along any axis, length and width of each class, and smallest length and width.

    The smallest ones are negative. -inf: a class that is not there.
    """
    found = np.full((_N_CLASSES, 6), -np.inf)
    boxes = detections.boxes
    _largest(boxes.circumradius_m, boxes.lwh_m, detections.label, detections.variance_m2, found)
    return found


def _largest_difference_m(one: Float[ndarray, "6"], other: Float[ndarray, "6"]) -> float:
    """Half the largest difference of the sizes of two classes, which does not count as distance."""
    larger = one[2:4] + other[4:]
    smaller = other[2:4] + one[4:]
    return 0.5 * float(np.hypot(*np.maximum(larger, smaller)))


@compiled
def _largest(radius, lwh, label, variance, found):
    """Write the largest of each class, as `_largest_of` returns them."""
    for d in range(len(label)):
        kind = label[d]
        if kind < len(found):
            xx, xy, yy = variance[d]
            along = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
            found[kind, 0] = max(found[kind, 0], radius[d])
            found[kind, 1] = max(found[kind, 1], along)
            length, width = lwh[d, 0], lwh[d, 1]
            found[kind, 2] = max(found[kind, 2], length)
            found[kind, 3] = max(found[kind, 3], width)
            found[kind, 4] = max(found[kind, 4], -length)
            found[kind, 5] = max(found[kind, 5], -width)


def _agreeing(a: _Detections, b: _Detections, gate: Gate) -> Pairs:
    """Pairs that pass the gate, and how well they agree; i < j if `a` and `b` are the same object."""
    reach_m = _reach_m(a, b, gate)
    most_m = reach_m.max(axis=0)
    least_m = np.where(reach_m > 0.0, reach_m, most_m).min(axis=0)
    side_m = np.maximum(np.maximum(least_m, most_m / _MOST_RINGS), 1.0) * (1.0 + 1e-9)
    places = _Places.of(a, side_m)
    others = places if a is b else _Places.of(b, side_m)
    pairs = _candidates(places, others, reach_m, gate)
    agreement = np.exp(-0.5 * pairs["square"])
    agreement[agreement <= gate.miss_p] = 0.0
    agreement = np.maximum(agreement, pairs["iou"])
    kept = np.flatnonzero(agreement > 0.0)
    return pairs["i"][kept], pairs["j"][kept], agreement[kept]


def _candidates(a: _Places, b: _Places, reach_m: Float[ndarray, "5 5"], gate: Gate) -> ndarray:
    """Pairs that may pass the gate, sorted by i and j; those at its edge are not decided."""
    n_chunks = (len(a.row) + _CHUNK - 1) // _CHUNK
    room = _ROOM
    most = -2.0 * np.log(gate.miss_p) * (1.0 + 1e-6) + 1e-9
    while True:
        found = np.empty((n_chunks, room), _FOUND)
        count = np.zeros(n_chunks, np.int64)
        given = a, b, a is b, reach_m, most, gate.least_iou, found, count

        def search(begin: int, end: int, given: Any = given) -> None:
            _search(begin, end, *given)

        in_ranges(search, n_chunks)
        largest = int(count.max(initial=0))
        if largest <= room:
            break
        room = largest
    of_chunks = [found[chunk, :n] for chunk, n in enumerate(count)]
    return np.concatenate([np.empty(0, _FOUND), *of_chunks])


_MOST_RINGS = 8
"""Cells to look at on each side, also where one enormous box is said to be there."""
_CHUNK = 256
"""Detections whose pairs one thread finds at once."""
_ROOM = 64 * _CHUNK
_WITHIN = 1.0 - 1e-5
"""Share of the gate that is not at its edge."""
_FOUND = np.dtype([("square", "f8"), ("iou", "f8"), ("i", "i4"), ("j", "i4")])
"""A pair that may pass the gate: squared Mahalanobis distance, and IoU if it is above the least one."""


@compiled
def _search(begin, end, a, b, is_same, reach_m, most, least_iou, found, count):
    """Write pairs into `found`, sorted by i and j in each chunk, and into `count` their number there.

    That number may exceed the room. Chunks of `a` are independent.
    """
    room = np.empty((4, 16))
    for chunk in range(begin, end):
        count[chunk] = _search_chunk(chunk, a, b, is_same, reach_m, most, least_iou, found[chunk], room)


@kernel
def _search_chunk(chunk, a, b, is_same, reach_m, most, least_iou, out, room):
    """Number of the pairs of one chunk of `a`, of which as many as fit are written to `out`."""
    n, n_buckets, begin = 0, len(b.start) - 1, chunk * _CHUNK
    for one in range(begin, min(begin + _CHUNK, len(a.yaw))):
        first, i = n, np.uint64(a.at[one])  # signed numbers of rows are tested for being negative at each access
        for label in range(len(reach_m)):
            reach = reach_m[a.label[i], label]
            side = b.side[label]
            if reach < 0.0:
                continue
            rings = np.int64(np.ceil(reach / side))
            middle_x = _cell(a.xyz[i, 0], side)
            middle_y = _cell(a.xyz[i, 1], side)
            for column in range(middle_x - rings, middle_x + rings + 1):
                for row in range(middle_y - rings, middle_y + rings + 1):
                    bucket = np.uint64(_bucket(column, row, label, n_buckets))
                    begin_j = np.uint64(b.start[bucket])
                    end_j = np.uint64(b.start[bucket + np.uint64(1)])
                    for j in range(begin_j, end_j):
                        x = a.xyz[i, 0] - b.xyz[j, 0]
                        y = a.xyz[i, 1] - b.xyz[j, 1]
                        apart = x * x + y * y
                        if apart > reach * reach:
                            continue
                        if b.label[j] != label:
                            continue
                        if b.cell[j, 0] != column or b.cell[j, 1] != row:
                            continue
                        other = b.row[j]
                        if is_same and other <= one:
                            continue
                        if len(a.owner) and a.owner[i] == b.owner[j]:
                            continue
                        if _are_above_each_other(a, i, b, j):
                            continue
                        square = _square(a, i, b, j, x, y)
                        iou = 0.0
                        both = a.radius[i] + b.radius[j]
                        if apart < both * both:
                            # Near the edge of the gate, agreement may count as none.
                            agreement = np.exp(-0.5 * square) if square < _WITHIN * most else 0.0
                            if _most_iou(a, i, b, j, x, y) + 1e-6 > max(agreement, least_iou):
                                iou = iou_of(a.xyz, a.lwh, a.yaw, i, b.xyz, b.lwh, b.yaw, j, room)
                                if iou <= least_iou:
                                    iou = 0.0
                        if square > most and iou == 0.0:
                            continue
                        if n < len(out):
                            at = n
                            while at > first and out[at - 1].j > other:  # insertion: a detection has few partners
                                out[at] = out[at - 1]
                                at -= 1
                            here = out[at]
                            here.square, here.iou, here.i, here.j = square, iou, one, other
                        n += 1
    return n


@inlined
def _are_above_each_other(a, i, b, j):
    """Whether two boxes have more height between them than errors explain."""
    apart = abs(a.xyz[i, 2] - b.xyz[j, 2])
    heights = a.lwh[i, 2] + b.lwh[j, 2]
    return apart - 0.5 * heights > _ROOM_BETWEEN_M


@inlined
def _most_iou(a, i, b, j, x, y):
    """IoU of two boxes that are x and y apart if they overlapped along both axes of the first at once."""
    cos, sin = a.cos[i], a.sin[i]
    own, other = a.lwh[i], b.lwh[j]
    turn_cos = abs(cos * b.cos[j] + sin * b.sin[j])
    turn_sin = abs(cos * b.sin[j] - sin * b.cos[j])
    length = turn_cos * other[0] + turn_sin * other[1]
    width = turn_sin * other[0] + turn_cos * other[1]
    along = _overlap(cos * x + sin * y, own[0], length)
    across = _overlap(cos * y - sin * x, own[1], width)
    z = a.xyz[i, 2] - b.xyz[j, 2]
    upright = _overlap(z, own[2], other[2])
    common = along * across * upright
    volume = own[0] * own[1] * own[2]
    other_volume = other[0] * other[1] * other[2]
    return common / (volume + other_volume - common)


@inlined
def _overlap(apart, one, other):
    """Length that two intervals have in common, from the distance of their middles."""
    return max(min(0.5 * (one + other) - abs(apart), one, other), 0.0)


@inlined
def _square(a, i, b, j, x, y):
    """Squared Mahalanobis distance of two centres that are x and y apart.

    What different sizes of the boxes explain along the axes of the longer box is not counted.
    """
    one, other = a.lwh[i], b.lwh[j]
    if one[0] >= other[0]:
        cos, sin = a.cos[i], a.sin[i]
    else:
        cos, sin = b.cos[j], b.sin[j]
    half_length = 0.5 * abs(one[0] - other[0])
    half_width = 0.5 * abs(one[1] - other[1])
    along = _beyond(cos * x + sin * y, half_length)
    across = _beyond(cos * y - sin * x, half_width)
    x = cos * along - sin * across
    y = sin * along + cos * across
    own, its = a.variance[i], b.variance[j]
    xx = own[0] + its[0]
    xy = own[1] + its[1]
    yy = own[2] + its[2]
    square = yy * x * x - 2.0 * xy * x * y + xx * y * y
    return square / (xx * yy - xy * xy)


@inlined
def _beyond(distance, slack):
    """A distance, shorter by the slack."""
    return np.sign(distance) * max(abs(distance) - slack, 0.0)
