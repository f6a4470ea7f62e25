"""The command that evaluates recorded data sets of others."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from cosim.cli.console import AsJson, print_json, print_line, print_note, screen
from cosim.cli.help import MORE


def evaluate(
    folder: Annotated[Path, typer.Argument(help="Folder of a data set: OPV2V, V2V4Real, DAIR-V2X or KITTI.")],
    layout: Annotated[
        Literal["opv2v", "dair-v2x", "kitti"] | None,
        typer.Option(help="Layout of the folder; opv2v also for V2V4Real. The default is found out."),
    ] = None,
    detections: Annotated[
        Path | None, typer.Option(help="Folder of the detections. By default they lie with the annotations.")
    ] = None,
    range_m: Annotated[
        float, typer.Option(min=1, help="Objects count up to this distance from the ego, in metres.")
    ] = 100.0,
    partners_m: Annotated[
        float,
        typer.Option(rich_help_panel=MORE, min=0, help="Agents up to this distance from the ego cooperate, in metres."),
    ] = 70.0,
    overlaps: Annotated[
        list[float] | None,
        typer.Option(
            "--overlap", min=0.01, max=1, help="A box is right from this overlap on. Repeatable; 0.5 and 0.7."
        ),
    ] = None,
    ego: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=MORE,
            help="Agent that is the ego. The default is the first one by name; roadside units come last.",
        ),
    ] = None,
    objects: Annotated[
        Literal["world", "lidar"] | None,
        typer.Option(rich_help_panel=MORE, help="opv2v: frame of the annotated objects. The default is found out."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure average precision on a recorded data set. Of the ego alone, late fusion, and our matching and fusion."""
    from cosim.addons.perception import evaluate as evaluating

    about, table = evaluating.evaluate(
        folder, layout, detections, range_m, partners_m, overlaps or (0.5, 0.7), ego, objects
    )
    rows = table.astype(object).where(table.notna(), None).to_dict("records")
    for remark in about["remarks"]:
        print_note(f"note: {remark}")
    if as_json:
        print_json(about | {"rows": rows})
        return
    from rich.box import SIMPLE
    from rich.table import Table

    for line in _read_lines(about):
        print_line(line)
    if not rows:
        print_line(about["missing"])
        return
    shown = Table(*table.columns, box=SIMPLE)
    for row in rows:
        cells = [_cell(str(name), value) for name, value in row.items()]
        shown.add_row(*cells)
    screen.print(shown)


def _read_lines(about: dict[str, Any]) -> Iterator[str]:
    """What was read of a data set, a line each."""
    counts = [f"{about[name]:,} {name}" for name in ("frames", "agents", "objects", "boxes")]
    yield f"{about['layout']}: {', '.join(counts)}"
    egos = about.get("egos", {})
    if len(egos) == 1:
        yield f"ego: {next(iter(egos))}"
    elif egos:
        some = [f"{name} in {n:,} frames" for name, n in egos.items()]
        if len(some) > _MOST_EGOS:
            some[_MOST_EGOS:] = ["..."]
        yield f"egos: {', '.join(some)}"
    classes, differ = [], False
    for ours, of in about["classes"].items():
        names = [f"{n:,} {name}" for name, n in of.items()]
        classes.append(f"{' and '.join(names)} as {ours}")
        differ |= any(name.lower() != ours for name in of)
    if differ:
        yield "classes: " + "; ".join(classes)
    if about.get("boxes_left_out"):
        yield (
            f"{about['boxes_left_out']:,} boxes are on the agents themselves or on objects of other classes: they are "
            "left out, as these are"
        )
    if about.get("frames_without_clouds"):
        yield f"{about['frames_without_clouds']:,} frames without trust: clouds are missing or cannot be read."
    for one in about.get("trust", ()):
        if one["trust"] is not None:
            yield f"trust in {one['agent']}: {one['trust']:.3f} by {one['n_evaluations']:,} evaluations"


_MOST_EGOS = 10
"""Egos that are listed by name."""


def _cell(name: str, value: object) -> str:
    """Percentages with one digit."""
    if value is None:
        return "-"
    return f"{value:.1f}" if name.startswith(("ap", "recall")) else str(value)
