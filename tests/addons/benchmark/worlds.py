"""A tiny evidence set, made by hand: no simulation."""

from functools import cache

import numpy as np

from cosim.addons.benchmark.evidence import (
    HONEST,
    TABLES,
    EvidencePlace,
    EvidenceRules,
    EvidenceSet,
    EvidenceStream,
    assembled,
    merged,
)

ATTACKS = ("ghost_insertion", "speed", "bad_mouthing", "collusion")
RULES = EvidenceRules(
    dt_s=1.0, n_steps=14, start_step=4, server_period_s=3.0, eta=-1.0, freshness_s=10.0, cases=(HONEST, *ATTACKS)
)
N, ATTACKERS = 7, (5, 6)
"""Vehicles 0 to 6 are all within reach of each other. The last two attack."""


def stream(case: str, seed: int) -> EvidenceStream:
    """Each vehicle reports itself and two objects; others confirm most of them, with random scores in percent.

    Ghosts have the index 3, and are denied by the honest. Vehicle 1's messages are lost on the way to the server in
    every third step; the broadcast of step s has reached everybody in step s + 1.
    """
    random = np.random.default_rng(seed)
    rows = {name: [] for name in TABLES}
    for step in range(RULES.n_steps):
        attacks = step >= RULES.start_step
        for observer in range(N):
            ghost = case == "ghost_insertion" and attacks and observer in ATTACKERS
            for index in range(3 + ghost):
                rows["detections"].append((step, observer, index, 100 if index in (0, 3) else 60 + 5 * index))
            lost = observer == 1 and step % 3 == 0
            rows["reports"].append((step, observer, -1 if lost or step + 1 == RULES.n_steps else step + 1))
            for receiver in range(N):
                if receiver == observer:
                    continue
                rows["lookups"].append((step, receiver, observer, step, (step - 1) // 3 * 3 if step else -1))
                for index in range(4):
                    e, phi = random.integers(50, 100), random.integers(5, 100)  # the same draws in every case
                    denied, unseen = random.random() < 0.2, random.random() < 0.3
                    false = receiver in ATTACKERS and attacks
                    friend = observer in ATTACKERS
                    if index == 3:
                        if ghost:
                            value = (100, 100) if friend and false else (-100, int(phi))
                            rows["evaluations"].append((step, receiver, step, observer, index, *value))
                    elif case == "collusion" and false:
                        rows["evaluations"].append(
                            (step, receiver, step, observer, index, 100 if friend else -100, 100)
                        )
                    elif case == "bad_mouthing" and false and not friend:
                        rows["evaluations"].append((step, receiver, step, observer, index, -100, 100))
                    elif not unseen:
                        value = -100 if denied else int(e)
                        rows["evaluations"].append((step, receiver, step, observer, index, value, int(phi)))
    rows["pseudonyms"] = [(n, n, int(n in ATTACKERS)) for n in range(N)]
    return EvidenceStream(**{
        name: merged(name, dict(zip(TABLES[name].columns, np.array(of, np.int64).T, strict=True)))
        for name, of in rows.items()
    })  # fmt: skip


@cache
def tiny_set() -> EvidenceSet:
    """Three worlds, with all attacks."""
    places = (EvidencePlace("here", 0.3, 1), EvidencePlace("here", 0.1, 2), EvidencePlace("there", 0.3, 3))
    return assembled("0", RULES, places, (
        (world, case, stream(name, world)) for world in range(3) for case, name in enumerate(RULES.cases)
    ))  # fmt: skip
