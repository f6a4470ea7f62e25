"""Tracks of actors on the steps of a run, interpolated between positions at any times; gaps cut a track in two."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.addons.traces.positions import Fixes
from cosim.base.ragged import expand

_ROWS_AT_ONCE = 1_000_000
_TOLERANCE = 1e-6
"""Part of a step by which a time may miss it."""
_FEWEST_LINKS, _LEAST_JOINED_P = 3, 0.1
"""If there are fewer pairs, or a larger share of them is joined, units are not doubted."""
COMMON_STEP_S = 1.0
"""Step for traces whose times have no common interval [s]."""


@dataclass(frozen=True, slots=True)
class TrackParams:
    """How positions become tracks."""

    step_s: float
    max_gap_s: float
    """Longest time between two positions of an actor across which it is followed [s]."""
    max_speed_mps: float = 70.0
    """Two positions that ask for a faster motion are a jump: the track is cut there [m/s]."""
    length_s: float = math.inf
    """Tracks are placed on the steps from 0 s to this time [s]."""


@dataclass(frozen=True, slots=True)
class PositionTracks:
    """S tracks, numbered by their first step and name, made of L links between positions that follow each other."""

    names: list[str]
    """Name of the vehicle of each track: that of the actor, and `/2`, `/3` ... where it cannot have driven there.
    Tracks of one name are one vehicle, which is not seen in between."""
    actor: Int[ndarray, "s"]
    """Row of `Fixes.names`."""
    first_step: Int[ndarray, "s"]
    last_step: Int[ndarray, "s"]
    link_track: Int[ndarray, "l"]
    link_fix: Int[ndarray, "l"]
    """Row of the earlier position of the link; a link of the last position has no length."""
    link_first: Int[ndarray, "l"]
    """First step of the link; links are sorted by it."""
    link_end: Int[ndarray, "l"]
    """One past its last step."""
    is_joined: Bool[ndarray, "l"]
    """Whether the link reaches the next position of its actor."""
    n_steps: int
    report: dict[str, float]


@dataclass(frozen=True, slots=True)
class Positions:
    """All actors of one step."""

    step: int
    track: Int[ndarray, "n"]
    xy_m: Float[ndarray, "n 2"]


def check_options(step_s: float | None, max_gap_s: float, max_speed_mps: float, frame_hz: float | None) -> None:
    """Raise ValueError, in one line, if a value of the command line is not a possible one."""
    given = {
        "step_s": (step_s, 1e-3),
        "max_gap_s": (max_gap_s, 0.0),
        "max_speed_mps": (max_speed_mps, 0.0),
        "frame_hz": (frame_hz, 1e-3),
    }
    for name, (value, least) in given.items():
        if value is not None and not (least < value < math.inf):
            raise ValueError(f"--{name.replace('_', '-')} {value:g}: a finite number above {least:g} is needed.")


def on_own_steps(fixes: Fixes) -> tuple[Fixes, float]:
    """The positions with times that are multiples of a step, if they are so but for rounding, and that step.

    Otherwise the positions as they are, and 1 s.
    """
    took_s = np.diff(fixes.time_s)[np.diff(fixes.actor) == 0]
    least_s = float(took_s.min(initial=math.inf))
    if not 1e-3 <= least_s <= COMMON_STEP_S:
        return fixes, COMMON_STEP_S
    near_s = took_s[took_s < 5 * least_s]
    steps_per_s = np.round(near_s / least_s).sum() / near_s.sum()
    number = np.round(fixes.time_s * steps_per_s)
    about_s = float((fixes.time_s @ number) / (number @ number))
    for step_s in (round(about_s, 3), 1 / round(1 / about_s), round(about_s, 6), about_s):
        time_s = np.round(fixes.time_s / step_s) * step_s
        if np.abs(time_s - fixes.time_s).max() < _spare_s(fixes.time_s, step_s):
            return replace(fixes, time_s=time_s), step_s
    return fixes, COMMON_STEP_S


def _spare_s(time_s: Float[ndarray, "n"], step_s: float) -> float:
    """By how much times can miss steps, because a file rounds them [s]."""
    for unit_s in (0.01, 0.001):
        rounded_s = np.round(time_s / unit_s) * unit_s
        if np.abs(time_s - rounded_s).max() < 1e-6:
            return max(1e-3 * step_s, min(0.6 * unit_s, 0.2 * step_s))
    return 1e-3 * step_s


def tracks(fixes: Fixes, params: TrackParams) -> PositionTracks:
    """Cut the positions of each actor into tracks at gaps and jumps, and place them on steps.

    Raises
    ------
    ValueError
        In one line, if no track reaches a step, or if almost no position can be joined to the next one.

    Notes
    -----
    Between two positions the motion is straight and of constant speed. If no vehicle is faster than v, the truth lies
    in an ellipse with the two positions as foci, so the error is at most sqrt((v T)^2 - d^2) / 2 across the line for a
    link of T seconds and d metres. The report has the median and the 95th percentile of that bound over steps between
    two positions, for v = 20 m/s or the speed of the link itself if that is more.
    """
    n = len(fixes.time_s)
    follows = np.diff(fixes.actor) == 0
    took_s = np.diff(fixes.time_s)
    gone_m = np.hypot(*np.diff(fixes.xy_m, axis=0).T)
    with np.errstate(divide="ignore", invalid="ignore"):
        is_jump = follows & (took_s > 0) & (gone_m > params.max_speed_mps * took_s + 1e-9)
    is_gap = follows & (took_s > params.max_gap_s * (1 + 1e-9))
    _check_links(params, took_s[follows], gone_m[follows], is_gap[follows], is_jump[follows])
    linked = np.append(follows & ~is_gap & ~is_jump, False)[:n]
    begins = np.append(True, ~linked[:-1])[:n]
    track = np.cumsum(begins) - 1
    # Steps s with time_s[i] <= s * step_s < time_s[i + 1]; the last position of a track has its own step, if on one.
    at = fixes.time_s / params.step_s
    begin = np.ceil(at - _TOLERANCE).astype(np.int64)
    own_end = np.floor(at + _TOLERANCE).astype(np.int64) + 1
    end = np.where(linked, np.append(begin[1:], 0), own_end)
    first = np.maximum(begin, 0)
    last = np.floor(params.length_s / params.step_s + _TOLERANCE)
    end = np.minimum(end, last + 1).astype(np.int64)
    some = end > first
    if not some.any():
        raise ValueError(
            f"no position of the trace is at, or interpolated to, a step of {params.step_s:g} s. Lower --step-s, or "
            "raise --max-gap-s."
        )
    links = np.flatnonzero(some)
    codes, of = np.unique(track[links], return_inverse=True)
    first_step = np.full(len(codes), np.iinfo(np.int64).max)
    last_step = np.full(len(codes), -1)
    np.minimum.at(first_step, of, first[links])
    np.maximum.at(last_step, of, end[links] - 1)
    first_fix = np.flatnonzero(begins)
    last_fix = np.append(first_fix[1:], n) - 1
    actor = fixes.actor[first_fix[codes]]
    names = _names(fixes, params, first_fix[codes], last_fix[codes])
    order = np.lexsort((np.array(names), first_step))
    number = np.empty(len(codes), np.int64)
    number[order] = np.arange(len(codes))
    by_step = np.argsort(first[links], kind="stable")
    return PositionTracks(
        names=[names[i] for i in order.tolist()],
        actor=actor[order],
        first_step=first_step[order],
        last_step=last_step[order],
        link_track=number[of][by_step],
        link_fix=links[by_step],
        link_first=first[links][by_step],
        link_end=end[links][by_step],
        is_joined=linked[links][by_step],
        n_steps=int(last_step.max()) + 1,
        report=_report(fixes, params, linked, (took_s, gone_m), (is_gap, is_jump), (links, first, end)),
    )


def _names(
    fixes: Fixes,
    params: TrackParams,
    first_fix: Int[ndarray, "s"],
    last_fix: Int[ndarray, "s"],
) -> list[str]:
    """Name of the vehicle of each track: one that the actor has already, if that one can have driven there.

    Parameters
    ----------
    first_fix, last_fix
        First and last position of each track. Tracks of an actor follow each other.
    """
    taken, names = set(fixes.names), list[str]()
    last_of = dict[str, int]()
    actor, n = -1, 1
    for first, last in zip(first_fix.tolist(), last_fix.tolist(), strict=True):
        if fixes.actor[first] != actor:
            actor, n, last_of = int(fixes.actor[first]), 1, {}
            name = fixes.names[actor]
        else:
            reached = (known for known, at in last_of.items() if _can_drive(fixes, params, at, first))
            name = next(reached, "")
        while not name:
            n += 1
            another = f"{fixes.names[actor]}/{n}"
            name = "" if another in taken else another
        names.append(name)
        last_of[name] = last
    return names


def _can_drive(fixes: Fixes, params: TrackParams, before: int, after: int) -> bool:
    east_m, north_m = fixes.xy_m[after] - fixes.xy_m[before]
    way_m = float(np.hypot(east_m, north_m))
    took_s = float(fixes.time_s[after] - fixes.time_s[before])
    return way_m <= params.max_speed_mps * took_s + 1e-9


def _check_links(
    params: TrackParams, took_s: ndarray, gone_m: ndarray, is_gap: Bool[ndarray, "f"], is_jump: Bool[ndarray, "f"]
) -> None:
    """Refuse positions of which almost none is joined to the next one of its actor: their units are wrong."""
    n, n_joined = len(took_s), int((~is_gap & ~is_jump).sum())
    if n < _FEWEST_LINKS or n_joined >= _LEAST_JOINED_P * n:
        return
    said = f"of {n:,} pairs of positions that follow each other, only {n_joined:,} are joined: "
    if 2 * is_gap.sum() >= n:
        raise ValueError(
            f"{said}they are {np.median(took_s):g} s apart (median), and --max-gap-s is {params.max_gap_s:g}. Are the "
            "times in another unit, such as milliseconds? Set --time-unit, or raise --max-gap-s."
        )
    with np.errstate(divide="ignore"):
        fast_mps = np.median(gone_m / took_s)
    raise ValueError(
        f"{said}they ask for {fast_mps:,.4g} m/s (median), and --max-speed-mps is {params.max_speed_mps:g}. Are times "
        "or positions in another unit? Set --time-unit, --length-unit or --frame-hz, or raise --max-speed-mps."
    )


def _report(
    fixes: Fixes,
    params: TrackParams,
    linked: Bool[ndarray, "n"],
    moved: tuple[ndarray, ndarray],
    cuts: tuple[ndarray, ndarray],
    steps: tuple[ndarray, ndarray, ndarray],
) -> dict[str, float]:
    """How much of the tracks is interpolated, and the bound on its error.

    `moved` is time [s] and way [m] between fixes, `cuts` whether there is a gap or a jump, and `steps` the links with
    their first and last step.
    """
    took_s, gone_m = moved
    is_gap, is_jump = cuts
    links, first, end = steps
    inner = links[linked[links]]
    before_first = np.abs(fixes.time_s[inner] / params.step_s - first[inner])
    begins_on_step = before_first <= _TOLERANCE
    n_between = (end[inner] - first[inner] - begins_on_step).astype(np.int64)
    n_all = int((end[links] - first[links]).sum())
    speed = np.maximum(20.0, gone_m[inner] / took_s[inner])
    farthest_m = speed * took_s[inner]
    squared_m2 = farthest_m**2 - gone_m[inner] ** 2
    bound_m = np.sqrt(np.maximum(squared_m2, 0)) / 2
    ends = np.array([0.5, 0.95])
    bounds = _weighted_quantiles(bound_m, n_between, ends) if n_between.sum() else np.zeros(2)
    are_linked = linked[:-1]
    between = took_s[are_linked]
    speeds = gone_m[are_linked] / between if len(between) else np.zeros(1)
    width_m, height_m = np.ptp(fixes.xy_m, axis=0).tolist()
    return {
        "positions": len(fixes.time_s),
        "interval_median_s": float(np.median(between)) if len(between) else 0.0,
        "gaps": int(is_gap.sum()),
        "jumps": int((is_jump & ~is_gap).sum()),
        "interpolated_share": float(n_between.sum() / n_all),
        "error_bound_median_m": float(bounds[0]),
        "error_bound_p95_m": float(bounds[1]),
        "speed_median_mps": float(np.median(speeds)),
        "speed_p95_mps": float(np.quantile(speeds, 0.95)),
        "extent_east_m": width_m,
        "extent_north_m": height_m,
    }


def _weighted_quantiles(values: ndarray, weights: ndarray, at: ndarray) -> ndarray:
    order = np.argsort(values)
    shares = np.cumsum(weights[order]) / weights.sum()
    rows = np.minimum(np.searchsorted(shares, at), len(values) - 1)
    return values[order[rows]]


def steps(fixes: Fixes, found: PositionTracks, step_s: float) -> Iterator[Positions]:
    """Positions of all tracks, step by step, from step 0 on. Of steps without actors, the first is there."""
    lengths = found.link_end - found.link_first
    longest = int(lengths.max())
    per_step = max(1.0, int(lengths.sum()) / found.n_steps)
    block = max(1, min(found.n_steps, int(_ROWS_AT_ONCE / per_step)))
    last_step = -1
    for begin in range(0, found.n_steps, block):
        end = min(begin + block, found.n_steps)
        low, high = np.searchsorted(found.link_first, [begin - longest, end])
        rows = np.arange(low, high)[found.link_end[low:high] > begin]
        first = np.maximum(found.link_first[rows], begin)
        step, which = expand(first, np.minimum(found.link_end[rows], end))
        link = rows[which]
        track = found.link_track[link]
        xy_m = _interpolated(fixes, found.link_fix[link], step * step_s)
        order = np.lexsort((track, step))
        step, track, xy_m = step[order], track[order], xy_m[order]
        taken, first = np.unique(step, return_index=True)
        ends = [*first.tolist(), len(step)][1:]
        for number, a, b in zip(taken.tolist(), first.tolist(), ends, strict=True):
            if number > last_step + 1:
                yield Positions(last_step + 1, track[:0], xy_m[:0])
            yield Positions(number, track[a:b], xy_m[a:b])
            last_step = number


def _interpolated(
    fixes: Fixes,
    fix: Int[ndarray, "k"],
    time_s: Float[ndarray, "k"],
) -> Float[ndarray, "k 2"]:
    """Positions at times between a position of an actor and its next one."""
    after = np.minimum(fix + 1, len(fixes.time_s) - 1)
    begin_s, begin_m = fixes.time_s[fix], fixes.xy_m[fix]
    took_s = fixes.time_s[after] - begin_s
    is_link = (fixes.actor[after] == fixes.actor[fix]) & (took_s > 0)
    divisor_s = np.where(is_link, took_s, 1.0)
    share = np.where(is_link, (time_s - begin_s) / divisor_s, 0.0)
    share = np.clip(np.where(np.abs(share) < _TOLERANCE, 0.0, share), 0.0, 1.0)  # a time on a step is that position
    way_m = fixes.xy_m[after] - begin_m
    return begin_m + share[:, None] * way_m
