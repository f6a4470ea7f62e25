"""Positions of actors in a trace from elsewhere: the rows of all its files, joined and checked."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.addons.traces import units
from cosim.addons.traces.layouts import FileRows, PositionColumns, rows_of_file
from cosim.base.earth import Projection
from cosim.base.rows import Rows
from cosim.traffic.frame import LARGEST_COORDINATE_M, TrafficError
from cosim.traffic.source import SHAPE_OF_CLASS
from sensors.scene import Shape
from sumo_nets import vtypes

_MOST_DEGREES = (90.0, 180.0)
_CRAWL_MPS = 0.05
"""If something moves, and nothing faster than this but for glitches, coordinates are not metres."""
_GLITCHES, _GLITCH_P, _ENOUGH = 2, 0.02, 10
"""Faster moves that are glitches at most: a receiver that says 0, 0 once makes two."""
_LONG_S, _FASTEST_MPS = 30.0, 70.0
"""An id that comes back as another class after a longer time, or by a faster way, is another actor."""
_DAY_S, _ZIGZAG = 86400.0, 1.5
"""Times of day are at most a day, and rows of two actors, sorted by time, are a way that is longer by this factor."""
_WIDE_M = 1.2
"""Who is wider, and wider than long, is no pedestrian."""
_LEAST_SIZE_M = 0.05
"""Smaller sizes, such as the zeros of pedestrians in inD, say nothing."""


@dataclass(frozen=True, slots=True)
class Fixes:
    """N positions of actors, sorted by actor and time, no two of an actor at one time."""

    names: list[str]
    """Name of each actor, as in the trace."""
    kinds: list[str]
    """Class of each actor, as in the trace; empty if it does not say."""
    actor: Int[ndarray, "n"]
    """Row of `names`."""
    time_s: Float[ndarray, "n"]
    """Seconds since `begin`."""
    xy_m: Float[ndarray, "n 2"]
    begin: str = "0"
    """What time 0 is in the trace."""
    repaired: dict[str, int] = field(default_factory=dict)
    """Rows that were left out or sorted, by reason."""
    own_lw_m: Float[ndarray, "a 2"] | None = None
    """Length and width of each actor, not a number where the trace does not say. None if it says none."""
    projection: Projection | None = None
    """From degrees to the metres. None if positions were metres, or if the projection is that of a network."""
    read_as: tuple[str, ...] = ()
    """How the numbers of the trace were understood, where that is not metres and seconds."""
    source: str = ""
    """Its files, for error messages."""
    is_front: bool = False
    """Whether positions are those of the front bumper. They are centres otherwise."""

    @property
    def types(self) -> list[vtypes.VehicleType]:
        """SUMO's class of each actor, and its size: that of the trace, or that of the class; a car without a class."""
        found = [vtypes.guess(kind) for kind in self.kinds]
        if self.own_lw_m is None:
            return found
        own = []
        for guessed, (length_m, width_m) in zip(found, self.own_lw_m.tolist(), strict=True):
            usual_length_m, usual_width_m, height_m = guessed.lwh_m
            length_m = length_m if length_m > _LEAST_SIZE_M else usual_length_m
            width_m = width_m if width_m > _LEAST_SIZE_M else usual_width_m
            own.append(vtypes.VehicleType(guessed.vclass, (length_m, width_m, height_m)))
        return own

    @property
    def shape(self) -> UInt8[ndarray, "a"]:
        """Shape code of each actor; a car where its class is not on the road."""
        classes = [vtypes.guess(kind).vclass for kind in self.kinds]
        return np.array([SHAPE_OF_CLASS.get(vclass, Shape.CAR) for vclass in classes], np.uint8)


@dataclass(frozen=True, slots=True)
class _Readings(Rows):
    """Where actors were, of all files: number of the actor, time, position, and what the row says of it."""

    actor: Int[ndarray, "n"]
    time_s: Float[ndarray, "n"]
    xy: Float[ndarray, "n 2"]
    speed: Float[ndarray, "n"]
    """NaN if the file has none."""
    kind: Int[ndarray, "n"]
    """Number of the class; 0 for none."""
    lw_m: Float[ndarray, "n 2"]
    """Length and width; NaN if the file has none."""


