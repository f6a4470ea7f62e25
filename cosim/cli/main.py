"""The commands."""

import gc
import os
import re
import shlex
import signal
import sys
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cosim import __version__
from cosim.base.addons import addons, hook, loaded
from cosim.base.durable import Damaged
from cosim.cli import check, init, studies
from cosim.cli.check import costs
from cosim.cli.console import (
    AsJson,
    ConfigPath,
    Overrides,
    Preset,
    TrustCode,
    notes,
    print_json,
    print_line,
    print_metrics,
    print_note,
    progress,
    screen,
    with_preset,
)
from cosim.cli.files import refuse_other_than_config
from cosim.cli.help import MORE, Commands, in_groups
from cosim.cli.nets import nets
from cosim.door.blame import ExtensionError
from cosim.door.permission import CodeNotTrusted
from cosim.runs.stop import Failed, Stopped
from cosim.traffic.scratch import Scratch, can_hold_files

if TYPE_CHECKING:
    from results.archive import OpenRun
    from results.run import Run

GROUPS = {
    "Start": ("run", "measure", "plot", "report", "explain"),
    "Own experiment": ("init", "check", "sweep", "status", "resume", "predict"),
    "Own city": ("nets", "trace", "contacts", "place"),
    "Own classes": ("new", "try", "benchmark"),
    "Compare and share": ("compare", "evaluate", "export", "view", "cite"),
    "Look after": ("verify", "cache"),
}
"""The commands in the help, in the order of the first hour. A name without a command is skipped."""

RENAMED = {
    "validate": "compare",
    "judge": "compare encounters --run RUN",
    "reproduce": "compare paper",
    "retrust": "run CONFIG, with sections [[trust_variant]] in the config",
}
"""What to type now, by the name of a command that is gone."""

app = Commands(
    cls=in_groups(GROUPS, RENAMED),
    pretty_exceptions_enable=False,
    help="Co-simulation of cooperative perception under trust at city scale.",
)
app.add_typer(nets, name="nets")
studies.add_to(app)


def _add_commands_of_addons() -> None:
    """Add the commands that the installed add-ons bring, to the program or to one of its groups."""
    groups = {"nets": nets}
    for addon in addons().values():
        for words, address in addon.commands.items():
            group, _, name = words.rpartition(" ")
            place, command = groups[group] if group else app, loaded(address)
            if isinstance(command, typer.Typer):
                place.add_typer(command, name=name)
            else:
                place.command(name)(command)


_add_commands_of_addons()
for commands in (check, init):
    commands.add_to(app)

RunPaths = Annotated[list[Path], typer.Argument(help="Folders of runs, or of a study.")]
Picture = Literal[
    "trust",
    "misbehaviour",
    "encounters",
    "durations",
    "freshness",
    "radio",
    "detection",
    "map",
    "safety",
    "security",
    "attacks",
    "ages",
    "stale",
    "scene",
    "sweep",
    "movie",
]


LONG_RUN_S = 60.0
"""Where nobody watches, the estimate of a run that takes longer is printed before it begins [s]."""


@dataclass(slots=True)
class _Debug:
    """Whether the program prints the traceback of an error."""

    is_on: bool = False


_debug = _Debug()


def _say_version(wanted: bool) -> None:
    if wanted:
        screen.print(f"cosim {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Print the traceback before the error message.")] = False,
) -> None:
    """Options that all commands have."""
    _debug.is_on = debug


