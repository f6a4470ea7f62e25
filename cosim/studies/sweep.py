"""Prepares and runs a study, and reports its state."""

import json
import statistics
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from scipy.stats import t

from cosim.base.threads import CORES
from cosim.door.load import checksum
from cosim.runs import check as checking
from cosim.runs.cluster import connected, local
from cosim.runs.run import new_remarks
from cosim.runs.source import code_digest
from cosim.studies.density import equipped_on_road
from cosim.studies.engine import Work, execute
from cosim.studies.estimate import Estimate, estimate
from cosim.studies.folder import Attempt, StudyFolder, write_whole
from cosim.studies.plan import PlannedRun, StudyPlan, plan
from cosim.studies.points import Point, points_of
from cosim.studies.speed import speed_here
from cosim.studies.stages import Cache, default_folder
from cosim.studies.study import SHIPPED, Study, load
from cosim.traffic.scenario import find
from cosim.traffic.scene_summary import scene_summary
from results.manifest import read_manifest
from results.study_measuring import changes, measuring_in, measuring_of

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
    levels: tuple[str, ...] = ()
    """Other levels of `record.level` than the study's at which finished runs were recorded."""


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


def prepare_study(study: Study, where: str, out: Path, merge: bool = True) -> Task:
    """Plan a sweep of a study that was read from the file `where`."""
    folder = StudyFolder(out)
    folder.check()
    points = points_of(study, where)
    answers = folder.answers()
    asked = {point.id for point in points}
    run_of = {point: run for point, (run, _) in answers.items() if point in asked}
    finished = {point: run for point, run in run_of.items() if folder.is_finished(run)}
    outdated = _outdated(study, folder, set(finished.values()))
    there = {point for point, run in finished.items() if run not in outdated}
    cache = Cache(default_folder())
    missing = [point for point in points if point.id not in there]
    made = plan(missing, needs_fused(study), cache.names("traffic")) if merge else separate(missing)
    done = []
    for run, _ in set(answers.values()):
        ended = [attempt for attempt in folder.attempts(run) if attempt.outcome == "ok"]
        done += [attempt.cpu_s or attempt.wall_s for attempt in ended]  # older versions did not write the former
    typical_s = statistics.median(done) if done else None
    return Task(
        study,
        folder,
        points,
        made,
        len(there),
        cache,
        estimate(missing, made, cache.names("traffic"), typical_s, speed_here()),
        outdated,
        _n_of_other_code(folder, {finished[point] for point in there}) if missing else 0,
        _other_levels(folder, points, finished),
    )


def _n_of_other_code(folder: StudyFolder, runs: Collection[str]) -> int:
    """How many runs were made by other code than this."""
    made_by = [read_manifest(folder.run(run)).get("source", {}).get("code") for run in runs]
    return sum(code not in (None, code_digest()) for code in made_by)


def _other_levels(folder: StudyFolder, points: Sequence[Point], finished: Mapping[str, str]) -> tuple[str, ...]:
    """Levels at which finished runs were recorded that are not those of their points."""
    found = set()
    for point in points:
        if (run := finished.get(point.id)) is None:
            continue
        recorded = read_manifest(folder.run(run))["config"]["record"]
        if recorded["level"] != point.config.record.level:
            found.add(recorded["level"])
    return tuple(sorted(found))


def _asked(study: Study) -> dict[str, Any]:
    """What is measured of every point, as `job.json` says it."""
    own = study.measuring.own
    code = checksum("measure.own", own) if own else ""
    return {"topics": study.keep.topics, "measure": asdict(study.measuring), "own_sha256": code}


def _outdated(study: Study, folder: StudyFolder, finished: Collection[str]) -> dict[str, list[str]]:
    """The finished runs that were measured otherwise than the study asks, and the keys that have changed."""
    now = measuring_of(_asked(study))
    found = {run: changes(measuring_in(folder.job(run)), now) for run in sorted(finished)}
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
    return found


def unbegun(study: Study, where: str) -> Task:
    """The work of a study that has no folder yet."""
    points, kept = points_of(study, where), Cache(default_folder())
    made = plan(points, needs_fused(study), kept.names("traffic"))
    return Task(
        study,
        StudyFolder(Path()),
        points,
        made,
        0,
        kept,
        estimate(points, made, kept.names("traffic"), None, speed_here()),
    )


def keys_in_vain(points: Sequence[Point]) -> list[str]:
    """Notes on keys that change nothing, with the number of points if this is so in some of them only."""
    scenario = cache(find)
    found: Counter[str] = Counter()
    for point in points:
        traffic = point.config.traffic
        found.update(checking.keys_in_vain(point.config, scenario(traffic.scenario, traffic.trace)))
    notes = []
    for note, n in found.items():
        if n != len(points):
            note = f"{note[:-1]}, in {n} of {len(points)} points."
        notes.append(note)
    return notes


def scene_notes(points: Sequence[Point]) -> list[str]:
    """Notes on the streets and buildings of the scenarios of a study, each scenario once."""
    notes: list[str] = []
    seen = set()
    for point in points:
        config = point.config
        named = (config.traffic.scenario, config.traffic.trace)
        if named in seen:
            continue
        seen.add(named)
        scenario = find(*named)
        scene = scene_summary(scenario)
        notes += scene.notes
        if scene.n_buildings == 0:
            notes.append(
                f"note: {named[1] or named[0]} has no buildings to block lines of sight. `cosim nets build` makes a "
                "city with buildings of a map."
            )
        notes += checking.empty_streets(config, scenario)
    return notes


