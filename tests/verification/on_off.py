"""Trust in attackers that pause, per trust model: `python -m tests.verification.on_off OUT [SEEDS]`.

Four groups of attackers insert ghosts in half of each period. The periods are 1/2, 1, 3/2 and 2 windows of evidence.
The table has the median trust in them just before their next ghosts, from the second period on. Each seed has its own
traffic; what is there of an earlier call is not driven again.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from results.archive import open_run
from results.metrics import misbehaviour, trust
from tests.verification.rings import MODELS, drive

PERIODS = (0.5, 1.0, 1.5, 2.0)
"""In windows."""
WINDOW_S, START_S, DURATION_S = 12.0, 16.0, 80.0
BASE = f"""[traffic]
duration_s = {DURATION_S:g}
[fleet]
penetration_p = 0.4
[trust]
freshness_s = {WINDOW_S:g}
server_period_s = 1.0
"""


def of_seed(out: Path, number: int) -> pd.DataFrame:
    """Trust in vehicles just before the ghosts of each group, per model; of honest vehicles at the same moments."""
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "run").exists():
        sections = [
            f'[[attacks]]\nattack = "ghost_insertion"\nshare_p = 0.1\nstart_s = {START_S:g}\nwhen = "on_off"\n'
            f"period_windows = {period:g}\n"
            for period in PERIODS
        ]
        variants = [f'[[trust_variant]]\nname = "{model}"\nmodel = "{model}"\nfused = false\n' for model in MODELS]
        base = f"seed = {4 + number}\n{BASE}".replace("[traffic]", f"[traffic]\nseed = {1 + number}")
        (out / "on_off.toml").write_text(base + "\n".join([*sections, *variants]))
        drive(out / "on_off.toml", out / "run")
    run = open_run(out / "run")
    group = run.vehicles.set_index("vehicle").attack
    rows = []
    for variant in run.variants:
        found = trust.values(run.as_variant(variant)).query("rated")
        found = found.assign(group=found.vehicle.map(group))
        for number_of_group, period in enumerate(PERIODS):
            before_s = np.arange(START_S + period * WINDOW_S, DURATION_S, period * WINDOW_S) - 1.0
            then = found[np.isclose(found.time_s.to_numpy()[:, None], before_s).any(axis=1)]
            mine = (then.role == misbehaviour.HONEST) | (then.group == number_of_group)
            rows.append(then[mine].assign(model=variant, period=period))
    return pd.concat(rows, ignore_index=True)


def main(out: Path, n_seeds: int = 3) -> None:
    """The runs and their table."""
    seeds = (of_seed(out / f"seed-{number}", number).assign(seed=number) for number in range(n_seeds))
    found = pd.concat(seeds, ignore_index=True)
    found["who"] = np.where(found.role == misbehaviour.HONEST, "honest", "attacker")
    table = found.groupby(["model", "period", "who"], sort=False, observed=True).agg(
        vehicles=("vehicle", "nunique"), trust=("trust", "median")
    )
    lowest = found.groupby(["model", "period", "who", "seed"], observed=True).trust.median()
    table["lowest_seed"], table["highest_seed"] = (
        getattr(lowest.groupby(["model", "period", "who"], observed=True), name)() for name in ("min", "max")
    )
    table.to_csv(out / "on_off.csv")
    sys.stdout.write(table.round(2).to_string() + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(n) for n in sys.argv[2:3]))
