"""Ghosts that receivers believe, where both rules of matching believe as many real objects.

`python -m tests.verification.ghosts_and_recall OUT [SEEDS]`. A rule by which vehicles believe more of everything
believes more ghosts, too. So ghosts are counted where gates and overlap believe as many real objects of their class
that the own sensor misses. (The score of a fused object also says how well its box fits, which small objects lack.) A
pair of a ghost and an honest receiver counts once per step, and so does a real object of an honest vehicle. What is
there of an earlier call is not driven again.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import t

from results.archive import open_run
from tests.verification.rings import drive

ATTACKS = ("ghost_insertion", "approaching_ghost")
RULES = ("gates", "iou")
START_S = 20.0
CONFIG = f"""seed = {{seed}}
trust_variant = []
[traffic]
seed = {{seed}}
duration_s = 80
[fleet]
penetration_p = 0.5
[trust]
freshness_s = 30
matching = "{{rule}}"
[record]
level = "full"
[[attacks]]
attack = "{{attack}}"
share_p = 0.2
start_s = {START_S:g}
"""
BY_IOU, EQUAL = "iou at 0.5", "gates, as many real"
HIGHER = 0.75
"""A second threshold, about midway between the trust of liars and of honest vehicles."""


def scores(out: Path, attack: str, rule: str, number: int) -> tuple[pd.DataFrame, pd.DataFrame, int]:
    """Class and score of ghosts at honest receivers (-1: dropped), of real objects by others alone, and all sweeps."""
    folder = out / f"{attack}-{rule}-{number}"
    if not folder.exists():
        out.mkdir(parents=True, exist_ok=True)
        config = folder.with_suffix(".toml")
        config.write_text(CONFIG.format(seed=6200 + number, rule=rule, attack=attack))
        drive(config, folder)
    run = open_run(folder)
    honest = run.vehicles.vehicle[run.vehicles.role == "honest"]
    lies = run.attack_outcomes[run.attack_outcomes.receiver.isin(honest)]
    said = run.detections.rename(columns={"step": "detection_step"}).drop(columns="score")
    ghosts = lies.merge(said, on=["detection_step", "observer", "detection_index"])
    fused = run.fused[run.fused.observer.isin(honest) & (run.fused.step * run.dt_s >= START_S)]
    others = fused[~fused.ego_detected & fused.truth_actor.notna() & (fused.truth_actor != fused.observer)]
    real = others.sort_values("score").drop_duplicates(["step", "observer", "truth_actor"], keep="last")
    n_sweeps = len(fused[["step", "observer"]].drop_duplicates())
    return ghosts[["class", "score"]].fillna({"score": -1.0}), real[["class", "score"]], n_sweeps


def believed(ghosts: pd.DataFrame, real: pd.DataFrame, real_by_iou: pd.DataFrame) -> float:
    """Share of ghosts that are believed where as many real objects of their class are as by overlap at 0.5."""
    n = 0
    for kind, scores_of in ghosts.groupby("class", observed=True).score:
        n_real = int((real_by_iou.score[real_by_iou["class"] == kind] >= 0.5).sum())
        least = real.score[real["class"] == kind].nlargest(n_real).min()
        n += int((scores_of >= least).sum())
    return n / len(ghosts)


def row(out: Path, attack: str, number: int) -> dict[str, float | str]:
    """One drive: shares of ghosts that are believed [%], and real objects per sweep."""
    (ghosts, real, n_sweeps), (by_iou, real_by_iou, _) = (scores(out, attack, rule, number) for rule in RULES)
    return {
        "attack": attack,
        BY_IOU: 100 * (by_iou.score >= 0.5).mean(),
        "real per sweep": (real_by_iou.score >= 0.5).sum() / n_sweeps,
        "gates at 0.5": 100 * (ghosts.score >= 0.5).mean(),
        "their real": (real.score >= 0.5).sum() / n_sweeps,
        EQUAL: 100 * believed(ghosts, real, real_by_iou),
        f"gates at {HIGHER:g}": 100 * (ghosts.score >= HIGHER).mean(),
        f"real at {HIGHER:g}": (real.score >= HIGHER).sum() / n_sweeps,
    }


def main(out: Path, n_seeds: int = 10) -> None:
    """The runs and their table: means over drives, and the paired difference with its 95 % interval."""
    rows = pd.DataFrame([row(out, attack, number) for attack in ATTACKS for number in range(1, n_seeds + 1)])
    more = (rows[EQUAL] - rows[BY_IOU]).groupby(rows.attack, sort=False)
    found = rows.groupby("attack", sort=False).mean()
    found["gates more, as many real"] = more.mean()
    found["+-"] = t.ppf(0.975, n_seeds - 1) * more.std() / np.sqrt(n_seeds)
    sys.stdout.write(found.round(2).T.to_string() + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(n) for n in sys.argv[2:3]))
