"""Freshness and attack success again, from receptions, evaluations, lists and the server's schedule: plain pandas.

It shares no code with the simulation or with `results`. The links to the server are taken to be perfect: reports of a
step reach it before the next, broadcasts reach at once every vehicle that is on the road.
"""

import numpy as np
import pandas as pd

from tests.solids import iou


def judgements(run):
    """One row per step, evaluator and observer: how many detections of the observer the evaluator could see."""
    said = run.evaluations
    said = said[(said.evaluator != said.observer) & (said.visibility > 0)]
    sent = run.detections[["step", "observer", "detection_index", "transmitted", "score"]]
    said = said.merge(sent, on=["step", "observer", "detection_index"])
    said = said[said.transmitted]
    return said.groupby(["step", "evaluator", "observer"]).size().rename("n").reset_index()


def summed(made, now, window_steps):
    """Per holder and subject: n, evaluators, newest and oldest step of what is younger than the window."""
    fresh = made[(made.step > now - window_steps) & (made.step <= now)]
    return fresh.groupby(["holder", "observer"]).agg(
        n=("n", "sum"), evaluators=("evaluator", "nunique"), newest=("step", "max"), oldest=("step", "min")
    )


def local(run, window_s):
    """What every lookup of a run with `trust.host = "local"` should say, by (step, receiver, subject)."""
    dt_s, every = run.dt_s, run.config["sensing_interval_s"]
    used_s = 2 * 0.4 * every  # two rounds of messages after the sweep
    mine = judgements(run)
    heard = run.receptions
    heard = heard[heard.message_type == "evaluation"]
    own = mine.rename(columns={"evaluator": "holder"}).assign(evaluator=mine.evaluator)
    told = mine.merge(heard[["step", "sender", "receiver"]], left_on=["step", "evaluator"], right_on=["step", "sender"])
    made = pd.concat([own, told.rename(columns={"receiver": "holder"})])[
        ["step", "holder", "observer", "evaluator", "n"]
    ]
    rows = []
    for step, now in heard.groupby("step"):
        behind = summed(made, step, window_s / dt_s)
        wanted = now[["receiver", "sender"]].rename(columns={"receiver": "holder", "sender": "observer"})
        found = wanted.merge(behind, "left", left_on=["holder", "observer"], right_index=True)
        rows.append(found.assign(step=step, used_s=step * dt_s + used_s))
    out = pd.concat(rows)
    return _lookups(out, dt_s, window_s, np.where(out.n.isna(), "no_value", "evaluated"))


def central(run, window_s, period_s):
    """The same with a server that computes every `period_s` from reports of earlier steps, and broadcasts at once."""
    dt_s, every = run.dt_s, run.config["sensing_interval_s"]
    used_s = 2 * 0.4 * every
    made = judgements(run).assign(holder=0)
    known = {}
    for step in range(0, run.manifest["steps"], round(period_s / dt_s)):
        known[step] = summed(made[made.step < step], step, window_s / dt_s).droplevel("holder")
    heard = run.receptions
    heard = heard[heard.message_type == "evaluation"][["step", "sender", "receiver"]]
    heard = heard.rename(columns={"sender": "observer", "receiver": "holder"})
    rows = []
    for step, now in heard.groupby("step"):
        computed = max(s for s in known if s <= step)
        found = now.merge(known[computed], "left", left_on="observer", right_index=True)
        rows.append(found.assign(used_s=step * dt_s + used_s, computed=computed))
    out = pd.concat(rows)
    came_later = out.holder.map(run.vehicles.set_index("vehicle").first_step) > out.computed
    out.loc[came_later, ["n", "evaluators", "newest", "oldest"]] = np.nan
    return _lookups(out, dt_s, window_s, np.where(out.n.isna(), "no_value", "evaluated")).assign(
        value_s=(out.used_s - out.computed * dt_s).to_numpy()
    )


def _lookups(out, dt_s, window_s, state):
    newest_s, oldest_s = out.used_s - out.newest * dt_s, out.used_s - out.oldest * dt_s
    state = np.where((state == "evaluated") & (newest_s >= window_s - 1e-9), "stale", state)
    return pd.DataFrame({
        "step": out.step.to_numpy(), "receiver": out.holder.to_numpy(), "subject": out.observer.to_numpy(),
        "state": state, "newest_s": newest_s.to_numpy(), "oldest_s": oldest_s.to_numpy(),
        "n": out.n.to_numpy(), "evaluators": out.evaluators.to_numpy(),
    })  # fmt: skip


def attacks(run):
    """Fabricated detections and the other vehicles that received them, with the score that they have there or NaN.

    A lie has the score of the fused object whose box it gave, or else of the one whose box another lie of its class
    gave that overlaps it (IoU above 0.1, the largest), unless a real detection overlaps it more: it is then part of a
    real object.
    """
    boxes = run.detections
    lies = boxes[(boxes.origin == "fabricated") & boxes.transmitted]
    heard = run.receptions
    heard = heard[heard.message_type == "cpm"][["step", "sender", "receiver"]]
    pairs = lies.merge(heard, left_on=["step", "observer"], right_on=["step", "sender"]).drop(columns="score")
    fused = run.table("fused", ["step", "variant", "observer", "source", "source_index", "score", "fabricated"])
    fused = fused[fused.variant == run.variant]
    fused = fused.rename(columns={"observer": "receiver", "source": "observer", "source_index": "detection_index"})
    key = ["step", "receiver", "observer", "detection_index"]
    pairs = pairs.merge(fused.loc[fused.fabricated, [*key, "score"]], "left", on=key)
    name = ["step", "observer", "detection_index"]
    rest = pairs[pairs.score.isna()].reset_index()
    near = rest[[*name, "class", *BOX]].drop_duplicates(name)
    near = near.merge(boxes[["step", "observer", "detection_index", "class", "origin", "transmitted", *BOX]],
                      on=["step", "class"], suffixes=("", "_there"))  # fmt: skip
    near = near[near.transmitted & (np.hypot(near.x_m - near.x_m_there, near.y_m - near.y_m_there) < 10)]
    both = (near[[c + end for c in BOX]].to_numpy(float) for end in ("", "_there"))
    near["iou"] = [iou(*pair) for pair in zip(*both, strict=True)]
    near = near[(near.iou > 0.1) & ((near.observer != near.observer_there)
                                    | (near.detection_index != near.detection_index_there))]  # fmt: skip
    real = near[near.origin != "fabricated"].groupby(name).iou.max().rename("real")
    lied = near[near.origin == "fabricated"].join(real, on=name)
    lied = lied[~(lied.real > lied.iou)][[*name, "observer_there", "detection_index_there", "iou"]]
    there = fused.loc[fused.fabricated, [*key, "score"]].set_axis([c + "_there" for c in [*key, "score"]], axis=1)
    there = there.rename(columns={"step_there": "step", "receiver_there": "receiver"})
    rest = rest.merge(lied, on=name).merge(there, on=["step", "receiver", "observer_there", "detection_index_there"])
    best = rest.sort_values("iou").drop_duplicates("index", keep="last").set_index("index")
    pairs.loc[best.index, "score"] = best.score_there
    return pairs


BOX = ["x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad"]
