"""Kernels of `sensors.evidence`: the area that is evaluated, and free space in the place of a box.

The test of a single point is exact, so a window of the range image may be too large but never changes a result. Rows
are taken as slices from 0: an index that might be negative prevents vectorisation.
"""

from __future__ import annotations

import numpy as np

from cosim.base.kernel import compiled, inlined, kernel
from cosim.base.threads import in_ranges
from sensors.pairs import in_sensor_frame
from sensors.range_steps import NO_RETURN
from sensors.raycast.column import MARGIN_RAD, below, columns_of, slopes_of, spans

_WIDEST = 14.0
"""Tangent of half the width of a pyramid from which on it is a plane rather than a pyramid: 86 degrees."""

_AT_ONCE = 8
"""Rows that are tested at once: a window of as many, or of a multiple, leaves none to be tested one by one."""

_ROUNDED = 1.0 + 1e-9
"""More than a distance is rounded by."""


@inlined
def _in_view(forward, left, fov_rad, slope, slack_m):
    """Inside the field of view or at most the slack beside it; `slope` as `sensors.evidence.edge_slope`."""
    if fov_rad <= np.pi:
        return forward >= 0.0 and abs(left) <= forward * slope + slack_m
    return forward >= 0.0 or abs(left) >= -forward * slope - slack_m


@compiled
def in_area(pairs, road_z, exempt, own_xyz, own_lwh, range_m, height_m, fov_rad, slope, slack_m, own_radius_m):
    """Whether the box of each pair lies in the area of its sensor; `road_z` is the height of the road in its frame.

    A box that is marked in `exempt` need not be in view if it is near the sensor's own box, which is given in the frame
    of the sensor. Without own boxes, no box is exempt.
    """
    found = np.zeros(len(pairs.o), np.bool_)
    for k in range(len(pairs.o)):
        x, y, z, _, _, height, _ = in_sensor_frame(pairs, k)
        bottom = z - 0.5 * height
        distance = np.sqrt(x * x + y * y + bottom * bottom)
        above_road = bottom - road_z[pairs.o[k]]
        if distance <= range_m and abs(above_road) <= height_m:
            inside = _in_view(x, y, fov_rad, slope, slack_m)
            if not inside and len(own_xyz) > 0 and exempt[pairs.b[k]]:
                o = pairs.o[k]
                x -= own_xyz[o, 0]
                y -= own_xyz[o, 1]
                z -= own_xyz[o, 2]
                z -= 0.5 * (height - own_lwh[o, 2])
                apart = np.sqrt(x * x + y * y + z * z)
                inside = apart <= own_radius_m
            found[k] = inside
    return found


@kernel
def is_testable(x, y, z, height, range_m, height_m, fov_rad, slope, road_z):
    """Whether the free-space test applies to a box (sensor frame); `road_z` is the height of the road."""
    bottom = z - 0.5 * height
    distance = np.sqrt(x * x + y * y + bottom * bottom)
    near_enough = distance < range_m and abs(bottom - road_z) <= height_m
    ahead = x != 0.0 or y != 0.0  # straight below there is no pyramid
    return near_enough and ahead and z <= 0.0 and _in_view(x, y, fov_rad, slope, 0.0)


@kernel
def _cross(a, b, sign, normal):
    """Normal of the plane through the sensor and two corners."""
    normal[0] = sign * (a[1] * b[2] - a[2] * b[1])
    normal[1] = sign * (a[2] * b[0] - a[0] * b[2])
    normal[2] = sign * (a[0] * b[1] - a[1] * b[0])


