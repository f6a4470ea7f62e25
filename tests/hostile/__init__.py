"""What is not meant well: configs, scenarios, traces, messages, run folders, kills, places and streams.

Every config that ever failed is kept in `kept.toml`; other cases are found again by their seed, which is printed.

    HOSTILE_N=2000 HOSTILE_SEED=7 python -m pytest -m verify -s tests/hostile

Each generator is a function of a seed; counts are printed.
"""

import os

N = int(os.environ.get("HOSTILE_N", "60"))
"""Cases of each kind; of damaged folders, twice as many commands and five times as many checks."""
SEED = int(os.environ.get("HOSTILE_SEED", "1"))
