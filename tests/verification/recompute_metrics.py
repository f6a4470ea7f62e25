"""All metrics of a run again, from its Parquet files and the definitions of `results/TABLES.md` alone.

It takes runs of every record level, with roadside units, `[[sensing_groups]]`, generation rules, and local trust.
It shares no code with `results`: files are read with pandas, and every metric is written as its definition says.
`python -m tests.verification.recompute_metrics RUN...` compares each with `cosim measure`. Not recomputed here: average
precision (held against KITTI's devkit in `tests/addons/perception/test_kitti.py`), conflicts, overlaps and braking
waves (held against SUMO's SSM device in `tests/addons/driver/test_safety.py`).
"""

import json
import math
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

NOT_HERE = (
    "detection.ap40", "safety.ttc", "safety.drac", "safety.pet", "safety.near_misses",
    "safety.collisions", "safety.wave",
)  # fmt: skip
"""Beginnings of the metrics that are not recomputed."""
STATE = {"evaluated": "evaluated", "unevaluated": "unevaluated", "stale": "stale", "no_value": "no value"}
FALSE_POSITIVES, FRESH_S = 0.05, 10.0


class Folder:
    """The files of a run."""

    def __init__(self, path, variant="base"):
        self.path, self.variant = Path(path), variant
        self.manifest = json.loads((self.path / "manifest.json").read_text())
        self.dt_s, self.steps = float(self.manifest["dt_s"]), int(self.manifest["steps"])
        self.config = self.manifest["config"]
        self.threshold = float(self.config["trust"]["suspect_below"])
        self.least = int(self.config["trust"]["suspect_from"])
        self.sensing_s = float(self.config.get("sensing_interval_s", self.dt_s))

    def table(self, name):
        """Rows of the variant, in the order of the files; labels as text, numbers as floats where they may be null."""
        parts = [pq.read_table(file, partitioning=None).to_pandas()
                 for file in sorted((self.path / name).glob("part-*.parquet"))]  # fmt: skip
        if not parts:
            return pd.DataFrame()
        frame = pd.concat(
            [p.assign(**{c: p[c].astype(object) for c in p if isinstance(p[c].dtype, pd.CategoricalDtype)})
             for p in parts], ignore_index=True,
        )  # fmt: skip
        return frame[frame.variant == self.variant].reset_index(drop=True) if "variant" in frame else frame


def recompute(path, variant="base"):
    """Every metric: {(metric, group): value}."""
    of = Folder(path, variant)
    found = {}
    for topic in (traffic, encounters, trust, misbehaviour, security, evidence, freshness, radio, detection, attack,
                  safety):  # fmt: skip
        found |= {(f"{topic.__name__}.{name}", group): value for name, group, value in topic(of)}
    return {key: value for key, value in found.items() if value == value}


def vehicles(of):
    return of.table("vehicles").set_index("vehicle")


def interval_steps(of):
    """Steps from one sweep of each equipped vehicle to its next one."""
    return vehicles(of).sensing_interval_steps.dropna().astype(int)


def on_road_steps(of):
    """Steps that each vehicle is on the road, by the poses of all steps where the run keeps them."""
    rows, who = of.table("actors"), vehicles(of)
    if not len(rows):
        return who.n_steps
    return rows.groupby("actor").size().reindex(who.index, fill_value=0)


def subjects(of):
    """Pseudonyms: vehicle, role, from_step, to_step, and the first attack of the vehicle."""
    return of.table("pseudonyms").set_index("pseudonym").join(vehicles(of)[["role", "attack_start_step"]], on="vehicle")


def survives(lasted, over):
    """Kaplan and Meier's curve in fractions: [(duration, share that lasts longer)]."""
    lasted, over = np.asarray(lasted, float), np.asarray(over, bool)
    share, curve = Fraction(1), []
    for time in np.unique(lasted):
        share *= 1 - Fraction(int(((lasted == time) & over).sum()), int((lasted >= time).sum()))
        curve.append((float(time), share))
    return curve


def km_median(lasted, over):
    return next((time for time, share in survives(lasted, over) if share <= Fraction(1, 2)), np.nan)


def km_mean(lasted, over):
    area, before_s, share = 0.0, 0.0, Fraction(1)
    for time, after in survives(lasted, over):
        area, before_s, share = area + float(share) * (time - before_s), time, after
    return area


def auc(high, low):
    """Share of pairs in which the first is above the second, ties counting half."""
    if not len(high) or not len(low):
        return np.nan
    low = np.sort(low)
    return float(np.mean([np.searchsorted(low, x, "left") + np.searchsorted(low, x, "right") for x in high]) / 2
                 / len(low))  # fmt: skip


def traffic(of):
    who = vehicles(of)
    time = on_road_steps(of)
    yield "duration_s", "", of.steps * of.dt_s
    is_traffic = ~who.sumo_id.str.startswith(("parked/", "object/", "roadside/"))
    yield "actors.mean", "all", time[is_traffic].sum() / of.steps
    yield "actors.mean", "equipped", time[who.equipped].sum() / of.steps
    for role in of.manifest["roles"]:
        yield "equipped.n", role, (who.role[who.equipped] == role).sum()


def definitions(frame):
    """Encounters by definition, with its name: kind of pairs and radius."""
    for (pairs, radius_m), some in frame.groupby(["pairs", "radius_m"]):
        yield f"{pairs}, {radius_m:g} m", some