FEW_EQUIPPED = 5.0
"""Fewer equipped vehicles than this on the road at a time hardly meet, and a share of them is one vehicle or none."""


def fleet_notes(points: Sequence[Point]) -> list[str]:
    """A note on the points with hardly any equipped vehicles."""
    found = {}
    for point in points:
        config = point.config
        named = (replace(config.traffic, seed=0), config.fleet)  # replicates are alike
        if named not in found and config.sensing:
            found[named] = equipped_on_road(config)
    few = {named: n for named, n in found.items() if n < FEW_EQUIPPED}
    if not few:
        return []
    (traffic, fleet), n = min(few.items(), key=lambda of: of[1])
    more = f", and {len(few) - 1} more" if len(few) > 1 else ""
    return [
        f"note: about {n:.1f} equipped vehicles are on the road at a time at traffic.scenario = {traffic.scenario}, "
        f"traffic.scale = {traffic.scale:g} and fleet.penetration_p = {fleet.penetration_p:g}{more}. So few hardly "
        "meet, and a share of them is one vehicle or none. Raise fleet.penetration_p or traffic.scale."
    ]


FEW_REPLICATES = 5
"""Fewer replicates than this give intervals that are wider than 1.5 standard deviations to either side."""


def interval_notes(study: Study) -> list[str]:
    """What intervals over so few replicates cannot say, before they are made.

    Half of a 95 % interval of the mean of n replicates is t(0.975, n - 1) / sqrt(n) standard deviations of a replicate.
    """
    n = study.head.replicates
    if n >= FEW_REPLICATES:
        return []
    if n == 1:
        return [
            "note: study.replicates = 1: means will have no interval, and no difference can be told from chance. Set 5."
        ]
    half = float(t.ppf(0.975, n - 1)) / n**0.5
    of_five = float(t.ppf(0.975, FEW_REPLICATES - 1)) / FEW_REPLICATES**0.5
    return [
        f"note: study.replicates = {n}: a 95 % interval reaches {half:.1f} standard deviations of a replicate to "
        f"either side ({FEW_REPLICATES} replicates: {of_five:.1f}). A smaller paired difference cannot be told from "
        "chance."
    ]


def name_notes(path: Path, study: Study) -> list[str]:
    """A note on a changed copy of a shipped study that kept its name and its question."""
    shipped = SHIPPED / f"{study.head.name}.toml"
    if not (path.is_file() and shipped.is_file()):
        return []
    original = load(shipped)
    if study.head.question != original.head.question or study.to_toml() == original.to_toml():
        return []
    return [
        f'note: study.name = "{study.head.name}" is that of a shipped study, which {path} changes. Its report will '
        "have this name and this question: write your own."
    ]


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
) -> tuple[dict[str, int], list[tuple[str, Attempt]]]:
    """Make the missing runs; return the number of points by state, and the runs that failed.

    `log` gets a line about each run that has ended, and the notes on it that no run before had.
    """
    study, folder = task.study, task.folder
    folder.prepare(study)
    with folder.locked():
        folder.stop.unlink(missing_ok=True)
        folder.tidy()
        for id in task.outdated:
            folder.forget_measures(id)
        work = _write(task)
        folder.write_index(study, task.points)
        failed: list[tuple[str, Attempt]] = []
        said: dict[str, str] = {}
        n_points = {run.id: len(run.members) for run in task.plan.runs}
        done = answered = 0
        report(0, len(n_points), task.n_finished, "")
        try:
            if n_points:
                n_workers = workers or CORES
                seen_by_all = folder.path.resolve() / "study.toml"
                with local(n_workers) if scheduler is None else connected(scheduler, seen_by_all) as client:
                    try:
                        for id, attempt in execute(client, StudyFolder(folder.path.resolve()), work, study.limits):
                            is_ok = attempt.outcome == "ok"
                            if id in work.runs:
                                done += 1
                                answered += n_points[id] * is_ok
                                number = f"run {done} of {len(n_points)}"
                                log(f"{number}: {_said(task, id)}: {_ended(attempt)}")
                            if not is_ok:
                                failed.append((id, attempt))
                            elif id in work.runs:
                                for note in new_remarks(folder.run(id), said):
                                    log(note)
                            report(
                                done,
                                len(n_points),
                                task.n_finished + answered,
                                f"{len(failed)} failed" if failed else "",
                            )
                    except BaseException:
                        folder.stop.touch()  # workers end their runs
                        raise
        finally:
            states = folder.write_index(study, task.points)
    return states, failed


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


def status(
    folder: StudyFolder, trust_code: bool = False
) -> tuple[Study, list[Point], dict[str, int], list[tuple[str, Attempt]]]:
    """Study, points, number of points by state, and failed runs of a study folder.

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
    states = folder.write_index(study, points)
    asked = {point.id for point in points}
    runs = {run for point, (run, _) in folder.answers().items() if point in asked}
    names = [run for run in sorted(runs) if folder.state(run) == "failed"]
    failed = [(run, folder.attempts(run)[-1]) for run in names]
    return study, points, states, failed