@kernel
def frustum(x, y, middle_z, length, width, height, corner, plane):
    """The pyramid from the sensor through a small square in the middle of a box (sensor frame).

    The bottom of the box lies below the sensor, but not straight below. `plane` [4, 3] is written (a point p is inside
    iff p . plane < 0 for all four), and `corner` [4, 3]: top left, top right, bottom left, bottom right.

    Returns
    -------
    The distance of the bottom centre, and the window that holds the pyramid: azimuth of its middle, half its width,
    lowest and highest slope.
    """
    z = middle_z - 0.5 * height
    away = np.sqrt(x * x + y * y + z * z)
    steep = (x * x + y * y) / z
    size = np.sqrt(x * x + y * y + steep * steep)
    s = min(length, width) / 4.0
    down_x, down_y, down_z = x / size, y / size, steep / size
    sight_x, sight_y, sight_z = x / away, y / away, z / away
    right_x = down_y * sight_z - down_z * sight_y
    right_y = down_z * sight_x - down_x * sight_z
    right_z = down_x * sight_y - down_y * sight_x
    for c in range(4):
        down = -s if c < 2 else s
        right = -s if c % 2 == 0 else s
        corner[c, 0] = x + down * down_x + right * right_x
        corner[c, 1] = y + down * down_y + right * right_y
        corner[c, 2] = middle_z + down * down_z + right * right_z
    _cross(corner[1], corner[0], 1.0, plane[0])
    _cross(corner[3], corner[2], -1.0, plane[1])
    _cross(corner[1], corner[3], -1.0, plane[2])
    _cross(corner[0], corner[2], 1.0, plane[3])
    flat = np.sqrt(x * x + y * y)
    half, low, high = _window(x / flat, y / flat, corner, plane)
    return away, np.arctan2(y, x), half, low, high


@kernel
def _window(cos, sin, corner, plane):
    """Half the width of a pyramid whose middle is in the direction (cos, sin), lowest and highest slope."""
    aside, low, high = 0.0, np.inf, -np.inf
    # Beside a large box the planes may bound no pyramid through the corners: then every ray is tested.
    sound = True
    for c in range(4):
        x, y, z = corner[c]
        along = x * cos + y * sin
        across = abs(y * cos - x * sin)
        slope = z / np.sqrt(x * x + y * y)
        sound = sound and across < _WIDEST * along
        aside = max(aside, across / along if along > 0.0 else np.inf)
        low, high = min(low, slope), max(high, slope)
        upper_or_lower = 0 if c < 2 else 1
        right_or_left = 2 if c % 2 == 1 else 3
        for p in range(4):
            lies_on = p in (upper_or_lower, right_or_left)
            sound = sound and (lies_on or _is_behind(x, y, z, plane[p]))
    if not sound:
        return np.pi, -np.inf, np.inf
    # The side of a pyramid between two corners is a great circle: its slope is larger by 1 / cos of half its arc.
    bulge = np.sqrt(1.0 + aside * aside)
    low = low * bulge if low < 0.0 else low / bulge
    high = high * bulge if high > 0.0 else high / bulge
    return np.arctan(aside) + MARGIN_RAD, low, high


@inlined
def in_frustum(x, y, z, plane):
    """Whether a point lies strictly inside the pyramid."""
    is_inside = _is_behind(x, y, z, plane[0])
    is_inside &= _is_behind(x, y, z, plane[1])
    is_inside &= _is_behind(x, y, z, plane[2])
    return is_inside & _is_behind(x, y, z, plane[3])


@inlined
def _is_behind(x, y, z, normal):
    """Whether a point lies on the inner side of a plane through the origin."""
    return x * normal[0] + y * normal[1] + z * normal[2] < 0.0


def free_space(range_steps, step_m, beams, pairs, run, area, margin_m, rule):
    """Whether the sweep of each pair allows that an object stands in its box: true where the test does not apply.

    `run` is `Pairs.runs`; its runs are divided among threads. `area` is the reach and the height of the evaluation
    area, the slope of its edges, and the height of the road in the frame of each sensor. `rule` is a share, and whether
    places below the lowest beam and gaps between rays permit a box. An object can stand there if more than this share
    of the returns in the pyramid through its box are nearer than the box; if such places permit it, also where its
    middle is lower than the lowest beam; if gaps permit it, also where no ray passes that pyramid.
    """
    allowed = np.ones(len(pairs.o), np.bool_)
    given = range_steps, step_m, beams, pairs, run, area, margin_m, rule

    def test(begin: int, end: int) -> None:
        _free_space(allowed, begin, end, given)

    in_ranges(test, len(run) - 1)
    return allowed


@compiled
def _free_space(allowed, begin, end, given):
    """Write what `free_space` returns, for the pairs of the runs `begin` to `end`."""
    range_steps, step_m, beams, pairs, run, area, margin_m, rule = given
    room = np.empty((4, 3)), np.empty((4, 3))
    view = beams, columns_of(beams), slopes_of(beams)
    for i in range(begin, end):
        first, end_of_run = run[i], run[i + 1]
        sweep = range_steps[pairs.o[first]]
        _free_space_of(allowed, sweep, step_m, view, pairs, first, end_of_run, area, margin_m, rule, room)


