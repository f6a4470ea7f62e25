"""Measures the speed of studies: two workers compared with one, and many points in one run compared with one point."""

import resource
from collections.abc import Callable
from functools import partial
from os import cpu_count
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from cosim.studies import sweep
from cosim.studies.study import SHIPPED
from tests.bench.suite import Row

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
"""Runs that share nothing, because every replicate has its own traffic."""


def bench() -> list[Row]:
    """Measure the wall time of 24 runs and the processor time of 20 points. It takes some minutes."""
    with TemporaryDirectory(prefix="cosim-bench-") as name:
        folder = Path(name)
        return [*_workers(folder), *_points(folder)]


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
    """Compare 20 points of the study `freshness` (five windows, four periods) in one run with one point alone."""
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


def _swept(file: Path, out: Path, workers: int, merge: bool = True) -> None:
    _, failed = sweep.sweep(sweep.prepare(file, out, merge), lambda *_: None, None, workers)
    assert not failed, failed


def _spent(work: Callable[[], object]) -> tuple[float, float]:
    """Wall time, and processor time including child processes [s]."""
    before, begin = _processor_s(), perf_counter()
    work()
    return perf_counter() - begin, _processor_s() - before


def _processor_s() -> float:
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)