def encounters(of):
    who = vehicles(of)
    on_road_h = on_road_steps(of) * of.dt_s / 3600
    for name, some in definitions(of.table("encounters")):
        seen = some[~some.censored_left.astype(bool)]
        end = of.steps - max(1, math.ceil(some.hysteresis_s.iloc[0] / of.dt_s - 1e-6))
        cut = (seen.end_step > end) | seen.censored_right.astype(bool)
        until = seen.end_step.astype(int).where(~cut, seen.end_step - 1).clip(upper=end)
        over = ~cut[until > seen.start_step]
        duration_s = (until - seen.start_step)[until > seen.start_step] * of.dt_s
        yield "n", name, len(some)
        yield "censored_left.share", name, some.censored_left.mean()
        yield "censored_right.share", name, some.censored_right.mean()
        yield "duration.mean_s", name, some.duration_s.astype(float).mean()
        yield "duration.median_s", name, some.duration_s.astype(float).median()
        yield "duration.km_mean_s", name, km_mean(duration_s, over)
        yield "duration.km_median_s", name, km_median(duration_s, over)
        yield "again.share", name, some.gap_s.notna().mean()
        stands = (who.vehicle_class == "roadside_unit") | who.sumo_id.str.startswith("parked/")
        of_all = ~stands & ((who.vehicle_class != "pedestrian") | some.pedestrians.any())
        counts = who.equipped if name.startswith(("equipped", "los")) else of_all
        yield "per_vehicle_h", name, 2 * len(seen) / on_road_h[counts.astype(bool)].sum()


VALUE = ["step", "subject", "trust", "evaluated", "enough"]
"""Columns of a value; `begins` is the first step of those that it is a mean of."""


