"""Commands on damaged run folders: found by `verify`; no figure of damaged tables with status 0; no traceback."""

import random
import shutil
from collections import Counter

import pytest

from tests.hostile import SEED, N
from tests.hostile.folders import HARMS
from tests.hostile.processes import sets_of_trace
from tests.hostile.scenes import write_trace

COMMANDS = (
    ("verify", "run"), ("measure", "run", "--json"), ("measure", "run", "--json"), ("report", "run"),
    ("plot", "trust", "run"), ("plot", "encounters", "run"), ("resume", "run"),
    ("export", "veremi", "run", "--out", "x"),
    ("run", "--set", "traffic.trace=run", "--set", "traffic.scenario=../street.csv", "--out", "again", "--json"),
)  # fmt: skip


@pytest.mark.verify
def test_commands(cosim, tmp_path):
    """At least 400 with HOSTILE_N=200."""
    whole = tmp_path / "whole"
    whole.mkdir()
    ended = cosim("run", *sets_of_trace(write_trace(tmp_path)), "--out", "run", cwd=whole)
    assert ended.status == 0, ended.err
    measured = cosim("measure", "run", "--json", cwd=whole).out
    assert measured
    counts, wrongs = Counter(), []
    for number in range(2 * N):
        rng = random.Random(SEED * 30_011 + number)
        folder = tmp_path / "case"
        shutil.copytree(whole, folder)
        harm, words = rng.choice(HARMS), rng.choice(COMMANDS)
        said = harm(folder / "run", rng)
        ended = cosim(*words, cwd=folder)
        wrong = ended.wrong
        if words[0] == "verify":
            wrong = "" if ended.status == 1 and "Traceback" not in ended.err else wrong or "not found"
        elif words[0] in ("measure", "report") and ended.status == 1 and "damaged" in ended.err:
            wrong = wrong if "Traceback" in ended.err else ""  # figures of sound tables are shown, then all damage
        elif words[0] == "measure" and not wrong and ended.status == 0 and ended.out != measured:
            wrong = "other figures, and status 0"
        counts[f"{words[0]}, status {ended.status}"] += 1
        if wrong:
            wrongs.append(f"{number} {said}; cosim {' '.join(words)}: {wrong}")
            print(wrongs[-1], flush=True)
        shutil.rmtree(folder)
    print(f"\ncommands on damaged folders, seed {SEED}: {dict(sorted(counts.items()))}, {len(wrongs)} wrong of {2 * N}")
    assert not wrongs, "\n".join(wrongs)
