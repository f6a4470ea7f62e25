"""Encounters: counts, durations, and survival with censoring in mind."""

import math
from collections import Counter
from typing import Literal

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.codes import PARKED
from results.metrics import intervals
from results.metrics.survival import kaplan_meier, median_estimate, restricted_mean
from results.run import Run

Departure = Literal["ends", "censors"]
"""Whether an actor that leaves the simulation ends its encounters, or censors them."""

DEFINITION = ("pairs", "radius_m", "hysteresis_s", "los", "pedestrians")
"""Columns that say which definition of an encounter a row is of."""

_KINDS = {"pairs": str, "radius_m": float | int, "hysteresis_s": float | int, "los": str, "pedestrians": bool}
_MOST = 1e9
"""No radius [m] and no time [s] of a definition is larger."""
_COLUMNS = (
    *DEFINITION,
    "a",
    "b",
    "start_step",
    "end_step",
    "duration_s",
    "censored_left",
    "censored_right",
    "departed",
    "gap_s",
)


def named(frame: pd.DataFrame, among: pd.DataFrame | None = None) -> pd.Series:
    """A name for the definition of each row: pairs and radius, and what else is needed to tell definitions apart.
    Pedestrians are named where they count by some definitions and not by others.

    They are told apart from those of the rows `among`: of a run, all `definitions`, so that one has the same name
    whichever others have encounters. Left out, from those of the frame.
    """
    keys = _kinds(frame)
    kinds = list(dict.fromkeys(keys if among is None else _kinds(among)))
    text = []
    are_mixed = len({kind[-1] for kind in kinds}) > 1
    for pairs, radius_m, *_, on_foot in kinds:
        more = ", pedestrians" if on_foot and are_mixed else ""
        text.append(f"{pairs}, {radius_m:g} m{more}")
    further = {
        "hysteresis_s": lambda s: f", {s:g} s",
        "los": lambda los: f", {los.replace('_', ' ')}",
    }
    for column, words in further.items():
        values = [kind[DEFINITION.index(column)] for kind in kinds]
        if len(set(values)) > 1:
            n = Counter(text)
            text = [one + words(value) if n[one] > 1 else one for one, value in zip(text, values, strict=True)]
    names = dict(zip(kinds, text, strict=True))
    return pd.Series([names[key] for key in keys], frame.index, dtype=object)


def _kinds(frame: pd.DataFrame) -> list[tuple]:
    """The definition of each row."""
    return list(zip(*(frame[column].tolist() for column in DEFINITION), strict=True))


def definitions(run: Run) -> pd.DataFrame:
    """The definitions of the config, and those of the table `encounters`: one row each, sorted by `DEFINITION`.

    A definition of the config without encounters is there, too: their number is 0, not unknown.
    """
    asked = pd.DataFrame(_asked(run), columns=[*DEFINITION])
    for name in ("radius_m", "hysteresis_s"):
        asked[name] = asked[name].astype(np.float32).astype(float)  # as the table keeps them
    there = run.table("encounters", DEFINITION).drop_duplicates()
    there = there.astype({"pairs": object, "los": object, "radius_m": float, "hysteresis_s": float})
    both = there if asked.empty else asked if there.empty else pd.concat([asked, there])
    return both.drop_duplicates().sort_values([*DEFINITION], ignore_index=True)


def _asked(run: Run) -> list[dict[str, object]]:
    """The definitions of the config. ValueError if somebody has written something else there."""
    found = run.config.get("encounters", [])
    if not isinstance(found, list) or not all(map(_is_definition, found)):
        raise ValueError(f"{run.path}: [[encounters]] in the config of its manifest are no definitions. Run again.")
    return found


def _is_definition(one: object) -> bool:
    if not isinstance(one, dict):
        return False
    for name, kind in _KINDS.items():
        if not isinstance(one.get(name), kind):
            return False
    return 0 < one["radius_m"] < _MOST and 0 <= one["hysteresis_s"] < _MOST


