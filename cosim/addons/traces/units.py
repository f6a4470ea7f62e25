"""Units of tables of positions: what names of columns, sizes of numbers and a column of speeds say of them."""

import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float
from numpy import ndarray

from cosim.traffic import delimited
from cosim.traffic.frame import TrafficError

TIME_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
LENGTH_M = {"m": 1.0, "ft": 0.3048, "km": 1000.0, "cm": 0.01, "mm": 1e-3}
_TIME_WORDS = {
    "ms": "ms",
    "msec": "ms",
    "millis": "ms",
    "milliseconds": "ms",
    "us": "us",
    "usec": "us",
    "micros": "us",
    "microseconds": "us",
    "ns": "ns",
    "nanoseconds": "ns",
    "nanos": "ns",
    "min": "min",
    "mins": "min",
    "minute": "min",
    "minutes": "min",
    "h": "h",
    "hr": "h",
    "hour": "h",
    "hours": "h",
}
_LENGTH_WORDS = {"m": "m", "metres": "m", "meters": "m", "ft": "ft", "feet": "ft", "km": "km", "cm": "cm", "mm": "mm"}
_OTHER_LENGTHS = {"px", "pixel", "pixels", "mi", "mile", "miles", "yd", "yard", "yards", "inch", "inches"}
_NGSIM_FEET = {"local_x", "local_y", "global_x", "global_y"}
_SINCE_1970 = (("ns", 1e17), ("us", 1e14), ("ms", 1e11))
"""A time that is larger than this is in this unit since 1970: as seconds, it would be after the year 5000."""
_PARTS = (("xVelocity", "yVelocity"), ("vx", "vy"), ("velocity_x", "velocity_y"))
SPEEDS = ("speed", "v_Vel", "v_vel", "speed_mps", "velocity", "vehicle_speed", *chain(*_PARTS))
"""Columns that say a speed, or its parts."""
_SPEED_UNITS = (1.0, 1 / 3.6, 0.44704, 0.51444, 0.3048)
"""m/s of a speed in m/s, km/h, mph, knots, ft/s."""
_NEAR = 1.15
_ODD = (0.2, 2.0)
"""Ratios of speeds outside these are refused."""
_DENSE_S, _ENOUGH = 2.0, 20
"""Ratios of positions that are farther apart, or of fewer of them, say little."""


def words(name: str) -> list[str]:
    """Words of a column's name, in lower case."""
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[XY])(?=[a-z])", " ", name).lower())


def is_number(column: pa.ChunkedArray) -> bool:
    """Whether a column of times holds numbers, and not dates or times of day."""
    if not delimited.is_text(column.type):
        return pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
    heads = [chunk[:1000] for chunk in column.chunks]
    texts = pa.chunked_array(heads, column.type).drop_null()
    first = texts[0].as_py() if len(texts) else ""
    return bool(re.match(r"^[-+.,\d]+([eE][-+]?\d+)?$", first))


def time_unit(
    name: str,
    times: Float[ndarray, "n"],
    given_s: float | None,
) -> tuple[float, str]:
    """Seconds per unit of a column of times, and a word about it if nobody said so."""
    if given_s is not None:
        return given_s, ""
    for word in words(name)[1:]:
        if word in _TIME_WORDS:
            unit = _TIME_WORDS[word]
            return TIME_S[unit], f"times in {unit}, as the column {name} says"
    most = float(np.nanmax(np.abs(times), initial=0.0))
    for unit, least in _SINCE_1970:
        if most >= least:
            return TIME_S[unit], f"times in {unit} since 1970"
    return 1.0, ""


def length_unit(x: str, y: str, given_m: float | None) -> tuple[float, str]:
    """Metres per unit of positions, and a word about it if nobody said so. Raises ValueError if x and y differ."""
    if given_m is not None:
        return given_m, ""
    if {x.lower(), y.lower()} <= _NGSIM_FEET:
        return LENGTH_M["ft"], f"positions in ft, as those of NGSIM in {x} and {y}"
    later_words = words(x)[1:] + words(y)[1:]
    if other := sorted(_OTHER_LENGTHS.intersection(later_words)):
        raise ValueError(
            f"the columns {x} and {y} are named as {other[0]}, which is not read. Turn them into metres, or set "
            "--length-unit if they are something else."
        )
    found = {_LENGTH_WORDS[word] for word in later_words if word in _LENGTH_WORDS}
    if len(found) > 1:
        raise ValueError(f"the columns {x} and {y} are named as {' and '.join(sorted(found))}. Set --length-unit.")
    unit = next(iter(found), "m")
    return LENGTH_M[unit], "" if unit == "m" else f"positions, lengths and widths in {unit}, as the column {x} says"


