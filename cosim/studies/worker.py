"""The process that makes one run of a study: `python -m cosim.studies.worker JOB` for a folder with a `job.json`.

It ends when the process that started it ends, because its standard input is then closed.
"""

import fcntl
import json
import logging
import shutil
import sys
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.base import durable
from cosim.config.config import resolve_data
from cosim.door.blame import ExtensionError
from cosim.door.load import function
from cosim.runs import run as running
from cosim.runs.process import end_with_parent
from cosim.runs.stop import Failed
from cosim.studies.folder import StudyFolder, status_of
from cosim.studies.stages import Cache
from results import study_curves
from results.archive import open_run
from results.manifest import drop_tables, read_manifest
from results.measure import measure
from results.metrics.registry import TOPICS
from results.own_metrics import check_own
from results.study_measuring import write_measured
from results.tables import TABLES

_log = logging.getLogger(__name__)


def make(job: Path) -> None:
    """Make the run of a job and its metrics. What is finished is not repeated."""
    study = StudyFolder(job.parent.parent)
    asked = json.loads(durable.read(job / "job.json"))
    with open(durable.open_lock(job / "lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a process of an earlier sweep may still work on it
        if study.is_finished(asked["id"]):
            return
        folder = study.run(asked["id"])
        if status_of(folder) == "finished" and read_manifest(folder).get("dropped"):
            shutil.rmtree(folder)  # it has been measured otherwise, and tables that metrics need are gone
        if status_of(folder) != "finished":
            traffic = None
            if asked["traffic"]:
                traffic = Cache(Path(asked["cache"])).find("traffic", asked["traffic"])
            _drive(folder, asked["config"], traffic)
        tables = _measured(folder, asked)
        _drop(folder, asked["tables"])
        write_measured(job, tables)  # from then on nobody comes back to the run


def _drive(folder: Path, config: dict[str, Any], traffic: Path | None) -> None:
    """Make the run; continue from its last complete block if an earlier attempt was interrupted."""
    if status_of(folder):
        try:
            ours = read_manifest(folder)["config"] == json.loads(json.dumps(config))
            running.resume(folder, lambda *_: None, traffic, trust_code=ours)
            return
        except ValueError as error:  # no complete block, another version, other inputs, or damage
            _log.warning("%s: made anew (%s)", folder, " ".join(str(error).split()))
    if folder.exists():
        shutil.rmtree(folder)
    running.run(resolve_data(config, "the plan", None), folder, lambda *_: None, traffic)


def _measured(folder: Path, asked: dict[str, Any]) -> dict[str, pd.DataFrame]:
    """Metrics and curves of every point of the run, by the file in the folder of the job that keeps them."""
    topics, frames, curves = tuple(asked["topics"]) or tuple(TOPICS), [], []
    options = dict(asked["measure"])
    own = options.pop("own", "")
    run = open_run(folder)
    for point, variant in asked["members"].items():
        one = run.as_variant(variant)
        frames.append(measure(one, topics=topics, **options).assign(point=point))
        if {"encounters", "freshness"} & set(topics):
            curves.append(study_curves.counts(one).assign(point=point))
        if own:
            rows = check_own(function("measure.own", own)(one), f"measure.own = {own}")
            frames.append(rows.assign(point=point))
    parts_of = {"curves.parquet": curves, "measures.parquet": frames}
    return {name: pd.concat(parts, ignore_index=True) for name, parts in parts_of.items() if parts}


def _drop(folder: Path, kept: list[str] | None) -> None:
    """Delete the tables that the study does not keep."""
    if kept is not None:
        drop_tables(folder, [name for name in TABLES if name not in kept])


def main() -> None:
    if not sys.stdin.isatty():
        end_with_parent()
    kind, *words = sys.argv[1:]
    try:
        if kind == "run":
            make(Path(words[0]))
        else:
            config = resolve_data(json.loads(durable.read(Path(words[2]))), "the plan", None)
            Cache(Path(words[0])).make_traffic(words[1], config, lambda *_: None)
    except (ValueError, Failed, ExtensionError, OSError) as error:
        sys.exit(" ".join(str(error).split()))


if __name__ == "__main__":
    main()
