"""The command `cells`: what a larger city takes in cells, from short runs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Column, Table

from cosim.cli.console import AsJson, print_json, screen

if TYPE_CHECKING:
    from cosim.addons.cells.model import CostModel, Measured


def add_to(app: typer.Typer) -> None:
    """Add the command `cells`."""
    app.command()(cells)


def cells(
    runs: Annotated[list[Path], typer.Argument(help="Runs in cells to fit, with different numbers of cells.")],
    check: Annotated[list[Path] | None, typer.Option(help="A run to compare with the prediction. Repeatable.")] = None,
    vehicles: Annotated[list[int] | None, typer.Option(help="Vehicles of a city to predict. Repeatable.")] = None,
    cores: Annotated[list[int] | None, typer.Option(help="Cores to predict for. Repeatable.")] = None,
    gbit: Annotated[
        float | None,
        typer.Option(help="Network of the machine of the run, in Gbit/s, if the cells are on other machines."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Predict the time of a step in cells: fit runs with --cells, check others, and print larger cities."""
    from cosim.addons.cells.model import CostModel

    if any(n < 1 for n in (*(vehicles or ()), *(cores or ()))):
        raise ValueError("--vehicles and --cores: give numbers from 1.")
    if gbit is not None and not gbit > 0:
        raise ValueError(f"--gbit {gbit:g}: give a number above 0.")
    model = CostModel.fit([_measured(run) for run in runs])
    compared = [_compared(run, model) for run in check or ()]
    predicted = [
        _predicted(model, n, k, float("inf") if gbit is None else 1e9 * gbit)
        for n in vehicles or (5_000, 20_000, 100_000, 1_000_000)
        for k in cores or (2, 16, 64)
    ]
    if as_json:
        print_json({"check": compared, "predicted": predicted})
        return
    for rows in (compared, predicted):
        if rows:
            table = Table(*(Column(name, justify="right") for name in rows[0]), box=SIMPLE)
            for row in rows:
                table.add_row(*(value if isinstance(value, str) else f"{value:,.4g}" for value in row.values()))
            screen.print(table)


def _measured(run: Path) -> Measured:
    from cosim.addons.cells.model import Measured
    from results.archive import read_manifest

    manifest = read_manifest(run)
    try:
        return Measured.of(manifest)
    except ValueError as error:
        raise ValueError(f"{run}: {error}") from None


def _compared(run: Path, model: CostModel) -> dict[str, Any]:
    """Predicted divided by measured values of a run."""
    found, n_cores = _measured(run), len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    want = model.predict(found.n_vehicles, found.n_cells, n_cores)
    ratios = {
        "run cpu": want.run_s / found.run_s,
        "cells cpu": want.cells_s / found.cells_s,
        "all cpu": (want.run_s + want.cells_s) / (found.run_s + found.cells_s),
        "busiest": want.busiest_s / found.busiest_s,
        f"step on {n_cores} cores": want.step_s / found.wall_s,
    }
    return {"run": str(run), "vehicles": found.n_vehicles, "cells": found.n_cells, **ratios}


def _predicted(model: CostModel, n_vehicles: int, n_cores: int, wire_bps: float) -> dict[str, Any]:
    n_cells = max(1, n_cores - 1)
    step = model.predict(n_vehicles, n_cells, n_cores, wire_bps)
    return {
        "vehicles": n_vehicles, "cores": n_cores, "cells": n_cells, "step [s]": step.step_s, "run [s]": step.run_s,
        "cells [s]": step.cells_s, "MB per step": step.n_bytes / 1e6,
    }  # fmt: skip
