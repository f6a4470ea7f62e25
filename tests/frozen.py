"""What small worlds compute today: fingerprints of their tables, their metrics, and the pixels of figures.

`python -m tests.frozen [WORLD ...]` writes `golden/frozen.json` anew, all of it or these worlds, and prints what moved.

A fingerprint depends on values and on names of columns alone. It does not depend on the order of rows, on blocks, on
the encoding of files, on meanings of columns, or on where in the repository the code is.
"""

import atexit
import hashlib
import importlib.util
import json
import os
import platform
import sys
import tempfile
import tomllib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas.util import hash_pandas_object

FOLDER = Path(__file__).parent / "golden"
FROZEN = FOLDER / "frozen.json"
COMMAND = "python -m tests.frozen"

TOLERANCE = 1e-9
"""Relative tolerance of metrics on the platform of the file."""
LOOSE, OUTLIERS_P = 0.02, 0.02
"""Relative and absolute tolerance of metrics on another platform, and the share of metrics that may exceed it.
A last bit that is rounded otherwise can decide whether an object is detected."""

ROUNDING = ("numpy", "numba", "llvmlite", "scipy", "pandas", "shapely", "libsumo", "matplotlib")
"""Packages whose versions decide on last bits."""

Found = dict[str, Any]
"""What a world computes: tables by name, metrics by name, figures by name."""


@dataclass(frozen=True, kw_only=True, slots=True)
class World:
    """A section of `golden/worlds.toml`, which explains the keys."""

    set: tuple[str, ...]
    on: str = ""
    acts: tuple[str, ...] = ()
    moves: tuple[str, ...] = ()
    quick: bool = False
    figures: bool = False
    module: str = ""

    @property
    def is_possible(self) -> bool:
        """Whether the module that the world needs is installed."""
        return not self.module or importlib.util.find_spec(self.module) is not None


def worlds() -> dict[str, World]:
    """All worlds by name; the keys of a world begin with those of the world that it is based on."""
    found: dict[str, World] = {}
    for name, section in tomllib.loads((FOLDER / "worlds.toml").read_text()).items():
        lists = {key: tuple(value) for key, value in section.items() if isinstance(value, list)}
        base = found[section["on"]].set if "on" in section else ()
        found[name] = World(**(section | lists | {"set": base + lists["set"]}))
    return found


def recorded() -> Found:
    """The content of the file."""
    return json.loads(FROZEN.read_text())


def simulated(world: World, *more: str) -> Found:
    """Simulate a world, with these keys in addition, in a process of its own, and find what it computes."""
    from tests.drive import python, simulate

    with tempfile.TemporaryDirectory(prefix="cosim-frozen-") as name:
        run = simulate(Path(name) / "run", *(_with_scene(key) for key in world.set), *more)
        asked = json.dumps([world.figures, *world.acts])
        return json.loads(python("import tests.frozen as frozen; frozen.say()", str(run), asked))


def say() -> None:
    """Print what the run in `sys.argv[1]` computes, as JSON. It is called in a process of its own."""
    from results.archive import open_run
    from results.measure import measure
    from results.tables import TABLES

    warnings.simplefilter("ignore")  # other tests are strict
    run = open_run(sys.argv[1])
    with_figures, *acts = json.loads(sys.argv[2])
    idle = [act for act in acts if not _has_rows(run, act)]
    tables = {name: fingerprint(run.table(name)) for name in TABLES if name in run.tables}
    metrics: dict[str, dict[str, float]] = {}
    for row in measure(run).dropna(subset="value").itertuples():
        metrics.setdefault(row.metric, {})[row.group] = float(f"{row.value:.12g}")
    found = {"idle": idle, "tables": tables, "metrics": metrics, "figures": _figures(run) if with_figures else {}}
    print(json.dumps(found))


def fingerprint(rows: pd.DataFrame) -> dict[str, str | int]:
    """Number of rows, hash of all rows, and hash of each column. None of them depends on the order of rows."""
    if rows.empty:
        return {"rows": 0}
    floats = rows.select_dtypes("floating").columns
    rows = rows.assign(**{name: rows[name] + 0.0 for name in floats})  # makes one zero of two
    columns = {name: _sum_of_hashes(rows[[name]])[:6] for name in sorted(rows.columns)}
    return {"rows": len(rows), "all": _sum_of_hashes(rows[sorted(rows.columns)])} | columns


def _sum_of_hashes(rows: pd.DataFrame) -> str:
    total = hash_pandas_object(rows, index=False).to_numpy().sum(dtype=np.uint64)
    types = " ".join(map(str, rows.dtypes))
    return hashlib.sha256(f"{types} {len(rows)} {total:x}".encode()).hexdigest()[:12]


def _has_rows(run: Any, act: str) -> bool:
    table, condition = act.split(": ", 1)
    return table in run.tables and len(run.table(table).query(condition, engine="python")) > 0


def _figures(run: Any) -> dict[str, str]:
    """Hash of the pixels of each figure; a figure without data has the reason."""
    from results.figures.catalogue import FIGURES

    found = {}
    for name, draw in FIGURES.items():
        try:
            canvas = draw([run]).canvas
        except ValueError:
            found[name] = "no data"
            continue
        pixels = np.asarray(canvas.buffer_rgba())
        found[name] = hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()).hexdigest()[:16]
    return found


