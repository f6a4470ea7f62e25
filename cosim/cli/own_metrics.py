"""Metrics of a user's own, named on the command line."""

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from results.run import Run


def own_metrics(names: list[str], sets: list[str]) -> "Callable[[Run], pd.DataFrame] | None":
    """A function that measures the user's own metrics on a run; None if no metric is named."""
    from cosim.config.single import from_command_line
    from cosim.door.guard import make
    from cosim.door.load import is_own
    from results.own_metrics import measure_own

    if not names:
        if sets:
            raise ValueError(f"--set {sets[0]} goes with a metric of your own, --metric mine.py:Name. Leave it out.")
        return None
    if strange := [name for name in names if not is_own(name)]:
        raise ValueError(
            f"--metric {strange[0]}: for a run, name a metric of your own, mine.py:Name. Those that ship are printed "
            "without --metric; of a study, --metric chooses among them."
        )
    if sets and len(names) > 1:
        raise ValueError(f"--set {sets[0]}: of which metric? With --set, name one --metric alone.")
    chosen = [from_command_line("metric", name, sets) for name in names]
    made = [make(choice, *params) for choice, params in chosen]
    return lambda run: measure_own(run, made)
