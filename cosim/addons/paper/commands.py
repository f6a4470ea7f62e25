"""The command `cosim reproduce`."""

from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.box import SIMPLE
from rich.table import Column, Table

from cosim.cli.console import AsJson, notes, print_json, progress, screen

if TYPE_CHECKING:
    import pandas as pd

Row = dict[Any, Any]
What = Literal["scenario-1", "scenario-2", "tables", "trust-levels"]


def reproduce(
    what: Annotated[What, typer.Argument(help="The scenario or experiment of the paper.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder to write. The default is runs/<scenario>, or runs/paper for an experiment."),
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="Experiments: change one key of the config. Repeatable.")
    ] = None,
    replicates: Annotated[int | None, typer.Option(help="Experiments: number of drives per city.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Experiments: number of parallel runs. The default is one per core.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run a scenario or an experiment of the paper and compare. After an interruption, the same command continues."""
    if what in ("tables", "trust-levels"):
        _experiment(what, out or Path("runs/paper"), overrides or [], replicates, workers, as_json)
        return
    if overrides or replicates or workers:
        raise ValueError(f"--set, --replicates and --workers go with tables and trust-levels, not with {what}.")
    _scenario(what, out or Path("runs") / what, as_json)


def _scenario(name: str, folder: Path, as_json: bool) -> None:
    from cosim.addons.paper.scenarios import SCENARIOS

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out {folder} cannot be a folder: {error.strerror}. Give another one.") from None
    compared = SCENARIOS[name](folder)
    if as_json:
        print_json({"scenario": name} | asdict(compared))
        return
    table = Table(*compared.rows[0], title=name, title_justify="left", box=SIMPLE)
    for row in compared.rows:
        table.add_row(*("-" if v is None else f"{v:.3f}" if isinstance(v, float) else v for v in row.values()))
    screen.print(table)
    for line in compared.notes + [f"drawn in {path}" for path in compared.pictures]:
        screen.print(line, highlight=False, soft_wrap=True)


def _experiment(
    name: str, folder: Path, overrides: list[str], replicates: int | None, workers: int | None, as_json: bool
) -> None:
    from cosim.addons.paper import experiments
    from cosim.studies import sweep as sweeping

    study = experiments.study_of(name, overrides, replicates)
    task = experiments.task_of(study, name, folder)
    with progress() as advance:
        _, failed = sweeping.sweep(
            task, lambda done, total, answered, note: advance(f"{name}, runs", done, total, ""), None, workers
        )
    for id, attempt in failed:
        notes.print(f"failed: {id}: {attempt.error}; log in {folder / 'jobs' / id / 'log.txt'}", soft_wrap=True)
    if failed:
        raise typer.Exit(1)
    found = experiments.conclude(name, folder)
    if as_json:
        print_json({"experiment": name, "rows": experiments.as_data(found.rows)})
        return
    for table in _precision_tables(found.rows, name):
        screen.print(table)
    screen.print(_others(found.rows))
    for path in found.files:
        screen.print(f"written: {path}", highlight=False, soft_wrap=True)


def _precision_tables(rows: "pd.DataFrame", name: str) -> list[Table]:
    """Average precision by city: the paper's, ours, and the change against the ego alone or honest vehicles."""
    from cosim.addons.paper.published import METHODS

    found: dict[tuple[str, str], dict[str, dict[str, Row]]] = {}
    for row in rows[rows.what == "average precision"].to_dict("records"):
        said = METHODS[row["method"]] + ("" if row["self_reports"] else ", no self-reports")
        said = said if name == "tables" else f"{row['setting']}: {said}"
        found.setdefault((row["city"], row["class"]), {}).setdefault(said, {})[row["level"]] = row
    tables, against = [], "the ego alone" if name == "tables" else "honest vehicles"
    for (city, label), lines in found.items():
        levels = list(dict.fromkeys(level for line in lines.values() for level in line))
        title = f"{city}, {label}: AP 3D, 11 points [%]: paper | obtained, 95 % interval | change against {against}"
        table = Table(Column("method", no_wrap=True), *levels, title=title, title_justify="left", box=SIMPLE)
        for said, line in lines.items():
            table.add_row(said, *(_cell(line[level]) if level in line else "" for level in levels))
        tables.append(table)
    return tables


def _cell(row: Row) -> str:
    parts = [] if isnan(row["paper"]) else [f"{row['paper']:.1f}"]
    parts.append(_interval(row["mean"], row["high"]))
    if not isnan(row["change"]) and (row["change"], row["change_high"]) != (0, 0):
        parts.append(_interval(row["change"], row["change_high"], "+.1f"))
    return " | ".join(parts)


def _interval(mean: float, high: float, form: str = ".1f") -> str:
    """A mean, and half of its confidence interval if it has one."""
    return f"{mean:{form}}" + ("" if isnan(high) else f" ±{high - mean:{form.strip('+')}}")


def _others(rows: "pd.DataFrame") -> Table:
    """The other metrics: trust, encounters, time to detection."""
    table = Table("what", "setting", "city", "method", "paper", "obtained", box=SIMPLE)
    for row in rows[rows.what != "average precision"].to_dict("records"):
        paper = "" if isnan(row["paper"]) else f"{row['paper']:g}"
        method = row["method"] + ("" if row["self_reports"] else ", no self-reports")
        unit = "" if row["unit"] in ("", "1") else f" {row['unit']}"
        obtained = _interval(row["mean"], row["high"], ".2f") + unit
        table.add_row(row["what"], row["setting"], row["city"], method, paper, obtained)
    return table
