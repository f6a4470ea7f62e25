"""Laws of exporters and metrics, checked on a run of the tiny scene."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cosim.addons.tryout.findings import Finding, Report, in_one_line
from cosim.addons.tryout.play import BASE
from cosim.addons.tryout.probe import difference
from cosim.addons.tryout.scene import N_STEPS, STEP_S, TinyScene
from cosim.base.addons import hook
from cosim.config.config import load
from cosim.config.single import from_command_line
from cosim.door.guard import make
from cosim.runs.run import run
from results.archive import open_run
from results.own_metrics import measure_own
from results.run import Run
from sensors.scene import Shape

_RUNS = "it runs, and returns what its interface asks for"
_AGAIN = "asked twice, it answers the same"
_LEVELS = "the length of the blocks in which tables were written changes nothing"


def try_exporter(name: str, sets: Sequence[str] = ()) -> Report:
    """Check an exporter."""
    choice, _ = from_command_line("exporter", name, sets)
    export = hook("export", "cosim try of an exporter")

    def files(of: Run, out: Path) -> dict[str, bytes]:
        export(of, choice.source.name, out, sets=sets)
        written = [path for path in sorted(out.rglob("*")) if path.is_file()]
        found = {str(path.relative_to(out)): path.read_bytes() for path in written}
        return {path: content for path, content in found.items() if path != "export.progress"}

    return _tried("exporter", name, files, "files")


def try_metric(name: str, sets: Sequence[str] = ()) -> Report:
    """Check a metric."""
    choice, params = from_command_line("metric", name, sets)

    def rows(of: Run, out: Path) -> list[dict[Any, Any]]:
        return measure_own(of, [make(choice, *params)]).to_dict("records")

    return _tried("metric", name, rows, "rows")


def _tried(kind: str, name: str, answer: Callable[[Run, Path], Any], what: str) -> Report:
    with _tiny_runs() as (one, other, scratch):
        try:
            first = answer(open_run(one), scratch / "1")
        except Exception as error:  # a user's class can raise anything
            return Report(kind, name, [Finding(_RUNS, in_one_line(error))])
        found = [Finding(_RUNS, "" if first else f"It gives no {what} for a run of {N_STEPS} steps.")]
        opened = open_run(one)
        answer(opened, scratch / "2")
        again = difference(first, answer(opened, scratch / "3"))
        found.append(Finding(_AGAIN, again and f"Its {what} differ when it is asked again: {again}. Draw nothing."))
        split = difference(first, answer(open_run(other), scratch / "4"))
        cure = "Sort by the columns that are the key of a table."
        found.append(Finding(_LEVELS, split and f"Its {what} follow the order of rows on disk: {split}. {cure}"))
        return Report(kind, name, found)


@contextmanager
def _tiny_runs() -> Iterator[tuple[Path, Path, Path]]:
    """Folders of the same run written in long and in short blocks, and a folder for other files."""
    with tempfile.TemporaryDirectory(prefix="cosim-try-") as folder:
        root = Path(folder)
        _write_trace(root / "trace.fcd.xml")
        sets = [
            *BASE,
            f"traffic.trace={root / 'trace.fcd.xml'}",
            "traffic.warmup_s=0",
            "record.level=full",
            "fleet.penetration_p=0.8",
            "attacks.0.share_p=0.3",
        ]
        for name, block_steps in (("one", N_STEPS), ("other", 3)):
            run(load(None, [*sets, f"record.block_steps={block_steps}"]), root / name, lambda *_: None)
        yield root / "one", root / "other", root


def _write_trace(path: Path) -> None:
    """Write the traffic of the tiny scene as a trace, with fronts of vehicles and centres of persons, like SUMO."""
    scene, types = TinyScene(), {Shape.CAR: "passenger", Shape.TRUCK: "truck", Shape.PEDESTRIAN: "pedestrian"}
    lines = ["<fcd-export>"]
    for number in range(N_STEPS + 1):
        lines.append(f'<timestep time="{number * STEP_S:.2f}">')
        boxes = scene.world(number).boxes
        rows = zip(scene.actors, boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad, strict=True)
        for actor, centre, size, yaw_rad in rows:
            is_person = actor.shape == Shape.PEDESTRIAN
            element = "person" if is_person else "vehicle"
            ahead_m = 0.0 if is_person else size[0] / 2
            ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
            x_m, y_m = centre[:2] + ahead_m * ahead
            lines.append(
                f'<{element} id="{actor.name}" x="{x_m:.2f}" y="{y_m:.2f}" '
                f'angle="{(90 - np.degrees(yaw_rad)) % 360:.2f}" type="{types[actor.shape]}" '
                f'speed="{actor.speed_mps:.2f}"/>'
            )
        lines.append("</timestep>")
    path.write_text("\n".join([*lines, "</fcd-export>"]), encoding="utf-8")
