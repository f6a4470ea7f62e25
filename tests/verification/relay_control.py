"""What relay control (`radio.relay.min_trust`) does to the messages of liars and of honest vehicles.

`python -m tests.verification.relay_control FOLDER [SEED ...]` simulates the runs of these seeds that FOLDER lacks, and
prints the table of all seeds there. Central Helsinki with the preset v0.2, 45 s, 30 % of the vehicles equipped, a fifth
of them attack from second 5 on, three hops. Counted from second 15 on: receptions over more than one hop, frames on the
air, busy ratio, and the seconds for which ghosts are believed. A column with control is compared with none within each
seed (same traffic, same vehicles, same attackers): geometric mean of the ratios, and its 95 % interval (Student, of
their logarithms).
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import t as student

from results.archive import open_run

ATTACKS = ("ghost_insertion", "bad_mouthing")
CONTROLS = {"none": ("trupercept", 0.0), "trupercept": ("trupercept", 0.25), "belief_graph": ("belief_graph", 0.48)}
"""Trust model and `radio.relay.min_trust`. Without control, the run carries `belief_graph` as a variant."""
FROM_S = 15.0


def simulate(folder: Path, seed: int) -> None:
    """The runs of a seed that are not in `folder`."""
    for attack in ATTACKS:
        for name, (model, min_trust) in CONTROLS.items():
            out = folder / f"{attack}-{name}-{seed}"
            if out.exists():
                continue
            keys = {
                "preset": "v0.2", "seed": seed, "traffic": {"seed": seed, "duration_s": 45},
                "fleet": {"penetration_p": 0.3},
                "radio": {"relay": {"max_hops": 3, "min_trust": min_trust}}, "trust": {"model": model},
                "attacks": [{"attack": attack, "share_p": 0.2, "start_s": 5}], "record": {"level": "full"},
                "trust_variant": [{"name": "belief_graph", "model": "belief_graph"}] if name == "none" else [],
            }  # fmt: skip
            code = "import json, sys, cosim; cosim.run(json.loads(sys.argv[1]), sys.argv[2])"
            subprocess.run([sys.executable, "-c", code, json.dumps(keys), str(out)], check=True)


def counts(path: Path, variant: str = "base") -> dict[str, float]:
    """What one run counts from `FROM_S` on; ghosts are those of a variant whose objects are fused, else NaN."""
    run = open_run(path)
    since = int(np.ceil(FROM_S / run.dt_s))
    got = run.table("receptions", ["step", "sender", "hops"])
    got = got[got.step >= since]
    role, far = got.sender.map(run.subjects.role), got.hops > 1
    radio = run.table("radio")
    radio = radio[radio.step >= since]
    found = run.table("attack_outcomes")
    found = found[(found.variant == variant) & (found.step >= since) & (found.effect == "inserted")]
    believed = (found.receiver.map(run.roles) == "honest") & (found.score >= 0.5)
    return {
        "liars, beyond one hop": int((far & (role == "malicious")).sum()),
        "honest, beyond one hop": int((far & (role == "honest")).sum()),
        "liars, all": int((role == "malicious").sum()),
        "honest, all": int((role == "honest").sum()),
        "frames": int(radio.n_sent.sum()),
        "busy ratio": float(radio.cbr.mean()),
        "believed ghosts [s]": float(believed.sum() * run.config["sensing_interval_s"]) if len(found) else np.nan,
    }


def table(folder: Path) -> pd.DataFrame:
    """A row per attack, control and measure: without and with control, and the ratio with its range over seeds."""
    rows = []
    for attack in ATTACKS:
        seeds = sorted(int(path.name.rsplit("-", 1)[1]) for path in folder.glob(f"{attack}-belief_graph-*"))
        for name in tuple(CONTROLS)[1:]:
            variant = "base" if name == "trupercept" else name
            without = pd.DataFrame([counts(folder / f"{attack}-none-{seed}", variant) for seed in seeds])
            controlled = pd.DataFrame([counts(folder / f"{attack}-{name}-{seed}") for seed in seeds])
            for measure in without:
                row = {"attack": attack, "by": name, "measure": measure, "seeds": len(seeds),
                       "without": without[measure].mean(), "with": controlled[measure].mean()}  # fmt: skip
                if (without[measure] > 0).all() and (controlled[measure] > 0).all():
                    logs = np.log(controlled[measure] / without[measure])
                    half = student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
                    row |= dict(zip(("ratio", "low", "high"), np.exp(logs.mean() + [0, -half, half]), strict=True))
                rows.append(row)
    return pd.DataFrame(rows)


if __name__ == "__main__":
    for number in sys.argv[2:]:
        simulate(Path(sys.argv[1]), int(number))
    with pd.option_context("display.width", 200, "display.max_rows", None):
        print(table(Path(sys.argv[1])).round(3).to_string(index=False))
