"""Rows of the benchmark's table: computed for a user's model, stored with the set for the models that ship."""

import inspect
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import trust
from cosim import __version__
from cosim.addons.benchmark import adapt, play, score
from cosim.addons.benchmark.digest import code_digest
from cosim.addons.benchmark.evidence import SHIPPED, EvidenceSet
from cosim.base.durable import write_output
from cosim.door.blame import ExtensionError
from trust.models import MODELS

TABLE = "table.json"
BUDGET = 34
"""Policies that the adversary tries for a model of the stored table."""
ADAPTED = ("belief_graph", "beta", "beta_discounted", "median_groups", "miso_v", "prbi", "trupercept")
"""Models of the stored table to which the adversary adapts. That takes as long again as all other figures of one."""

Row = dict[str, Any]


def digest() -> str:
    """Hash of the code on which a row depends."""
    return code_digest(code_files())


def code_files() -> list[Path]:
    """Files of that code: trust models, playing and scoring."""
    rooms = {Path(str(trust.__file__)).parent}
    rooms |= {Path(inspect.getfile(model)).parent for model in MODELS.values()}
    files = {file for room in rooms for file in room.rglob("*.py")}
    modules = [Path(str(module.__file__)) for module in (play, score, adapt)]
    return [*sorted(files), *modules]


def citation(evidence: EvidenceSet) -> str:
    """How to cite the set."""
    return (
        f"cosim trust benchmark, evidence set {evidence.version}, sha256 {evidence.checksum[:16]}, "
        f"made with cosim {__version__}"
    )


def row_of(
    evidence: EvidenceSet, name: str, sets: Sequence[str], advance: score.Advance, budget: int = 0, seed: int = 0
) -> Row:
    """Score a model, and search its worst case if there is a budget.

    Raises
    ------
    ValueError
        In one line, if the model cannot be loaded, raises an exception, or returns something wrong.
    """
    candidate = play.candidate(name, sets, evidence.rules)
    try:
        found = score.score(evidence, candidate, advance)
        worst = None
        if budget:
            worst = adapt.Search(evidence, candidate, found.threshold, advance).run(budget, seed)
    except ExtensionError as error:
        raise ValueError(str(error)) from None
    row: Row = {
        "model": name,
        "parameters": list(sets),
        "sha256": found.sha256,
        "threshold": _plain(found.threshold),
        "quiet_p": _plain(found.quiet_p),
        "cost_us": _plain(found.cost_us),
        "attacks": {attack: _figures(of) for attack, of in found.attacks.items()},
        "worst_case": None,
    }
    if worst is not None:
        policy = {f.name: getattr(worst.policy, f.name) for f in fields(worst.policy)}
        row["worst_case"] = {
            "policy": policy,
            "words": worst.policy.words,
            "budget": worst.budget,
            "n_worlds": worst.n_worlds,
            "seed": worst.seed,
            **_figures(worst.figures),
        }
    return row


def _figures(of: score.Figures) -> dict[str, list[float | None]]:
    """Value, low and high of each figure."""
    found = {}
    for one in fields(of):
        interval = getattr(of, one.name)[:3]
        found[one.name] = list(map(_plain, interval))
    return found


def _plain(value: float) -> float | None:
    """A number for JSON, to five digits; null if there is none."""
    return float(f"{value:.5g}") if math.isfinite(value) else None


def head(evidence: EvidenceSet) -> dict[str, str]:
    """What a table belongs to: version and checksum of the set, version and hash of the code."""
    return {"set": evidence.version, "sha256": evidence.checksum, "cosim": __version__, "code": digest()}


def make(
    evidence: EvidenceSet,
    folder: Path,
    advance: score.Advance,
    models: Mapping[str, type] = MODELS,
    budget: int = BUDGET,
) -> None:
    """Score all models that ship, and store each row in the folder of the set. Rows of this set and code are kept.

    The models `raya_*` have the trust in vehicles of `beta`: they differ in how they score objects, and are left out.
    """
    about = head(evidence)
    known, remark = stored(evidence, folder)
    rows = [] if remark else list(known)
    for name in models:
        if not name.startswith("raya_") and name not in {row["model"] for row in rows}:
            rows.append(row_of(evidence, name, (), advance, budget if name in ADAPTED else 0))
            write_output(folder / TABLE, (json.dumps({**about, "rows": rows}, indent=1) + "\n").encode())


def stored(evidence: EvidenceSet, folder: Path = SHIPPED) -> tuple[list[Row], str]:
    """The stored rows of the set, and a remark if they were computed by other code.

    There are no rows if none are stored, or if they belong to another set.
    """
    try:
        table = json.loads((folder / TABLE).read_text(encoding="utf-8"))
        rows, now = [_checked(row) for row in table["rows"]], head(evidence)
    except FileNotFoundError:
        return [], "no rows of the models that ship are stored with this set; --all computes them."
    except (OSError, KeyError, TypeError, ValueError, AttributeError):
        return [], f"{folder / TABLE} is damaged, so it is left out; --all computes it anew."
    if table.get("sha256") != now["sha256"]:
        return [], f"{folder / TABLE} belongs to another set, so it is left out; --all computes it anew."
    if table.get("code") != now["code"]:
        return rows, f"the rows of the models that ship were computed by other code, cosim {table.get('cosim')}."
    return rows, ""


def _checked(row: Row) -> Row:
    """A stored row; KeyError, TypeError or ValueError if it is none."""
    every = list(row["attacks"].values())
    if row["worst_case"] is not None:
        every.append(row["worst_case"])
    for of in every:
        for one in fields(score.Figures):
            value, low, high = of[one.name]
            for number in (value, low, high):
                if not isinstance(number, int | float | None):
                    raise ValueError(one.name)
    if not row["attacks"] or not isinstance(row["model"], str):
        raise ValueError("model, attacks")
    if not isinstance(row["cost_us"], int | float | None):
        raise ValueError("cost_us")
    return row


def worst_attack(row: Row) -> str:
    """The attack with the smallest AUC."""
    auc = {}
    for attack, of in row["attacks"].items():
        auc[attack] = _or(of["auc"][0], math.inf)
    return min(auc, key=lambda attack: auc[attack])


def summary(row: Row) -> dict[str, float | None]:
    """The figures by which rows are compared: worst and mean over attacks."""
    of = list(row["attacks"].values())

    def column(name: str) -> list[float]:
        return [one[name][0] for one in of if one[name][0] is not None]

    def mean(values: list[float]) -> float | None:
        return sum(values) / len(values) if values else None

    auc, wrong = column("auc"), column("wrong_p")
    return {
        "auc_worst": min(auc, default=None),
        "auc_mean": mean(auc),
        "wrong_worst": max(wrong, default=None),
        "believed_mean": mean(column("believed_p")),
        "harm_worst": max(column("harm"), default=None),
        "age_mean_s": mean(column("age_s")),
        "never_excluded": sum(one["exclusion_s"][0] is None for one in of),
    }


def ranked(rows: Sequence[Row]) -> list[Row]:
    """Rows by their worst AUC, best first."""
    return sorted(rows, key=lambda row: -_or(summary(row)["auc_worst"], -1.0))


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
