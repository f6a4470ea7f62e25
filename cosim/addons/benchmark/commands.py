"""The command that scores trust models on recorded evidence."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Column, Table

from cosim.cli.console import AsJson, print_json, print_line, print_note, progress, screen

if TYPE_CHECKING:
    from cosim.addons.benchmark.evidence import EvidenceSet


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
    """Score a trust model on recorded evidence, beside all others. Without a model, print the table."""
    from cosim.addons.benchmark import table
    from cosim.addons.benchmark.evidence import SHIPPED, load

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
            n_policies = (budget or 34) if adapt else 0
            mine = table.row_of(found, model, sets or [], advance, n_policies, seed or 0)
    rows, remark = table.stored(found, folder)
    if as_json:
        print_json({**table.head(found), "citation": table.citation(found), "row": mine, "rows": rows})
        return
    if mine is not None:
        screen.print(*_of_attacks(mine), sep="\n")
    if rows or mine:
        screen.print(*_of_models(rows, mine), sep="\n")
    print_line(_about(found))
    if remark:
        print_note(f"note: {remark}")


def _make(folder: Path | None, model: str | None) -> None:
    from cosim.addons.benchmark import record

    if folder is None or model is not None:
        raise ValueError(
            "--make records a set and takes no model. Name the folder: cosim benchmark --make --evidence FOLDER."
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"--evidence {folder} is there already. Name a new folder, or remove it.")
    with progress() as advance:
        made = record.make(advance)
    made.write(folder)
    print_line(f"wrote {folder}: {_about(made)}")


def _about(found: "EvidenceSet") -> str:
    rules = found.rules
    return (
        f"evidence set {found.version}, sha256 {found.checksum[:16]}: "
        f"{len(found.worlds)} worlds of {rules.n_steps * rules.dt_s:g} s, {len(rules.cases) - 1} attacks"
    )


def _of_attacks(row: dict[str, Any]) -> Iterator[Table | str]:
    """The figures of a model under each attack, worst first."""
    names = {
        "auc": "AUC",
        "exclusion_s": "excluded after [s]",
        "wrong_p": "honest excluded",
        "believed_p": "believed",
        "age_s": "age [s]",
        "harm": "harm",
    }
    worst = row["worst_case"]
    attacks = list(row["attacks"].items())
    if worst is not None:
        attacks.append((f"adapts ({worst['budget']} policies)", worst))
    cells = []
    for attack, of in attacks:
        cells.append([attack, *(_cell(of[name]) for name in names)])
    yield from _fitted(row["model"], ["attack", *names.values()], cells)
    if worst is not None:
        yield f"worst case: {worst['words']}"


def _of_models(
    rows: list[dict[str, Any]],
    mine: dict[str, Any] | None,
) -> Iterator[Table]:
    """One line per model, the best worst case first."""
    from cosim.addons.benchmark.table import ranked, summary, worst_attack

    names = [
        "model",
        "worst AUC",
        "under",
        "mean AUC",
        "honest excluded",
        "believed",
        "age [s]",
        "us per evaluation",
        "worst harm",
        "worst case: harm",
        "worst case: AUC",
    ]
    cells = []
    for row in ranked(rows if mine is None else [*rows, mine]):
        of, worst, under = summary(row), row["worst_case"], worst_attack(row)
        means = (of["auc_mean"], of["wrong_worst"], of["believed_mean"], of["age_mean_s"])
        numbers = map(_number, (*means, row["cost_us"], of["harm_worst"]))
        adapted = ["", ""]
        if worst is not None:
            adapted = [_cell(worst["harm"]), _cell(worst["auc"])]
        auc = _cell(row["attacks"][under]["auc"])
        cells.append([row["model"], auc, under, *numbers, *adapted])
    return _fitted("all models", names, cells, "" if mine is None else mine["model"])


def _fitted(
    title: str,
    names: Sequence[str],
    rows: Sequence[Sequence[str]],
    bold: str = "",
) -> Iterator[Table]:
    """Tables of columns as wide as the screen allows: each begins with the first column, and none is cut."""
    texts = zip(names, *rows, strict=True)
    widths = [max(map(len, column)) + 3 for column in texts]
    columns: list[list[int]] = [[]]
    for i in range(1, len(names)):
        beside = (0, *columns[-1], i)
        width = sum(widths[k] for k in beside) + 2
        if columns[-1] and width > screen.width:
            columns.append([])
        columns[-1].append(i)
    for n, chosen in enumerate(columns):
        head = [Column(names[0], no_wrap=True)]
        for i in chosen:
            head.append(Column(names[i], justify="left" if names[i] == "under" else "right"))
        table = Table(*head, box=SIMPLE, title=None if n else title, title_justify="left")
        for row in rows:
            shown = [row[i] for i in (0, *chosen)]
            table.add_row(*shown, style="bold" if row[0] == bold else None)
        yield table


def _cell(of: list[float | None]) -> str:
    value, low, high = of
    if low is None or value is None:
        return _number(value)
    return f"{_number(value)} ({_number(low)} to {_number(high)})"


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if abs(value) < 10 else f"{value:.0f}"
