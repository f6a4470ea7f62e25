"""`python -m tests.bench`: measures the speed of the components on this machine."""

import sys
from typing import Annotated

import typer

from cosim.cli.console import AsJson, print_json, print_rows
from tests.bench.suite import machine, run, run_scale


def main(
    only: Annotated[
        list[str] | None,
        typer.Argument(
            help="Components to measure: sensors, trust, models, radio, mobility, cycle, studies. Without any, all "
            "of them. `scale` alone measures how the cost grows with the number of vehicles."
        ),
    ] = None,
    scenario: Annotated[str, typer.Option(help="scale: a city or a .sumocfg, as in traffic.scenario.")] = "helsinki",
    trace: Annotated[str | None, typer.Option(help="scale: recorded traffic, as in traffic.trace.")] = None,
    vehicles: Annotated[
        str, typer.Option(help="scale: numbers of actors; the city is cropped to each of them.")
    ] = "250,500,1000,2000,5000",
    seconds: Annotated[int, typer.Option(min=1, max=3600, help="scale: simulated seconds to measure.")] = 5,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="scale: change one key of the config. Repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the speed of the components on this machine."""
    try:
        if only == ["scale"]:
            rows = run_scale(scenario, trace, vehicles, seconds, overrides or ())
        else:
            rows = run(only or [])
    except ValueError as wrong:
        print(f"error: {wrong}", file=sys.stderr)
        raise typer.Exit(2) from None
    if as_json:
        print_json({"machine": machine(), "figures": rows})
    else:
        print_rows(machine(), rows)


if __name__ == "__main__":
    typer.run(main)
