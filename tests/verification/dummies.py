"""How far dummies on pavements move the trust in honest vehicles: `python -m tests.verification.dummies OUT`.

Dummies of pedestrians stand on the busiest 800 m of pavement in Helsinki. Detectors may disagree about them, and
there is nobody whom traffic would avoid. Runs of one seed have the same traffic, with and without dummies. Prints the
difference that dummies make to `trust.final.mean` of honest vehicles, for each seed.
"""

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

import cosim
from cosim.traffic.scenario import find
from results.archive import open_run
from results.measure import measure
from sumo_nets.network import lanes

CITY = "helsinki"
SEEDS = (1, 2, 3)
NUMBERS = (40, 100)
PAVEMENT_M, NEAR_M = 800.0, 20.0


def places_m(n: int, cars_m: Float[ndarray, "m 2"]) -> Float[ndarray, "n 2"]:
    """Places at equal distances on the pavements whose middles most cars pass."""
    net = find(CITY).net
    assert net is not None
    streets = {lane.edge for lane in lanes(net) if lane.for_cars}
    lines = [lane.line_m[:, :2] for lane in lanes(net) if lane.edge in streets and not lane.for_cars]
    middles_m = np.array([line.mean(axis=0) for line in lines])
    n_near = cKDTree(cars_m).query_ball_point(middles_m, NEAR_M, return_length=True)
    lines = [lines[k] for k in np.argsort(-n_near, kind="stable")]
    begins, steps = [], []
    for line in lines:
        begins.append(line[:-1])
        steps.append(np.diff(line, axis=0))
        if np.hypot(*np.concatenate(steps).T).sum() >= PAVEMENT_M:
            break
    begin_m, step_m = np.concatenate(begins), np.concatenate(steps)
    end_m = np.cumsum(np.hypot(*step_m.T))
    at_m = (np.arange(n) + 0.5) / n * PAVEMENT_M
    row = np.searchsorted(end_m, at_m)
    left_m = (end_m[row] - at_m) / np.hypot(*step_m[row].T)
    return begin_m[row] + (1.0 - left_m)[:, None] * step_m[row]


def config(seed: int, dummies_m: Float[ndarray, "n 2"]) -> dict:
    """The config of one run."""
    objects = [{"vehicle_class": "pedestrian", "at_m": place} for place in dummies_m.tolist()]
    return {"seed": seed, "traffic": {"scenario": CITY, "seed": seed, "duration_s": 120}, "objects": objects}


def trust_of(folder: Path) -> float:
    """Mean final trust in honest vehicles."""
    rows = measure(open_run(folder), topics=("trust",))
    chosen = (rows.metric == "trust.final.mean") & (rows.group == "honest")
    return float(rows.value[chosen].iloc[0])


def main(out: Path) -> None:
    """The runs and their table."""
    for seed in SEEDS:
        alone = out / f"{seed}-0"
        cosim.run(config(seed, np.zeros((0, 2))), alone)
        run = open_run(alone)
        cars = run.vehicles.vehicle[run.vehicles.equipped]
        actors = run.table("actors", ["actor", "x_m", "y_m"])
        cars_m = actors[actors.actor.isin(cars)][["x_m", "y_m"]].to_numpy(float)
        print(f"seed {seed}: {trust_of(alone):.3f} without dummies", end="")
        for n in NUMBERS:
            folder = out / f"{seed}-{n}"
            cosim.run(config(seed, places_m(n, cars_m)), folder)
            print(f", {trust_of(folder) - trust_of(alone):+.3f} with {n}", end="", flush=True)
        print()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
