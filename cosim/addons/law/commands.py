"""The commands that predict what a study would measure."""

import json
import shlex
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from cosim.cli.console import AsJson, TrustCode, print_json, print_line, print_note, print_table, progress
from cosim.cli.help import Commands

if TYPE_CHECKING:
    from cosim.addons.law.prediction import Prediction

Points = list[tuple[Any, "Prediction"]]
"""Keys and prediction of each point of a study."""
predict = Commands(help="Predict what a study would measure, from traffic alone.")

_SHORT = {
    "freshness.newest_evaluation_age.median_s": "median [s]",
    "freshness.newest_evaluation_age.p90_s": "90 % [s]",
    "freshness.lookup_state.share:evaluated": "evaluated",
    "freshness.lookup_state.share:stale": "stale",
    "freshness.lookup_state.share:unevaluated": "unevaluated",
    "freshness.lookup_state.share:no value": "no value",
    "freshness.evaluators.mean": "evaluators",
    "freshness.encounters_without_trust.share": "encounters without trust",
}
"""Metrics of the printed table, and the heads of their columns."""


_REPLICATE = ", replicate 0"
"""Which runs of a study are compared: those with the traffic that is predicted."""


@predict.command()
def freshness(
    config: Annotated[
        Path | None,
        typer.Argument(help="Config or study file (TOML), or a shipped study. Without one, the default city is used."),
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="Change one key of the config, e.g. fleet.penetration_p=0.2.")
    ] = None,
    fleets: Annotated[
        int,
        typer.Option(min=0, max=100, help="Other fleets, for intervals of a run with another seed."),
    ] = 0,
    out: Annotated[Path | None, typer.Option(help="File to write: the predictions as JSON, with their date.")] = None,
    grid: Annotated[
        Path | None, typer.Option(help="Study file to write: a grid that the prediction chooses, for `cosim sweep`.")
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(help="Folder of a run, or of a study (replicate 0): what it measured is printed beside."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="File to draw: .png, .svg or .pdf. With --against, law and simulation.")
    ] = None,
    trust_code: TrustCode = False,
    as_json: AsJson = False,
) -> None:
    """Predict the age of trust at lookup, and what lookups find, without sensing, messages or trust."""
    from cosim.addons.law.comparison import as_json as plain
    from cosim.addons.law.comparison import differences, measured_in, rows_of
    from cosim.addons.law.freshness import predict as predicted
    from cosim.addons.law.freshness import predict_study
    from cosim.addons.law.scope import left_out
    from cosim.config.config import load
    from cosim.studies.study import config_at

    study = _study_of(config, trust_code)
    if study is not None and (overrides or grid):
        raise ValueError("--set and --grid go with a config, and this is a study. Change its file.")
    if grid is not None and (out or against or picture or fleets):
        raise ValueError("--grid writes a study file alone. Leave --out, --against, --picture and --fleets out.")
    if out is not None and out.suffix != ".json":
        raise ValueError(f"--out {out}: predictions are JSON. Name the file .json, or draw them with --picture.")
    asked = study or load(config, overrides, trust_code)
    if against is not None and (others := differences(against, asked)):  # before minutes of computing
        more = f", and {len(others) - 9} more" if len(others) > 9 else ""
        said = ", ".join(others[:9])
        print_note(f"note: {against} was measured with another config: {said}{more}.")
    inputs: dict[str, float] = {}
    found: list[tuple[Any, Prediction]]
    with progress() as advance:
        if study is not None:
            found = list(predict_study(study, str(config), advance, fleets))
            points = [config_at(study, keys, 0, str(config)) for keys in study.combinations()]
            neglected = list(dict.fromkeys(line for point in points for line in left_out(point)))
        else:
            if grid is not None:
                _write_grid(asked, grid, advance)
                return
            of, inputs = predicted(asked, advance, fleets)
            found, neglected = [({}, p) for p in of], left_out(asked)
    measured = None if against is None else measured_in(against, found)
    if out is not None:
        _write(out, {"inputs": inputs, "predictions": plain(found)})
    if picture is not None:
        _draw(picture, found, against, measured)
    if as_json:
        print_json({"inputs": inputs, "neglected": neglected, "rows": rows_of(found, measured)})
        return
    for line in neglected:
        print_note(f"note: neglected: {line}")
    print_table(_table(found, measured))
    if inputs:
        said = ", ".join(f"{name} {value:.3g}" for name, value in inputs.items())
        print_line(f"measured from traffic: {said}")