@app.command()
def run(
    config: ConfigPath = None,
    overrides: Overrides = None,
    preset: Preset = None,
    out: Annotated[
        Path | None, typer.Option(help="Run folder to write. The default is the next runs/<city>-N.")
    ] = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show the city, trust and ages in the Rerun viewer while the run computes.")
    ] = False,
    watch_file: Annotated[
        str | None,
        typer.Option(
            help="Write the same into a file meanwhile: .rrd for Rerun, or .mcap for Foxglove and ROS 2.",
            rich_help_panel=MORE,
        ),
    ] = None,
    trust_code: TrustCode = False,
    as_json: AsJson = False,
) -> None:
    """Simulate traffic, sensors, messages and trust. Write a run folder."""
    from cosim.config.config import load
    from cosim.runs import run as running
    from cosim.runs.check import check as checked
    from cosim.runs.check import remarks_on
    from cosim.studies.cost import cost_of
    from cosim.studies.density import note_density
    from cosim.studies.speed import Pace

    refuse_other_than_config(config)
    experiment = load(config, with_preset(preset, overrides), trust_code)
    for remark in remarks_on(experiment, checked(experiment), config):
        print_note(remark)
    if watch and watch_file is not None:
        raise ValueError("--watch shows the run in the viewer, and --watch-file writes a file. Choose one.")
    target = "viewer" if watch else watch_file
    live_view = None if target is None else hook("live", "cosim run --watch")
    cost = cost_of(experiment)
    if cost.wall_s >= LONG_RUN_S or notes.is_terminal:
        for line in costs(cost).values():
            print_note(f"estimate: {'; '.join(line)}")
    if live_view is None:
        with progress() as advance:
            folder = running.run(experiment, out, Pace(cost.step_cpu_s, advance))
    else:
        with progress() as advance, live_view(experiment, target) as live:
            folder = running.run(experiment, out, advance, on_step=live)
    note_density(experiment, folder)
    _conclude(folder, as_json)


@app.command()
def resume(
    folder: Annotated[Path, typer.Argument(help="Folder of a run that was interrupted or killed.")],
    trust_code: TrustCode = False,
    as_json: AsJson = False,
) -> None:
    """Continue a run from its last complete block. The tables equal those of a run without interruption."""
    from cosim.runs import run as running
    from results.study import again, is_study

    if is_study(folder):
        raise ValueError(f"{folder} is a study. Continue it with: {again(folder)}")
    with progress() as advance:
        running.resume(folder, advance, trust_code=trust_code)
    _conclude(folder, as_json)


@app.command()
def verify(runs: RunPaths, as_json: AsJson = False) -> None:
    """Check runs or studies for missing, changed or unexpected files. Exit status 1 if there are any."""
    from results.study import is_study, missing_in, runs_of
    from results.verify import UNREADABLE
    from results.verify import verify as verified

    found = {str(folder): verified(folder) for named in runs for folder in runs_of(named)}
    for study in filter(is_study, runs):
        if missing := missing_in(study):
            found[str(study)] = UNREADABLE, missing
    if as_json:
        as_plain = {name: about | {"problems": problems} for name, (about, problems) in found.items()}
        print_json(as_plain)
    else:
        for name, (about, problems) in found.items():
            for problem in problems:
                print_line(f"{name}: {problem}")
            what = "damaged" if problems else "whole"
            tables = f"{about['status']}, {about['steps']} steps, {about['tables']} tables"
            size = f"{about['parts']} parts, {about['rows']:,} rows, {about['bytes']:,} bytes"
            print_line(f"{name}: {what}; {tables}, {size}")
    if any(problems for _, problems in found.values()):
        raise typer.Exit(1)


def _conclude(folder: Path, as_json: bool) -> None:
    from cosim.cli.summary import print_run_summary
    from cosim.runs.run import remarks
    from cosim.runs.speed.allocator import give_back_freed_memory

    gc.collect()
    give_back_freed_memory()  # otherwise the memory of the run would add to the memory that the metrics take
    run = print_run_summary(folder, as_json)
    for remark in remarks(folder):
        print_note(remark)
    _say_damage([run])


def _opened(folder: Path) -> "OpenRun":
    """Open a run to measure or draw it. A note says so when the run is unfinished."""
    from results.archive import open_run

    run = open_run(folder, unfinished=True)
    if (status := run.status) != "finished":
        print_note(f"note: {folder} is {status}: its first {run.manifest['steps']} steps are shown.")
    return run


def _say_damage(runs: Iterable["Run"]) -> None:
    """Print what could not be shown because files are damaged; exit with status 1 if there is any damage."""
    said = list(dict.fromkeys(line for run in runs for line in run.damage))
    for line in said:
        print_note(f"error: {line}")
    if said:
        raise typer.Exit(1)