@kernel
def _free_space_of(allowed, sweep, step_m, view, pairs, first, end, area, margin_m, rule, room):
    """Write what `free_space` returns, for the pairs `first` to `end` of one sweep."""
    reach_m, height_m, slope, road_z = area
    least_share, below_permits, gaps_permit = rule
    corner, plane = room
    beams, columns, slopes = view
    fov_rad = beams.fov_rad
    for k in range(first, end):
        x, y, z, length, width, height, _ = in_sensor_frame(pairs, k)
        road = road_z[pairs.o[k]]
        if is_testable(x, y, z, height, reach_m, height_m, fov_rad, slope, road):
            away, middle, half, low, high = frustum(x, y, z, length, width, height, corner, plane)
            window = spans(middle, half, columns), _rows(slopes, low, high)
            limit = away + margin_m
            if _nearest_in(sweep, window) * step_m < limit * _ROUNDED:
                allowed[k] = _are_nearer(sweep, step_m, beams, window, plane, limit, least_share)
            else:
                allowed[k] = False
            if below_permits and not allowed[k]:
                flat = np.sqrt(x * x + y * y)
                allowed[k] = z < flat * slopes.tan_el[0]
            if gaps_permit and not allowed[k]:
                allowed[k] = not _has_ray(beams, window, plane)


@kernel
def _has_ray(beams, window, plane):
    """Whether a sensor sends any ray through a pyramid, which lies in a window."""
    (a0, a1, b0, b1), (r0, r1) = window
    for turn in range(2):
        first, end = (a0, a1) if turn == 0 else (b0, b1)
        for c in range(first, end):
            for r in range(r0, r1):
                x = beams.cos_el[r] * beams.cos_az[c]
                y = beams.cos_el[r] * beams.sin_az[c]
                if in_frustum(x, y, beams.sin_el[r], plane):
                    return True
    return False


@kernel
def _rows(slopes, low, high):
    """Rows between two slopes, and as many more as make them a multiple of `_AT_ONCE`."""
    m = len(slopes.tan_el)
    r0 = max(0, below(slopes, low) - 1)
    r1 = min(m, below(slopes, high) + 1)
    n_rows = -(-(r1 - r0) // _AT_ONCE) * _AT_ONCE
    r1 = min(m, r0 + n_rows)
    return max(0, r1 - n_rows), r1


@kernel
def _nearest_in(sweep, window):
    """The nearest return in a window, in steps; `NO_RETURN` if there is none."""
    (a0, a1, b0, b1), (r0, r1) = window
    nearest = np.uint16(NO_RETURN)
    for turn in range(2):
        first, end = (a0, a1) if turn == 0 else (b0, b1)
        for c in range(first, end):
            steps = sweep[c, r0:r1]
            for r in range(len(steps)):
                nearest = min(nearest, steps[r])
    return nearest


@kernel
def _are_nearer(sweep, step_m, beams, window, plane, limit, least_share):
    """Whether more than a share of the returns in a pyramid, which lies in a window, are nearer than a limit."""
    (a0, a1, b0, b1), (r0, r1) = window
    cos_el = beams.cos_el[r0:r1]
    sin_el = beams.sin_el[r0:r1]
    n_seen, n_closer = 0, 0
    n_rays = (a1 - a0 + b1 - b0) * (r1 - r0)
    for turn in range(2):
        first, end = (a0, a1) if turn == 0 else (b0, b1)
        for c in range(first, end):
            steps = sweep[c, r0:r1]
            ca, sa = beams.cos_az[c], beams.sin_az[c]
            for r in range(len(steps)):
                d = steps[r] * step_m
                flat = d * cos_el[r]
                x, y = flat * ca, flat * sa
                z = d * sin_el[r]
                is_seen = in_frustum(x, y, z, plane) & (steps[r] != NO_RETURN)
                n_seen += is_seen
                distance = np.sqrt(x * x + y * y + z * z)
                n_closer += is_seen & (distance < limit)
            if n_closer > least_share * n_rays:
                return True  # also if all others lie in the pyramid and are farther
    return n_closer > least_share * n_seen
