"""What is not meant well: configs, run folders, messages, kills. Every case that ever failed is kept in `kept.toml`.

    HOSTILE_N=2000 HOSTILE_SEED=7 python -m pytest -m verify -s tests/hostile

Each generator is a function of a seed; counts are printed.
"""

import os

N = int(os.environ.get("HOSTILE_N", "200"))
"""Cases of each kind that run within this process; those in processes of their own are a twentieth."""
SEED = int(os.environ.get("HOSTILE_SEED", "1"))