def read(
    paths: Sequence[Path],
    columns: PositionColumns | None = None,
    frame_hz: float | None = None,
    repair: bool = False,
    time_unit_s: float | None = None,
    length_unit_m: float | None = None,
    to_net: Projection | None = None,
) -> Fixes:
    """Read the pieces of one trace.

    Parameters
    ----------
    paths
        Files of one layout.
    columns
        Names of the columns. None recognises the layout.
    frame_hz
        Frames per second, if the time is a frame number. None reads it from the `recordingMeta` file beside.
    repair
        Sort rows that are not in the order of time, and leave out rows with missing values and repeated rows.
        Otherwise these are errors, except that exact copies of a row are always left out.
    time_unit_s, length_unit_m
        Seconds and metres per unit. None takes those of the layout, or those that the names of columns and the size of
        the times say.
    to_net
        Projection of degrees. None projects them around their median.

    Raises
    ------
    TrafficError
        In one line: the file, and what is wrong with it.
    """
    names: dict[str, int] = {}
    kind_codes = {"": 0}
    parts: list[_Readings] = []
    repaired, read_as = {"missing": 0, "repeated": 0, "unordered": 0}, dict[str, None]()
    degrees = False
    for path in paths:
        rows = rows_of_file(path, columns, frame_hz, time_unit_s, length_unit_m)
        if parts and rows.is_degrees != degrees:
            raise TrafficError(f"{path}: not in the units of {paths[0]}. Count contacts of each in its own command.")
        degrees = rows.is_degrees
        read_as |= dict.fromkeys(rows.read_as)
        if frame_hz is not None and not rows.is_frame:
            raise TrafficError(f"{path}: its times are no frame numbers, so --frame-hz has no effect. Leave it out.")
        good = _good(path, rows, repair)
        repaired["missing"] += int((~good).sum())
        parts.append(_readings(rows.take(good), names, kind_codes))
    read = _Readings.concat(parts)
    if not len(read.actor):
        raise TrafficError(f"{paths[0]}: no position in it. Give a trace with at least one row.")
    where = ", ".join(map(str, paths))
    _check_order(where, list(names), read, repaired, repair)
    read = read.take(np.lexsort((read.time_s, read.actor)))
    read = read.take(_without_copies(where, list(names), read, repaired, repair))
    time_s, xy = read.time_s, read.xy
    projection = to_net
    if degrees and projection is None:
        projection = Projection(*np.median(xy, axis=0).tolist())
    xy_m = xy if projection is None or not degrees else _projected(where, xy, projection)
    if not degrees:
        _check_metres(where, read.actor, time_s, xy_m, length_unit_m is not None)
    is_said = time_unit_s is not None and length_unit_m is not None
    if odd := units.check_speeds(where, read.actor, time_s, xy_m, read.speed, is_said):
        read_as[odd] = None
    name_of, actor, n_again = _reused(list(names), read.actor, time_s, xy_m, read.kind)
    read = replace(read, actor=actor, xy=xy_m)
    if n_again:
        read_as[f"{n_again} ids come back elsewhere or later as another class: they are other actors"] = None
        read = read.take(np.argsort(actor, kind="stable"))
    kind, n_several = _classes(read.actor, read.kind, len(name_of))
    if n_several:
        read_as[f"classes of {n_several} actors change: each has its most frequent one"] = None
    kinds = [list(kind_codes)[code] for code in kind.tolist()]
    read_as |= dict.fromkeys(_guesses(kinds))
    begin = float(read.time_s.min())
    lw_m = pd.DataFrame(read.lw_m).groupby(read.actor).median().to_numpy()
    length_m, width_m = lw_m.T
    if n_wide := int(((width_m > _WIDE_M) & (width_m > length_m)).sum()):
        read_as[f"{n_wide} actors are wider than long: are the columns of lengths and widths exchanged?"] = None
    return Fixes(
        names=name_of,
        kinds=kinds,
        actor=read.actor,
        time_s=read.time_s - begin,
        xy_m=read.xy,
        begin=f"{begin:.6f}".rstrip("0").rstrip("."),
        repaired={reason: n for reason, n in repaired.items() if n},
        own_lw_m=None if np.isnan(lw_m).all() else lw_m,
        projection=projection if degrees and to_net is None else None,
        read_as=tuple(read_as),
        source=where,
        is_front=rows.is_front,
    )


def _readings(rows: FileRows, names: dict[str, int], kind_codes: dict[str, int]) -> _Readings:
    """The rows of a file with numbers for actors and classes; those without a number get the next ones."""
    values, code = np.unique(rows.actors.astype(str), return_inverse=True)
    numbers = [names.setdefault(name, len(names)) for name in values.tolist()]
    n = len(code)
    kind_names = np.full(n, "") if rows.kinds is None else rows.kinds.astype(str)
    return _Readings(
        actor=np.array(numbers, np.int64)[code],
        time_s=rows.time_s,
        xy=rows.xy,
        speed=np.full(n, np.nan) if rows.speed is None else rows.speed,
        kind=_numbered(kind_names, kind_codes),
        lw_m=np.full((n, 2), np.nan) if rows.lw_m is None else rows.lw_m,
    )


