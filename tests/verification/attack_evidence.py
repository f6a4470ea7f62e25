"""Records what trust models receive under many attacks, with all kinds of evaluations: each world is simulated once.

`python -m tests.verification.attack_evidence FOLDER CITY SEED [N_STEPS [ATTACK=SHARE ...]]` writes `CITY-SEED.pickle`:
for each case its name, its `EvidenceStream`, and the step in which each pseudonym's vehicle first attacks.
"""

import pickle
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.addons.benchmark.evidence import HONEST, MOST_PSEUDONYMS, EvidenceRules, EvidenceStream
from cosim.addons.benchmark.record import ATTACKS, RULES, Tape, numbered, simulated
from cosim.config.config import Config, resolve_data
from trust.params import KINDS

PENETRATION_P, SHARE_P = 0.3, 0.1
NEVER = np.iinfo(np.int64).max

Recorded = tuple[str, EvidenceStream, Int[ndarray, "p"]]
"""Name of the case, its evidence, and by pseudonym the first step of its vehicle's attack; `NEVER` for the honest."""


def config_of(city: str, seed: int, n_steps: int, attack: str, share_p: float) -> Config:
    """The config of a case: the default world, with all kinds of evaluations."""
    return resolve_data({
        "preset": "modern", "seed": seed,
        "traffic": {"scenario": city, "seed": seed, "step_s": RULES.dt_s, "duration_s": n_steps * RULES.dt_s},
        "fleet": {"penetration_p": PENETRATION_P}, "encounters": [{}],
        "attacks": [{"attack": attack, "share_p": share_p, "start_s": RULES.start_step * RULES.dt_s}],
        "trust": {"model": f"{Tape.__module__}:Tape", "freshness_s": RULES.freshness_s,
                  "server_period_s": RULES.server_period_s, "evidence": list(KINDS)},
    }, "the recording", None)  # fmt: skip


def record(city: str, seed: int, n_steps: int, asked: list[tuple[str, float]]) -> list[Recorded]:
    """All cases of a world: without attack, and with each attack by this share of the equipped vehicles."""
    configs = [config_of(city, seed, n_steps, *one) for one in asked]
    cases = simulated(configs, city, lambda *_: None)
    names = [HONEST, *(f"{attack}={share_p:g}" for attack, share_p in asked)]
    tables = [case.tables() for case in cases]
    known = np.unique(np.concatenate([of["pseudonyms"]["pseudonym"] for of in tables]))
    found = []
    for name, stream, of, case in zip(names, numbered(tables), tables, cases, strict=True):
        since, start = np.full(MOST_PSEUDONYMS, NEVER), case.state.attack_start.step_of
        who = of["pseudonyms"]
        since[np.searchsorted(known, who["pseudonym"])] = [start.get(v, NEVER) for v in who["vehicle"].tolist()]
        found.append((name, stream, since))
    return found


def rules_of(n_steps: int) -> EvidenceRules:
    """The benchmark's rules for a world of this length."""
    return EvidenceRules(**{name: getattr(RULES, name) for name in EvidenceRules.__slots__} | {"n_steps": n_steps})


if __name__ == "__main__":
    folder, city, seed, *more = sys.argv[1:]
    n_steps = int(more[0]) if more else RULES.n_steps
    shares = [one.split("=") for one in more[1:]] or [(one, SHARE_P) for one in ATTACKS]
    if len({float(share) for _, share in shares}) > 1:
        sys.exit("One share per recording: which vehicles attack is drawn once for all cases of a world.")
    found = record(city, int(seed), n_steps, [(attack, float(share)) for attack, share in shares])
    Path(folder).mkdir(parents=True, exist_ok=True)
    (Path(folder) / f"{city}-{seed}.pickle").write_bytes(pickle.dumps((n_steps, found)))
