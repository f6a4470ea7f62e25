"""The command that puts contacts beside what others have published."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.text import Text

from cosim.cli.console import AsJson, print_json, rows_of, screen
from cosim.cli.help import Commands

judges = Commands(no_args_is_help=True, help="Put figures of runs beside what others have published.")


@judges.callback()
def _group() -> None:
    """Keeps `contacts` a command of a group, although it is the only one."""


@judges.command("contacts")
def judge_contacts(
    runs: Annotated[list[Path], typer.Argument(help="Folders that `cosim run` or `cosim contacts` wrote.")],
    departure: Annotated[
        Literal["ends", "censors"], typer.Option(help="Whether a vehicle that leaves ends its encounters.")
    ] = "ends",
    as_json: AsJson = False,
) -> None:
    """Print published facts about contacts, each with its source and the figure of each run, and rank families."""
    from cosim.addons.durations.facts import judge, sentences
    from results.archive import open_run

    answers: dict[str, Any] = {}
    for folder in runs:
        run = open_run(folder)
        run.require("encounters", "vehicles")
        if not run.n_rows("encounters"):
            raise ValueError(
                f"{folder} holds no encounters: no two came within the radius of each other. Raise the radius."
            )
        answers[str(folder)] = judge(run, departure), sentences(run, departure)
    if as_json:
        print_json({
            name: {"facts": rows_of(facts), "families": rows_of(ranks)} for name, (facts, ranks) in answers.items()
        })  # fmt: skip
        return
    first = next(iter(answers.values()))[0]
    for i, fact in enumerate(first.itertuples()):
        screen.print(Text.assemble((f"{fact.fact}: ", "bold"), str(fact.published)), soft_wrap=True)
        screen.print(f"  {fact.conditions}. {fact.source} ({fact.read} read)", soft_wrap=True)
        for name, (facts, _) in answers.items():
            row = facts.iloc[i]
            said = f"{row.ours}: " if row.ours else ""
            screen.print(
                Text.assemble(f"  {name}: {said}", (row.verdict, "bold"), f"; {row.why}."), soft_wrap=True
            )  # fmt: skip
    screen.print()
    for name, (_, ranks) in answers.items():
        screen.print(Text(f"{name}: families by AIC", "bold"), soft_wrap=True)
        for row in ranks.itertuples():
            screen.print(f"  {row.ranking}" if row.ranking else f"  {row.what}", soft_wrap=True)
            screen.print(f"    {row.sentence}", soft_wrap=True)
