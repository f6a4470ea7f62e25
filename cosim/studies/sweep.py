"""Prepares and runs a study, and reports its state."""

import json
import statistics
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.threads import CORES
from cosim.door.load import checksum
from cosim.runs.cluster import connected, local
from cosim.runs.run import new_remarks
from cosim.runs.source import code_digest
from cosim.studies.engine import Work, execute
from cosim.studies.estimate import Estimate, estimate
from cosim.studies.folder import Attempt, StudyFolder, write_whole
from cosim.studies.plan import PlannedRun, StudyPlan, plan
from cosim.studies.points import Point, points_of
from cosim.studies.speed import speed_here
from cosim.studies.stages import Cache, default_folder
from cosim.studies.study import Study, load
from results.manifest import read_manifest
from results.study_measuring import changed_in, changes, measuring_in, measuring_of

FUSED_TOPICS = {"detection", "attack", "evidence"}
"""Topics of metrics that need the fused objects of every point."""
FUSED_TABLES = {"fused", "fused_evidence", "attack_outcomes"}
"""Tables of the fused objects of every point."""


@dataclass(frozen=True, slots=True)
class Task:
    """The remaining work of a study."""

    study: Study
    folder: StudyFolder
    points: list[Point]
    plan: StudyPlan
    n_finished: int
    """Number of finished points."""
    cache: Cache
    estimate: Estimate
    outdated: dict[str, list[str]] = field(default_factory=dict)
    """By finished run that is measured again, the keys of the study that have changed since it was measured."""
    n_of_other_code: int = 0
    """Finished runs that other code has made, where further runs are to join them."""
    levels: Sequence[str] = ()
    """Other levels of `record.level` than the study's at which finished runs were recorded."""
    n_aside: int = 0
    """Finished runs of points that the study does not have any more."""


Failed = list[tuple[str, Attempt]]
"""Runs that have failed, and the last attempt at each."""
Report = Callable[[int, int, int, str], None]
"""Callback for progress. Its arguments are runs done, runs in total, points done and a note."""


def prepare(file: Path, out: Path, merge: bool = True, trust_code: bool = False) -> Task:
    """Plan a sweep. Nothing is written.

    Parameters
    ----------
    file
        Study file, or the name of a shipped study.
    out
        Folder of the study.
    merge
        Let points share runs and traffic.
    trust_code
        Load code that a `study.toml` in a study folder names.

    Raises
    ------
    ValueError
        In one line, if the study has a mistake.
    """
    return prepare_study(load(file, trust_code), file.name, out, merge)


def prepare_study(study: Study, where: str, out: Path, merge: bool) -> Task:
    """Plan a sweep of a study that was read from the file `where`."""
    folder = StudyFolder(out)
    folder.check()
    points = points_of(study, where)
    run_of = {point: run for point, (run, _) in folder.answers().items()}
    finished = {}
    for point in points:
        run = run_of.get(point.id)
        if run is not None and folder.is_finished(run):
            finished[point.id] = run
    aside = set(run_of.values()) - set(finished.values())
    outdated = _outdated(study, folder, set(finished.values()))
    kept = {point: run for point, run in finished.items() if run not in outdated}
    missing = [point for point in points if point.id not in kept]
    cache = Cache(default_folder())
    stored = cache.names("traffic")
    made = plan(missing, needs_fused(study), stored) if merge else separate(missing)
    return Task(
        study=study,
        folder=folder,
        points=points,
        plan=made,
        n_finished=len(kept),
        cache=cache,
        estimate=estimate(missing, made, stored, _typical_s(folder, set(run_of.values())), speed_here()),
        outdated=outdated,
        n_of_other_code=_n_of_other_code(folder, set(kept.values())) if missing else 0,
        levels=_other_levels(folder, points, finished),
        n_aside=sum(map(folder.is_finished, aside)),
    )


def _typical_s(folder: StudyFolder, runs: Collection[str]) -> float | None:
    """Median processor time of the attempts that have succeeded; None if there is none."""
    spent_s = []
    for run in runs:
        for attempt in folder.attempts(run):
            if attempt.outcome == "ok":
                spent_s.append(attempt.cpu_s or attempt.wall_s)  # older versions did not write the former
    return statistics.median(spent_s) if spent_s else None