@app.command()
def measure(
    runs: Annotated[list[Path] | None, typer.Argument(help="Folders that `cosim run` wrote.")] = None,
    explain: Annotated[bool, typer.Option("--explain", help="List all metrics and their definitions.")] = False,
    metrics: Annotated[
        list[str] | None,
        typer.Option(
            "--metric",
            help="Only METRIC, METRIC:GROUP, or all that begin so (radio, radio.pdr); of a run also your own, "
            "mine.py:Name. Repeatable.",
        ),
    ] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", help="Set a parameter of your own metric, key=value. Repeatable.")
    ] = None,
    variant: Annotated[
        str, typer.Option(help="Trust variant to measure. `all` shows all variants side by side.")
    ] = "base",
    csv: Annotated[Path | None, typer.Option("--csv", help="Write the metrics to this file.")] = None,
    threshold: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="A vehicle with less trust than this is suspected; by default trust.suspect_below of the run.",
            rich_help_panel=MORE,
        ),
    ] = None,
    fresh_s: Annotated[
        float | None,
        typer.Option(help="Trust is fresh up to this age, in seconds; by default 10.", rich_help_panel=MORE),
    ] = None,
    false_positives: Annotated[
        float | None,
        typer.Option(
            min=0, max=1, help="False positive rate at which recall is reported; by default 0.05.", rich_help_panel=MORE
        ),
    ] = None,
    over: Annotated[str | None, typer.Option(help="study: swept key whose values are the columns.")] = None,
    where: Annotated[
        list[str] | None, typer.Option(help="study: only points with this value, KEY=VALUE. Repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the metrics of runs. For a study, print means over replicates, 95 % intervals and paired differences."""
    if explain:
        print_metrics(as_json)
        return
    if not runs:
        raise ValueError("There is no run to measure. Name at least one run folder, or ask with --explain.")
    if fresh_s is not None and not fresh_s >= 0:
        raise ValueError(f"--fresh-s {fresh_s:g}: an age is 0 or more. Give seconds.")
    if studies.is_study(runs):
        studies.refuse_options_of_runs(runs[0], set=sets, variant=variant)
        stated = ", or set it in the section [measure] of the study and sweep again"
        studies.refuse_options_of_runs(
            runs[0], stated, threshold=threshold, fresh_s=fresh_s, false_positives=false_positives
        )
        studies.measure(runs[0], metrics or [], as_json, over, where, csv)
        return
    if over or where:
        raise ValueError("--over and --where go with a study, and this is a run. Leave them out.")
    import pandas as pd

    from cosim.cli.own_metrics import own_metrics, refuse_other_groups, split_metrics, with_metrics
    from cosim.cli.side_by_side import print_measures, remarks
    from results.measure import measure as all_metrics

    own, shipped = split_metrics(metrics or [])
    measured = own_metrics(own, sets or [])
    chosen = _chosen(runs, variant)
    topics = [re.split("[:.]", name)[0] for name in shipped]
    given = {"threshold": threshold, "fresh_s": fresh_s, "false_positives": false_positives}
    options: dict[str, Any] = {}
    for name, value in given.items():
        if value is not None:
            options[name] = value
    if shipped:
        options["topics"] = tuple(dict.fromkeys(topics))
    tables, every = [], []
    for run in chosen:
        parts = [] if measured is None else [measured(run)]
        if shipped or measured is None:
            every.append(all_metrics(run, **options))
            parts.append(with_metrics(every[-1], shipped) if shipped else every[-1])
        tables.append(pd.concat(parts, ignore_index=True))
    refuse_other_groups(every, shipped)
    for run, table in zip(chosen, tables, strict=True):
        if table.empty:
            print_note(f"note: {run.path} has no value of {', '.join(metrics or ())}.")
    print_measures(chosen, tables, as_json, csv)
    for remark in remarks(chosen):
        print_note(remark)
    _say_damage(chosen)


def _chosen(folders: list[Path], variant: str) -> "list[Run]":
    """The runs in these folders as one of their trust variants; ValueError if a folder is named twice."""
    from cosim.cli.side_by_side import of_variants

    paths = [folder.resolve() for folder in folders]
    for folder, path in zip(folders, paths, strict=True):
        if paths.count(path) > 1:
            raise ValueError(f"{folder} is named twice. Name each run once.")
    return [one for folder in folders for one in of_variants(_opened(folder), variant)]


@app.command()
def plot(
    what: Annotated[Picture, typer.Argument(help="The figure to draw.")],
    runs: RunPaths,
    out: Annotated[
        Path | None,
        typer.Option(help="File to write: .png, .svg or .pdf. For sweep also .ply, .pcd, .pcd.txt, .bin or .npy."),
    ] = None,
    vehicles: Annotated[
        list[int] | None,
        typer.Option(
            "--vehicle",
            help="trust: also draw this vehicle. sweep, scene: draw its point cloud. movie: follow it. Repeatable for "
            "trust and scene.",
        ),
    ] = None,
    step: Annotated[int | None, typer.Option(help="sweep, scene: the step to draw.")] = None,
    over: Annotated[str | None, typer.Option(help="study: key on the x axis, e.g. trust.freshness_s.")] = None,
    by: Annotated[str | None, typer.Option(help="study: one colour for each value of this swept key.")] = None,
    metrics: Annotated[
        list[str] | None, typer.Option("--metric", help="study: draw this metric, or METRIC:GROUP. Repeatable.")
    ] = None,
    where: Annotated[
        list[str] | None, typer.Option(help="study: use only points with this value, KEY=VALUE. Repeatable.")
    ] = None,
    variant: Annotated[str, typer.Option(help="Trust variant to draw; `all` draws each like a run.")] = "base",
    radius_m: Annotated[
        float | None,
        typer.Option(help="map, durations: radius of the encounters, in metres.", rich_help_panel=MORE),
    ] = None,
    pairs: Annotated[
        str | None,
        typer.Option(help="map, durations: pairs of the encounters, as encounters.pairs.", rich_help_panel=MORE),
    ] = None,
) -> None:
    """Draw a figure of runs, or of a study over a swept key."""
    from results.figures import style

    if studies.is_study(runs):
        studies.refuse_options_of_runs(runs[0], vehicle=vehicles, step=step, variant=variant)
        held = ", or write --where radius_m=RADIUS, --where pairs=PAIRS or, of durations, --where group=GROUP"
        studies.refuse_options_of_runs(runs[0], held, radius_m=radius_m, pairs=pairs)
        wanted = metrics or []
        studies.plot(what, runs[0], out, over, by, wanted, where or [])
        return
    if over or by or metrics or where:
        raise ValueError("--over, --by, --metric and --where go with a study, and this is a run. Leave them out.")
    from inspect import signature

    from results.figures.catalogue import FIGURES

    is_of_addon = what not in FIGURES  # sweep, scene and movie, which take vehicles and a step
    draw_of_addon = hook(f"plot {what}", f"cosim plot {what}") if is_of_addon else None
    if step is not None and not is_of_addon:
        raise ValueError(f"--step goes with `cosim plot sweep` or scene, not with {what}. Leave it out.")
    options = {"vehicles": vehicles, "radius_m": radius_m, "pairs": pairs}
    given = {name: value for name, value in options.items() if value not in (None, [])}
    for name in given:
        takers = [figure for figure, draw in FIGURES.items() if name in signature(draw).parameters]
        if what not in takers and not (is_of_addon and name == "vehicles"):
            flag = "vehicle" if name == "vehicles" else name.replace("_", "-")
            named = " or ".join(takers)
            raise ValueError(f"--{flag} goes with `cosim plot {named}`, not with {what}. Leave it out.")
    chosen = _chosen(runs, variant)
    if draw_of_addon is not None:
        path = draw_of_addon(chosen, vehicles or [], step, out)
    else:
        drawn = FIGURES[what](chosen, **given)
        path = style.save(drawn, out or runs[0] / f"{what}.png")
    print_line(f"wrote {path}")
    _say_damage(chosen)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of a run or a study.")],
    out: Annotated[Path | None, typer.Option(help="File to write. The default is report.html in the folder.")] = None,
    figures: Annotated[
        Path | None, typer.Option(help="study: folder for its figures, as PDF files.", metavar="FOLDER")
    ] = None,
    where: Annotated[
        list[str] | None, typer.Option(help="study: only points with this value, KEY=VALUE. Repeatable.")
    ] = None,
) -> None:
    """Write one self-contained HTML page about a run or a study."""
    if studies.is_study([folder]):
        studies.report(folder, out, figures, where or [])
        return
    from results.report import write

    run = _opened(folder)
    if where:
        raise ValueError("--where goes with a study, and this is a run. Leave it out.")
    if figures:
        raise ValueError("--figures goes with a study, and this is a run. `cosim plot` draws the figures of a run.")
    path = write(run, out or folder / "report.html")
    print_line(f"wrote {path}")
    _say_damage([run])


def main(command: Callable[..., int | None] = app) -> None:
    """Run the command line. A mistake of the user ends in one line on standard error and exit status 2."""
    _open_standard_streams()
    sys.argv[1:] = map(_of_home, sys.argv[1:])
    status: int | None
    kernels = None
    try:
        kernels = _place_for_kernels()
        status = _carry_out(command)
        sys.stdout.flush()
    except typer.TyperException as error:
        status = _say(_in_plain_words(error), 2)
    except (typer.Abort, KeyboardInterrupt):
        status = _say("interrupted", 130)
    except Stopped as stopped:
        print_note(str(stopped))
        status = 128 + stopped.signum
    except BrokenPipeError:
        status = 1
    except (Damaged, Failed, ExtensionError) as error:
        status = _say(str(error), 1, error)
    except RecursionError:
        status = _say("the input is nested too deeply.", 2)
    except CodeNotTrusted as error:
        again = shlex.join(["cosim", *sys.argv[1:], "--trust-code"])
        status = _say(f"{error} To go on: {again}", 2)
    except ValueError as error:
        status = _say(str(error), 2, error)
    except OSError as error:
        status = _say(f"{error.filename or 'output'}: {error.strerror or error}.", 1)
    try:
        sys.stdout.flush()
    except OSError:  # standard output has no reader any more; the interpreter must not flush it again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    if kernels is not None:
        kernels.remove()
    sys.exit(status)


def _in_plain_words(error: typer.TyperException) -> str:
    """What is wrong with the words of a command line, and where it is said what they may be."""
    message = error.format_message().replace("Value error, ", "")  # pydantic's words before those of Typer
    extra = message.partition("unexpected extra argument(s) (")[2].rstrip(").")
    if extra:
        path = getattr(getattr(error, "ctx", None), "command_path", "cosim")
        return f"{extra}: {path} takes no more without the name of an option. See {path} --help."
    return message


def _of_home(word: str) -> str:
    """A word of the command line, with the user's folder in place of `~`: shells do not replace it after `=`."""
    before, sign, path = word.rpartition("=") if re.match(r"[\w.-]+=~", word) else ("", "", word)
    if path == "~" or path.startswith("~/"):
        path = os.path.expanduser(path)
    return before + sign + path


def _carry_out(command: Callable[..., int | None]) -> int | None:
    """Run a command. An interrupt that compiled code has turned into another exception is raised as an interrupt.

    Matplotlib's compiled code does so: it takes an interrupt while it reads an array for a wrong type of argument.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return command(standalone_mode=False)
    noted = False

    def note(_signum: int, _frame: FrameType | None) -> None:
        nonlocal noted
        noted = True
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, note)
    try:
        return command(standalone_mode=False)
    except Exception as error:
        if noted:
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _place_for_kernels() -> Scratch | None:
    """A temporary folder for compiled kernels if neither the installation nor the user's cache is writable.

    A user of a container may have no home: then the folder takes its place.
    """
    folder = None
    if os.path.expanduser("~") == "~":
        folder = Scratch()
        os.environ["HOME"] = str(folder.path)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "numba"
    usual = Path(__file__).parents[1] / "__pycache__", cache
    if "NUMBA_CACHE_DIR" in os.environ or any(map(can_hold_files, usual)):
        return folder
    folder = folder or Scratch()
    os.environ["NUMBA_CACHE_DIR"] = str(folder.path)
    return folder


def _say(message: str, status: int, error: BaseException | None = None) -> int:
    """Print an error in one line, after its traceback if the user gave --debug; return the exit status."""
    with suppress(OSError):
        if error is not None and _debug.is_on:
            notes.print("".join(traceback.format_exception(error)), soft_wrap=True, end="")
        if message:
            print_note(f"error: {' '.join(message.split())}")
    return status


def _open_standard_streams() -> None:
    """Open closed standard streams on the null device, so that no other file gets their descriptors."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115
