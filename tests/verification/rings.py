"""How many colluders it takes to exclude an honest vehicle, per trust model: `python -m tests.verification.rings OUT`.

Rings of 1, 2, 4 and 8 vehicles each deny whatever one honest vehicle reports. Victims and their rings are those that
stay nearest to each other in the shipped city; all trust models judge the same evidence.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from results.archive import open_run
from results.metrics import misbehaviour, trust

SIZES = (1, 2, 4, 8)
N_VICTIMS, START_S, DURATION_S = 4, 20.0, 80.0
MODELS = (
    "beta", "beta_discounted", "subjective_logic", "mate", "minhas", "announcement", "eigentrust", "report_count",
    "majority_ban",
)  # fmt: skip
BASE = f"""sensing_interval_s = 1.0
[traffic]
duration_s = {DURATION_S:g}
[fleet]
penetration_p = 0.6
"""


def drive(config: Path, out: Path) -> None:
    """A run in a process of its own."""
    subprocess.run([sys.executable, "-m", "cosim", "run", str(config), "--out", str(out)], check=True)


def choose(folder: Path) -> dict[int, list[tuple[str, list[str]]]]:
    """By size of the ring: victims and their rings, by SUMO's names; every vehicle in one place only."""
    run = open_run(folder)
    who = run.vehicles[run.vehicles.equipped & (run.vehicles.first_step == 0)]
    who = who[who.last_step >= run.manifest["steps"] - 1].set_index("vehicle")
    poses = run.table("actors", ["step", "actor", "x_m", "y_m"])
    poses = poses[poses.actor.isin(who.index)]
    x, y = (poses.pivot(index="actor", columns="step", values=k).to_numpy(float) for k in ("x_m", "y_m"))
    names = who.sumo_id.reindex(np.sort(poses.actor.unique())).tolist()
    away = np.nanmean(np.hypot(x[:, None] - x, y[:, None] - y), axis=2)
    free, found = np.ones(len(names), bool), {}
    for size in sorted(SIZES, reverse=True):
        found[size] = []
        for _ in range(N_VICTIMS):
            cost = np.where(free[:, None] & free, away, np.inf)
            cost = np.sort(np.where(np.eye(len(names), dtype=bool), np.inf, cost), axis=1)[:, size - 1]
            victim = int(np.argmin(cost))
            if not np.isfinite(cost[victim]):
                break
            free[victim] = False
            ring = np.argsort(np.where(free, away[victim], np.inf))[:size]
            free[ring] = False
            found[size].append((names[victim], [names[i] for i in ring]))
    return found


def table(folder: Path, rings: dict[int, list[tuple[str, list[str]]]]) -> pd.DataFrame:
    """Per model and size: victims, their median trust at the end, and how many are below half of the median of the
    other honest vehicles (size 0: those)."""
    run = open_run(folder)
    size_of = {name: size for size, some in rings.items() for name, _ in some}
    rows = []
    for variant in run.variants:
        one = run.as_variant(variant)
        last = trust.values(one).query("rated").drop_duplicates("subject", keep="last")
        last = last[last.role == misbehaviour.HONEST]
        names = run.vehicles.set_index("vehicle").sumo_id
        size = last.vehicle.map(names).map(size_of).fillna(0).astype(int)
        limit = 0.5 * last.trust[size == 0].median()
        rows += [
            {"model": variant, "ring": n, "victims": len(some), "trust": some.trust.median(),
             "excluded": int((some.trust < limit).sum())}
            for n, some in last.groupby(size)
        ]  # fmt: skip
    return pd.DataFrame(rows)


def main(out: Path) -> None:
    """The run and its table."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "traffic.toml").write_text("sensing = false\n" + BASE)
    drive(out / "traffic.toml", out / "traffic")
    rings = choose(out / "traffic")
    sections = [
        f'[[attacks]]\nattack = "bad_mouthing"\nids = {ring}\nstart_s = {START_S:g}\nvictim = "one"\n'
        f'victim_id = "{victim}"\nvictim_range_m = 1000.0\nonly_victim = true\n'
        for some in rings.values() for victim, ring in some
    ]  # fmt: skip
    variants = [f'[[trust_variant]]\nname = "{model}"\nmodel = "{model}"\nfused = false\n' for model in MODELS]
    (out / "rings.toml").write_text(BASE + "\n".join([*sections, *variants]))
    drive(out / "rings.toml", out / "rings")
    found = table(out / "rings", rings)
    found.to_csv(out / "rings.csv", index=False)
    sys.stdout.write(found.round(3).to_string(index=False) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
