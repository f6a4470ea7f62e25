"""Place, size and heading of a fused object, and the variance of its place."""

import numpy as np

from cosim.base.kernel import inlined, kernel
from sensors.box_fusion.information import mean_of_group, pull_of, times


@kernel
def fuse_place(begin, end, seed, owner, table, ego, errors, covariance, slope, box, variance):
    """Write place and variance of one group. `slope` is room, zero before and after."""
    x, y, xx, xy, yy = mean_of_group(begin, end, ego, errors)
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
                a, b = pull_of(c, k, ego.info, ego)
                a, b = times(xx, xy, yy, a, b)
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
def fuse_shape(begin, end, seed, own_turn, table, ego, errors, covariance, box):
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