def _with_scene(key: str) -> str:
    return key.format(**{name: _scene(name)}) if (name := key.partition("{")[2].partition("}")[0]) in SCENES else key


SCENES = ("street", "town")


@cache
def _scene(name: str) -> Path:
    """A scene that is written once per process."""
    from tests.hostile.scenes import write_town, write_trace

    folder = tempfile.TemporaryDirectory(prefix="cosim-scene-")
    atexit.register(folder.cleanup)
    write = write_trace if name == "street" else write_town
    return write(Path(folder.name))


def platform_now() -> dict[str, str]:
    """What decides on last bits: the processor, its features that compilers use, and versions of packages."""
    import llvmlite.binding as llvm

    features = os.environ.get("NUMBA_CPU_FEATURES", llvm.get_host_cpu_features().flatten())
    return {
        "machine": f"{platform.system()} {platform.machine()}",
        "processor": os.environ.get("NUMBA_CPU_NAME", llvm.get_host_cpu_name()),
        "features": hashlib.sha256(features.encode()).hexdigest()[:12],
        "numpy features": " ".join(_numpy_features()),
        "c library": " ".join(platform.libc_ver()),
        "python": ".".join(platform.python_version_tuple()[:2]),
    } | {name: version(name) for name in ROUNDING}


def _numpy_features() -> list[str]:
    from numpy._core._multiarray_umath import __cpu_features__

    return sorted(name for name, there in __cpu_features__.items() if there)


def other_platform(was: Mapping[str, str]) -> str:
    """How this platform differs from the recorded one; empty if it does not."""
    now = platform_now()
    return "; ".join(f"{key}: {was.get(key)} then, {now[key]} here" for key in now if now[key] != was.get(key))


def moved_tables(was: Found, now: Found) -> Iterator[str]:
    """A line for each table that moved: its columns, or its number of rows."""
    for kind in ("tables", "figures"):
        for name in sorted(was[kind].keys() | now[kind].keys()):
            before, after = was[kind].get(name), now[kind].get(name)
            if before is None or after is None:
                yield f"{kind[:-1]} {name}: {'is new' if before is None else 'is gone'}"
            elif before != after:
                yield f"{kind[:-1]} {name}: {_columns(before, after) if kind == 'tables' else 'other pixels'}"


def _columns(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    names = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    rows = f"{before['rows']} -> {after['rows']} rows; " if before["rows"] != after["rows"] else ""
    if not before["rows"] or not after["rows"]:
        return rows.removesuffix("; ")
    return rows + (", ".join(sorted(set(names) - {"rows", "all"})) or "the same values, otherwise combined")


def moved_metrics(was: Found, now: Found, rel: float = TOLERANCE, absolute: float = 0.0) -> list[str]:
    """A line for each metric that moved by more than the tolerance, with its values."""
    before, after = _flat(was["metrics"]), _flat(now["metrics"])
    lines = []
    for name in [*before, *(after.keys() - before.keys())]:
        old, new = before.get(name, np.nan), after.get(name, np.nan)
        if not abs(new - old) <= max(rel * abs(old), absolute):  # a metric that is gone is NaN here
            lines.append(f"metric {name}: {old:.12g} -> {new:.12g}")
    return lines


def _flat(metrics: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    return {
        f"{name} | {group}": value for name, values in metrics.items() for group, value in values.items()
    }  # fmt: skip


def write(found: Mapping[str, Found]) -> None:
    """Write the file: a line for each table, metric and figure."""
    lines = ["{", f'"platform": {json.dumps(platform_now())},', '"worlds": {']
    for name, world in found.items():
        lines.append(f"{json.dumps(name)}: {{")
        for kind, items in world.items():
            rows = [f"  {json.dumps(item)}: {json.dumps(value)}" for item, value in items.items()]
            lines += [f' "{kind}": {{', ",\n".join(rows), " },"]
        lines[-1] = " }"  # JSON has no comma after the last one
        lines.append("},")
    FROZEN.write_text("\n".join([*lines[:-1], "}}}"]) + "\n")


def main(names: Sequence[str]) -> None:
    """Simulate all worlds or these, say what moved, and write the file."""
    was = recorded()["worlds"] if FROZEN.exists() else {}
    if names and (other := other_platform(recorded()["platform"])):
        sys.exit(f"The file is of another platform ({other}). Write all of it: {COMMAND}")
    found = {}
    for name, world in worlds().items():
        if (names and name not in names) or not world.is_possible:
            found |= {name: was[name]} if name in was else {}
            continue
        found[name] = simulated(world)
        idle = found[name].pop("idle")
        moved = [*moved_tables(was[name], found[name]), *moved_metrics(was[name], found[name])] if name in was else []
        moved += [f"no row of {act}" for act in idle]
        print(f"{name}: {'recorded anew' if name in was else 'is new'}", *moved, sep="\n  ", flush=True)
    write(found)


if __name__ == "__main__":
    main(sys.argv[1:])