def definition(
    run: Run,
    radius_m: float | None = None,
    pairs: str | None = None,
) -> dict[str, float | str]:
    """One definition of an encounter, by column of `DEFINITION`.

    What is not given is chosen: the smallest radius, the first kind of pairs, and the first value of each further
    column.

    Raises
    ------
    ValueError
        If the run has no encounters, or none of the given radius or pairs.
    """
    frame = run.table("encounters", DEFINITION)
    if frame.empty:
        raise ValueError(f"{run.path} holds no encounters: no two came within the radius of each other.")
    found: dict[str, float | str] = {}
    for name, wanted in (
        ("radius_m", None if radius_m is None else float(np.float32(radius_m))),  # as the table keeps it
        ("pairs", pairs),
        ("hysteresis_s", None),
        ("los", None),
        ("pedestrians", None),
    ):
        there = sorted(frame[name].unique().tolist())
        chosen = there[0] if wanted is None else wanted
        if chosen not in there:
            said, *has = (f"{value:g}" if isinstance(value, float) else value for value in (wanted, *there))
            raise ValueError(f"{run.path} recorded no encounters with {name} = {said}; it has {', '.join(has)}.")
        frame = frame[frame[name] == chosen]
        found[name] = chosen
    return found


def begun(run: Run, radius_m: float | None = None, pairs: str | None = None) -> pd.DataFrame:
    """Encounters by one definition, see `definition`, that begin while the run is recorded: a, b, start_step."""
    frame = run.table("encounters", ["a", "b", "start_step", "censored_left", *DEFINITION])
    for name, chosen in definition(run, radius_m, pairs).items():
        frame = frame[frame[name] == chosen]
    frame = frame[~frame.censored_left]
    if frame.empty:
        raise ValueError(
            f"{run.path}: no encounter begins while it is recorded. Raise traffic.duration_s and run again."
        )
    return frame[["a", "b", "start_step"]]


def durations(run: Run, departure: Departure = "ends") -> pd.DataFrame:
    """One row per encounter: the columns of `DEFINITION`, a, b, duration_s, gap_s, `start_seen` and `end_seen`; and
    `lasted_s` and `over`: for how long it was followed, and whether it ended then (`survival`)."""
    frame = _durations(run, departure)
    if frame.empty:
        raise ValueError(
            f"{run.path} holds no encounters: no two came within the radius of each other. "
            "Raise encounters.radius_m, fleet.penetration_p or traffic.duration_s and run again."
        )
    return frame


def _durations(run: Run, departure: Departure) -> pd.DataFrame:
    frame = run.table("encounters", _COLUMNS)
    end_seen = ~frame.censored_right
    if departure == "censors":
        end_seen &= ~frame.departed
    last_step = followed_until(run, frame.hysteresis_s.to_numpy(np.float64))
    over = end_seen & (frame.end_step <= last_step)
    until = np.minimum(frame.end_step - ~end_seen, last_step)  # cut off: not known to end with that step
    lasted_s = np.round((until - frame.start_step) * run.dt_s, 6)
    frame = frame.assign(start_seen=~frame.censored_left, end_seen=end_seen, lasted_s=lasted_s, over=over)
    return frame[[*DEFINITION, "a", "b", "duration_s", "gap_s", "start_seen", "end_seen", "lasted_s", "over"]]


def fewest_steps(hysteresis_s: Float[ndarray, "n"], dt_s: float) -> Int[ndarray, "n"]:
    """Least number of steps out of contact that end an encounter, of times in single precision."""
    n = np.ceil(hysteresis_s / dt_s * (1 - 1e-6))
    return np.maximum(1, n).astype(np.int64)


