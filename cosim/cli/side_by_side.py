"""Print metrics of one or several runs as tables, or write them to a file."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from rich.box import SIMPLE
from rich.table import Column, Table

from cosim.base import durable
from cosim.cli.console import plain, print_json, print_line, print_rows, print_table, rows_of
from results.figures.style import names
from results.metrics.compare import differing
from results.run import Run
from results.spreadsheet import csv_of

ENGINES_DIFFER = "where rays graze edges, tables of one ray caster differ from those of another."


def of_variants(run: Run, variant: str) -> list[Run]:
    """The run as one of its trust variants; with `variant = "all"`, once for each variant."""
    return [run.as_variant(name) for name in (run.variants if variant == "all" else (variant,))]


def print_measures(runs: list[Run], tables: list[pd.DataFrame], as_json: bool, csv: Path | None) -> None:
    """Print the metrics of runs, or write them to a CSV file with one row per run, metric and group.

    Several runs are shown side by side. The first rows show the config keys in which the runs differ.

    Parameters
    ----------
    runs
        The runs that were measured.
    tables
        One table of metrics per run, as `measure` returns it.
    as_json
        Print JSON instead of tables.
    csv
        File to write instead of printing.

    Raises
    ------
    ValueError
        If the CSV file cannot be written.
    """
    keys = differing(runs) if len(runs) > 1 else {}
    labels = names(runs)
    if csv is not None:
        whole = _one_table(runs, tables, keys)
        try:
            durable.write_output(csv, csv_of(whole))
        except OSError as error:
            raise ValueError(f"--csv {csv} cannot be written: {error.strerror or error}. Give another file.") from None
        print_line(f"wrote {csv}")
    elif as_json:
        of_run = {}
        for run, table in zip(runs, tables, strict=True):
            variant = "" if run.variant == "base" else f":{run.variant}"
            of_run[f"{run.path}{variant}"] = rows_of(table)
        print_json(of_run)
    elif len(runs) == 1:
        print_rows(str(runs[0].path), rows_of(tables[0]))
    else:
        print_table(_side_by_side(labels, tables, keys))
        if pd.concat(tables).low.notna().any():
            line = "These values have intervals and notes: cosim measure of one run prints them, and --csv writes them."
            print_line(line)


def _one_table(
    runs: list[Run],
    tables: list[pd.DataFrame],
    keys: dict[str, list[Any]],
) -> pd.DataFrame:
    """All tables one after another, with columns in front that say the run and the keys in which the runs differ."""
    parts = []
    for number, (run, table) in enumerate(zip(runs, tables, strict=True)):
        differing_keys = {key: str(values[number]) for key, values in keys.items()}
        parts.append(table.assign(run=str(run.path), variant=run.variant, **differing_keys))
    whole = pd.concat(parts, ignore_index=True)
    first = ["run", "variant", *keys]
    return whole[[*first, *whole.columns.drop(first)]]


def remarks(runs: list[Run]) -> Iterator[str]:
    """Notes on what differs between the runs, and may be overlooked: ray casters, and times that were simulated."""
    engines = sorted({str(run.config.get("lidar", {}).get("engine", "columnar")) for run in runs})
    if len(engines) > 1:
        yield f"note: the runs were cast by {' and '.join(engines)}: {ENGINES_DIFFER}"
    lengths_s = sorted({run.manifest["steps"] * run.dt_s for run in runs})
    if len(lengths_s) > 1 and "traffic.duration_s" not in differing(runs):
        said = " and ".join(f"{length_s:g}" for length_s in lengths_s)
        yield f"note: the runs have one traffic.duration_s, but simulated {said} s: counts and times grow with that."


def _side_by_side(
    labels: list[str],
    tables: list[pd.DataFrame],
    keys: dict[str, list[Any]],
) -> Table:
    """A row per metric and group, a column per run; metrics of one kind stand together, in the order of the tables."""
    head = [Column(label, justify="right", no_wrap=True, min_width=7, overflow="fold") for label in labels]
    table = Table(Column("metric", overflow="fold"), Column("group", overflow="fold"), *head, box=SIMPLE)
    for key, settings in keys.items():
        shown = ("" if setting is None else str(setting) for setting in settings)
        table.add_row(key, "", *shown, style="bold")
    table.add_section()
    name = ["metric", "group"]
    values = [one[one.value.notna()].set_index(name).value for one in tables]
    order = pd.concat(tables).drop_duplicates(name)[name]
    first_of = {metric: i for i, metric in enumerate(order.metric.unique())}
    order = order.sort_values("metric", key=lambda names: names.map(first_of), kind="stable")
    last = ""
    for metric, group in order.itertuples(index=False, name=None):
        found = [of.get((metric, group)) for of in values]
        cells = ["" if value is None else plain(float(value)) for value in found]
        if not any(cells):
            continue
        if last and metric.split(".")[0] != last.split(".")[0]:
            table.add_section()
        table.add_row(metric if metric != last else "", group, *cells)
        last = metric
    return table