def _n_of_other_code(folder: StudyFolder, runs: Collection[str]) -> int:
    """How many runs were made by other code than this."""
    made_by = [read_manifest(folder.run(run)).get("source", {}).get("code") for run in runs]
    return sum(code not in (None, code_digest()) for code in made_by)


def _other_levels(folder: StudyFolder, points: Sequence[Point], finished: Mapping[str, str]) -> list[str]:
    """Levels at which finished runs were recorded that are not those of their points."""
    found = set()
    for point in points:
        if point.id in finished:
            recorded = read_manifest(folder.run(finished[point.id]))["config"]["record"]
            if recorded["level"] != point.config.record.level:
                found.add(recorded["level"])
    return sorted(found)


def _asked(study: Study) -> dict[str, Any]:
    """What is measured of every point, as `job.json` says it."""
    own = study.measuring.own
    code = checksum("measure.own", own) if own else ""
    return {"topics": study.keep.topics, "measure": asdict(study.measuring), "own_sha256": code}


def _outdated(study: Study, folder: StudyFolder, finished: Collection[str]) -> dict[str, list[str]]:
    """The finished runs that were measured otherwise than the study asks, and the keys or tables that have changed."""
    now = measuring_of(_asked(study))
    found = {}
    for run in sorted(finished):
        job = folder.job(run)
        found[run] = changes(measuring_in(job), now) + changed_in(job)
    return {run: keys for run, keys in found.items() if keys}


def measuring_notes(task: Task) -> list[str]:
    """Notes on finished runs that are measured again, and on those that another version of cosim has made."""
    found = []
    if task.outdated:
        keys = dict.fromkeys(key for changed in task.outdated.values() for key in changed)
        found.append(
            f"note: {len(task.outdated)} finished runs were measured before {', '.join(keys)} changed. They are "
            "measured again. A run whose tables are gone (keep.tables) is simulated again."
        )
    if task.n_of_other_code:
        found.append(
            f"note: {task.n_of_other_code} finished runs were made by other code of cosim. They are kept, and averaged "
            "with those to come. Where an update has moved figures, sweep the study in another --out."
        )
    if task.levels:
        found.append(
            f'note: finished runs were recorded with record.level = "{task.levels[0]}", and the study asks for another '
            "level. They stay as they are, with the tables of that level. Sweep the study in another --out."
        )
    if task.n_aside:
        found.append(
            f"note: {task.n_aside} finished runs are of no point of the study any more: the study, a file that it "
            "reads, or cosim has changed. They stay in its folder and count for nothing."
        )
    return found


def unbegun(study: Study, where: str) -> Task:
    """The work of a study that has no folder yet."""
    points = points_of(study, where)
    cache = Cache(default_folder())
    stored = cache.names("traffic")
    made = plan(points, needs_fused(study), stored)
    return Task(
        study=study,
        folder=StudyFolder(Path()),
        points=points,
        plan=made,
        n_finished=0,
        cache=cache,
        estimate=estimate(points, made, stored, None, speed_here()),
    )


def separate(points: Sequence[Point]) -> StudyPlan:
    """A plan with one run for each point, which share nothing."""
    return StudyPlan(tuple(map(PlannedRun.of, points)), {}, ())


def needs_fused(study: Study) -> bool:
    """Whether what is measured or kept of every point includes its fused objects."""
    topics = set(study.keep.topics)
    kept = set(study.keep.tables or ())
    return bool(study.measuring.own or kept & FUSED_TABLES or not topics or topics & FUSED_TOPICS)


def sweep(
    task: Task,
    report: Report,
    scheduler: str | None = None,
    workers: int | None = None,
    log: Callable[[str], None] = lambda _: None,
) -> tuple[dict[str, int], Failed]:
    """Make the missing runs; return the number of points by state, and the runs that failed.

    `log` gets a line about each run that has ended, and the notes on it that no run before had.
    """
    folder = task.folder
    folder.prepare(task.study)
    with folder.locked():
        folder.stop.unlink(missing_ok=True)
        folder.tidy()
        for id in task.outdated:
            folder.forget_measures(id)
        work = _write(task)
        folder.write_index(task.study, task.points)
        report(0, len(work.runs), task.n_finished, "")
        try:
            failed = _execute(task, work, report, scheduler, workers, log) if work.runs else []
        finally:
            states = folder.write_index(task.study, task.points)
    return states, failed


