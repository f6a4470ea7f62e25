"""The paper's quantitative experiments as studies, and the comparison of their results with the paper."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.addons.paper import figure as pictures
from cosim.addons.paper.page import BETWEEN, POINTS, before_of, markdown
from cosim.addons.paper.published import AP, FINAL_TRUST
from cosim.base import durable
from cosim.config import data as config_data
from cosim.studies import sweep as sweeping
from cosim.studies.study import SHIPPED, Study, load
from results import study as studies
from results.figures import style
from results.metrics.kitti import FEWEST, LEVELS
from results.spreadsheet import csv_of

EXPERIMENTS: Mapping[str, str] = {"tables": "paper_tables", "trust-levels": "paper_trust_levels"}
"""The shipped study of each experiment, by its name in `cosim reproduce`."""

CITY, METHOD, SELF_REPORTS = "traffic.scenario", "trust.method", "trust.self_reports"
START, ATTACK = "attacks.0.start_s", "attacks.0.attack"
SETTINGS = ("trustworthy", "unreliable", "malicious")
_AP_METRICS = ("paper.ap11", "paper.ap40")
NEVER_S = 1e8
"""Start of an attack that is never carried out."""

_FIRST = ["what", "setting", "city", "method", "self_reports", "class", "level", "unit"]
_SHOWN: Mapping[str, tuple[str, str]] = {
    "misbehaviour.time_to_detection.median_s": ("first lie to half the default trust, at the server, median", "{}"),
    "misbehaviour.time_to_detection.share": ("share of attackers that the server trusts below half the default", "{}"),
    "misbehaviour.time_to_detection_at_vehicle.median_s": (
        "first lie to half the default trust, as vehicles look it up, median", "{}",
    ),
    "encounters.duration.km_median_s": ("encounter within 100 m, median", ""),
    "encounters.duration.km_mean_s": ("encounter within 100 m, mean", ""),
    "attack.believed.share": ("inserted objects that their victim believes", "0.5, intended, {}"),
    "paper.egos.n": ("egos of a drive", ""),
    "paper.frames.n": ("frames of a drive", ""),
}  # fmt: skip
"""Further figures by metric: a description, and the group, which may name the role of the attackers."""


@dataclass(frozen=True, slots=True)
class ExperimentOutcome:
    """The results of an experiment."""

    name: str
    rows: pd.DataFrame
    """Columns what, setting, city, method, self_reports, class, level, unit; paper; n, mean, low, high over replicates;
    change, change_low, change_high; paper_change. Changes are paired differences against the ego alone (tables) or
    against honest vehicles (trust levels)."""
    files: list[Path]
    """Tables and a picture."""


def study_of(name: str, overrides: Sequence[str] = (), replicates: int | None = None) -> Study:
    """The study of an experiment, with changed keys of its base.

    Raises
    ------
    ValueError
        In one line, if an override has a mistake or names a swept key.
    """
    if replicates is not None and replicates < 1:
        raise ValueError(f"--replicates {replicates}: at least one run is needed. Give 1 or more.")
    study = load(SHIPPED / f"{EXPERIMENTS[name]}.toml")
    for text in overrides:
        key = text.partition("=")[0].strip()
        if key in study.keys or key in ("seed", "traffic.seed"):
            raise ValueError(f"--set {text}: {key} is varied by the experiment. Leave it out.")
        config_data.override(study.base, text)
    return study if replicates is None else replace(study, head=replace(study.head, replicates=replicates))


def task_of(study: Study, name: str, out: Path) -> sweeping.Task:
    """The remaining work of an experiment. Nothing is written."""
    return sweeping.prepare_study(study, f"{EXPERIMENTS[name]}.toml", out)


def conclude(name: str, out: Path) -> ExperimentOutcome:
    """Write the tables and the picture of an experiment whose runs are finished.

    Raises
    ------
    ValueError
        If the drives are too short for any average precision. Nothing is written then.
    """
    study = studies.open_study(out)
    rows = outcome(study, name)
    if not (rows.what == "average precision").any():
        raise ValueError(
            f"{out}: no average precision, because in no run a class and level has {FEWEST} objects. Set "
            "traffic.duration_s higher, in another --out."
        )
    table, picture = out / f"{name}.csv", out / f"{name}.png"
    durable.write_output(table, csv_of(rows))
    plain = out / f"{name}.json"
    durable.write_output(plain, (json.dumps(as_data(rows), indent=1) + "\n").encode())
    page = out / f"{name}.md"
    runs = [out / "runs" / run for run in sorted(study.points["run"].astype(str).unique())]
    durable.write_output(page, markdown(rows, name, runs).encode())
    draw = pictures.draw_tables if name == "tables" else pictures.draw_trust_levels
    return ExperimentOutcome(name, rows, [table, plain, page, style.save(draw(rows), picture)])


def as_data(rows: pd.DataFrame) -> list[dict[Any, Any]]:
    """Rows as dictionaries; missing values are None."""
    return rows.astype(object).where(rows.notna(), None).to_dict("records")


def outcome(study: studies.StudyResults, name: str) -> pd.DataFrame:
    """Rows of `ExperimentOutcome` from the metrics of a study."""
    frame = study.measures
    start = frame[START] if START in frame else pd.Series(NEVER_S, frame.index)
    attack = frame[ATTACK] if ATTACK in frame else pd.Series("", frame.index)
    kind = attack.map({"unreliable": "unreliable"}).fillna("malicious")
    self_reports = frame[SELF_REPORTS] if SELF_REPORTS in frame else pd.Series(True, frame.index)
    frame = frame.assign(
        setting=kind.where(start < NEVER_S, "trustworthy"), city=frame[CITY], method=frame[METHOD],
        self_reports=self_reports.astype(bool), **{"class": "", "level": ""},
    )  # fmt: skip
    found = [_precision(frame, name, metric, what) for metric, what in zip(_AP_METRICS, POINTS, strict=True)]
    found += [_between(frame)] * (name == "tables") + [_final_trust(frame)]
    for metric, (what, group) in _SHOWN.items():
        found.append(_further(frame[frame.metric == metric], what, group))
    rows = pd.concat(found, ignore_index=True)
    return rows.sort_values("setting", key=lambda c: c.map(SETTINGS.index), kind="stable", ignore_index=True)[
        [*_FIRST, "paper", "n", "mean", "low", "high", "change", "change_low", "change_high", "paper_change"]
    ]


def _of_metric(frame: pd.DataFrame, metric: str, what: str) -> pd.DataFrame:
    """Average precision of every run, by class and level."""
    ap = frame[frame.metric == metric].assign(what=what)
    parts = ap.group.str.split(", ", expand=True)
    return ap.assign(**{"class": parts[0], "level": parts[1]}) if len(ap) else ap


def _between(frame: pd.DataFrame) -> pd.DataFrame:
    """Paired differences of average precision between each TruPercept method and the one before it."""
    ap = _of_metric(frame, _AP_METRICS[0], BETWEEN)
    later = ap[ap.method.isin(("trupercept_2", "trupercept_3"))]
    on = ["replicate", "city", "class", "level", "self_reports", "setting"]
    pairs = later.assign(before=later.method.map(before_of)).merge(
        ap[[*on, "method", "value"]], left_on=[*on, "before"], right_on=[*on, "method"], suffixes=("", "_before")
    )
    rows = _with_change(pairs.assign(value=pairs.value - pairs.value_before), ap.iloc[:0], on)
    return rows.assign(paper=float("nan"), paper_change=float("nan"))


def _precision(frame: pd.DataFrame, name: str, metric: str, what: str) -> pd.DataFrame:
    """Average precision with that of the paper, and its change."""
    ap = _of_metric(frame, metric, what)
    reference = ap[ap.method == "local"] if name == "tables" else ap[ap.setting == "trustworthy"]
    on = ["replicate", "city", "class", "level", "self_reports", "setting" if name == "tables" else "method"]
    rows = _with_change(ap, reference, on)
    printed = [AP[key] for key in zip(rows.method, rows["class"], rows.level, strict=True)]
    base = [AP["local", label, level] for label, level in zip(rows["class"], rows.level, strict=True)]
    printed = printed if metric == _AP_METRICS[0] else [float("nan")] * len(rows)  # the paper has 11 points
    rows = rows.assign(paper=printed).assign(paper_change=lambda r: r.paper - base)
    if name != "tables":
        rows = rows.assign(paper=rows.paper.where(rows.setting == "trustworthy"), paper_change=float("nan"))
    order = {level: i for i, level in enumerate(LEVELS)}
    return rows.sort_values("level", key=lambda c: c.map(order), kind="stable").sort_values(
        ["city", "class"], kind="stable"
    )


def _final_trust(frame: pd.DataFrame) -> pd.DataFrame:
    """Mean trust at the end, of vehicles drawn as attackers and of all others."""
    frame = frame[(frame.metric == "paper.final_trust.mean") & (frame.method.isin(("local", "trupercept_1")))]
    what = "mean trust at the end, " + pd.Series("drawn as attackers", frame.index).where(
        frame.group != "honest", "all others"
    )
    rows = _with_change(frame.assign(what=what), frame.iloc[:0].assign(what=""), ["replicate"])
    printed = rows.setting.map(FINAL_TRUST).where((rows.setting == "trustworthy") == rows.what.str.endswith("others"))
    return rows.assign(paper=printed.where(rows.method == "local"), paper_change=float("nan"))


def _further(frame: pd.DataFrame, what: str, group: str) -> pd.DataFrame:
    """A figure that does not depend on the fusion method. The paper prints none of these."""
    if group:
        frame = frame[(frame.group == frame.setting.map(group.format)) & (frame.setting != "trustworthy")]
    if "believed" not in what:
        frame = frame[frame.method == "local"]
    if what.startswith(("egos", "frames", "encounter")):
        frame = frame[(frame.setting == "trustworthy") & frame.self_reports]
    rows = _with_change(frame.assign(what=what), frame.iloc[:0].assign(what=""), ["replicate"])
    return rows.assign(paper=float("nan"), paper_change=float("nan"))


def _with_change(frame: pd.DataFrame, reference: pd.DataFrame, on: list[str]) -> pd.DataFrame:
    """Means with intervals, and paired differences against matching rows of the reference, also with intervals."""
    rows = studies.intervals(frame, _FIRST)
    pairs = frame.merge(reference[[*on, "value"]], on=on, suffixes=("", "_reference"))
    apart = studies.intervals(pairs.assign(value=pairs.value - pairs.value_reference), _FIRST)
    apart = apart.rename(columns={"mean": "change", "low": "change_low", "high": "change_high"}).drop(columns="n")
    return rows.merge(apart, on=_FIRST, how="left")
