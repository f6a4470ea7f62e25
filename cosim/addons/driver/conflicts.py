"""Surrogate safety measures from poses alone: time to collision, deceleration to avoid a crash, post-encroachment time.

Geometry: a vehicle's leader is the nearest vehicle ahead of it whose heading differs by less than 45 degrees and whose
middle is beside the vehicle's straight axis by less than half the sum of both widths, at most 50 m away unless asked
otherwise. The gap is that of parallel vehicles: the distance of their middles along this axis, less half the sum of
both lengths. In bends this misses leaders that a lane would show. Vehicles whose wheels are more than 3 m apart in
height are on different roads, such as a bridge and the street below. Definitions follow SUMO's SSM device, against
which they are verified.
"""

from collections.abc import Iterator
from itertools import chain, pairwise
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.base.codes import PARKED
from cosim.base.plane import crossed, turned_by
from cosim.base.ragged import differs_from_last
from results.run import Run

RANGE_M = 50.0
_ALONG = np.cos(np.pi / 4)
_CROSSING = np.cos(np.pi / 6)
"""Paths that differ by more than 30 degrees cross; others follow each other."""
_LEVEL_M = 3.0
"""Vehicles with a larger difference in height of their wheels are on different roads."""
_SEGMENT_M, _PET_S = 12.0, 5.0
"""Distance up to which ways of a step are compared, or more if a way is longer, and largest post-encroachment time that
is looked for."""
_FASTEST_MPS = 60.0
"""Ways that are faster, and longer than `_SEGMENT_M`, are jumps."""
_STRETCH = 120.0
"""Length of the stretches of time that are searched one after another, in the unit of scaled time."""
_ROWS = 20_000
"""Poses of whole steps that are compared at once."""


_TRACKS = """
    SELECT step, actor, x_m, y_m, z_m - height_m / 2 AS ground_m, yaw_rad, speed_mps, length_m, width_m,
        if(lag(step) OVER mine = step - 1, (speed_mps - lag(speed_mps) OVER mine)::DOUBLE / $dt_s, NULL)
            AS acceleration_mps2
    FROM actors JOIN vehicles ON vehicle = actor
    WHERE vehicle_class <> 'pedestrian' AND NOT starts_with(sumo_id, $parked)
    WINDOW mine AS (PARTITION BY actor ORDER BY step) ORDER BY step, actor
"""


def tracks(run: Run) -> pd.DataFrame:
    """Vehicles' poses with their sizes, without pedestrians and parked cars.

    Returns
    -------
    step, actor, x_m, y_m, ground_m (height of the wheels), yaw_rad, speed_mps, length_m, width_m, acceleration_mps2
    (missing in a vehicle's first step); by step, then actor.
    """
    return run.sql(_TRACKS, parked=PARKED)


def driven_km(poses: pd.DataFrame, run: Run) -> float:
    """Distance that vehicles drove, of the speeds in some of their poses."""
    return float(poses.speed_mps.astype(float).sum()) * run.dt_s / 1000


def following(run: Run, poses: pd.DataFrame | None = None, range_m: float = RANGE_M) -> pd.DataFrame:
    """Every vehicle's leader in every step, up to a gap of `range_m`.

    Returns
    -------
    step, actor, leader, gap_m (bumper to bumper, at least 0), closing_mps, ttc_s (time to collision: gap over closing
    speed; missing where the gap does not close), drac_mps2 (deceleration rate to avoid a crash: closing speed squared
    over twice the gap).
    """
    poses = tracks(run) if poses is None else poses
    parts = [_leaders(at, range_m) for at in _stretches(poses)]
    return pd.concat(parts, ignore_index=True)


def _stretches(poses: pd.DataFrame) -> Iterator[dict[str, ndarray]]:
    """Columns of whole steps, about `_ROWS` rows at once. There is one stretch at least, without rows if need be."""
    columns = {name: poses[name].to_numpy() for name in poses.columns}
    first_of_steps = np.flatnonzero(differs_from_last(columns["step"]))
    number = first_of_steps // _ROWS
    begins = first_of_steps[differs_from_last(number)]
    edges = [0, *begins[1:].tolist(), len(poses)]
    for begin, end in pairwise(edges):
        yield {name: column[begin:end] for name, column in columns.items()}