def values(of):
    """Trust in pseudonyms while in use, with the columns of `VALUE`; the server's, or means over receivers."""
    frame = of.table("trust")
    if len(frame):
        n = frame.n_evaluations
        frame = frame.assign(begins=frame.step, evaluated=n > 0, enough=n >= of.least)
    else:
        looked = of.table("trust_lookups")
        if not len(looked):
            return pd.DataFrame(columns=[*VALUE, "role", "begins"])
        own = looked[(looked.source == "own") & (looked.n_evaluations > 0)]
        own = own[own.step <= own.subject.map(subjects(of).to_step)]
        interval = max(interval_steps(of), default=1)
        last = looked.groupby(looked.step // interval).step.max()
        own = own.assign(step=(own.step // interval).map(last))
        frame = own.groupby(["step", "subject"], as_index=False)[["trust", "n_evaluations"]].mean()
        begins = frame.step // interval * interval
        frame = frame.assign(begins=begins, evaluated=True, enough=frame.n_evaluations >= of.least)
    frame = frame.assign(trust=frame.trust.astype(float))
    frame = frame[frame.begins <= frame.subject.map(subjects(of).to_step)]
    return frame.assign(role=frame.subject.map(subjects(of).role))[[*VALUE, "role", "begins"]]


def watched(of):
    """Pseudonyms to be classified: role, since, until; none in a run without attacks."""
    who = subjects(of)
    begin = who.attack_start_step.where(who.role != "honest", who.attack_start_step.min())
    who = who.assign(since=np.maximum(begin, who.from_step), until=who.to_step.clip(upper=of.steps - 1))
    return who[who.since.notna() & (who.since <= who.until)]


def pairs(of):
    """Every step with values and every subject watched at it, with its value if it has one."""
    known, who = values(of), watched(of)
    steps = known[["step", "begins"]].drop_duplicates().sort_values("step")
    every = steps.merge(who.rename_axis("subject").reset_index()[["subject", "role", "since", "until"]], how="cross")
    every = every[(every.since <= every.step) & (every.begins <= every.until)]
    every = every.merge(known[VALUE], "left", on=["step", "subject"])
    return every.assign(evaluated=every.evaluated.eq(True), enough=every.enough.eq(True))


def trust(of):
    frame = values(of)
    for role, some in frame.groupby("role"):
        last = some.sort_values("step", kind="stable").groupby("subject").trust.last()
        yield "final.median", role, last.median()
        yield "final.mean", role, last.mean()
        yield "run.mean", role, some.trust.mean()


def first_low(of, frame, threshold):
    """First step, while watched, with a value below the threshold that rests on enough evaluations, by subject."""
    who = watched(of)
    low = frame[frame.enough & (frame.trust < threshold) & frame.subject.isin(who.index)]
    low = low[(low.step >= low.subject.map(who.since)) & (low.step <= low.subject.map(who.until))]
    return low.groupby("subject").step.min()


def detection_times(of, frame, threshold, name):
    who = watched(of)
    first = first_low(of, frame, threshold).reindex(who.index)
    delay_s = (first.fillna(who.until) - who.since) * of.dt_s
    for role, some in who.groupby("role"):
        yield f"{name}.share", role, first[some.index].notna().mean()
        yield f"{name}.median_s", role, km_median(delay_s[some.index], first[some.index].notna())


def lookups(of):
    """Rows of `trust_lookups` with `evaluated`, `enough` and the role of the subject."""
    looked = of.table("trust_lookups")
    if not len(looked):
        return looked
    return looked.assign(
        trust=looked.trust.astype(float),
        evaluated=looked.n_evaluations > 0,
        enough=looked.n_evaluations >= of.least,
        role=looked.subject.map(subjects(of).role),
    )


def misbehaviour(of):
    frame = values(of)
    for role, some in frame.groupby("role"):
        yield "below_threshold.share", role, (some.trust < of.threshold).mean()
        yield "below_threshold.evaluated_share", role, (some.trust[some.evaluated] < of.threshold).mean()
    if watched(of).empty:
        return
    looked = lookups(of)
    if len(looked):
        yield from at_lookup(of, looked)
    if frame.empty:
        return
    every = pairs(of)
    rated = every[every.evaluated]
    honest = rated.trust[rated.role == "honest"]
    at = int(np.floor(FALSE_POSITIVES * len(honest) + 1e-9))
    limit = np.sort(honest)[at] if len(honest) else np.nan
    yield "fpr_threshold", "", limit
    yield "evaluated.share", "honest", every.evaluated[every.role == "honest"].mean()
    for role, some in every.groupby("role"):
        if role == "honest":
            continue
        mine = rated.trust[rated.role == role]
        yield "attackers.n", role, some.subject.nunique()
        yield "evaluated.share", role, some.evaluated.mean()
        yield "auc", role, auc(honest, mine)
        yield "auc_unevaluated", role, auc(every.trust[every.role == "honest"].dropna(), some.trust.dropna())
        if limit == limit:
            yield "recall_at_fpr", role, (mine < limit).mean()
            yield "suspected_at_fpr.share", role, (some.enough & (some.trust < limit)).mean()
    last = rated.sort_values("step", kind="stable").groupby("subject").last()
    yield "auc_final", "", auc(last.trust[last.role == "honest"], last.trust[last.role == "malicious"])
    at_server = len(of.table("trust")) > 0
    kept = frame if at_server else looked
    yield from detection_times(of, kept, of.threshold, "time_to_detection")
    if limit == limit:
        yield from detection_times(of, kept, limit, "time_to_detection_at_fpr")
    if at_server and len(looked):
        yield from detection_times(of, looked, of.threshold, "time_to_detection_at_vehicle")


def at_lookup(of, looked):
    who = watched(of)
    mine = looked[looked.subject.isin(who.index)]
    mine = mine[(mine.step >= mine.subject.map(who.since)) & (mine.step <= mine.subject.map(who.until))]
    honest = mine.trust[mine.evaluated & (mine.role == "honest")]
    for role, some in mine.groupby("role"):
        low = some.enough & (some.trust < of.threshold)
        yield "at_lookup.evaluated.share", role, some.evaluated.mean()
        yield "at_lookup.suspected.share", role, low.mean()
        if role != "honest":
            yield "at_lookup.auc", role, auc(honest, some.trust[some.evaluated])
        by_pair = some.groupby(["receiver", "subject"]).step.agg(["min", "max"])
        first = some[low].groupby(["receiver", "subject"]).step.min().reindex(by_pair.index)
        waited_s = (first.fillna(by_pair["max"]) - by_pair["min"]) * of.dt_s
        yield "at_lookup.time_to_detection.share", role, first.notna().mean()
        yield "at_lookup.time_to_detection.median_s", role, km_median(waited_s, first.notna())


def rates(attacks, excluded):
    tp, fp = float((attacks & excluded).sum()), float((~attacks & excluded).sum())
    fn, tn = float((attacks & ~excluded).sum()), float((~attacks & ~excluded).sum())

    def over(a, b):
        return a / b if b else np.nan

    yield "precision", over(tp, tp + fp)
    yield "recall", over(tp, tp + fn)
    yield "fpr", over(fp, fp + tn)
    yield "f1", over(2 * tp, 2 * tp + fp + fn)
    yield "mcc", over(tp * tn - fp * fn, ((tp + fp) * (tp + fn) * (tn + fp) * (tn + fn)) ** 0.5)
    yield "informedness", over(tp, tp + fn) - over(fp, fp + tn)


def security(of):
    if watched(of).empty or values(of).empty:
        return
    every = pairs(of).sort_values(["step", "subject"])
    sent = of.table("detections")
    now = every.assign(attacks=every.role != "honest", excluded=every.enough & (every.trust < of.threshold))
    units = [("value", now), ("pseudonym", now.groupby("subject").tail(1))]
    if len(sent):
        units.append(("message", messages(of, sent, now)))
    for unit, some in units:
        for name, value in rates(some.attacks.astype(bool), some.excluded.astype(bool)):
            yield name, unit, value
    times, watched_s = 0, 0.0
    for _, one in now[~now.attacks].groupby("subject"):
        flags = one.excluded.to_numpy()
        watched_s += (one.step.max() - one.step.min()) * of.dt_s
        if one.step.max() > one.step.min():
            times += int((flags[1:] & ~flags[:-1]).sum())
    yield "false_exclusions_per_h", "", times / (watched_s / 3600) if watched_s else np.nan
    rated = every[every.evaluated].sort_values("trust", kind="stable")
    attacks, n_attacks = rated.role != "honest", (every.role != "honest").sum()
    area, before = 0.0, 0.0
    for limit in np.unique(rated.trust):
        below = rated.trust <= limit
        recall = (attacks & below).sum() / n_attacks
        area, before = area + (attacks & below).sum() / below.sum() * (recall - before), recall
    yield "average_precision", "", area
    for role, some in rated.groupby("role"):
        yield "trust_error", role, (some.trust - (role == "honest")).abs().mean()
    if of.variant == "base" and of.config.get("pseudonyms", {}).get("revocation", "none") != "none":
        who = watched(of)
        by = who.groupby("vehicle").agg({"role": "first", "since": "min", "until": "max", "refused_step": "min"})
        delay_s = (by.refused_step.fillna(by.until) - by.since).clip(lower=0) * of.dt_s
        for role, some in by.groupby("role"):
            yield "time_to_exclusion.share", role, some.refused_step.notna().mean()
            yield "time_to_exclusion.median_s", role, km_median(delay_s[some.index], some.refused_step.notna())


def messages(of, sent, now):
    """Messages with detections of watched subjects: whether a detection lied, and whether its sender was excluded."""
    who = watched(of)
    one = sent.groupby(["step", "observer"])[["lied", "transmitted"]].any().reset_index()
    one = one[one.observer.isin(who.index) & one.transmitted]  # of the others nothing was sent
    one = one[(one.step >= one.observer.map(who.since)) & (one.step <= one.observer.map(who.until))]
    flags = now.pivot(index="step", columns="subject", values="excluded")
    excluded = []
    for step, sender in zip(one.step, one.observer, strict=True):
        known = flags[sender].loc[:step].dropna() if sender in flags else []
        excluded.append(bool(len(known) and known.iloc[-1]))
    return pd.DataFrame({"attacks": one.lied.to_numpy(bool), "excluded": excluded})


def evidence(of):
    total = of.table("evidence").sum(numeric_only=True)
    fused = of.table("fused_evidence")
    yield "trust.multiplicity", "", ratio(total.n_evaluations, total.n_looks)
    yield "echoes.share", "", ratio(total.n_echoes, total.n_evaluations)
    yield "copies_per_evaluation", "", ratio(total.n_copies, total.n_evaluations)
    if len(fused):
        yield "fused.multiplicity", "", ratio(fused.n_evaluations.sum(), fused.n_evaluators.sum())
    objects = of.table("fused") if (of.path / "fused").is_dir() else ()
    if len(objects):
        yield "fused.evaluators.mean", "", ratio(fused.n_evaluators.sum(), len(objects))
    made, boxes = of.table("evaluations"), of.table("detections")
    if not len(made) or not len(boxes):
        return
    yield from ideal_observer(of, made)
    yield from repeated(of, made, boxes)
    made = made[made.kind == "detection"] if "kind" in made else made
    who = subjects(of)
    own = boxes[(boxes.origin == "sensed") & boxes.transmitted & ~boxes.lied]
    own = own[own.observer.map(who.role) == "honest"]
    yield "no_actor.share", "all", own.truth_actor.isna().mean()
    for label, some in own.groupby("class"):
        yield "no_actor.share", label, some.truth_actor.isna().mean()
    made = made[(made.visibility > 0) & ~made.lied & (made.evaluator.map(who.role) == "honest")]
    made = made[made.observer.map(who.role).notna()]  # not those of roadside units
    made = made.assign(of_step=made.detection_step if "detection_step" in made else made.step)
    of_step = boxes.rename(columns={"step": "of_step"})
    made = made.merge(of_step, on=["of_step", "observer", "detection_index"], suffixes=("", "_box"))
    made = made[made.transmitted & (~made.lied_box | (made.origin == "fabricated"))]
    made["kind"] = np.where(made.truth_actor.isna(), "false positive", "true detection")
    made.loc[made.origin == "self", "kind"] = "self report"
    made.loc[made.origin == "fabricated", "kind"] = "fabricated"
    is_own = made.evaluator.map(who.vehicle) == made.observer.map(who.vehicle)
    made["evaluator_is"] = np.where(is_own, "the sender", "another vehicle")
    poses = of.table("actors").rename(columns={"actor": "at"})[["step", "at", "x_m", "y_m"]]
    made = made.assign(at=made.evaluator.map(who.vehicle)).merge(poses, on=["step", "at"], suffixes=("", "_at"))
    away_m = np.hypot(made.x_m - made.x_m_at, made.y_m - made.y_m_at)
    near = ((20, "0 to 20 m"), (40, "20 to 40 m"), (60, "40 to 60 m"), (np.inf, "over 60 m"))
    made["distance"] = [next(name for top, name in near if d <= top) for d in away_m]
    names = {0.25: "0 to 0.25", 0.5: "0.25 to 0.5", 0.75: "0.5 to 0.75", 1.0: "0.75 to 1"}
    made["seen"] = [next(name for top, name in names.items() if v <= top) for v in made.visibility]
    made["role"] = made.observer.map(who.role)
    others = made[made.evaluator_is != "the sender"]
    for kind, some in others.groupby("kind"):
        yield "denied.share", kind, (some.evaluation < 0).mean()
        yield "confirmed.share", kind, (some.evaluation > 0).mean()
        if kind in ("self report", "true detection"):
            yield "denied_unseen.share", kind, unseen(some[some.evaluation < 0], boxes)
    for (kind, by), some in made.groupby(["kind", "evaluator_is"]):
        yield "denied.share", f"{kind}, evaluator {by}", (some.evaluation < 0).mean()
        yield "confirmed.share", f"{kind}, evaluator {by}", (some.evaluation > 0).mean()
    for by, column in (("class", "class"), ("visibility", "seen"), ("distance", "distance"), ("role", "role")):
        for (kind, value), some in others[others.kind != "fabricated"].groupby(["kind", column]):
            yield "denied.share", f"{kind}, {by} {value}", (some.evaluation < 0).mean()


def repeated(of, made, boxes):
    """What the same vehicle says again, counted with sets and lists of verdicts."""
    vehicle, role = subjects(of).vehicle.to_dict(), subjects(of).role
    units = set(role.index[role.isna()])
    actor = {
        (step, by, index): int(who)
        for step, by, index, sent, who in boxes[["step", "observer", "detection_index", "transmitted", "truth_actor"]]
        .itertuples(index=False) if sent and who == who
    }  # fmt: skip
    age = made.detection_step if "detection_step" in made else made.step
    kind = made.kind if "kind" in made else ["detection"] * len(made)
    n, looks, spans, witnesses, pairs_of, verdicts = 0, set(), set(), {}, {}, {}
    for step, sensed, by, subject, index, e, seen, what in zip(
        made.step, age, made.evaluator, made.observer, made.detection_index, made.evaluation, made.visibility, kind,
        strict=True,
    ):  # fmt: skip
        who = actor.get((sensed, subject, index))
        is_own = vehicle[by] == vehicle[subject] or subject in units
        if what != "detection" or seen <= 0 or who is None or is_own:
            continue
        n += 1
        one = vehicle[by], subject, who
        spans.add((one, int(step * of.dt_s / 10 + 1e-9)))
        if (one, step) not in looks:
            looks.add((one, step))
            witnesses.setdefault(one, []).append(e < 0)
            pairs_of.setdefault(one[:2], []).append(e < 0)
            verdicts.setdefault((sensed, subject, who), []).append(e < 0)
    for span, distinct in (("step", looks), ("10 s", spans), ("run", witnesses)):
        yield "repeats.distinct.share", span, ratio(len(distinct), n)
    for name, groups in (
        ("same evaluator, object", witnesses), ("same evaluator", pairs_of), ("same object, step", verdicts),
    ):  # fmt: skip
        sizes = [len(said) for said in groups.values()]
        pairs = sum(m * (m - 1) for m in sizes)
        if not pairs:
            continue
        agree = sum(said.count(one) - 1 for said in groups.values() for one in said) / pairs
        denied = sum(sum(said) * (len(said) - 1) for said in groups.values()) / pairs
        chance = denied**2 + (1 - denied) ** 2
        if chance == 1:
            continue
        kappa = (agree - chance) / (1 - chance)
        yield "repeats.agreement.kappa", name, kappa
        yield "repeats.effective.share", name, sum(m / (1 + (m - 1) * max(kappa, 0)) for m in sizes) / sum(sizes)


def ideal_observer(of, made):
    """Clues are counted with dictionaries, subject by subject."""
    who, roles = watched(of), subjects(of).role.dropna()
    attackers = set(roles.index[roles != "honest"])
    made = made[(made.visibility > 0) & (made.evaluator != made.observer)].copy()
    made["x"] = made.evaluation.astype(float) * made.visibility.astype(float)
    made["bin"] = [
        next(i for i, end in enumerate((-0.95, -0.5, -0.1, 0, 0.1, 0.5, 0.95, 1)) if x <= end) for x in made.x
    ]
    kinds = {"detection": 0, "missing": 1, "speed": 2}
    made["kind_number"] = made.kind.map(kinds) if "kind" in made else 0
    step = made.detection_step if "detection_step" in made else made.step
    of_claim = made.groupby([step.rename("of"), "observer", "detection_index", "kind_number"]).x
    total, n = of_claim.transform("sum") - made.x, of_claim.transform("size") - 1
    made["others"] = np.where((n == 0) | (made.kind_number == 1), 0, np.where(total < 0, 1, 2))
    for role in sorted(set(who.role) - {"honest"}):
        some = who[who.role.isin(["honest", role])]
        best = np.nan
        for name, known in (("auc_bound_alone", False), ("auc_bound", True)):
            clues = {subject: [] for subject in some.index}
            for row in made.itertuples():
                value = row.kind_number * 8 + row.bin
                if row.observer in clues and some.since[row.observer] <= row.step <= some.until[row.observer]:
                    clues[row.observer].append(value * 2 + (known and row.evaluator in attackers))
                if row.evaluator in clues and some.since[row.evaluator] <= row.step <= some.until[row.evaluator]:
                    cell = 48 + (value * 3 + row.others) * 2 + (known and row.observer in attackers)
                    clues[row.evaluator].append(cell)
            vehicle = subjects(of).vehicle.to_dict()
            attacks = {subject: some.role[subject] == role for subject in clues}
            best = np.fmax(best, separated(clues, attacks, vehicle))
            yield name, role, best


def separated(clues, attacks, vehicle):
    """Pair by pair: likelihood ratios with shares of the clues of all other vehicles."""
    cells = sorted({cell for listed in clues.values() for cell in listed})
    counts = {one: np.array([listed.count(cell) for cell in cells], float) for one, listed in clues.items()}
    roles = {role: [one for one in clues if attacks[one] == role] for role in (True, False)}
    if min(len({vehicle[one] for one in listed}) for listed in roles.values()) < 2:
        return np.nan

    def logs(one):
        others = [other for other in clues if vehicle[other] != vehicle[one]]
        mean = (sum(counts[other] for other in others) + 0.5) / len(others)
        count = mean + sum(counts[other] for other in others if attacks[other] == attacks[one])
        return np.log(count / count.sum())

    log, n = {one: logs(one) for one in clues}, {one: max(len(listed), 1) for one, listed in clues.items()}
    wins = {"sum": [], "mean": []}
    for a in roles[True]:
        for h in roles[False]:
            of_a, of_h = (float(counts[one] @ (log[a] - log[h])) for one in (a, h))
            for name, above in (("sum", of_a - of_h), ("mean", of_a / n[a] - of_h / n[h])):
                wins[name].append((1 + np.sign(np.round(above, 9))) / 2)
    return max(float(np.mean(each)) for each in wins.values())


def unseen(denials, boxes):
    """Share of denials whose evaluator detected nothing of the actor in that step."""
    sensed = boxes[(boxes.origin == "sensed") & boxes.truth_actor.notna()]
    there = set(zip(sensed.step, sensed.observer, sensed.truth_actor.astype(int), strict=True))
    rows = zip(denials.step, denials.evaluator, denials.truth_actor.astype(int), strict=True)
    return float(np.mean([row not in there for row in rows]))


def ratio(a, b):
    return a / b if b else np.nan


def freshness(of):
    who, computed = subjects(of), of.table("trust")
    for role, some in computed.groupby(computed.subject.map(who.role)) if len(computed) else ():
        evaluated = some.state == "evaluated"
        yield "server_unevaluated.share", role, (~evaluated).mean()
        yield "server_newest_evaluation.median_s", role, some.newest_evaluation_age_s[evaluated].astype(float).median()
    equipped = vehicles(of).index[vehicles(of).equipped]
    met = of.table("encounters")
    if of.variant != "base":
        key = ["a", "b", "start_step", "radius_m", "pairs", "hysteresis_s", "los", "pedestrians"]
        mine = of.table("encounter_trust")[[*key, "trusted_after_ab_s", "trusted_after_ba_s"]]
        met = met.drop(columns=["trusted_after_ab_s", "trusted_after_ba_s"]).merge(mine, on=key)
    met = met[met.a.isin(equipped) & met.b.isin(equipped)]
    for name, some in definitions(met):
        after_s = np.r_[some.trusted_after_ab_s.astype(float), some.trusted_after_ba_s.astype(float)]
        yield "encounters_without_trust.share", name, np.isnan(after_s).mean()
        yield "wait_in_encounter.median_s", name, np.median(after_s[after_s > 0]) if (after_s > 0).any() else np.nan
    looked = lookups(of)
    if not len(looked):
        yield from totals(of)
        return
    for role, some in [("all", looked), *looked.groupby("role")]:
        for stored, state in STATE.items():
            yield "lookup_state.share", f"{state}, {role}", (some.state == stored).mean()
        newest_s = some.newest_evaluation_age_s.astype(float)
        yield "evaluation_within.share", role, (newest_s <= FRESH_S).mean()
        capped_s = np.clip(newest_s.fillna(np.inf), None, window_s(of))
        yield "capped_age.mean_s", role, capped_s.mean()
        yield "capped_age.median_s", role, np.quantile(capped_s, 0.5)
        yield "capped_age.p90_s", role, np.quantile(capped_s, 0.9)
        for name, column in AGES.items():
            age_s = some[column].dropna().astype(float)
            if len(age_s):
                yield f"{name}_age.mean_s", role, age_s.mean()
                yield f"{name}_age.median_s", role, np.quantile(age_s, 0.5)
                yield f"{name}_age.p90_s", role, np.quantile(age_s, 0.9)
    some = looked[looked.newest_evaluation_age_s.notna()]
    yield "evaluations.mean", "", some.n_evaluations.mean()
    yield "evaluators.mean", "", some.n_evaluators.astype(float).mean()
    for name in ("value", "newest_evaluation"):
        yield from sawtooth(of, looked, name)


def totals(of):
    """Shares of states and mean ages of all lookups, where single ones were not kept."""
    by_state = of.table("lookup_totals").groupby("state").sum(numeric_only=True)
    by_state = by_state.reindex(list(STATE), fill_value=0).astype(float)
    for stored, state in STATE.items():
        yield "lookup_state.share", f"{state}, all", by_state.n[stored] / by_state.n.sum()
    n_known = by_state.n[["evaluated", "stale"]].sum()
    for name, column in AGES.items():
        n = by_state.n_valued.sum() if name == "value" else n_known
        yield f"{name}_age.mean_s", "all", ratio(by_state[column.replace("_s", "_sum_s")].sum(), n)


AGES = {
    "value": "age_s", "newest_evaluation": "newest_evaluation_age_s", "oldest_evaluation": "oldest_evaluation_age_s",
}  # fmt: skip


def window_s(of):
    """How long evidence counts in the variant; the recorded time if for ever."""
    trust = of.config["trust"]
    if of.variant != "base":
        trust = trust | next(one for one in of.config["trust_variant"] if one["name"] == of.variant)
    return of.manifest["steps"] * of.dt_s if trust["freshness_s"] == "off" else float(trust["freshness_s"])


def sawtooth(of, looked, name):
    """Peak age at use, and mean and peak age over time, pair by pair."""
    age_s = looked[AGES[name]].astype(float)
    if name == "value":
        age_s = age_s.where(looked.source == "server")
    at_use, area, time, peaks = [], 0.0, 0.0, []
    frame = looked.assign(age=age_s).sort_values("step", kind="stable")
    interval_s = of.table("vehicles").set_index("vehicle").sensing_interval_steps * of.dt_s
    for (receiver, _), one in frame.groupby(["receiver", "subject"]):
        reach_s = max(3.0, 2 * interval_s.get(receiver, of.sensing_s))
        step, age = one.step.to_numpy(), one.age.to_numpy()
        made_s = step * of.dt_s - age
        for i in range(len(one) - 1):
            if np.isnan(age[i]):
                continue
            renewed, passed_s = made_s[i + 1] > made_s[i] + of.dt_s / 2, (step[i + 1] - step[i]) * of.dt_s
            if renewed:
                at_use.append(age[i])
            if passed_s <= reach_s + 1e-9:
                area, time = area + (age[i] + passed_s / 2) * passed_s, time + passed_s
                if renewed:
                    peaks.append(age[i] + passed_s)
    yield f"{name}_age.peak_s", "", np.mean(at_use) if at_use else np.nan
    yield f"{name}_age_over_time.mean_s", "", area / time if time else np.nan
    yield f"{name}_age_over_time.peak_s", "", np.mean(peaks) if peaks else np.nan


def radio(of):
    frame = of.table("radio")
    if not len(frame) or not frame.n_in_range.sum():
        return
    yield "sent.n", "", frame.n_sent.sum()
    for name, some in (("all", frame), *((kind, frame[frame.message_type == kind]) for kind in ("cpm", "evaluation"))):
        yield f"pdr.{name}", "", ratio(some.n_delivered.sum(), some.n_in_range.sum())
    for cause in ("propagation", "collision", "receiver_busy", "expired", "late"):
        yield f"lost.{cause}", "", frame[f"n_lost_{cause}"].sum() / frame.n_in_range.sum()
    yield "cbr.mean", "", frame.cbr.astype(float).mean()
    for state, some in of.table("pdr_by_distance").groupby("los_state"):
        yield "pdr_by_los", state, ratio(some.n_delivered.sum(), some.n_in_range.sum())
    late = of.table("latency_histogram").groupby("latency_s").n_delivered.sum()
    edges_s = 1e-4 * 2.0 ** (np.arange(-2, 33) / 2)
    for share, name in ((0.5, "median_s"), (0.95, "p95_s")):
        lower_s = late.index[(late.cumsum() >= share * late.sum())][0]
        yield f"latency.{name}", "", edges_s[edges_s > lower_s * (1 + 1e-6)][0]
    gaps = of.table("packet_inter_reception")
    gaps = gaps[gaps.message_type == "cpm"]
    n, every = gaps.n_received, round(of.sensing_s / of.dt_s)
    n_lost = (gaps.pir_steps // every - 1).clip(lower=0)
    yield "pir.mean_s", "", ratio((gaps.pir_steps * n).sum() * of.dt_s, n.sum())
    if not of.config.get("sensing_groups") and of.config["cpm"]["rules"] == "all":
        yield "pir.after_loss.share", "", ratio(n[n_lost > 0].sum(), n.sum())
        yield "lost_in_a_row.mean", "", ratio((n_lost * n).sum(), n[n_lost > 0].sum())
    sent, who = of.table("cpm_content"), vehicles(of)
    if len(sent):
        on_air = sent[sent.length_bytes > 0].astype(float)
        road_s = on_road_steps(of)[who.equipped].sum() * of.dt_s
        yield "cpm_rate.mean_hz", "", len(on_air) / road_s
        yield "cpm_objects.mean", "", on_air.n_included.mean()
        yield "cpm_length.mean_bytes", "", on_air.length_bytes.mean()
        for reason in ("waiting", "not_due", "redundant", "over_limit"):
            share = ratio(sent[f"n_{reason}"].sum(), sent.n_objects.sum())
            yield "cpm_left_out.share", reason.replace("_", " "), share
    clouds = of.table("clouds") if (of.path / "clouds").is_dir() else ()
    if len(clouds):
        bits, got = 8e-6 * clouds.length_bytes.to_numpy(float), clouds.n_received.to_numpy(float)
        got += clouds.n_received_late if "n_received_late" in clouds else 0
        yield "clouds_offered.mean_mbps", "", bits[clouds.sender.isin(who.index[who.equipped])].sum() / road_s
        yield "clouds_delivered.mean_mbps", "", bits @ got / road_s
        yield "clouds_complete.share", "", ratio(got.sum(), clouds.n_in_range.sum())
    server = of.table("server")
    if len(server) and server.n_reports.sum():
        total = server.sum(numeric_only=True)
        total["n_reached"] += total["n_late"]
        total["n_lost"] -= total["n_late"]
        for name in ("reached", "lost", "over_capacity", "outage"):
            yield f"server_reports.{name}.share", "", total[f"n_{name}"] / total.n_reports
        yield "server_broadcasts.reached.share", "", ratio(total.n_informed, total.n_addressed)


def detection(of):
    """Environmental awareness of honest vehicles on the steps that `cosim measure` samples: sweeps, evenly, about 4,000
    frames."""
    who, boxes = vehicles(of), of.table("detections")
    if not len(boxes):
        return
    equipped = who[who.equipped]
    honest = equipped[equipped.role == "honest"]
    every, first = interval_steps(of), equipped.sensing_phase_steps.astype(int)
    stride = max(1, -(-int(((honest.last_step - honest.first_step + 1) / every[honest.index]).sum()) // 4000))
    steps = np.flatnonzero([((step - first) % every == 0).any() for step in range(of.steps)])
    steps = steps[stride // 2 :: stride]
    poses = of.table("actors")
    poses = poses[poses.step.isin(steps)]
    fused = of.table("fused") if (of.path / "fused").is_dir() else pd.DataFrame()
    if len(fused):
        fused = fused.assign(of_step=fused.source_step if "source_step" in fused else fused.step).merge(
            boxes[["step", "observer", "detection_index", "truth_actor"]].rename(columns={"step": "of_step"}),
            "left",
            left_on=["of_step", "source", "source_index"],
            right_on=["of_step", "observer", "detection_index"],
            suffixes=("", "_box"),
        )
    own = boxes[boxes.origin == "sensed"].assign(observer=boxes.observer.map(subjects(of).vehicle))
    early = of.table("early_fused") if (of.path / "early_fused").is_dir() else ()
    for name, known in (("local", own), ("fused", fused), ("early", early)):
        if not len(known):
            continue
        known = known[(known.score >= 0.5) & known.truth_actor.notna()]
        there = set(zip(known.step, known.observer, known.truth_actor.astype(int), strict=True))
        n, n_known = 0, 0
        for step, at in poses.groupby("step"):
            xy = at[["x_m", "y_m"]].to_numpy(float)
            for i in np.flatnonzero(at.actor.isin(honest.index)):
                me = at.actor.iloc[i]
                if (step - first[me]) % every[me]:
                    continue
                near = np.hypot(*(xy - xy[i]).T) <= 70
                around = [a for a in at.actor.to_numpy()[near] if a != me]
                n += len(around)
                n_known += sum((step, me, a) in there for a in around)
        yield "awareness_70m.share", name, ratio(n_known, n)


def attack(of):
    frame = of.table("attack_outcomes")
    if not len(frame):
        return
    who, role = subjects(of), vehicles(of).role
    frame = frame[(frame.effect == "inserted") | ~frame.ego_detected.astype(bool)]
    frame = frame[frame.receiver.map(role) == "honest"].assign(score=frame.score.astype(float))
    frame = frame.assign(attacker=frame.observer.map(who.vehicle), role=frame.observer.map(who.role))
    frame = frame.assign(every=frame.receiver.map(interval_steps(of)))
    for among in ("received", "intended"):
        chosen = frame if among == "received" else frame[frame.intended.astype(bool)]
        for (effect, attacker), some in chosen.groupby(["effect", "role"]):
            name = "believed" if effect == "inserted" else "missing"
            yield f"{name}.pairs.n", f"{among}, {attacker}", len(some)
            for limit in (0.1, 0.3, 0.5, 0.7):
                there = some.score >= limit
                group = f"{limit:g}, {among}, {attacker}"
                yield f"{name}.share", group, (there if effect == "inserted" else ~there).mean()
        lies = chosen[chosen.effect == "inserted"]
        for attacker, some in lies.groupby("role"):
            held = some[some.score >= 0.5]
            total_s = held.every.sum() * of.dt_s
            yield "damage.total_s", f"{among}, {attacker}", total_s
            yield "damage.per_attacker_s", f"{among}, {attacker}", total_s / some.attacker.nunique()
            stretches, length_s = 0, 0.0
            for _, one in held.groupby(["attacker", "receiver"]):
                steps, every = np.unique(one.step), one.every.iloc[0]
                stretches += 1 + int((np.diff(steps) > every).sum())
                length_s += len(steps) * every * of.dt_s
            if stretches:
                yield "believed_duration.mean_s", f"{among}, {attacker}", length_s / stretches
        if len(lies):
            wrong = lies.assign(wrong=lies.in_path.astype(bool) & (lies.score >= 0.5))
            n = wrong.groupby(["receiver", "step"]).wrong.sum()
            yield "false_in_path.share", among, (n > 0).mean()
            yield "false_in_path.boxes_mean", among, n.mean()
    for attacker, some in frame[frame.effect == "inserted"].groupby("role"):
        of_step = "detection_step" if "detection_step" in some else "step"
        best = some.groupby([of_step, "observer", "detection_index"]).score.max()
        for limit in (0.1, 0.3, 0.5, 0.7):
            yield "believed_by_any.share", f"{limit:g}, {attacker}", (best >= limit).mean()


def safety(of):
    poses = of.table("actors")
    if not len(poses):
        return
    who = vehicles(of)
    drives = (who.vehicle_class != "pedestrian") & ~who.sumo_id.str.startswith("parked/")
    poses = poses[poses.actor.map(drives)].sort_values(["actor", "step"])
    km = poses.speed_mps.astype(float).sum() * of.dt_s / 1000
    yield "driven_km", "", km
    placed = poses.actor.map(who.sumo_id.str.startswith("object/"))
    yield "travel_time.s_per_km", "", (~placed).sum() * of.dt_s / km
    counts = {"hard_braking": 0, "emergency_braking": 0, "stops": 0}
    for _, one in poses.groupby("actor"):
        speed, step = one.speed_mps.to_numpy(float), one.step.to_numpy()
        for name, limit in (("hard_braking", 3.0), ("emergency_braking", 4.5)):
            braking = False
            for i in range(len(one)):
                down = (speed[i - 1] - speed[i]) / of.dt_s if i and step[i] == step[i - 1] + 1 else 0.0
                if not braking and down >= limit - 1 / 256 / of.dt_s:
                    counts[name] += 1
                    braking = True
                elif down < 1.0:
                    braking = False
        moving = False
        for i in range(len(one)):
            if i and moving and speed[i] < 0.1:
                counts["stops"] += 1
            moving = speed[i] > 2.0 or (moving and speed[i] >= 0.1)
    for name, n in counts.items():
        yield f"{name}.per_km", "", n / km
    if of.config["driver"]["model"] == "none":
        return
    rows = of.table("reactions")
    rows = rows.sort_values(["vehicle", "step"])
    kinds = np.where(rows.fabricated, "ghost", np.where(rows.truth_actor.notna(), "real", "false positive"))
    for kind in ("ghost", "false positive", "real"):
        n, hard, taken = 0, 0, []
        before = None
        most = 0.0
        for row, its in zip(rows.itertuples(), kinds, strict=True):
            fresh = before is None or before[0] != row.vehicle or (row.step - before[1]) * of.dt_s > 1.0
            fresh = fresh or before[2] != its
            before = (row.vehicle, row.step, its)
            if its != kind:
                continue
            if fresh:
                hard += n > 0 and most >= 3.0
                n, most = n + 1, -np.inf
                taken.append(0.0)
            most = max(most, float(row.deceleration_mps2))
            taken[-1] += max(0.0, float(row.deceleration_mps2)) * of.dt_s
        hard += n > 0 and most >= 3.0
        yield "reactions.n", kind, n
        yield "reactions.per_km", kind, n / km
        yield "reactions_hard.per_km", kind, hard / km
        yield "speed_taken.mean_mps", kind, np.mean(taken) if taken else np.nan


def differences(path, variant="base"):
    """Metrics that differ by more than rounding, or that only one of the two has: (metric, group, measured, again)."""
    from results.archive import open_run
    from results.measure import measure

    table = measure(open_run(path).as_variant(variant))
    table = table[table.value.notna() & ~table.metric.str.startswith(NOT_HERE)]
    measured = {(m, g): float(v) for m, g, v in table[["metric", "group", "value"]].itertuples(index=False)}
    again = recompute(path, variant)
    found = []
    for key in sorted(measured.keys() | again.keys()):
        one, two = measured.get(key, np.nan), float(again.get(key, np.nan))
        if not abs(one - two) <= 1e-7 * max(1.0, abs(two)):  # durations and ages are 32-bit numbers
            found.append((*key, one, two))
    return len(measured), found


if __name__ == "__main__":
    for folder in sys.argv[1:]:
        for name in json.loads((Path(folder) / "manifest.json").read_text()).get("variants", ["base"]):
            n, wrong = differences(folder, name)
            print(f"{folder}, {name}: {n} values, {len(wrong)} differ")
            for row in wrong:
                print("  ", *row)
