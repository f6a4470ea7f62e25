"""Holds the tables of schema 4, when it was new, against those of schema 3, value for value under the new names.

    python -m tests.verification.same_science [--before COMMIT] [--after COMMIT] [--keep FOLDER]

drives four experiments with the code of two commits, each in a worktree of its own, and compares every table. By
default these are the last commit of schema 3 and the first whole one of the pure step; what changed results since then
stands in CHANGELOG.md under "Numbers change". Columns that differ are printed with their count; only what `EXPLAINED`
names may differ.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

ROOT = Path(__file__).parents[2]
BEFORE = "The price of reading, measured last"
AFTER = "The cycle as a pure step of parts: same tables, value for value"
FULL = '[record]\nlevel = "full"\n'

EXPERIMENTS: dict[str, tuple[str, str]] = {
    "default": (FULL, FULL),
    "relays": (
        """
[traffic]
duration_s = 120
[adversary]
start_s = 20
[radio]
verdicts = "piggybacked"
[radio.relay]
max_hops = 3
[rsu]
n_at_junctions = 6
[server]
uplink = "rsu"
"""
        + FULL,
        """
[traffic]
duration_s = 120
[[attacks]]
attack = "ghost_insertion"
role = "malicious"
start_s = 20
[[attacks]]
attack = "unreliable"
role = "unreliable"
start_s = 20
[radio]
evaluations = "piggybacked"
[radio.relay]
max_hops = 3
[rsu]
n_at_junctions = 6
[server]
uplink = "rsu"
"""
        + FULL,
    ),
    "local": (
        """
[traffic]
scenario = "koenigs-wusterhausen"
duration_s = 120
[adversary]
start_s = 20
[trust]
where = "local"
"""
        + FULL,
        """
[traffic]
scenario = "koenigs-wusterhausen"
duration_s = 120
[[attacks]]
attack = "ghost_insertion"
role = "malicious"
start_s = 20
[[attacks]]
attack = "unreliable"
role = "unreliable"
start_s = 20
[trust]
host = "local"
"""
        + FULL,
    ),
    "replay": (
        """
[traffic]
scenario = "{folder}/before-default"
duration_s = 120
[adversary]
start_s = 20
[radio]
cpm_rules = "etsi"
[radio.relay]
max_hops = 2
[trust]
method = "trupercept_1"
"""
        + FULL,
        """
[traffic]
scenario = "{folder}/after-default"
duration_s = 120
[[attacks]]
attack = "ghost_insertion"
role = "malicious"
start_s = 20
[[attacks]]
attack = "unreliable"
role = "unreliable"
start_s = 20
[radio]
cpm_rules = "etsi"
[radio.relay]
max_hops = 2
[trust]
method = "trupercept_1"
"""
        + FULL,
    ),
}
"""Config of each experiment in the former schema, and in this one."""

_MESSAGE = {"message": "message_type"}
NAMES: dict[str, tuple[str, dict[str, str]]] = {
    "vehicles": ("vehicles", {"kind": "vehicle_class", "behaviour": "role", "first_lie_step": "attack_start_step"}),
    "actors": ("actors", {}),
    "encounters": ("encounters", {f"n_verdicts_{d}": f"n_evaluations_{d}" for d in ("ab", "ba")}),
    "sightings": ("observability", {}),
    "detections": ("detections", {"k": "detection_index", "kind": "origin", "said": "transmitted"}),
    "deliveries": ("receptions", _MESSAGE | {"generated_s": "generation_offset_s", "access_s": "access_delay_s"}),
    "radio": ("radio", _MESSAGE | {"n_in_reach": "n_in_range", "bytes": "sent_bytes", "busy_ratio": "cbr"}),
    "links": ("pdr_by_distance", _MESSAGE | {"ring_m": "distance_bin_m", "view": "los_state",
                                             "n_in_reach": "n_in_range"}),
    "latencies": ("latency_histogram", _MESSAGE),
    "silences": ("packet_inter_reception", _MESSAGE | {"gap_steps": "pir_steps", "n_parted": "n_censored"}),
    "ears": ("vehicle_channel", {"busy_ratio": "cbr", "n_in_reach": "n_in_range", "n_heard": "n_received"}),
    "verdicts": ("evaluations", {"k": "detection_index", "e": "evaluation"}),
    "trust": ("trust", {"vehicle": "subject"}),
    "uses": ("trust_lookups", {}),
    "fused": ("fused", {"k": "fused_index", "n_witnesses": "n_sources", "local": "ego_detected",
                        "source_k": "source_index", "pose_k": "pose_index"}),
    "server": ("server", {"up_bytes": "uplink_bytes"}),
}  # fmt: skip
"""Former table, its name now, and its columns that have other names now."""

DROPPED = {("verdicts", "judged_step")}
"""Columns that are no more: it always equalled `step`."""

LABELS = {"detections": "cpm", "verdicts": "evaluation", "open": "los", "wall": "nlos", "sight": "los"}
"""Labels that have other names now, in columns of kinds."""

EXPLAINED = {
    (
        "fused",
        "score",
    ): "an attacker fuses with its own honest evaluations, no longer with those that vouch for its lies",
    ("fused", "pose"): "follows the score",
    ("fused", "pose_index"): "follows the score",
}
"""Columns of attackers' own rows that may differ, and why."""


