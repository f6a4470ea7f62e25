"""A study that ships, made short: `python -m tests.cosim.docs.short NAME OUT` sweeps it within a minute or two.

It keeps the question, the first and the last value of every key, and what is measured. It has one replicate, 20 s of
traffic after a minute, and attacks that begin at once.
"""

import subprocess
import sys
import tomllib
from pathlib import Path

from cosim.runs.manifest import toml_text
from cosim.studies.study import SHIPPED

REPLICATES = 1
DURATION_S, WARMUP_S, ATTACK_S = 20, 60, 2


def shortened(name: str) -> str:
    """The TOML text of the short study."""
    data = tomllib.loads((SHIPPED / f"{name}.toml").read_text(encoding="utf-8"))
    data["study"]["replicates"] = REPLICATES
    if "config" in data["study"]:
        data["study"]["config"] = str((SHIPPED / data["study"]["config"]).resolve())
    data["base"] = _plain(data.get("base", {}))
    data["base"].setdefault("traffic", {}).update(duration_s=DURATION_S, warmup_s=WARMUP_S)
    for attack in data["base"].get("attacks", []):
        attack["start_s"] = min(attack.get("start_s", 0), ATTACK_S)
    data["grid"] = {key: _ends(values) for key, values in _flat(data.get("grid", {}))}
    data["zip"] = [{key: _ends(values) for key, values in _flat(section)} for section in data.get("zip", [])]
    baseline = data["study"].get("baseline", {})
    kept = {**data["grid"], **{key: values for section in data["zip"] for key, values in section.items()}}
    data["study"]["baseline"] = {key: value if value in kept[key] else kept[key][0] for key, value in baseline.items()}
    return toml_text(data)


def _plain(base):
    """Dotted keys as sections."""
    found = {}
    for key, value in _flat(base):
        at = found
        *sections, last = key.split(".")
        for section in sections:
            at = at.setdefault(section, {})
        at[last] = value
    return found


def _flat(section, prefix=""):
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _ends(values):
    return [values[0], values[-1]] if len(values) > 2 else values


if __name__ == "__main__":
    study, out, *more = sys.argv[1:]
    Path(f"{study}-short.toml").write_text(shortened(study), encoding="utf-8")
    words = [sys.executable, "-m", "cosim", "sweep", f"{study}-short.toml", "--out", out, *more]
    raise SystemExit(subprocess.run(words).returncode)
