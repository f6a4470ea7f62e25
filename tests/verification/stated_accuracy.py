"""Matching by stated accuracies against matching by overlap.

`python -m tests.verification.stated_accuracy FOLDER [N [S]]`

In each of three cities, N replicates (3 by default) of S seconds (300 by default) of the default world are simulated
twice, with traffic, detections and attacks of the same seeds: by `gates` and by `iou`. Runs that FOLDER has are not
simulated again, so that more replicates can be added. The table has, of every measure, the means with 95 % intervals
over runs (Student) and the paired difference, for each city and for all. Nothing was tuned on
these seeds, except `trust.suspect_from` on the first two.

A run of Helsinki costs 0.42 s of processor time per simulated second, so that 10 replicates of 300 s in three cities
cost about two hours of a core.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import t as student

from cosim.addons.perception.detection import precision
from results.archive import open_run
from results.measure import measure
from results.metrics.intervals import auc
from results.metrics.trust import HONEST, watched
from results.run import Run

CITIES = ("helsinki", "adlershof", "koenigs-wusterhausen")
FIRST_SEED = 55_001
IOU = {"matching": "iou", "one_per_vehicle": False, "denials": "visibility"}
ARMS = {"gates": {}, "iou": IOU}
METRICS = {
    **{
        f"denied, {name}": f"evidence.denied.share:true detection, class {name}"
        for name in ("pedestrian", "cyclist", "truck", "car")
    },
    "denied, self report": "evidence.denied.share:self report",
    "denied, false positive": "evidence.denied.share:false positive",
    "confirmed, fabricated": "evidence.confirmed.share:fabricated",
    "confirmed, false positive": "evidence.confirmed.share:false positive",
    "AUC of trust at lookup": "misbehaviour.at_lookup.auc:malicious",
    "median trust, honest": "trust.final.median:honest",
    "median trust, malicious": "trust.final.median:malicious",
    "precision of suspicion": "security.precision:value",
    "ever suspected, honest": "misbehaviour.time_to_detection.share:honest",
    "ever suspected, malicious": "misbehaviour.time_to_detection.share:malicious",
    "ghosts believed at 0.5": "attack.believed.share:0.5, received, malicious",
}
"""Measures, and the metric and group of `cosim measure`."""
TOPICS = ("trust", "misbehaviour", "security", "evidence", "attack")


def simulate(folder: Path, city: str, seed: int, arm: str, duration_s: float) -> Path:
    """The run of this seed, simulated if it is not there."""
    out = folder / f"{city}-{seed}-{arm}"
    if not out.exists():
        keys = {
            "preset": "modern", "seed": seed, "traffic": {"scenario": city, "seed": seed, "duration_s": duration_s},
            "trust": ARMS[arm],
        }  # fmt: skip
        code = "import json, sys, cosim; cosim.run(json.loads(sys.argv[1]), sys.argv[2])"
        subprocess.run([sys.executable, "-c", code, json.dumps(keys), str(out)], check=True)
    return out


def plain_auc(run: Run) -> dict[str, float]:
    """AUC against ghosts of two rules without a trust model, of all that a sender sent while it was watched.

    The shares of its boxes that nobody confirms although somebody denies them, and the mean score of its boxes.
    """
    who = watched(run)
    boxes = run.table("detections", ["step", "observer", "detection_index", "origin", "transmitted", "score"])
    boxes = boxes[boxes.transmitted & (boxes.origin != "self") & boxes.observer.isin(who.index)]
    boxes = boxes[boxes.step >= boxes.observer.map(who.since)]
    seen = run.table("evaluations", ["evaluator", "observer", "detection_step", "detection_index", "evaluation",
                                     "visibility", "kind"])  # fmt: skip
    seen = seen[(seen.kind == "detection") & (seen.visibility > 0) & (seen.evaluator != seen.observer)]
    best = seen.groupby(["observer", "detection_step", "detection_index"]).evaluation.max().rename("best")
    boxes = boxes.join(best, on=["observer", "step", "detection_index"])
    role = who.role.astype(str)
    found = {}
    for name, value in (("boxes that all deny", (boxes.best > 0)[boxes.best.notna()]), ("mean score", boxes.score)):
        mean = value.groupby(boxes.observer).mean()
        honest, attacking = (mean[mean.index.map(role) == name].to_numpy(float) for name in (HONEST, "malicious"))
        found[f"AUC, {name}"] = auc(honest, np.arange(len(honest)), attacking, np.arange(len(attacking))).value
    return found


def measures(path: Path) -> dict[str, float]:
    """What one run measures."""
    run = open_run(path)
    frame = measure(run, topics=TOPICS)
    value = frame.set_index(frame.metric + ":" + frame.group).value
    found = {name: float(value.get(key, np.nan)) for name, key in METRICS.items()}
    return found | gains(run) | plain_auc(run)


def gains(run: Run) -> dict[str, float]:
    """By how much the average precision of fused objects is above that of the vehicle's own sensor."""
    strict, loose = (precision(run, ("local", "fused"), max_frames=1000, loose=loose) for loose in (False, True))
    found = {}
    for frame, label, least in ((loose, "car", 0.5), (strict, "car", 0.7), (strict, "pedestrian", 0.5)):
        ap = frame[(frame["class"] == label) & (frame.level == "all")].set_index("boxes").ap40
        found[f"gain of AP40, {label} at {least}"] = float(ap.get("fused", np.nan) - ap.get("local", np.nan))
    return found


def mean_interval(values: np.ndarray) -> str:
    """Mean and 95 % interval of independent runs."""
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return f"{values.mean():.3f}" if len(values) else ""
    half = student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return f"{values.mean():.3f} [{values.mean() - half:.3f}, {values.mean() + half:.3f}]"


def table(runs: pd.DataFrame) -> pd.DataFrame:
    """A row per measure and city: both arms, and their difference within runs."""
    rows = []
    names = [name for name in runs if name not in ("city", "seed", "arm")]
    for name in names:
        pairs = runs.pivot(index=["city", "seed"], columns="arm", values=name)
        for city in ("all", *CITIES):
            some = pairs if city == "all" else pairs[pairs.index.get_level_values("city") == city]
            row = {"measure": name, "city": city, "runs": len(some)}
            row |= {arm: mean_interval(some[arm].to_numpy(float)) for arm in ARMS}
            rows.append(row | {"gates minus iou": mean_interval((some.gates - some.iou).to_numpy(float))})
    return pd.DataFrame(rows)


def main(folder: Path, n_replicates: int = 3, duration_s: float = 300.0) -> None:
    """The runs and their table."""
    rows = []
    for number in range(n_replicates):
        for city in CITIES:
            for arm in ARMS:
                path = simulate(folder, city, FIRST_SEED + number, arm, duration_s)
                rows.append({"city": city, "seed": FIRST_SEED + number, "arm": arm} | measures(path))
    runs = pd.DataFrame(rows)
    runs.to_csv(folder / "runs.csv", index=False)
    table(runs).to_csv(folder / "stated_accuracy.csv", index=False)
    with pd.option_context("display.width", 200, "display.max_rows", None):
        sys.stdout.write(table(runs).to_string(index=False) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(n) for n in sys.argv[2:3]), *(float(s) for s in sys.argv[3:4]))