def _guesses(kinds: Sequence[str]) -> Iterator[str]:
    """What is said of classes whose names are not SUMO's, or that are not on the road."""
    if guessed := sorted({kind for kind in kinds if kind and not vtypes.is_plain(kind)}):
        few = [f"{kind} as {vtypes.guess(kind).vclass}" for kind in guessed[:5]]
        more = f" and {len(guessed) - 5} more" if len(guessed) > 5 else ""
        yield f"classes guessed from their names: {', '.join(few)}{more}"
    if off_road := sorted({kind for kind in kinds if vtypes.guess(kind).vclass not in SHAPE_OF_CLASS}):
        yield f"{', '.join(off_road)} as cars here; a run leaves them out, because they are not on the road"


def _numbered(names: ndarray, codes: dict[str, int]) -> Int[ndarray, "n"]:
    """The number of each name; names without a number get the next ones in `codes`."""
    row, found = pd.factorize(names)
    number = [codes.setdefault(name, len(codes)) for name in found.tolist()]
    return np.array(number, np.int64)[row]


def _reused(
    names: list[str],
    actor: Int[ndarray, "n"],
    time_s: Float[ndarray, "n"],
    xy_m: Float[ndarray, "n 2"],
    kind: Int[ndarray, "n"],
) -> tuple[list[str], Int[ndarray, "n"], int]:
    """Names and numbers of actors, where an id that is given again is another actor: its class changes, and it has not
    been seen for long, or cannot have driven there. And how many there are."""
    took_s = np.diff(time_s)
    way_m = np.hypot(*np.diff(xy_m, axis=0).T)
    away = (took_s > _LONG_S) | (way_m > _FASTEST_MPS * took_s)
    is_known = (kind[1:] > 0) & (kind[:-1] > 0)
    changes = is_known & (np.diff(kind) != 0)
    again = np.flatnonzero(away & changes & (np.diff(actor) == 0)) + 1
    taken, names, actor = set(names), list(names), actor.copy()
    for row in again.tolist():
        of, n = actor[row], 2
        while (name := f"{names[of]}/{n}") in taken:
            n += 1
        taken.add(name)
        names.append(name)
        actor[row:][actor[row:] == of] = len(names) - 1
    return names, actor, len(again)


def _classes(
    actor: Int[ndarray, "n"],
    kind: Int[ndarray, "n"],
    n_actors: int,
) -> tuple[Int[ndarray, "a"], int]:
    """The most frequent class of each actor, 0 without any, and the number of actors that have several."""
    said = pd.DataFrame({"actor": actor, "kind": kind})[kind > 0]
    counts = said.groupby(["actor", "kind"]).size().sort_values(ascending=False, kind="stable").reset_index()
    first = counts.drop_duplicates("actor")
    found = np.zeros(n_actors, np.int64)
    found[first.actor.to_numpy()] = first.kind.to_numpy()
    return found, int((counts.actor.value_counts() > 1).sum())


def _good(path: Path, rows: FileRows, repair: bool) -> Bool[ndarray, "n"]:
    """Rows with an actor, a time and a position that are there and finite."""
    good = np.isfinite(rows.time_s) & np.isfinite(rows.xy).all(axis=1)
    good &= ~pd.isna(rows.actors)
    bad = np.flatnonzero(~good)
    if len(bad) and not repair:
        row = int(bad[0])
        raise TrafficError(
            f"{path}: row {row + 1} ({rows.actors[row]!r}) has a value missing or not finite, and "
            f"{len(bad)} of {len(good)} rows do. Correct them, or leave them out with --repair."
        )
    return good


