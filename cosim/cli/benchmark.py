"""The command that scores trust models on recorded evidence."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Column, Table

from cosim.cli.console import AsJson, notes, print_json, progress, screen

if TYPE_CHECKING:
    from cosim.benchmark.evidence import EvidenceSet


def add_to(app: typer.Typer) -> None:
    """Add the command `benchmark`."""
    app.command()(benchmark)


def benchmark(
    model: Annotated[
        str | None, typer.Argument(metavar="[MODEL]", help="A model of your own, mine.py:Name, or one that ships.")
    ] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", help="Set a parameter of the model, or host=local. Repeatable.")
    ] = None,
    adapt: Annotated[
        bool, typer.Option("--adapt", help="Also let an adversary that knows the model search its worst case.")
    ] = False,
    budget: Annotated[
        int | None, typer.Option(min=1, max=100_000, help="With --adapt: policies to try. The default is 34.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="With --adapt: seed of the search. The default is 0.")] = None,
    evidence: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Another evidence set. The default ships with cosim.")
    ] = None,
    make: Annotated[bool, typer.Option("--make", help="Record the set into the folder of --evidence.")] = False,
    every: Annotated[
        bool, typer.Option("--all", help="Score all models that ship and store their rows beside the set.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Score a trust model on recorded evidence, beside all models that ship. Without a model, print the table."""
    from cosim.benchmark import card, table
    from cosim.benchmark.evidence import SHIPPED, load

    folder = evidence or SHIPPED
    if make:
        _make(evidence, model)
        return
    if model is None and (sets or adapt):
        raise ValueError(f"{'--adapt' if adapt else '--set'} goes with a model. Name one, such as mine.py:Beta.")
    if not adapt and (budget is not None or seed is not None):
        raise ValueError(f"{'--seed' if budget is None else '--budget'} goes with --adapt. Add it.")
    if every and model is not None:
        raise ValueError(f"--all scores the models that ship. Leave {model} out, or leave --all out.")
    found, mine = load(folder), None
    with progress() as advance:
        if every:
            table.make(found, folder, advance)
        if model is not None:
            mine = table.row_of(found, model, sets or [], advance, (budget or 34) if adapt else 0, seed or 0)
    rows, remark = table.stored(found, folder)
    if as_json:
        print_json({**table.head(found), "citation": card.citation(found), "row": mine, "rows": rows})
        return
    if mine is not None:
        screen.print(_of_attacks(mine))
    if rows or mine:
        screen.print(_of_models(rows, mine))
    screen.print(_about(found), soft_wrap=True)
    if remark:
        notes.print(f"note: {remark}", soft_wrap=True)


def _make(folder: Path | None, model: str | None) -> None:
    from cosim.benchmark import card, record

    if folder is None or model is not None:
        raise ValueError(
            "--make records a set and takes no model. Name the folder: cosim benchmark --make --evidence FOLDER."
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"--evidence {folder} is there already. Name a new folder, or remove it.")
    with progress() as advance:
        made = record.make(advance)
    made.write(folder)
    card.write(made, folder)
    screen.print(f"wrote {folder}: {_about(made)}", soft_wrap=True)


def _about(found: "EvidenceSet") -> str:
    rules = found.rules
    return (
        f"evidence set {found.version}, sha256 {found.checksum[:16]}: {len(found.worlds)} worlds of "
        f"{rules.n_steps * rules.dt_s:g} s, {len(rules.cases) - 1} attacks"
    )


def _of_attacks(row: dict[str, Any]) -> Table:
    """The figures of a model under each attack, worst first."""
    names = {
        "auc": "AUC", "exclusion_s": "excluded after [s]", "wrong_p": "honest excluded", "believed_p": "believed",
        "age_s": "age [s]", "harm": "harm",
    }  # fmt: skip
    head = [Column(name, justify="right") for name in names.values()]
    table = Table(Column("attack"), *head, title=row["model"], title_justify="left", box=SIMPLE)
    for attack, of in row["attacks"].items():
        table.add_row(attack, *(_cell(of[name]) for name in names))
    worst = row["worst_case"]
    if worst is not None:
        table.add_section()
        table.add_row(f"adapts ({worst['budget']} policies)", *(_cell(worst[name]) for name in names))
        table.caption, table.caption_justify = f"worst case: {worst['words']}", "left"
    return table


def _of_models(rows: list[dict[str, Any]], mine: dict[str, Any] | None) -> Table:
    """One line per model, the best worst case first."""
    from cosim.benchmark.table import ranked, summary, worst_attack

    names = ("worst AUC", "under", "mean AUC", "honest excluded", "believed", "age [s]", "us per evaluation",
             "worst harm", "worst case: harm", "worst case: AUC")  # fmt: skip
    table = Table(
        Column("model"), *(Column(name, justify="left" if name == "under" else "right") for name in names), box=SIMPLE,
        title="all models", title_justify="left",
    )  # fmt: skip
    for row in ranked([*rows, *([] if mine is None else [mine])]):
        of, worst, under = summary(row), row["worst_case"], worst_attack(row)
        table.add_row(
            row["model"], _cell(row["attacks"][under]["auc"]), under, *(_number(of[name]) for name in (
                "auc_mean", "wrong_worst", "believed_mean", "age_mean_s")), _number(row["cost_us"]),
            _number(of["harm_worst"]), *(("", "") if worst is None else (_cell(worst["harm"]), _cell(worst["auc"]))),
            style="bold" if row is mine else None,
        )  # fmt: skip
    return table


def _cell(of: list[float | None]) -> str:
    value, low, high = of
    if low is None or value is None:
        return _number(value)
    return f"{_number(value)} ({_number(low)} to {_number(high)})"


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if abs(value) < 10 else f"{value:.0f}"
