"""False speeds and withheld objects, by models that know these kinds of evidence and by one that adds everything up.

`python -m tests.verification.two_false_kinds OUT` simulates Helsinki with all kinds of evidence (`trust.evidence`). A
tenth of the vehicles claims false speeds, and another tenth withholds all that it sees. Prints the AUC over all lookups
by honest vehicles from the begin of the attacks on, for each seed.
"""

import sys
from pathlib import Path

import numpy as np
from numpy import ndarray

import cosim
from results.archive import open_run
from results.metrics.intervals import auc
from trust.params import KINDS

SEEDS = (1, 2, 3)
START_S = 10.0
ATTACKS = ("speed", "removal")
MODELS = ("trupercept", "belief_graph", "beta_by_kind")


def config(seed: int) -> dict:
    """The config of one seed."""
    return {
        "seed": seed,
        "traffic": {"seed": seed, "duration_s": 60},
        "trust": {"model": MODELS[0], "evidence": list(KINDS)},
        "attacks": [{"attack": attack, "share_p": 0.1, "start_s": START_S} for attack in ATTACKS],
        "trust_variant": [{"name": model, "model": model} for model in MODELS[1:]],
    }


def areas(folder: Path, variant: str) -> list[float]:
    """AUC of trust in the honest against that in the vehicles of each attack."""
    run = open_run(folder).as_variant(variant)
    lookups = run.variant_table("trust_lookups", ["step", "subject", "receiver", "trust"])
    # Nobody changes its pseudonym here, so that pseudonyms are vehicles.
    lookups = lookups[lookups.step * run.dt_s >= START_S]
    vehicles = run.vehicles.set_index("vehicle")
    role, attack = vehicles.role.astype(str), vehicles.attack
    lookups = lookups[lookups.receiver.map(role) == "honest"]

    def trust_in(chosen: ndarray) -> ndarray:
        return lookups.trust[lookups.subject.isin(vehicles.index[chosen])].to_numpy(float)

    honest = trust_in(role == "honest")
    found = []
    for number in range(len(ATTACKS)):
        liars = trust_in((role == "malicious") & (attack == number))
        found.append(auc(honest, np.arange(len(honest)), liars, np.arange(len(liars))).value)
    return found


def main(out: Path) -> None:
    """The runs and their table."""
    for seed in SEEDS:
        cosim.run(config(seed), out / str(seed))
    for model in MODELS:
        variant = "base" if model == MODELS[0] else model
        by_seed = np.array([areas(out / str(seed), variant) for seed in SEEDS])
        for attack, values in zip(ATTACKS, by_seed.T, strict=True):
            print(model, attack, *(f"{value:.2f}" for value in values))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
