"""Ghosts that no other vehicle can see, under three rules: `python -m tests.verification.ghosts_in_shadows OUT`.

15 % of the equipped vehicles of Helsinki place ghosts where no other one has line of sight. The rules are trust
variants of one run, and there is a run for each seed. Prints the table of `cosim/attacks/README.md`.
"""

import sys
from pathlib import Path

import cosim
from results.archive import open_run
from results.measure import measure

SEEDS = (1, 2, 3)
VARIANTS = {
    "base": {},
    "zero": {"unseen": "zero"},
    "paper": {"unseen": "zero", "unevaluated": "value", "least_score": 0},
}
"""Rules by name: what differs from the default one."""
TOPICS = ("trust", "misbehaviour", "attack")
SHOWN = (
    "misbehaviour.at_lookup.auc:malicious",
    "trust.final.median:malicious",
    "trust.final.median:honest",
    "attack.believed.share:0.5, received, malicious",
    "attack.damage.per_attacker_s:received, malicious",
)
"""Metrics and groups of `cosim measure`."""


def config(seed: int) -> dict:
    """The config of one seed."""
    further = [{"name": name, "fused": True} | keys for name, keys in VARIANTS.items() if keys]
    return {
        "seed": seed,
        "traffic": {"seed": seed, "duration_s": 90},
        "attacks": [{"attack": "ghost_in_shadow", "share_p": 0.15, "start_s": 20}],
        "trust_variant": further,
    }


def measures(folder: Path, variant: str) -> dict[str, float]:
    """What is shown of one run, by one rule."""
    rows = measure(open_run(folder).as_variant(variant), topics=TOPICS)
    by_key = dict(zip(rows.metric + ":" + rows.group, rows.value, strict=True))
    return {key: by_key[key] for key in SHOWN}


def main(out: Path) -> None:
    """The runs and their table."""
    for seed in SEEDS:
        cosim.run(config(seed), out / str(seed))
    print("|", *VARIANTS, sep=" | ")
    for key in SHOWN:
        cells = []
        for variant in VARIANTS:
            values = [measures(out / str(seed), variant)[key] for seed in SEEDS]
            cells.append(", ".join(f"{value:.3g}" for value in values))
        print(f"| {key}", *cells, sep=" | ")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