def _execute(
    task: Task,
    work: Work,
    report: Report,
    scheduler: str | None,
    workers: int | None,
    log: Callable[[str], None],
) -> Failed:
    """Make the runs, and the traffic that they replay, on a cluster; return those that failed."""
    folder = StudyFolder(task.folder.path.resolve())
    n_points = {run.id: len(run.members) for run in task.plan.runs}
    n_done, n_answered = 0, task.n_finished
    failed: Failed = []
    said: dict[str, str] = {}
    n_workers = workers or CORES
    cluster = local(n_workers) if scheduler is None else connected(scheduler, folder.path / "study.toml")
    with cluster as client, _stopping(folder):
        for id, attempt in execute(client, folder, work, task.study.limits):
            is_run, is_ok = id in work.runs, attempt.outcome == "ok"
            if is_run:
                n_done += 1
                number = f"run {n_done} of {len(work.runs)}"
                log(f"{number}: {_said(task, id)}: {_ended(attempt)}")
            if not is_ok:
                failed.append((id, attempt))
            elif is_run:
                n_answered += n_points[id]
                for note in new_remarks(task.folder.run(id), said):
                    log(note)
            report(n_done, len(work.runs), n_answered, f"{len(failed)} failed" if failed else "")
    return failed


@contextmanager
def _stopping(folder: StudyFolder) -> Iterator[None]:
    """Tell workers to end their runs if the sweep ends early."""
    try:
        yield
    except BaseException:
        folder.stop.touch()
        raise


def _said(task: Task, id: str) -> str:
    """What a run stands for: keys and values that its points have in common, and their number if they are several."""
    (run,) = (run for run in task.plan.runs if run.id == id)
    ids = {point for point, _ in run.members}
    points = [point for point in task.points if point.id in ids]
    words = []
    for key, value in points[0].keys.items():
        if all(one.keys[key] == value for one in points):
            words.append(f"{key} = {value}")
    words.append(f"replicate {points[0].replicate}")
    return ", ".join(words) + (f", {len(points)} points" if len(points) > 1 else "")


def _ended(attempt: Attempt) -> str:
    spent = f"{attempt.wall_s:.0f} s ({attempt.cpu_s:.0f} s of processor time)"
    return spent if attempt.outcome == "ok" else f"{attempt.outcome} after {spent}: {attempt.error}"


def _write(task: Task) -> Work:
    """Write the jobs for the processes that make the runs."""
    study, folder, cache = task.study, task.folder, task.cache
    more = _asked(study) | {"tables": study.keep.tables, "cache": str(cache.path.resolve())}
    for run in task.plan.runs:
        folder.write_job(run, more)
    (folder.path / "traffic").mkdir(exist_ok=True)
    traffic = {}
    for name, config in task.plan.traffic.items():
        if cache.find("traffic", name) is None:
            traffic[name] = (folder.path / "traffic" / f"{name}.json").resolve()
            write_whole(traffic[name], json.dumps(config.to_dict(), default=str).encode())
    traffic_of = {run.id: run.traffic for run in task.plan.runs}
    return Work(traffic_of, traffic, cache.path.resolve())


def status(folder: StudyFolder, trust_code: bool = False) -> tuple[Study, dict[str, int], Failed]:
    """Study, number of points by state, and failed runs of a study folder.

    Code that the study names is loaded only with `trust_code`.
    """
    file = folder.path / "study.toml"
    if not file.is_file():
        raise ValueError(
            f"{folder.path} holds no run and no study. Give the folder of a `cosim run` or a `cosim sweep`."
        )
    folder.check()
    study = load(file, trust_code)
    points = points_of(study, str(file))
    content, states = folder.index(study, points)
    with suppress(OSError):  # the study of somebody else, or a full disk
        write_whole(folder.path / "index.parquet", content)
    answers = folder.answers()
    runs = {answers[point.id][0] for point in points if point.id in answers}
    names = [run for run in sorted(runs) if folder.state(run) == "failed"]
    failed = [(run, folder.attempts(run)[-1]) for run in names]
    return study, states, failed
