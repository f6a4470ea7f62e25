"""Metrics of a user's own, named on the command line."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from results.run import Run


def own_metrics(names: list[str], sets: list[str]) -> "Callable[[Run], pd.DataFrame] | None":
    """A function that measures the user's own metrics on a run; None if no metric is named."""
    from cosim.config.single import from_command_line
    from cosim.door.guard import make
    from results.own_metrics import measure_own

    if not names:
        if sets:
            raise ValueError(f"--set {sets[0]} goes with a metric of your own, --metric mine.py:Name. Leave it out.")
        return None
    if sets and len(names) > 1:
        raise ValueError(f"--set {sets[0]}: of which metric? With --set, name one --metric alone.")
    chosen = [from_command_line("metric", name, sets) for name in names]
    made = [make(choice, *params) for choice, params in chosen]
    return lambda run: measure_own(run, made)


def split_metrics(names: list[str]) -> tuple[list[str], list[str]]:
    """Metrics of the user's own, and those that ship: an identifier, `identifier:group`, or how identifiers begin.

    Raises
    ------
    ValueError
        In one line, with the closest identifiers, if a name is neither.
    """
    import difflib

    from cosim.door.load import is_own
    from results.metrics.registry import METRICS, TOPICS

    shipped = [name for name in names if _metrics_of(name.partition(":")[0])]
    own = [name for name in names if name not in shipped]
    for name in own:
        if not is_own(name):
            metric = name.partition(":")[0]
            near = difflib.get_close_matches(metric, [*METRICS, *TOPICS], 3, 0.5)
            hint = f"Near: {', '.join(near)}. " if near else ""
            raise ValueError(
                f"--metric {name}: there is no such metric. {hint}All of them: cosim measure --explain. One of your "
                "own: mine.py:Name."
            )
    return own, shipped


def refuse_other_groups(tables: "Sequence[pd.DataFrame]", names: list[str]) -> None:
    """Raise ValueError for a METRIC:GROUP whose metric was measured, but in none of the tables for this group."""
    for name in names:
        metric, _, group = name.partition(":")
        groups: dict[str, None] = {}
        for table in tables:
            is_measured = ~table.metric.str.endswith(".not_measured")
            is_measured &= table.metric.isin(_metrics_of(metric))
            groups |= dict.fromkeys(table.group[is_measured])
        if group and groups and group not in groups:
            others = "; ".join(filter(None, groups))
            named = f"There are: {others}." if others else f"{metric} has none."
            raise ValueError(f"--metric {name}: there is no such group. {named}")


def with_metrics(table: "pd.DataFrame", names: list[str]) -> "pd.DataFrame":
    """The rows of these metrics, each once, in the order of the table; where there are none, what is not measured."""
    kept = table.metric != table.metric
    for name in names:
        metric, _, group = name.partition(":")
        rows = table.metric.isin(_metrics_of(metric))
        rows &= (table.group == group) if group else True
        kept |= rows if rows.any() else table.metric == f"{metric.partition('.')[0]}.not_measured"
    return table[kept]


def _metrics_of(name: str) -> list[str]:
    """The metric of this name; else all whose names begin so, as those of a topic, or of `radio.pdr`."""
    from results.metrics.registry import METRICS

    return [name] if name in METRICS else [metric for metric in METRICS if metric.startswith(name + ".")]