def _check_order(where: str, names: list[str], read: _Readings, repaired: dict[str, int], repair: bool) -> None:
    """Refuse an actor whose rows go back in time; sorting does not help where it is two actors, or at midnight."""
    actor, time_s = read.actor, read.time_s
    order = np.argsort(actor, kind="stable")
    is_same = np.diff(actor[order]) == 0
    back = is_same & (np.diff(time_s[order]) < 0)
    if not back.any():
        return
    row = order[int(np.flatnonzero(back)[0]) + 1]
    said = (
        f"{where}: the rows of {names[actor[row]]!r} are not in the order of time, as {int(back.sum())} of "
        f"{len(actor)} rows are not."
    )
    mine = np.flatnonzero(actor == actor[row])
    fall_s = -np.diff(time_s[mine]).min()
    if time_s.max() <= _DAY_S < 2 * fall_s and not time_s.min() < 0:
        raise TrafficError(
            f"{said} Its times fall by {fall_s:g} s: are they times of day, and midnight is between? Write dates with "
            "times, or count hours on from 24. If not, sort the rows."
        )
    xy = read.xy[mine]
    sorted_xy = xy[np.argsort(time_s[mine], kind="stable")]
    if _way(sorted_xy) > _ZIGZAG * _way(xy):
        raise TrafficError(
            f"{said} Sorted, they jump to and fro: is it the id of several vehicles at once? Give each its own."
        )
    if not repair:
        raise TrafficError(f"{said} Sort them, or let --repair do it.")
    repaired["unordered"] += int(back.sum())


def _way(xy: Float[ndarray, "n 2"]) -> float:
    """Length of a way, in the unit of the positions."""
    return float(np.hypot(*np.diff(xy, axis=0).T).sum())


def _without_copies(
    where: str, names: list[str], read: _Readings, repaired: dict[str, int], repair: bool
) -> Bool[ndarray, "n"]:
    """Rows of an actor that are the first of their time."""
    again = (np.diff(read.actor) == 0) & (np.diff(read.time_s) == 0)
    moves = (np.diff(read.xy, axis=0) != 0).any(axis=1)
    other = np.flatnonzero(again & moves) + 1
    if len(other) and not repair:
        row = int(other[0])
        raise TrafficError(
            f"{where}: {names[read.actor[row]]!r} has two positions at the time "
            f"{read.time_s[row]:.10g} s, and there are {len(other)} such rows. Are these recordings of their own? "
            "Then count each in its own command; or keep the first of such rows with --repair."
        )
    repaired["repeated"] += int(again.sum())
    return np.append(True, ~again)


def _projected(where: str, degrees: Float[ndarray, "n 2"], to_world: Projection) -> Float[ndarray, "n 2"]:
    """East and north of latitudes and longitudes, on a transverse Mercator map."""
    most = np.abs(degrees).max(axis=0)
    if most[0] > _MOST_DEGREES[0] or most[1] > _MOST_DEGREES[1]:
        hint = " Are they the other way round?" if most[0] <= 180 and most[1] <= 90 else " Are they metres?"
        raise TrafficError(
            f"{where}: latitudes reach {most[0]:g} and longitudes {most[1]:g} degrees; at most 90 and 180 can be.{hint}"
        )
    xy_m = to_world.to_world(degrees[:, 0], degrees[:, 1])
    from_m = xy_m - np.median(xy_m, axis=0)
    if not np.isfinite(xy_m).all() or np.abs(from_m).max() > 2e6:
        raise TrafficError(
            f"{where}: positions reach {np.nanmax(np.abs(from_m)) / 1000:,.0f} km from their median: no map without "
            "distortion shows all of them. Leave out those far away."
        )
    return xy_m


def _check_metres(where: str, actor: ndarray, time_s: ndarray, xy_m: Float[ndarray, "n 2"], is_given: bool) -> None:
    """Refuse coordinates that are nowhere on Earth, and degrees as metres, unless the unit is given."""
    if np.abs(xy_m).max() > LARGEST_COORDINATE_M:
        raise TrafficError(f"{where}: coordinates reach {np.abs(xy_m).max():g} m, which is no place on Earth.")
    gone_m = np.hypot(*np.diff(xy_m, axis=0).T)
    moved = (np.diff(actor) == 0) & (gone_m > 0)
    speeds_mps = gone_m[moved] / np.diff(time_s)[moved]
    n = len(speeds_mps)
    n_odd = int(max(_GLITCHES, _GLITCH_P * n)) if n >= _ENOUGH else 0
    fastest = np.sort(speeds_mps)[: n - n_odd].max(initial=0.0)
    if n and fastest < _CRAWL_MPS and not is_given:
        is_small = np.abs(xy_m).max() <= _MOST_DEGREES[1]
        said = "x and y look like degrees or kilometres" if is_small else "x and y look like kilometres"
        who = "hardly anything" if speeds_mps.max() > _CRAWL_MPS else "nothing"
        raise TrafficError(
            f"{where}: {who} is faster than {fastest:.2g} m/s, so {said}, or the times like milliseconds. Name "
            "degrees with --lat and --lon, or set --length-unit or --time-unit."
        )
