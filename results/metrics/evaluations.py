"""How right evaluations are: how often honest vehicles deny what is true, and confirm what is not there.

These rates decide every trust value. Evaluations are those that honest vehicles make, with visibility above 0, of
detections that were sent; unless said otherwise, those that another vehicle sent. An evaluation denies a detection if
it is negative: the detection matches none of the evaluator's own. It confirms it if it is positive. An evaluator that
finds no match but knows nothing about the place (visibility 0, see `trust.denials`) neither denies nor confirms.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from results.metrics.intervals import columns, share
from results.metrics.trust import HONEST
from results.run import Run

KINDS = ("self report", "true detection", "false positive", "fabricated")
"""What is evaluated: the sender's report of itself, a box of its detector that belongs to an actor, one that belongs to
none, and one that an attack made up. Of the first three, only those count that no attack changed."""
SPLITS = ("evaluator", "class", "visibility", "distance", "role")
EVALUATORS = ("the sender", "another vehicle")
_VISIBILITY = (0.0, 0.25, 0.5, 0.75, 1.0)
_DISTANCE_M = (0.0, 20.0, 40.0, 60.0, np.inf)
_MOST_ROWS = 5_000_000
"""Evaluations that suffice: of a run with more, those of evenly spread steps."""


def rates(run: Run) -> pd.DataFrame:
    """Rates of evaluations by what is evaluated, of all and split by one property after another.

    Returns
    -------
    kind (`KINDS`); by ("all" or one of `SPLITS`: whether another vehicle evaluates or the sender its own list, class of
    the detection, visibility and distance of the evaluator to the box, role of the vehicle that sent it); value;
    n (evaluations); denied and confirmed: shares of them; missed: share of the denials in which the evaluator's own
    detector reported nothing of that actor in that step (in the others, its box lies too far away to match). Shares
    have intervals clustered by evaluator.
    """
    counts = run.once_for_all("evaluations.rates", lambda: _counts(run))
    rows = []
    for (by, kind, value), of in counts.groupby(["by", "kind", "value"], sort=True):
        n, denied = of.n.to_numpy(), of.denied.to_numpy()
        row = {"kind": kind, "by": by, "value": value, "n": int(n.sum())}
        for name, top, bottom in (
            ("denied", denied, n), ("confirmed", of.confirmed.to_numpy(), n), ("missed", of.missed.to_numpy(), denied),
        ):  # fmt: skip
            row |= columns(share(top, bottom), name)
        rows.append(row)
    found = pd.DataFrame(rows)
    order = [["all", *SPLITS].index(by) * 10 + KINDS.index(kind) for by, kind in zip(found.by, found.kind, strict=True)]
    return found.iloc[np.argsort(order, kind="stable")].reset_index(drop=True)


def boxes_of_no_actor(run: Run) -> pd.DataFrame:
    """Share of boxes that belong to no actor, among the boxes of their detectors that honest vehicles sent.

    Returns
    -------
    class ("all" first), n, share, with its interval clustered by sender.
    """
    run.require("detections")
    names = ["step", "observer", "class", "truth_actor"]
    sent = (pc.field("origin") == "sensed") & pc.field("transmitted") & ~pc.field("lied")
    frame = run.table("detections", names, sent)
    frame = frame[frame.observer.map(run.subjects.role) == HONEST]
    if frame.empty:
        raise ValueError(f"{run.path} holds no detections of honest vehicles. Equip vehicles, or set sensing = true.")
    rows = []
    for label in ("all", *frame["class"].cat.categories):
        some = frame if label == "all" else frame[frame["class"] == label]
        if len(some):
            of = some.truth_actor.isna().groupby(some.observer).agg(["sum", "size"])
            found = share(of["sum"].to_numpy(float), of["size"].to_numpy(float))
            rows.append({"class": label, "n": len(some)} | columns(found, "share"))
    return pd.DataFrame(rows)


def _counts(run: Run) -> pd.DataFrame:
    """by, kind, value, vehicle (that evaluates), n, denied, confirmed, missed."""
    run.require("evaluations", "detections", "actors")
    stride = max(1, -(-run.n_rows("evaluations") // _MOST_ROWS))
    parts = [_counted(one) for one in _blocks(run, stride)]
    if not parts or not sum(map(len, parts)):
        raise ValueError(f"{run.path} holds no evaluations by honest vehicles. Raise radio.range_m, or equip vehicles.")
    whole = pd.concat(parts, ignore_index=True)
    return whole.groupby(["by", "kind", "value", "vehicle"], as_index=False).sum()


def _blocks(run: Run, stride: int) -> Iterator[pd.DataFrame]:
    """Evaluations that count, block by block: vehicle, evaluator, kind, class, visibility, distance, role, denied,
    confirmed, missed."""
    who = run.subjects
    seen = (pc.field("visibility") > 0) & ~pc.field("lied") & (pc.field("kind") == "detection")
    wanted = ["step", "evaluator", "observer", "detection_index", "detection_step", "evaluation", "visibility"]
    for part in run.parts("evaluations", wanted, seen):
        part = part[(part.step % stride == 0) & (part.evaluator.map(who.role) == HONEST)]
        if part.empty:
            continue
        during = (pc.field("step") >= int(part.detection_step.min())) & (pc.field("step") <= int(part.step.max()))
        made = run.table(
            "detections",
            ["step", "observer", "detection_index", "class", "x_m", "y_m", "origin", "transmitted", "lied",
             "truth_actor"], during,
        )  # fmt: skip
        poses = run.table("actors", ["step", "actor", "x_m", "y_m"], during)
        named = made.rename(columns={"step": "detection_step"})
        part = part.merge(named, on=["detection_step", "observer", "detection_index"])
        part["vehicle"] = part.evaluator.map(who.vehicle)
        part["own"] = part.vehicle == part.observer.map(who.vehicle)
        part = part[part.transmitted & (~part.lied | (part.origin == "fabricated"))]
        part = part.merge(poses, left_on=["step", "vehicle"], right_on=["step", "actor"], suffixes=("", "_there"))
        sensed = made[(made.origin == "sensed") & made.truth_actor.notna()]
        known = pd.MultiIndex.from_arrays([sensed.step, sensed.observer, sensed.truth_actor.astype(int)])
        actor = part.truth_actor.fillna(-1).astype(int)
        missed = ~pd.MultiIndex.from_arrays([part.step, part.evaluator, actor]).isin(known)
        evaluator = np.where(part.own.to_numpy(bool), *EVALUATORS)
        away_m = np.hypot(part.x_m - part.x_m_there, part.y_m - part.y_m_there)
        denied = (part.evaluation < 0).to_numpy()
        yield pd.DataFrame({
            "vehicle": part.vehicle.to_numpy(), "evaluator": evaluator, "kind": _kind(part),
            "class": part["class"].astype(str).to_numpy(),
            "visibility": _bins(part.visibility.to_numpy(float), _VISIBILITY, ""),
            "distance": _bins(np.asarray(away_m, float), _DISTANCE_M, " m"),
            "role": part.observer.map(who.role).astype(str).to_numpy(),
            "denied": denied, "confirmed": (part.evaluation > 0).to_numpy(), "missed": denied & missed,
        })  # fmt: skip


def _kind(part: pd.DataFrame) -> np.ndarray:
    is_actors = part.truth_actor.notna()
    return np.select(
        [part.origin == "self", part.origin == "fabricated", is_actors], [KINDS[0], KINDS[3], KINDS[1]], KINDS[2]
    )


def _bins(values: np.ndarray, edges: tuple[float, ...], unit: str) -> np.ndarray:
    """Names of the bins, each without its lower edge and with its upper one."""
    names = [f"over {low:g}{unit}" if np.isinf(high) else f"{low:g} to {high:g}{unit}" for low, high in pairwise(edges)]
    return np.array(names)[np.clip(np.searchsorted(edges, values, "left") - 1, 0, len(names) - 1)]


def _counted(frame: pd.DataFrame) -> pd.DataFrame:
    frame = frame.assign(n=1, all="all")
    parts = []
    for by in ("all", *SPLITS):
        some = frame if by == "evaluator" else frame[frame.evaluator == EVALUATORS[1]]
        sums = some.groupby(["kind", by, "vehicle"])[["n", "denied", "confirmed", "missed"]].sum().reset_index()
        parts.append(sums.rename(columns={by: "value"}).assign(by=by))
    return pd.concat(parts, ignore_index=True)
