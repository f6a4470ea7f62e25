"""Several runs beside each other: what was set differently, and what came of it."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from results.run import Run

DICE = ("seed", "traffic.seed")
"""Keys that change only the random draws: runs that differ in nothing else are repetitions."""

_IDLE = ("record.", "compute.", "trust_variant.")
"""Sections that have no effect on the variant that is measured."""

_UNITS = {"s": "s", "m": "m", "mps": "m/s", "deg": "°", "rad": "rad", "dbm": "dBm", "db": "dB", "hz": "Hz"}


def differing(runs: Sequence[Run]) -> dict[str, list[Any]]:
    """Keys of the configuration whose values differ, seeds left out, and their value in every run."""
    leaves = [dict(flat(run.config)) for run in runs]
    keys = sorted({key for one in leaves for key in one if key not in DICE and not key.startswith(_IDLE)})
    values = {key: [one.get(key) for one in leaves] for key in keys}
    return {key: found for key, found in values.items() if any(v != found[0] for v in found)}


def axis(runs: Sequence[Run], over: str | None = None) -> tuple[str, np.ndarray] | None:
    """The number to compare runs by.

    Parameters
    ----------
    over
        Its key in the configuration. Left out, it is the only key in which the configurations differ.

    Returns
    -------
    The key, and the value in every run, in the order of the runs; "off" is infinite. None if `over` is left out and the
    runs differ in no key, in several keys, or in a key that is no number.

    Raises
    ------
    ValueError
        If `over` is no number, or does not differ between the runs.
    """
    found = differing(runs)
    numbers = {key: [_number(v) for v in values] for key, values in found.items() if all(map(_is_number, values))}
    if over is None:
        return next(((k, np.array(v, float)) for k, v in numbers.items()), None) if len(found) == 1 else None
    if over not in numbers:
        raise ValueError(
            f"The runs cannot be compared over {over}: it is no number that differs between them. "
            + (f"These are: {', '.join(numbers)}." if numbers else "They differ in no number.")
        )
    return over, np.array(numbers[over], float)


def label(key: str) -> str:
    """Axis label of a key of the configuration, with the unit that its name ends in."""
    unit = _UNITS.get(key.rpartition("_")[2])
    return f"{key} [{unit}]" if unit else key


def tabulate(runs: Sequence[Run], over: str | None, ask: Mapping[str, Callable[[Run], float]]) -> pd.DataFrame:
    """One row per run, sorted by the number in which the runs differ.

    Returns
    -------
    That number (named by its key), run, row (position of the run among `runs`), and every answer; null where a run
    cannot answer.

    Raises
    ------
    ValueError
        If `over` is left out and the runs do not differ in exactly one number, or if `over` is no number that differs.
    """
    found = axis(runs, over)
    if found is None:
        keys = ", ".join(differing(runs)) or "nothing"
        raise ValueError(f"The runs do not differ in one number alone, but in {keys}. Say which one to compare over.")
    key, values = found
    rows = [
        {key: value, "run": run.name, "row": row} | {name: _answer(run, question) for name, question in ask.items()}
        for row, (run, value) in enumerate(zip(runs, values, strict=True))
    ]
    return pd.DataFrame(rows).sort_values(key, kind="stable", ignore_index=True)


def _answer(run: Run, question: Callable[[Run], float]) -> float:
    try:
        return question(run)
    except ValueError:
        return float("nan")


def flat(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """Leaves of nested sections and of lists of sections: trust.freshness_s, encounters.0.radius_m."""
    if isinstance(value, dict):
        items = [(str(k), v) for k, v in value.items()]
    elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
        items = [(str(i), v) for i, v in enumerate(value)]
    else:
        return [(name, value)]
    return [leaf for k, v in items for leaf in flat(v, f"{name}.{k}" if name else k)]


def sort_key(value: Any) -> tuple[bool, float, str]:
    """Numbers by size, "off" behind them, words behind that."""
    return (not _is_number(value), _number(value) if _is_number(value) else 0.0, str(value))


def _is_number(value: Any) -> bool:
    return value == "off" or (isinstance(value, int | float) and not isinstance(value, bool))


def _number(value: Any) -> float:
    """`trust.freshness_s = "off"` is a window without end."""
    return float("inf") if value == "off" else float(value)
