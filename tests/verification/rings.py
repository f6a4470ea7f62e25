"""How many colluders exclude an honest vehicle, per trust model: `python -m tests.verification.rings OUT [SEEDS]`.

Rings of 1, 2, 4 and 8 vehicles each deny whatever one honest vehicle reports. Victims and their rings are those that
stay nearest to each other in the shipped city; all trust models judge the same evidence. Each seed has its own traffic
and victims; what is there of an earlier call is not driven again.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from results.archive import open_run
from results.metrics import intervals, misbehaviour, trust

SIZES = (1, 2, 4, 8)
N_VICTIMS, START_S, DURATION_S = 4, 20.0, 80.0
MODELS = (
    "beta", "beta_discounted", "subjective_logic", "mate", "minhas", "announcement", "eigentrust", "report_count",
    "majority_ban",
)  # fmt: skip
BASE = f"""[traffic]
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
    """Honest vehicles at the end, per model: ring (size; 0 for those without one), trust, and whether it is below half
    of the median of those without a ring."""
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
        rows.append(pd.DataFrame(
            {"model": variant, "ring": size, "trust": last.trust, "excluded": last.trust < limit}
        ))  # fmt: skip
    return pd.concat(rows, ignore_index=True)


def summary(victims: pd.DataFrame) -> pd.DataFrame:
    """Per model and size: victims, their median trust, how many are excluded, and Wilson's 95 % interval of the share;
    victims are the units."""
    rows = []
    for model, of_model in victims.groupby("model", sort=False):
        for ring, some in of_model.groupby("ring"):
            n, k = len(some), int(some.excluded.sum())
            found = intervals.share(some.excluded.to_numpy(float), np.ones(n))
            rows.append((model, ring, n, some.trust.median(), k, found.low, found.high))
    return pd.DataFrame(rows, columns=["model", "ring", "victims", "trust", "excluded", "low", "high"])


def of_seed(out: Path, number: int) -> pd.DataFrame:
    """Victims of one seed."""
    out.mkdir(parents=True, exist_ok=True)
    base = f"seed = {4 + number}\n{BASE}".replace("[traffic]", f"[traffic]\nseed = {1 + number}")
    if not (out / "traffic").exists():
        (out / "traffic.toml").write_text("sensing = false\n" + base)
        drive(out / "traffic.toml", out / "traffic")
    rings = choose(out / "traffic")
    if not (out / "rings").exists():
        sections = [
            f'[[attacks]]\nattack = "bad_mouthing"\nids = {ring}\nstart_s = {START_S:g}\nvictim = "one"\n'
            f'victim_id = "{victim}"\nvictim_range_m = 1000.0\nonly_victim = true\n'
            for some in rings.values() for victim, ring in some
        ]  # fmt: skip
        variants = [f'[[trust_variant]]\nname = "{model}"\nmodel = "{model}"\nfused = false\n' for model in MODELS]
        (out / "rings.toml").write_text(base + "\n".join([*sections, *variants]))
        drive(out / "rings.toml", out / "rings")
    return table(out / "rings", rings).assign(seed=number)


def main(out: Path, n_seeds: int = 3) -> None:
    """The runs and their table."""
    victims = pd.concat([of_seed(out / f"seed-{number}", number) for number in range(n_seeds)], ignore_index=True)
    victims.to_csv(out / "victims.csv", index=False)
    sys.stdout.write(summary(victims).round(3).to_string(index=False) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(n) for n in sys.argv[2:3]))