def followed_until(run: Run, hysteresis_s: Float[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Step up to which encounters are followed: of contact that breaks off later, it is not known whether it is over.

    Those breaks are as many as ends. To take their encounters for cut off there would hide these ends.
    """
    return int(run.manifest["steps"]) - fewest_steps(hysteresis_s, run.dt_s)


def survival(run: Run, departure: Departure = "ends") -> pd.DataFrame:
    """Share of encounters that last longer than a duration (Kaplan and Meier 1958), by definition of the config.

    Returns
    -------
    the columns of `DEFINITION`, duration_s, survival, and low, high: its 95 % confidence band (Greenwood, log-log).

    Notes
    -----
    Encounters that go on after `followed_until` count up to then, and other ones whose end was not observed up to the
    step before. Those whose start was not observed are left out: they are a sample biased to long ones, of unknown age
    (`summary` says how many).
    """
    groups = durations(run, departure).groupby([*DEFINITION], observed=True)
    curves = {kind: _curve(frame) for kind, frame in groups}
    return pd.concat(curves, names=[*DEFINITION]).droplevel(-1).reset_index()


def summary(run: Run, departure: Departure = "ends") -> pd.DataFrame:
    """Counts and durations, by definition of the config.

    Returns
    -------
    The columns of `DEFINITION`; n; n_start_unseen, n_end_unseen and their shares censored_left, censored_right; mean_s,
    median_s of the durations as recorded; km_median_s (Kaplan-Meier, null if the survival curve stays above one half)
    and km_mean_s, restricted to the longest duration observed, with km_mean_s_note if the curve stays above one half
    until then; again_share: share that are not the first of their pair; gap_median_s: time since the encounter before;
    definition: its name. Without encounters, n is 0 and nothing else is known.

    mean_s and the three shares have intervals in which encounters that share an actor depend on each other
    (`intervals.mean_of_pairs`). The interval of km_median_s takes encounters as independent.
    """
    found = dict(list(_durations(run, departure).groupby([*DEFINITION], observed=True)))
    rows = []
    for kind in definitions(run).itertuples(index=False, name=None):
        definition: dict[str, object] = dict(zip(DEFINITION, kind, strict=True))
        if kind not in found:
            rows.append(definition | {"n": 0})
            continue
        frame = found[kind]
        curve = _curve(frame)
        again = frame.gap_s.dropna()
        rows.append(
            definition
            | {
                "n": len(frame),
                "n_start_unseen": int((~frame.start_seen).sum()),
                "n_end_unseen": int((~frame.end_seen).sum()),
                **_mean(frame, frame.duration_s, "mean_s"),
                "median_s": float(frame.duration_s.median()),
                **_mean(frame, ~frame.start_seen, "censored_left"),
                **_mean(frame, ~frame.end_seen, "censored_right"),
                "km_mean_s": restricted_mean(curve) if followed(frame).any() else np.nan,
                **intervals.columns(median_estimate(curve, int(followed(frame).sum())), "km_median_s"),
                "km_mean_s_note": _restriction(curve),
                **_mean(frame, frame.gap_s.notna(), "again_share"),
                "gap_median_s": float(again.median()) if len(again) else np.nan,
            }
        )
    table = pd.DataFrame(rows, columns=None if rows else [*DEFINITION, "n"])  # a config may define no encounters
    return table.assign(definition=named(table))


def _restriction(curve: pd.DataFrame) -> str:
    """A note on the restricted mean, where more than half of the encounters last longer than what was observed."""
    longest_s, survival = curve[["duration_s", "survival"]].iloc[-1]
    return f"{survival:.0%} last longer than {longest_s:g} s" if survival > 0.5 else ""


def rates(run: Run) -> pd.DataFrame:
    """How often a vehicle meets another: the columns of `DEFINITION`, per_vehicle_h [1/h], and its name, definition.

    Encounters that begin while the run is recorded count, for both of their vehicles. They are divided by the time that
    the vehicles which can have one are on the road: equipped vehicles, or all where all pairs count.
    """
    kinds = definitions(run)
    begun = run.table("encounters", [*DEFINITION, "censored_left"])
    n = begun[~begun.censored_left].groupby([*DEFINITION], observed=True).size().to_dict()
    vehicles = run.table("vehicles", ["sumo_id", "n_steps", "equipped", "vehicle_class"])
    there_h = vehicles.n_steps * run.dt_s / 3600
    walks = vehicles.vehicle_class == "pedestrian"
    stands = (vehicles.vehicle_class == "roadside_unit") | vehicles.sumo_id.str.startswith(PARKED)
    rates = []
    for kind in kinds.to_dict("records"):
        counted = ~stands & (~walks | bool(kind["pedestrians"]))
        can_meet = vehicles.equipped if kind["pairs"] in ("equipped", "los") else counted
        total_h = float(there_h[can_meet].sum())
        n_begun = n.get(tuple(kind.values()), 0)
        rates.append(2 * n_begun / total_h if total_h else np.nan)
    return kinds.assign(per_vehicle_h=rates, definition=named(kinds))


def _mean(frame: pd.DataFrame, values: pd.Series, name: str) -> dict[str, float]:
    """Mean over encounters with its interval, which stays within what a share, or a duration, can be."""
    bounds = (0.0, 1.0) if values.dtype == bool else (0.0, math.inf)
    a, b = frame.a.to_numpy(), frame.b.to_numpy()
    found = intervals.mean_of_pairs(values.to_numpy(np.float64), a, b, bounds)
    return intervals.columns(found, name)


def _curve(frame: pd.DataFrame) -> pd.DataFrame:
    seen = frame[followed(frame)]
    return kaplan_meier(seen.lasted_s.to_numpy(), seen.over.to_numpy(bool))


def followed(frame: pd.DataFrame) -> "pd.Series[bool]":
    """Which encounters, of `durations`, count in a survival curve."""
    return frame.start_seen & (frame.lasted_s > 0)
