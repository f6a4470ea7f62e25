"""A folder of unknown origin is opened by every command and by the Python API: no code of it runs.

Commands are found by walking the command line, functions by walking the packages: a new one that has no call in the
tables below fails the test.
"""

import ast
import importlib
import inspect
import os
import pkgutil
import shutil
from contextlib import suppress
from pathlib import Path

import pytest
import typer

import cosim.addons.export
import cosim.runs
import cosim.studies
import results
from cosim.cli.main import app
from cosim.config.config import load
from cosim.door.permission import CodeNotTrusted
from cosim.runs.stop import Failed
from cosim.studies.folder import StudyFolder
from results.archive import open_run
from results.manifest import drop_tables
from results.run import Run
from tests.hostile import shared

CALLS = {
    "benchmark": ["benchmark beta --evidence {run}"],
    "cache": [],
    "check": ["check {run}/config.toml", "check {part}/config.toml --json"],
    "export": [
        "export kitti {run} --out {out}/kitti --vehicles 0 --steps 1-2",
        "export veremi-nextgen {run} --out {out}/nextgen", "export nuscenes {run} --out {out}/nuscenes",
        "export pcap {run} --out {out}/packets",
    ],
    "cite": ["cite {run}"],
    "compare": ["compare contacts.duration contacts.freeway --run {run} --out {out}/compare"],
    "explain": [],  # it opens no folder
    "init": [],  # it writes a file of its own
    "contacts": ["contacts {run} --out {out}/contacts"],
    "evaluate": ["evaluate {run}"],
    "measure": ["measure {run}", "measure {part} --json", "measure {run} --csv {out}/x.csv", "measure {study}"],
    "nets build": ["nets build --out {run}"],
    "nets counts": ["nets counts {run} counts.csv --out {out}/counted"],
    "nets example": ["nets example {out}/kotka.osm.pbf"],
    "nets list": ["nets list {run} {study}"],
    "nets show": ["nets show {run}"],
    "nets tile": ["nets tile {run} --trace {run} --tiles 2x1 --out {out}/tiled"],
    "new": [],  # it writes a file of its own
    "plot": [
        "plot trust {run}", "plot map {part}", "plot sweep {run} --vehicle 0 --step 2", "plot trust {study}",
        "plot scene {run} --step 2", "plot movie {run} --out {out}/movie.gif",
    ],
    "place roadside": ["place roadside {run}/config.toml --count 1"],
    "predict freshness": ["predict freshness {run}/config.toml", "predict freshness --against {run}"],
    "report": ["report {run} --out {out}/report.html", "report {study}"],
    "resume": ["resume {part}", "resume {run}"],
    "run": [
        "run {run}/config.toml --out {out}/again", "run {run}/config.toml --set seed=5 --out {out}/again",
        "run --set traffic.scenario={run} --set traffic.duration_s=2 --out {out}/replayed",
    ],
    "status": ["status {run}", "status {part} --json", "status {study}"],
    "sweep": ["sweep {study}/study.toml --out {study}", "sweep {study}/study.toml --out {out}/other --dry-run"],
    "trace": ["trace {run} --out {out}/traffic.parquet"],
    "try": [],  # of code that the user names, it opens no folder
    "verify": ["verify {run} {part} {study}/runs/*"],
    "view": ["view {run} --out {out}/run.rrd --vehicle 0"],
}  # fmt: skip
"""How each command is called; {run} is finished, {part} interrupted, {study} a study, {out} an empty folder."""

PATHS = (Path, str | Path, StudyFolder)
SLOW = ("measure", "plot", "predict freshness", "report")
"""Commands that take seconds."""

