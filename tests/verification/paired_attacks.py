"""Two sweeps of the study `attacks`, by gates and by overlap: AUC at look-up of each model and attack, paired.

`python -m tests.verification.paired_attacks GATES OVERLAP` reads the folders of the two sweeps after `cosim measure`.
It prints TruPercept under every attack with the 95 % interval of the difference (Student, by replicate), and how many
of all cases differ by more than the interval.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import t as student

ATTACK, MODEL = "attacks.0.attack", "trust.model"


def paired(gates: Path, overlap: Path, metric: str, group: str) -> pd.DataFrame:
    """By attack and model: mean of both, difference within replicates, half of its interval, n."""
    keys = [ATTACK, MODEL, "replicate"]
    sides = []
    for folder in (gates, overlap):
        frame = pd.read_parquet(folder / "measures.parquet")
        chosen = frame[(frame.metric == metric) & (frame.group == group)]
        sides.append(chosen.set_index(keys).value)
    both = pd.concat(sides, axis=1, keys=["gates", "iou"], join="inner").dropna()
    by = both.assign(difference=both.gates - both.iou).groupby(keys[:2], sort=False)
    found, n = by.mean(), by.size()
    spread = by.difference.std(ddof=1) / np.sqrt(n)
    return found.assign(half=student.ppf(0.975, n - 1) * spread, n=n)


def main(gates: Path, overlap: Path) -> None:
    """Print both tables."""
    found = paired(gates, overlap, "misbehaviour.at_lookup.auc", "malicious")
    print(found.xs("trupercept", level=MODEL).round(3).to_string())
    better, worse = found[found.difference > found.half], found[found.difference < -found.half]
    print(f"of {len(found)} cases, gates are better in {len(better)} by more than the interval, worse in {len(worse)}:")
    print(worse.round(3).to_string())
    believed = paired(gates, overlap, "attack.believed.share", "0.5, received, malicious")
    print("lies believed at a score of 0.5:", believed.xs("trupercept", level=MODEL).round(4).to_string(), sep="\n")


if __name__ == "__main__":
    main(*(Path(folder) for folder in sys.argv[1:3]))
