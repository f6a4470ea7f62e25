"""Speed of studies: two workers against one, points in one run against one point, shards against one process."""

import json
import resource
from collections.abc import Callable
from functools import partial
from os import cpu_count
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from cosim.bench.suite import Row
from cosim.config.config import load as load_config
from cosim.execution import run as running
from cosim.studies import shards, sweep
from cosim.studies.study import SHIPPED

N_RUNS = 24
_APART = f"""
[study]
name = "apart"
replicates = {N_RUNS}
[base]
traffic.duration_s = 100
compute.threads = 1
[grid]
fleet.penetration_p = [0.3]
[keep]
topics = ["traffic", "trust"]
"""
"""Runs that share nothing: every replicate has traffic of its own."""
_SHARDED = ("traffic.duration_s=100", "fleet.penetration_p=1", "trust_variant=[]", "compute.threads=1")


def bench() -> list[Row]:
    """Wall time of 24 runs, processor time of 20 points, both of a run with shards; some minutes."""
    with TemporaryDirectory(prefix="cosim-bench-") as name:
        folder = Path(name)
        return [*_workers(folder), *_points(folder), *_shards(folder)]


def _workers(folder: Path) -> list[Row]:
    (folder / "apart.toml").write_text(_APART)
    wall_s = {}
    for n in (1, 2):
        wall_s[n], _ = _spent(partial(_swept, folder / "apart.toml", folder / f"apart{n}", n, merge=False))
    return [
        (f"{N_RUNS} runs that share nothing, one worker", wall_s[1], "s"),
        ("two workers", wall_s[1] / wall_s[2], f"times faster, of {cpu_count()} cores"),
    ]


def _points(folder: Path) -> list[Row]:
    """Five windows and four periods of the study `freshness` in one run, against one of them; metrics included."""
    text = (SHIPPED / "freshness.toml").read_text().replace("replicates = 5", "replicates = 1")
    many = text.replace("[0.1, 0.3, 0.6]", "[0.3]")
    one = many.replace("[5, 10, 20, 50, 100]", "[50]").replace("[1, 5, 10, 30]", "[5]")
    spent = {}
    for name, study in (("one", one), ("many", many)):
        (folder / f"{name}.toml").write_text(study)
        _, spent[name] = _spent(partial(_swept, folder / f"{name}.toml", folder / name, 1))
    return [
        ("one point of the study freshness", spent["one"], "s of processor time"),
        ("20 points in one run", spent["many"] / spent["one"], "times that"),
    ]


def _shards(folder: Path) -> list[Row]:
    """The shipped city, every car and van equipped, traffic recorded before."""
    traffic = running.record_traffic(load_config(None, list(_SHARDED)), folder / "traffic", lambda *_: None)
    config = load_config(None, [*_SHARDED, f"traffic.trace={traffic}"])
    plain = _spent(lambda: running.run(config, folder / "plain", lambda *_: None))
    timings_s = json.loads((folder / "plain" / "manifest.json").read_text())["timings_s"]
    theirs = sum(timings_s[stage] for stage in ("sweep", "detect", "evaluate")) / sum(timings_s.values())
    rows = [
        ("a run of one process", plain[0], "s"),
        ("of which workers can compute", 100 * theirs, "%"),
    ]
    for n in (1, 2):
        wall_s, processor_s = _spent(partial(shards.run, config, folder / f"shards{n}", lambda *_: None, None, n))
        rows += [
            (f"with {n} worker{'s' * (n > 1)}: faster", plain[0] / wall_s, "times"),
            (f"with {n} worker{'s' * (n > 1)}: processor time", processor_s / plain[1], "times"),
        ]
    return rows


def _swept(file: Path, out: Path, workers: int, merge: bool = True) -> None:
    _, failed = sweep.sweep(sweep.prepare(file, out, merge), lambda *_: None, None, workers)
    assert not failed, failed


def _spent(work: Callable[[], object]) -> tuple[float, float]:
    """Wall time and processor time, of child processes too [s]."""
    before, begin = _processor_s(), perf_counter()
    work()
    return perf_counter() - begin, _processor_s() - before


def _processor_s() -> float:
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)