NAMED = ("path", "folder", "run", "study", "job", "file")
FUNCTIONS = {
    "cosim.runs.folder.check": None,  # these name a folder to be written, or files of the program's own
    "cosim.runs.folder.reopen": None,
    "cosim.runs.speed.kernels.listed": None,
    "cosim.runs.speed.kernels.compiling": None,
    "cosim.studies.folder.write_whole": None,
    "cosim.studies.worker.make": None,  # the process of a sweep, with a job that the sweep has just written
    "cosim.runs.run.remarks": lambda f, at: f(at["run"]),
    "cosim.runs.run.new_remarks": lambda f, at: f(at["run"], {}),
    "cosim.runs.run.resumable": lambda f, at: f(at["part"], False),
    "cosim.runs.run.resume": lambda f, at: f(at["part"], print),
    "cosim.addons.perception.evaluate.evaluate": lambda f, at: f(at["run"]),
    "cosim.addons.perception.evaluate.layout_of": lambda f, at: f(at["run"]),
    "cosim.addons.export.export.export": lambda f, at: f(open_run(at["run"]), "nuscenes", at["out"] / "api"),
    "cosim.runs.replay_lidar.config_of": lambda f, at: f(open_run(at["run"])),
    "cosim.addons.pictures.pictures.film": lambda f, at: f(open_run(at["run"]), 0, at["out"] / "api.gif"),
    "cosim.addons.pictures.pictures.replay_scan": lambda f, at: f(open_run(at["run"]), 0, 2),
    "cosim.runs.replay_lidar.worlds": lambda f, at: list(f(open_run(at["run"]))),
    "cosim.addons.export.view.first_look": None,  # these two are given a run that `view` has opened
    "cosim.addons.export.view.role_colours": None,
    "cosim.addons.export.view.follow": lambda f, at: f(at["run"], at["out"] / "followed.rrd"),
    "cosim.addons.export.view.view": lambda f, at: f(open_run(at["run"]), at["out"] / "api.rrd"),
    "cosim.studies.folder.status_of": lambda f, at: f(at["run"]),
    "cosim.studies.study.load": None,  # of a file that the user names; `status` and `prepare` name those of folders
    "cosim.studies.remarks.name_notes": None,  # of a file that the user names, which has been loaded
    "cosim.studies.sweep.prepare": lambda f, at: f(at["study"] / "study.toml", at["study"]),
    "cosim.studies.sweep.status": lambda f, at: f(StudyFolder(at["study"])),
}
"""How each function that takes a run, or the path of one, is called; None for those that open no folder."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Booby-trapped folders, by name; the sentinel is there as soon as any of their code has run."""
    base = tmp_path_factory.mktemp("shared")
    whole, part = shared.make_runs(base)
    at = {"sentinel": base / "sentinel", "elsewhere": base / "elsewhere"}
    at["elsewhere"].mkdir()
    at["study"] = shared.make_study(base / "study", whole, at["sentinel"], base / "street.csv")
    for name, run in (("run", whole), ("part", part)):
        at[name] = base / f"trapped-{name}"
        shutil.copytree(run, at[name])
        shared.set_trap(at[name], at["sentinel"], at["elsewhere"])
    return at


@pytest.fixture
def at(made, tmp_path, monkeypatch):
    """The same with an empty folder, from within the trapped one: its modules are on the path."""
    monkeypatch.chdir(made["run"])
    monkeypatch.syspath_prepend(made["run"])
    return made | {"out": tmp_path}


def words_of(call, at):
    words = call.format(**at).split()
    return [str(path) for word in words for path in (sorted(Path("/").glob(word[1:])) if "*" in word else [word])]


def carry_out(words):
    """A command within this process; what it says where it refuses. Anything but a line is raised."""
    try:
        typer.main.get_command(app).main(args=words, prog_name="cosim", standalone_mode=False)
    except (ValueError, Failed, OSError, typer.TyperException, typer.Exit) as error:
        return str(error)
    return ""


def commands(command=None, words=()):
    """Names of all commands of the program; groups of commands are left out."""
    command = command or typer.main.get_command(app)
    if not hasattr(command, "commands"):
        return [" ".join(words)]
    return [name for word, inner in command.commands.items() for name in commands(inner, (*words, word))]


def test_every_command_has_a_call():
    assert sorted(commands()) == sorted(CALLS)


@pytest.mark.parametrize(
    "command", [pytest.param(name, marks=[pytest.mark.verify] if name in SLOW else []) for name in CALLS]
)
def test_no_command_runs_code_of_a_folder(at, command):
    for call in CALLS[command]:
        said = carry_out(words_of(call, at))
        assert not at["sentinel"].exists(), (call, said)
        assert "\n" not in said.strip(), (call, said)


REFUSE = (
    "check {run}/config.toml", "run {run}/config.toml --out {out}/x", "resume {part}", "status {study}",
    "sweep {study}/study.toml --out {study}",
)  # fmt: skip


@pytest.mark.parametrize("call", REFUSE)
def test_what_needs_the_code_says_so(at, call):
    command = typer.main.get_command(app)
    with pytest.raises(CodeNotTrusted, match=r"It was not loaded.*trust_code=True"):
        command.main(args=words_of(call, at), prog_name="cosim", standalone_mode=False)
    assert not (at["out"] / "x").exists()


def functions():
    """Public functions that take a run or the path of one, by name."""
    for package in (cosim.runs, cosim.addons.export, cosim.studies):
        for about in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            module = importlib.import_module(about.name)
            for name, function in inspect.getmembers(module, inspect.isfunction):
                if not name.startswith("_") and function.__module__ == module.__name__ and takes_folder(function):
                    yield f"{about.name}.{name}", function