def _pairs(step: ndarray, xy: Float[ndarray, "n 2"], reach_m: float) -> Int[ndarray, "p 2"]:
    """Pairs of rows of one step that are at most `reach_m` apart."""
    if len(xy) < 2:
        return np.zeros((0, 2), int)
    height = (step - step[0]) * (2 * reach_m + 1.0)  # each step lies in a plane of its own, out of reach of the others
    return cKDTree(np.column_stack([xy, height])).query_pairs(reach_m, output_type="ndarray")


def _leaders(at: dict[str, ndarray], range_m: float) -> pd.DataFrame:
    """As `following`, of some steps."""
    xy = np.column_stack([at["x_m"], at["y_m"]]).astype(float)
    length, width, yaw, speed, ground = (
        np.asarray(at[name], float) for name in ("length_m", "width_m", "yaw_rad", "speed_mps", "ground_m")
    )
    reach_m = np.hypot(range_m + length.max(initial=0.0), width.max(initial=0.0))
    pairs = _pairs(at["step"], xy, float(reach_m))
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    ahead, left = turned_by(-yaw[i], xy[j] - xy[i]).T
    along = np.cos(yaw[j] - yaw[i])
    gap = ahead - (length[i] + length[j]) / 2
    in_path = np.abs(left) < (width[i] + width[j]) / 2
    in_path &= _on_one_road(ground, i, j)
    is_leader = (ahead > 0) & in_path & (along > _ALONG)
    leads = np.flatnonzero(is_leader & (gap <= range_m))
    gap = np.maximum(gap, 0.0)
    by_gap = np.lexsort((j[leads], gap[leads], i[leads]))
    leads = leads[by_gap]
    nearest = leads[differs_from_last(i[leads])]
    i, j = i[nearest], j[nearest]
    gap, along = gap[nearest], along[nearest]
    closing = speed[i] - speed[j] * along
    with np.errstate(divide="ignore", invalid="ignore"):
        ttc = np.where(closing > 1e-6, gap / closing, np.nan)
        drac = np.where(closing > 1e-6, closing**2 / (2 * gap), 0.0)
    actor = at["actor"]
    columns = {"actor": actor[i], "leader": actor[j], "gap_m": gap, "closing_mps": closing}
    return pd.DataFrame({"step": at["step"][i], **columns, "ttc_s": ttc, "drac_mps2": drac})


def encroachments(run: Run, poses: pd.DataFrame | None = None) -> pd.DataFrame:
    """Vehicles whose ways cross within 5 s of each other. Of several crossings of two, the closest in time counts.

    Returns
    -------
    first, second, time_s (at which the second arrives), pet_s (post-encroachment time: from when the first has left
    the common area until the second arrives; negative where both were in it at once). The area is where the two
    footprints, on straight ways, would overlap.
    """
    poses = tracks(run) if poses is None else poses
    ways = _ways(poses, run.dt_s)
    reach_m = max(_SEGMENT_M, ways.long_m.max(initial=0.0))
    scale = reach_m / _PET_S
    scaled_time = ways.step * run.dt_s * scale
    near = _near(np.column_stack([ways.start_m + ways.way_m / 2, scaled_time]), reach_m)
    nothing = np.zeros((0, 2), int)
    found = [_crossing(pairs, ways) for pairs in chain([nothing], near)]  # one stretch of pairs at a time in memory
    i, j, u, v = map(np.concatenate, zip(*found, strict=True))
    at_i = (ways.step[i] + u) * run.dt_s
    at_j = (ways.step[j] + v) * run.dt_s
    in_i = _half_m(ways, i, j) * run.dt_s / ways.long_m[i]
    in_j = _half_m(ways, j, i) * run.dt_s / ways.long_m[j]
    i_first = at_i <= at_j
    actor_i, actor_j = ways.actor[i], ways.actor[j]
    frame = pd.DataFrame(
        {
            "first": np.where(i_first, actor_i, actor_j),
            "second": np.where(i_first, actor_j, actor_i),
            "time_s": np.where(i_first, at_j - in_j, at_i - in_i),
            "pet_s": np.abs(at_j - at_i) - in_i - in_j,
        }
    )
    frame = frame[frame.pet_s <= _PET_S].sort_values(["pet_s", "first", "second"], kind="stable")
    two = pd.DataFrame(np.sort(frame[["first", "second"]].to_numpy(), axis=1))
    frame = frame[~two.duplicated().to_numpy()]
    return frame.sort_values(["first", "second"], ignore_index=True)


