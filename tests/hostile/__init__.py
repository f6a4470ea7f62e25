"""What is not meant well: configs, scenarios, traces, messages, run folders, kills, places and streams.

Every config that ever failed is kept in `kept.toml`; other cases are found again by their seed, which is printed.

    HOSTILE_N=2000 HOSTILE_SEED=7 python -m pytest -m verify -s tests/hostile

Each generator is a function of a seed; counts are printed.
"""

import os
from collections import Counter

N = int(os.environ.get("HOSTILE_N", "60"))
"""Cases of each kind; of damaged folders, twice as many commands and five times as many checks."""
SEED = int(os.environ.get("HOSTILE_SEED", "1"))


def conclude(what: str, counts: Counter[str], wrongs: list[str], cpu_s: float) -> None:
    """Print how many of which cases there were, and fail where any was wrong."""
    n = sum(counts.values())
    print(f"\n{what}, seed {SEED}: {dict(sorted(counts.items()))}, {len(wrongs)} wrong of {n} in {cpu_s:.0f} s")
    assert not wrongs, "\n".join(wrongs)