def takes_folder(function):
    """Whether the first parameter is a run, or a path with a name that says it is one of a folder."""
    first = next(iter(inspect.signature(function).parameters.values()), None)
    return first is not None and (is_run(first) or (first.annotation in PATHS and first.name in NAMED))


def test_no_function_runs_code_of_a_folder(at):
    for name, function in functions():
        if (call := FUNCTIONS[name]) is not None:
            with suppress(ValueError, Failed, OSError):
                call(function, at)
        assert not at["sentinel"].exists(), name


def is_run(parameter):
    """Whether a parameter is a run that is open."""
    return inspect.isclass(parameter.annotation) and issubclass(parameter.annotation, Run)


def test_results_has_no_means_to_run_code():
    """What reads a run folder imports no module by name, and unpickles nothing."""
    ways = {
        "importlib",
        "runpy",
        "pickle",
        "marshal",
        "shelve",
        "exec",
        "eval",
        "compile",
        "__import__",
        "allow_pickle",
    }
    for path in Path(results.__path__[0]).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert isinstance(node.value, ast.Constant) and node.value.value is False, path
                continue
            names = {getattr(node, name, None) for name in ("id", "module", "arg")}
            names |= {alias.name.split(".")[0] for alias in getattr(node, "names", ()) if isinstance(alias, ast.alias)}
            assert not names & ways, (path, names & ways)


def test_the_trap_works(at, tmp_path):
    """With the permission the code does run, also from below the folder: what the tests above look for is there."""
    with pytest.raises(ValueError, match="Trap has no method"):
        load(at["run"] / "config.toml", trust_code=True)
    assert at["sentinel"].read_text() == "code ran"
    at["sentinel"].unlink()


def test_links_are_not_written_through(made, tmp_path):
    """Tables, files of a study and pictures that are links to what is somebody else's."""
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "part-00000.parquet").write_text("mine")
    shutil.copytree(made["run"].parent / "part", tmp_path / "part")
    shutil.rmtree(tmp_path / "part" / "trust")
    (tmp_path / "part" / "trust").symlink_to(victim)
    assert "trust is a symbolic link" in carry_out(["resume", str(tmp_path / "part")])
    shutil.copytree(made["study"], tmp_path / "study", symlinks=True)
    (tmp_path / "study" / "lock").symlink_to(victim / "part-00000.parquet")
    study = made["study"].parent / "mine.toml"
    assert "lock is a symbolic link" in carry_out(["sweep", str(study), "--out", str(tmp_path / "study")])
    assert (victim / "part-00000.parquet").read_text() == "mine"


@pytest.mark.parametrize("name", ["lock", "stop", "runs", "jobs", "jobs/ID", "jobs/ID/job.json", "traffic"])
@pytest.mark.parametrize("make", ["link", "pipe"])
def test_a_sweep_neither_follows_links_nor_waits_for_pipes(made, tmp_path, name, make):
    victim = tmp_path / "victim"
    victim.mkdir()
    shutil.copytree(made["study"], tmp_path / "study", symlinks=True)
    id = next((tmp_path / "study" / "jobs").iterdir()).name
    place = tmp_path / "study" / name.replace("ID", id)
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    if make == "link":
        place.symlink_to(victim)
    else:
        os.mkfifo(place)
    said = "symbolic link" if make == "link" else "neither a file nor a folder"
    study = made["study"].parent / "mine.toml"
    assert said in carry_out(["sweep", str(study), "--out", str(tmp_path / "study")])
    assert said in carry_out(["status", str(tmp_path / "study"), "--trust-code"])
    assert not list(victim.iterdir())


def test_variants_of_a_folder_are_code_of_its_author(at):
    """A config with variants that lies in a run, and a study that is predicted."""
    (at["run"] / "variants.toml").write_text('[[trust_variant]]\nname = "other"\nmodel = "trap.py:Trap"\n')
    words = ["run", str(at["run"] / "variants.toml"), "--out", str(at["out"] / "x")]
    try:
        assert "It was not loaded" in carry_out(words)
        assert "It was not loaded" in carry_out(["predict", "freshness", str(at["study"] / "study.toml")])
    finally:
        (at["run"] / "variants.toml").unlink()
    assert not at["sentinel"].exists() and not (at["out"] / "x").exists()


def test_what_a_manifest_drops_stays_in_its_folder(made, tmp_path):
    shutil.copytree(made["run"].parent / "whole", tmp_path / "run")
    (tmp_path / "precious").mkdir()
    shared.reseal(tmp_path / "run", dropped=["../precious", "trust"])
    drop_tables(tmp_path / "run", ["fused"])
    assert (tmp_path / "precious").is_dir() and not (tmp_path / "run" / "trust").exists()