class _Ways(NamedTuple):
    """Ways of vehicles from one step to the next, by vehicle, then step."""

    actor: Int[ndarray, "n"]
    step: Int[ndarray, "n"]
    """The first of the two."""
    start_m: Float[ndarray, "n 2"]
    way_m: Float[ndarray, "n 2"]
    long_m: Float[ndarray, "n"]
    """Length of the way."""
    ground_m: Float[ndarray, "n"]
    length_m: Float[ndarray, "n"]
    """Length of the vehicle."""
    width_m: Float[ndarray, "n"]


def _ways(poses: pd.DataFrame, dt_s: float) -> _Ways:
    """The ways of vehicles that move, without jumps."""
    order = np.lexsort([poses.step, poses.actor])
    actor = poses.actor.to_numpy()[order]
    step = poses.step.to_numpy()[order]
    goes_on = np.flatnonzero((np.diff(actor) == 0) & (np.diff(step) == 1))
    xy = poses[["x_m", "y_m"]].to_numpy(float)
    start = xy[order[goes_on]]
    way = xy[order[goes_on + 1]] - start
    length = np.hypot(*way.T)
    moves = (length > 0.1) & (length < max(_SEGMENT_M, _FASTEST_MPS * dt_s))
    start, way, length = start[moves], way[moves], length[moves]
    rows = goes_on[moves]
    actor, step = actor[rows], step[rows]
    begins = order[rows]
    sizes = poses[["ground_m", "length_m", "width_m"]].iloc[begins]
    ground_m, length_m, width_m = sizes.to_numpy(float).T
    return _Ways(actor, step, start, way, length, ground_m, length_m, width_m)


def _on_one_road(
    ground_m: ndarray,
    i: Int[ndarray, "p"],
    j: Int[ndarray, "p"],
) -> Bool[ndarray, "p"]:
    """Whether pairs of rows have their wheels at about one height."""
    return np.abs(ground_m[i] - ground_m[j]) <= _LEVEL_M


def _near(points: Float[ndarray, "n 3"], reach_m: float) -> Iterator[Int[ndarray, "p 2"]]:
    """Pairs of rows that lie within `reach_m` in place and scaled time, a stretch of time after another."""
    time = points[:, 2]
    edges = np.arange(time.min(initial=0.0), time.max(initial=0.0) + _STRETCH, _STRETCH)
    for begin in edges.tolist():
        rows = np.flatnonzero((time >= begin) & (time < begin + _STRETCH + reach_m))
        if len(rows) > 1:
            yield rows[cKDTree(points[rows]).query_pairs(reach_m, output_type="ndarray")]


