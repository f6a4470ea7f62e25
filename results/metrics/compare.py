"""Several runs beside each other: what was set differently, and what came of it."""

from collections.abc import Sequence
from typing import Any

from results.run import Run

DICE = ("seed", "traffic.seed")
"""Keys that change only the random draws: runs that differ in nothing else are repetitions."""

_IDLE = ("record.", "compute.", "trust_variant.")
"""Sections that have no effect on the variant that is measured."""


def differing(runs: Sequence[Run]) -> dict[str, list[Any]]:
    """Keys of the configuration whose values differ, seeds left out, and their value in every run."""
    leaves = [dict(flat(run.config)) for run in runs]
    differing = {}
    for key in sorted(set[str]().union(*leaves) - set(DICE)):
        values = [one.get(key) for one in leaves]
        if not key.startswith(_IDLE) and any(value != values[0] for value in values):
            differing[key] = values
    return differing


def flat(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """Leaves of nested sections and of lists of sections: trust.freshness_s, encounters.0.radius_m."""
    if isinstance(value, dict):
        items = [(str(k), v) for k, v in value.items()]
    elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
        items = [(str(i), v) for i, v in enumerate(value)]
    else:
        return [(name, value)]
    before = f"{name}." if name else ""
    return [leaf for k, v in items for leaf in flat(v, before + k)]


def sort_key(value: Any) -> tuple[bool, float, str]:
    """Numbers by size, "off" behind them, words behind that."""
    return (not _is_number(value), _number(value) if _is_number(value) else 0.0, str(value))


def _is_number(value: Any) -> bool:
    return value == "off" or (isinstance(value, int | float) and not isinstance(value, bool))


def _number(value: Any) -> float:
    """`trust.freshness_s = "off"` is a window without end."""
    return float("inf") if value == "off" else float(value)
