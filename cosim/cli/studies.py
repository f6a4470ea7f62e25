"""The commands of studies."""

import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Column, Table

from cosim.cli.console import (
    AsJson,
    Overrides,
    Preset,
    TrustCode,
    duration,
    print_done,
    print_json,
    print_line,
    print_note,
    print_table,
    progress,
    screen,
    with_preset,
)
from cosim.cli.files import refuse_other_than_study

if TYPE_CHECKING:
    from cosim.studies.sweep import Task


def add_to(app: typer.Typer) -> None:
    """Add the commands `sweep`, `status` and `cache`."""
    for command in (sweep, status, cache):
        app.command()(command)


def sweep(
    study: Annotated[
        Path, typer.Argument(help="Study file (TOML), or the name of a shipped study (cosim/studies/README.md).")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the study; finished runs stay. The default is runs/<file name>.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a running Dask scheduler. The default is to use this machine alone.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of parallel runs on this machine. The default is one per core.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan and run nothing.")] = False,
    separate: Annotated[
        bool, typer.Option("--separate", help="Share nothing between points, to check that sharing changes nothing.")
    ] = False,
    overrides: Overrides = None,
    preset: Preset = None,
    trust_code: TrustCode = False,
    as_json: AsJson = False,
) -> None:
    """Make all runs of a study. After an interruption, the same command continues."""
    from cosim.studies import remarks
    from cosim.studies import sweep as sweeping
    from cosim.studies.study import changed, load

    refuse_other_than_study(study)
    asked = changed(load(study, trust_code), with_preset(preset, overrides))
    out = out or Path("runs", study.stem)
    task = sweeping.prepare_study(asked, study.name, out, not separate)
    said: list[str] = []
    for notes_on in (remarks.keys_in_vain, remarks.scene_notes, remarks.fleet_notes):
        said += notes_on(task.points)
    if study.parent != out:  # there it is the copy of what is asked for
        said += remarks.name_notes(study, asked)
    for note in said + sweeping.measuring_notes(task) + remarks.interval_notes(asked):
        print_note(note)
    if dry_run:
        print_done(plan_facts(task, workers), "\n".join(plan_lines(task, workers)), as_json)
        return
    if task.plan.runs:
        print_note(_by_the_clock(plan_facts(task, workers)))
    with progress() as advance:

        def report(done: int, total: int, answered: int, note: str) -> None:
            note = f"{answered} of {len(task.points)} points {note}"
            advance(f"{task.study.head.name}, runs", done, total, note)

        def log(line: str) -> None:
            print_note(line)

        states, failed = sweeping.sweep(task, report, scheduler, workers, log)
    _print_states(task.study.head.name, out, states, failed, as_json)
    if not as_json:
        _print_first(out)
    if failed:
        raise typer.Exit(1)


def status(
    folder: Annotated[Path, typer.Argument(help="Folder that `cosim run` or `cosim sweep` wrote.")],
    trust_code: TrustCode = False,
    as_json: AsJson = False,
) -> None:
    """Print how far a run or a study is, and how to continue it."""
    if (folder / "manifest.json").is_file():
        _print_progress(folder, as_json)
        return
    from cosim.studies import sweep as sweeping
    from cosim.studies.folder import StudyFolder
    from results.study import again

    study, states, failed = sweeping.status(StudyFolder(folder), trust_code)
    _print_states(study.head.name, folder, states, failed, as_json)
    if not as_json:
        is_done = states["finished"] == sum(states.values())
        said = f"cosim report {shlex.quote(str(folder))}" if is_done else again(folder)
        if not is_done and StudyFolder(folder).is_swept():
            said = "wait, a sweep is running"
        print_line(f"next: {said}")


def _print_progress(folder: Path, as_json: bool) -> None:
    """Print how far a run is."""
    from results.progress import progress as progress_of

    found = progress_of(folder)
    of = "" if found["steps_asked"] is None else f" of {found['steps_asked']:,}"
    why = f" ({found['error']})" if found["error"] else ""
    done = f"{found['steps']:,}{of} steps in {found['blocks']:,} blocks"
    size_mb = found["bytes"] / 1e6
    said = f"{folder}: {found['status']}{why}; {done}, {size_mb:,.1f} MB."
    print_done(found, f"{said} Next: {found['next']}", as_json)


def cache(
    limit_gb: Annotated[
        float | None, typer.Option(min=0, help="Delete the least recently used entries until the rest fits.")
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Delete all entries.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show or delete the recorded traffic that studies keep."""
    from datetime import datetime

    from cosim.studies.stages import Cache, default_folder

    kept = Cache(default_folder())
    if clear:
        limit_gb = 0.0
    gone = [] if limit_gb is None else kept.shrink(limit_gb, set())
    entries = kept.entries()
    rows: list[dict[str, Any]] = []
    for entry in entries:
        row = {
            "stage": entry.stage,
            "name": entry.name,
            "MB": round(entry.bytes / 1e6, 2),
            "seconds": entry.seconds,
            "last used": datetime.fromtimestamp(entry.used_s).isoformat(" ", "seconds"),
        }
        rows.append(row)
    if as_json:
        print_json({"folder": str(kept.path), "entries": rows, "deleted": len(gone)})
        return
    table = Table("stage", "name", "MB", "seconds", "last used", title=str(kept.path), title_justify="left", box=None)
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    screen.print(table)
    kept_mb = sum(entry.bytes for entry in entries) / 1e6
    screen.print(f"{len(entries)} kept, {kept_mb:.1f} MB; {len(gone)} deleted")


def is_study(folders: list[Path]) -> bool:
    """Whether the folder is that of a study; ValueError if a study is named together with other folders."""
    from results.study import is_study as holds_study

    found = [folder for folder in folders if holds_study(folder)]
    if found and len(folders) > 1:
        raise ValueError(f"{found[0]} is a study, and other folders are named too. Name one study alone.")
    return bool(found)


def measure(
    folder: Path,
    metrics: list[str],
    as_json: bool,
    over: str | None = None,
    where: list[str] | None = None,
    csv: Path | None = None,
) -> None:
    """Print means, intervals and paired differences of a study by a swept key, and write them to files.

    As JSON, and to the file `csv`, rows are written as they are. `csv` gets the means.
    """
    from cosim.base import durable
    from results.spreadsheet import csv_of
    from results.study import open_study
    from results.study_table import cautions, core, pivot, together, unpaired

    if over and (as_json or csv):
        flag = "--json" if as_json else "--csv"
        raise ValueError(
            f"--over names the columns of the printed table, and {flag} has a row for each mean. Leave it out."
        )
    study = open_study(folder)
    written = []
    try:
        written = study.write()
    except OSError as error:  # the study of somebody else, or a full disk
        said = f"note: {error.filename} cannot be written: {error.strerror}. The tables are shown alone."
        print_note(said)
    tables = {"summary": study.summary}
    if study.baseline and len(study.differences):
        tables["differences"] = study.differences
    held = _held(where or [])
    if as_json or csv:
        rows = {name: _rows(study, table, metrics, held) for name, table in tables.items()}
        if csv:
            durable.write_output(csv, csv_of(rows["summary"]))
            print_line(f"wrote {csv}")
        else:
            print_json({name: table.to_dict("records") for name, table in rows.items()})
        return
    asked = metrics or core(study)
    for name, frame in tables.items():
        there = [one for one in asked if metrics or _has(frame, one)]
        title = f"{study.name}: {_means(study)}"
        if name == "differences":
            against = ", ".join(f"{key} = {value}" for key, value in study.baseline.items())
            title = f"{study.name}: difference to {against}, replicate by replicate; {_means(study)}"
        try:
            found = pivot(study, frame, there, over, held)
        except ValueError:
            if name == "summary":
                raise
            continue  # these points are the baseline itself
        _print_pivot(study, title, found)
        for line in cautions(study, frame, there, held):
            print_line(line)
    for line in [*together(study), *unpaired(study, asked, held)]:
        print_line(line)
    if written:
        print_line("written: " + ", ".join(str(path) for path in written))
    if not metrics:
        said = "These are the core metrics; --metric names others, --over the key of the columns."
        print_line(f"{said} Next: cosim report {shlex.quote(str(folder))}")


def _rows(study, table, metrics: list[str], held: dict[str, str]):
    """Rows of these metrics at these values of keys. A baseline has no differences to itself."""
    from results.study import chosen

    shown = chosen(study.summary, metrics) if metrics else study.summary
    names = set(zip(shown.metric, shown.group, strict=True))
    study.check_swept(*held)
    kept = table[[name in names for name in zip(table.metric, table.group, strict=True)]]
    for key, text in held.items():
        kept = study.held(kept, key, text)
    return kept


def refuse_options_of_runs(folder: Path, hint: str = "", **given: Any) -> None:
    """ValueError if one of these options is given, which a study does not read."""
    for name, value in given.items():
        if value not in (None, [], "base"):
            flag = name.replace("_", "-")
            raise ValueError(f"--{flag} goes with a run, and {folder} is a study. Leave it out{hint}.")


def _means(study) -> str:
    n = study.points.replicate.nunique()
    return f"mean of {n} replicates, and 95 % interval" if n > 1 else "one replicate, which has no interval"


def _has(frame, name: str) -> bool:
    metric, _, group = name.partition(":")
    rows = frame[frame.metric == metric]
    return bool(len(rows) and (not group or (rows.group == group).any()))


def _print_pivot(study, title: str, found) -> None:
    from results.study import short_keys

    if found.empty:
        print_line(f"{title}: no metric has a value")
        return
    short = short_keys(study.keys)
    heads = [Column(short.get(name, name), overflow="fold") for name in found]
    table = Table(*heads, title=f"{title}; columns: {found.attrs['over']}", title_justify="left", box=None)
    for row in found.itertuples(index=False):
        table.add_row(*map(str, row))
    print_table(table)


def _print_first(folder: Path) -> None:
    """After a sweep: the core metrics, in a grid with other keys at their first value, and the next command."""
    from results.study import apart, as_column, is_grid, open_study, said
    from results.study_table import cautions, core, pivot, together

    study = open_study(folder)
    try:
        asked = core(study)
    except ValueError:  # no run has finished
        return
    over, *others = apart(study.points, study.keys) or study.keys
    first = study.points.iloc[0]
    # Where each point changes one key, to hold the others would leave most points out.
    others = others if is_grid(study.points, study.keys) else []
    held = {key: said(first[key]) for key in others}
    for key in study.baseline.keys() & held.keys():
        held[key] = said(as_column(study.points[key], study.baseline[key]))
    at = ", ".join(f"{key} = {value}" for key, value in held.items())
    beside = f" at {at}" if at else ""
    title = f"{study.name}{beside}: {_means(study)}"
    table = pivot(study, study.summary, asked, over, held)
    _print_pivot(study, title, table)
    if missing := table.attrs["missing"]:
        print_line(f"without a value here: {', '.join(missing)}")
    for line in [*together(study), *cautions(study, study.summary, asked, held)]:
        print_line(line)
    given = shlex.quote(str(folder))
    print_line(f"next: cosim report {given}   cosim measure {given}")


def _held(where: list[str]) -> dict[str, str]:
    if wrong := [text for text in where if "=" not in text]:
        raise ValueError(f"--where {wrong[0]}: not KEY=VALUE. Write for example --where fleet.penetration_p=0.3.")
    held = dict(text.split("=", 1) for text in where)
    if len(held) < len(where):
        said = ", ".join(where)
        raise ValueError(f"--where {said}: a key is held at one value. Name each key once.")
    return held


_CURVES = {"durations": "encounters", "ages": "ages"}
"""Figures of a study that show distributions, pooled over replicates."""


def plot(
    topic: str,
    folder: Path,
    out: Path | None,
    over: str | None,
    by: str | None,
    metrics: list[str],
    where: list[str],
) -> None:
    """Draw a figure of a study."""
    from results.figures import study as figure
    from results.figures import study_curves, style
    from results.study import open_study

    held, study = _held(where), open_study(folder)
    if topic in _CURVES and not metrics:
        if over:
            raise ValueError(f"--over: the axis of {topic} is time. Name the key of the lines with --by.")
        drawn = study_curves.draw(study, _CURVES[topic], by, held)
    else:
        drawn = figure.draw(study, topic, metrics, over, by, held)
    path = style.save(drawn, out or folder / f"{topic}.png")
    print_line(f"wrote {path}")


def report(folder: Path, out: Path | None, figures: Path | None, where: list[str]) -> None:
    """Write the HTML page of a study, and its figures into a folder of their own."""
    from results.study import open_study
    from results.study_report import save_figures, write

    if figures is not None and figures.exists() and not figures.is_dir():
        raise ValueError(f"--figures {figures} is a file. Give a folder.")
    study = open_study(folder).at(_held(where))
    path = write(study, out or folder / "report.html", ", ".join(where))
    print_line(f"wrote {path}")
    if figures is not None:
        print_line(f"wrote {len(save_figures(study, figures))} figures to {figures}")


def plan_facts(task: "Task", workers: int | None = None) -> dict[str, Any]:
    """What a sweep would make, as numbers."""
    made, cost = task.plan, task.estimate
    n_members = [len(run.members) for run in made.runs]
    n_merged = sum(n for n in n_members if n > 1)
    n_workers = max(1, min(workers or n_cores(), len(made.runs)))
    return {
        "study": task.study.head.name,
        "points": len(task.points),
        "finished": task.n_finished,
        "runs": len(made.runs),
        "points_as_trust_variants": n_merged,
        "traffic_driven": len(made.traffic),
        "runs_that_replay_traffic": sum(bool(run.traffic) for run in made.runs),
        "seconds": round(cost.planned_s),
        "seconds_separately": round(cost.separate_s),
        "seconds_saved_by_trust_variants": round(cost.merged_saves_s),
        "seconds_saved_by_traffic": round(cost.traffic_saves_s),
        "MB": round(cost.bytes / 1e6, 1),
        "workers": n_workers,
        "seconds_by_the_clock": round(cost.planned_s / n_workers),
        "memory_GB": round(n_workers * cost.memory_bytes / 1e9, 1),
        "estimate": "from finished runs" if cost.is_measured else "rough: nothing of this study has run",
        "remarks": list(made.remarks),
    }


def plan_lines(task: "Task", workers: int | None = None) -> list[str]:
    """What a sweep would make, in sentences."""
    from results.study_notes import counted

    made, cost, facts = task.plan, task.estimate, plan_facts(task, workers)
    shared = []
    if merged := facts["points_as_trust_variants"]:
        what = f"{merged} points are trust variants of runs that differ in trust alone"
        shared.append(f"{what}: {saving(cost.merged_saves_s)}")
    if n := facts["runs_that_replay_traffic"]:
        replaying = "1 run replays" if n == 1 else f"{n} runs replay"
        traffic = counted(len(made.traffic), "recorded traffic")
        shared.append(f"{replaying} {traffic}: {saving(cost.traffic_saves_s)}")
    points = counted(facts["points"], "point")
    runs = counted(facts["runs"], "run")
    most = "at most " if task.study.keep.tables else ""  # tables that are not kept are deleted after the metrics
    return [
        f"{facts['study']}: {points}, {facts['finished']} finished, {runs} to make",
        *shared,
        f"about {facts['seconds']} s of processor time"
        f"{_instead_of(cost.separate_s, cost.planned_s)}, {most}{facts['MB']} MB ({facts['estimate']})",
        _by_the_clock(facts),
        *_cheaper(task, facts),
        *(f"not shared: {remark}" for remark in made.remarks),
    ]


def _by_the_clock(facts: dict[str, Any]) -> str:
    """How long a sweep takes, and its memory."""
    n, lasts = facts["workers"], duration(facts["seconds_by_the_clock"])
    workers = "1 worker on a free core" if n == 1 else f"{n} workers on free cores"
    return f"about {lasts} with {workers}, and {facts['memory_GB']} GB of memory"


def _instead_of(separate_s: float, planned_s: float) -> str:
    """What runs of their own would take, if that is more."""
    if not 0.95 * separate_s > planned_s > 0:
        return ""
    return f" instead of {separate_s:.0f} s ({separate_s / planned_s:.1f} times less)"


def _cheaper(task: "Task", facts: dict[str, Any]) -> list[str]:
    """What halves the time of a long study."""
    from cosim.studies.cost import LONG_S

    if facts["seconds_by_the_clock"] <= LONG_S:
        return []
    n = task.study.head.replicates
    fewer = f"replicates = {n // 2} in place of {n}, with wider intervals; or " if n > 3 else ""
    return [f"half of it: {fewer}--set traffic.duration_s={task.points[0].config.traffic.duration_s / 2:g}"]


def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def saving(seconds: float) -> str:
    """What sharing saves, or costs where recording takes longer than what it spares."""
    whole = round(seconds)
    return f"saves {whole} s" if whole >= 0 else f"costs {-whole} s"


def _print_states(name: str, out: Path, states, failed, as_json: bool) -> None:
    if as_json:
        print_json({"study": name, "points": states, "failed": {id: a.error for id, a in failed}})
        return
    said = ", ".join(f"{n} {state}" for state, n in states.items() if n)
    print_line(f"{name}: {said or 'no points'} ({out})")
    for id, attempt in failed:
        log = out / "jobs" / id / "log.txt"
        log = log if log.is_file() else out / "traffic" / f"{id}.log"
        print_line(f"failed: {id} ({attempt.outcome}): {attempt.error}; log in {log}")