def read(folder: Path, table: str) -> pd.DataFrame:
    """All parts of a table."""
    parts = [pq.read_table(path, partitioning=None) for path in sorted((folder / table).glob("part-*.parquet"))]
    frame = pa.concat_tables(parts, promote_options="permissive").to_pandas() if parts else pd.DataFrame()
    for name in frame.columns:
        if isinstance(frame[name].dtype, pd.CategoricalDtype):
            frame[name] = frame[name].astype(object)
    return frame


def compare(before: Path, after: Path) -> tuple[int, list[str]]:
    """Number of values that are equal, and a line per column that differs."""
    n_equal, lines = 0, []
    roles = read(after, "vehicles").set_index("vehicle").role
    attackers = set(roles.index[roles.isin(["malicious", "unreliable"])])
    for old, (new, columns) in NAMES.items():
        a, b = read(before, old), read(after, new)
        a = a.drop(columns=[column for table, column in DROPPED if table == old and column in a])
        a = a.rename(columns=columns)
        if "variant" in b:
            b = b[b.variant == "base"]
        if new == "fused":  # rows of attackers' own beliefs may come and go with their score
            key = ["step", "observer", "source", "source_index"]
            own = [len(x[x.observer.isin(attackers)]) for x in (a, b)]
            a, b = (x.drop(columns="fused_index").sort_values(key) for x in (a, b))
            a, b = (x[~x.observer.isin(attackers)].reset_index(drop=True) for x in (a, b))
            if own[0] != own[1]:
                lines.append(f"  {new}: attackers' own rows {own[0]:,} -> {own[1]:,} ({EXPLAINED['fused', 'score']})")
        if len(a) != len(b):
            lines.append(f"! {new}: {len(a):,} rows -> {len(b):,} rows")
            continue
        for column in a.columns:
            one, other = a[column].to_numpy(), b[column].to_numpy() if column in b else None
            if other is None:
                lines.append(f"! {new}.{column} is missing")
                continue
            if one.dtype == object:
                one = np.array([LABELS.get(v, v) if isinstance(v, str) else v for v in one], object)
            same = (one == other) | (pd.isna(one) & pd.isna(other))
            n_equal += int(same.sum())
            if not same.all():
                lines.append(f"! {new}.{column}: {int((~same).sum()):,} of {len(a):,} values differ")
    return n_equal, lines


DRIVE = """
import sys
from pathlib import Path
from cosim.execution import run
from cosim.config.config import load
run.run(load(Path(sys.argv[1])), Path(sys.argv[2]), lambda *_: None)
"""
"""A run without its closing summary."""


def drive(code: Path, config: Path, out: Path) -> None:
    """A run with the code of a checkout."""
    env = os.environ | {"PYTHONPATH": str(code)}
    done = subprocess.run(
        [sys.executable, "-c", DRIVE, str(config), str(out)],
        env=env, cwd=code, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{out}: {done.stderr[-2000:]}")


def checkout(folder: Path, commit: str) -> Path:
    """A worktree of a commit, given by its name or the first line of its message."""
    if not folder.exists():
        git = ["git", "-C", str(ROOT)]
        found = subprocess.run([*git, "log", "--format=%H", f"--grep=^{commit}"], capture_output=True, text=True).stdout
        name = found.split()[0] if found.strip() else commit
        subprocess.run([*git, "worktree", "add", "--detach", str(folder), name], check=True)
    return folder


def main() -> None:
    """Both sides of every experiment, and what differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", default=BEFORE)
    parser.add_argument("--after", default=AFTER)
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    folder = given.keep or Path(tempfile.mkdtemp(prefix="same-science-"))
    folder.mkdir(parents=True, exist_ok=True)
    codes = [checkout(folder / "code-before", given.before), checkout(folder / "code-after", given.after)]
    total, wrong = 0, 0
    try:
        for name, configs in EXPERIMENTS.items():
            for side, config, code in zip(("before", "after"), configs, codes, strict=True):
                out = folder / f"{side}-{name}"
                if not out.exists():
                    path = folder / f"{side}-{name}.toml"
                    path.write_text(config.replace("{folder}", str(folder)), encoding="utf-8")
                    drive(code, path, out)
            n_equal, lines = compare(folder / f"before-{name}", folder / f"after-{name}")
            total += n_equal
            wrong += sum(line.startswith("!") for line in lines)
            print(f"{name}: {n_equal:,} values equal", *lines, sep="\n")
    finally:
        if not given.keep:
            for code in codes:
                subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(code)], check=False)
    print(f"{total:,} values compared and equal; {wrong} columns differ without an explanation")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
