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


class Tally:
    """What has become of the cases of a kind."""

    def __init__(self, what):
        self.what, self.counts, self.wrongs, self.cpu_s = what, Counter(), [], 0.0

    def add(self, kind, ended, case, wrong):
        """Count how a command ended; print the case where something is wrong with that."""
        self.counts[f"{kind}, status {ended.status}"] += 1
        self.cpu_s += ended.cpu_s
        if wrong:
            self.wrongs.append(f"{case}: {wrong}")
            print(self.wrongs[-1], flush=True)

    def conclude(self):
        """Print how many of which cases there were, and fail where any was wrong."""
        n, counts = self.counts.total(), dict(sorted(self.counts.items()))
        print(f"\n{self.what}, seed {SEED}: {counts}, {len(self.wrongs)} wrong of {n} in {self.cpu_s:.0f} s")
        assert not self.wrongs, "\n".join(self.wrongs)