def _study_of(path: Path | None, trust_code: bool) -> Any:
    """The study that a path names; None if it names a config."""
    from cosim.cli.files import refuse_traffic
    from cosim.config.data import read_toml
    from cosim.studies.study import SHIPPED, load

    if path is None:
        return None
    refuse_traffic(path)
    if path.is_file():
        return load(path, trust_code) if {"study", "grid", "zip"} & read_toml(path, "file").keys() else None
    return load(path) if (SHIPPED / f"{path}.toml").is_file() else None


def _write(path: Path, content: dict[str, Any]) -> None:
    from cosim.base.durable import write_output
    from cosim.runs.source import source

    head = {"made": datetime.now(UTC).isoformat(timespec="seconds"), **source()}
    write_output(path, (json.dumps(head | content, indent=1) + "\n").encode())
    print_note(f"wrote {path}")


def _write_grid(experiment: Any, path: Path, advance: Any) -> None:
    from cosim.addons.law.grid import propose
    from cosim.base.durable import write_output

    if path.suffix != ".toml":
        raise ValueError(f"--grid {path}: the name of a study file to write, which ends in .toml.")
    study, found = propose(experiment, path.stem, advance)
    head = [
        "# Chosen by `cosim predict freshness`. Predicted median and 90th percentile of the age of the newest",
        "# evaluation at lookup [s], and share of lookups without a value:",
    ]
    names = (*list(_SHORT)[:2], "freshness.lookup_state.share:no value")
    for keys, p in found:
        point = ", ".join(f"{key} = {value:g}" for key, value in keys.items())
        values = ", ".join(f"{p.metrics[name]:.3g}" for name in names)
        head.append(f"# {point}: {values}")
    write_output(path, ("\n".join(head) + "\n\n" + study.to_toml()).encode())
    print_line(f"wrote {path}: {len(found)} points. Next: cosim sweep {shlex.quote(str(path))} --out FOLDER")


def _table(found: Points, measured: list[dict[str, float]] | None) -> Table:
    keys = list(dict.fromkeys(key for swept, _ in found for key in swept))
    title = "freshness of trust at lookup, predicted"
    if measured is not None:
        title += f" / measured{_REPLICATE if keys else ''}"
    columns = [*(keys or ["variant"]), *_SHORT.values()]
    table = Table(*columns, title=title, title_justify="left", box=None)
    for number, (swept, p) in enumerate(found):
        cells = [str(swept[key]) for key in keys] if keys else [p.variant]
        for name in _SHORT:
            text = f"{p.metrics[name]:.3g}"
            if name in p.low:
                text += f" ({p.low[name]:.3g} to {p.high[name]:.3g})"
            if measured is not None:
                text += f" / {measured[number].get(name, float('nan')):.3g}"
            cells.append(text)
        table.add_row(*cells)
    return table


def _draw(
    path: Path,
    found: Points,
    against: Path | None,
    measured: list[dict[str, float]] | None,
) -> None:
    """Draw distributions, and those of a run beside; or the points of a study."""
    from cosim.addons.law import figure as law
    from results.figures import style

    if against is not None and measured is not None and any(keys for keys, _ in found):
        predicted = [p.metrics for _, p in found]
        points = law.points_of(against.name + _REPLICATE, predicted, measured)
        figure = law.draw([], [], [points])
    else:
        curves = []
        for keys, p in found:
            point = ", ".join(f"{key} = {value}" for key, value in keys.items())
            curves.append(law.Curve(point or p.variant, p.age_s, p.newest))
        variants = [p.variant for _, p in found]
        simulation = [] if against is None else law.measured(against, variants)
        figure = law.draw(curves, simulation)
    print_note(f"wrote {style.save(figure, path)}")