def size_unit(name: str, positions_m: float) -> float:
    """Metres per unit of a column of sizes: as its name says, and otherwise as positions."""
    for word in words(name)[1:]:
        if word in _LENGTH_WORDS:
            return LENGTH_M[_LENGTH_WORDS[word]]
    return positions_m


def of_size(what: str, names: Sequence[str]) -> str:
    """The column that is named as this size, or as it and its unit, such as `length_m`; empty if none is."""
    for name in names:
        size, *unit = words(name) or [""]
        if size == what and len(unit) <= 1 and _LENGTH_WORDS.keys() >= set(unit):
            return name
    return ""


def degrees_by_name(*names: str) -> str:
    """The first column that is named as a latitude or longitude; empty if none is."""
    return next((n for n in names if {"lat", "lon", "lng", "latitude", "longitude"} & set(words(n))), "")


def is_frame(name: str) -> bool:
    """Whether a column is named as numbers of frames or steps."""
    said = words(name)
    counts_steps = said[-1:] in (["step"], ["timestep"])
    return counts_steps or not {"frame", "frames"}.isdisjoint(said)


def speeds(path: Path, table: pa.Table) -> Float[ndarray, "n"] | None:
    """Speeds that a table says, in a unit that is not known. None if it says none, or not in numbers."""
    try:
        for pair in _PARTS:
            if set(pair) <= set(table.column_names):
                return np.hypot(*(delimited.numbers(path, name, table.column(name)) for name in pair))
        for name in SPEEDS:
            if name in table.column_names:
                return np.abs(delimited.numbers(path, name, table.column(name)))
    except TrafficError:
        return None
    return None


def check_speeds(
    where: str,
    actor: ndarray,
    time_s: Float[ndarray, "n"],
    xy_m: Float[ndarray, "n 2"],
    speed: Float[ndarray, "n"],
    is_given: bool,
) -> str:
    """Compare speeds of positions with those that the trace says, in any usual unit; a word if they are no such ones.

    Parameters
    ----------
    is_given
        Whether the user has named both units.

    Raises
    ------
    TrafficError
        Times or positions are in other units. The line names those that fit.
    """
    took_s = np.diff(time_s)
    said = (speed[1:] + speed[:-1]) / 2
    use = (np.diff(actor) == 0) & (took_s > 0) & (said > 0.5)
    if is_given or np.count_nonzero(use) < 2:
        return ""
    gone_m = np.hypot(*np.diff(xy_m, axis=0).T)
    found = gone_m[use] / took_s[use]
    ratio = float(np.median(found / said[use]))
    if _ODD[0] < ratio < _ODD[1] or ratio == 0:
        is_dense = np.median(took_s[use]) <= _DENSE_S and len(found) >= _ENOUGH
        is_usual = any(1 / _NEAR < ratio / per < _NEAR for per in _SPEED_UNITS)
        if is_usual or not is_dense:
            return ""
        return f"positions move {ratio:.3g} times as fast as the table says, as on a map that stretches (web Mercator)"
    fits = []
    for time, unit_s in TIME_S.items():
        for length, unit_m in LENGTH_M.items():
            scaled = ratio * unit_m / unit_s
            if any(1 / _NEAR < scaled / per < _NEAR for per in _SPEED_UNITS[:2]):
                fits.append(f"--time-unit {time} --length-unit {length}")
    hint = f" These units would fit: {', or '.join(fits[:3])}." if fits else ""
    raise TrafficError(
        f"{where}: positions and times ask for {ratio:.3g} times the speeds that the table says, so they are not in "
        f"metres and seconds.{hint} Set both units."
    )