def _crossing(pairs: Int[ndarray, "p 2"], ways: _Ways) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Pairs of ways of different vehicles on one road that intersect, and where on each, as a share of it."""
    i, j = pairs.T
    of_two = ways.actor[i] != ways.actor[j]
    i, j = i[of_two], j[of_two]
    dot = np.sum(ways.way_m[i] * ways.way_m[j], axis=1)
    cosine = dot / (ways.long_m[i] * ways.long_m[j])
    crosses = (cosine < _CROSSING) & _on_one_road(ways.ground_m, i, j)
    i, j = i[crosses], j[crosses]
    way_i, way_j = ways.way_m[i], ways.way_m[j]
    det = crossed(way_i, way_j)
    between = ways.start_m[j] - ways.start_m[i]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = crossed(between, way_j) / det
        v = crossed(between, way_i) / det
    inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    return i[inside], j[inside], u[inside], v[inside]


def _half_m(ways: _Ways, row: ndarray, other: ndarray) -> Float[ndarray, "p"]:
    """Half the way on which a vehicle's footprint is in the common area: its length and the other's width, slanted."""
    area = np.abs(crossed(ways.way_m[row], ways.way_m[other]))
    sine = area / (ways.long_m[row] * ways.long_m[other])
    slanted_m = ways.width_m[other] / np.maximum(sine, 0.5)
    return (ways.length_m[row] + slanted_m) / 2


def overlaps(run: Run, poses: pd.DataFrame | None = None) -> pd.DataFrame:
    """Pairs of vehicles whose footprints are in each other by more than 0.3 m, one of them moving: a, b, step.

    Notes
    -----
    SUMO checks vehicles of one lane, and of crossing lanes at junctions; this sees everything, also vehicles that SUMO
    lets pass through each other between lanes.
    """
    poses = tracks(run) if poses is None else poses
    found = []
    for at in _stretches(poses):
        xy = np.column_stack([at["x_m"], at["y_m"]]).astype(float)
        reach = np.hypot(at["length_m"], at["width_m"]).astype(float)
        i, j = _pairs(at["step"], xy, float(reach.max(initial=0.0))).T
        apart = xy[i] - xy[j]
        close = np.hypot(*apart.T) < (reach[i] + reach[j]) / 2
        close &= _on_one_road(at["ground_m"], i, j)
        i, j = i[close], j[close]
        fastest_mps = np.maximum(at["speed_mps"][i], at["speed_mps"][j])
        hit = (_depth(at, xy, i, j) > 0.3) & (fastest_mps > 0.5)
        i, j = i[hit], j[hit]
        actor, step = at["actor"], at["step"][i]
        lower = np.minimum(actor[i], actor[j])
        higher = np.maximum(actor[i], actor[j])
        found.append(pd.DataFrame({"a": lower, "b": higher, "step": step}))
    frame = pd.concat(found).sort_values("step", kind="stable")
    return frame.drop_duplicates(["a", "b"]).reset_index(drop=True)


def _depth(
    at: dict[str, ndarray],
    xy: ndarray,
    i: ndarray,
    j: ndarray,
) -> Float[ndarray, "p"]:
    """Penetration of two rectangles along the axis on which it is least; negative where they are apart."""
    depth = np.full(len(i), np.inf)
    apart = xy[j] - xy[i]
    for own in (i, j):
        for turn in (0.0, np.pi / 2):
            axis = at["yaw_rad"][own].astype(float) + turn
            reach = np.zeros(len(i))
            for row in (i, j):
                angle = at["yaw_rad"][row] - axis
                by_length = np.abs(at["length_m"][row] * np.cos(angle))
                by_width = np.abs(at["width_m"][row] * np.sin(angle))
                reach += (by_length + by_width) / 2
            along_axis = turned_by(-axis, apart)[:, 0]
            depth = np.minimum(depth, reach - np.abs(along_axis))
    return depth


def begins(
    on: Bool[ndarray, "n"],
    off: Bool[ndarray, "n"],
    track: ndarray,
) -> Bool[ndarray, "n"]:
    """Rows in which an event begins: `on` holds, and no event of the same track is under way.

    Parameters
    ----------
    on, off
        Rows in which an event is under way for certain, and rows in which none is. In rows with neither, the state
        stays as it was.
    track
        Number of the track of each row. The rows of a track follow each other in the order of time. No event is under
        way before its first row.

    Returns
    -------
    True in the first row of each event.
    """
    is_first = differs_from_last(track)
    now = held(np.where(on, 1, np.where(off | is_first, -1, 0)))
    before = np.where(is_first, -1, np.append(-1, now[:-1]))
    return (now == 1) & (before == -1)


def held(state: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """States in which 0 means: as in the row before. The first one is not 0."""
    last_change = np.where(state != 0, np.arange(len(state)), 0)
    return state[np.maximum.accumulate(last_change)]
