"""Commands on damaged run folders: found by `verify`; no figure of damaged tables with status 0; no traceback."""

import random
import shutil

import pytest

from tests.fingerprint import fingerprint
from tests.hostile import SEED, N, Tally
from tests.hostile.folders import HARMS
from tests.hostile.scenes import write_trace
from tests.processes import sets_of_trace

COMMANDS = (
    ("verify", "run"), ("measure", "run", "--json"), ("measure", "run", "--json"), ("report", "run"),
    ("plot", "trust", "run"), ("plot", "encounters", "run"), ("resume", "run"),
    ("export", "nuscenes", "run", "--out", "x"),
    ("run", "--set", "traffic.trace=run", "--set", "traffic.scenario=../street.csv", "--out", "again", "--json"),
)  # fmt: skip


def made(folder, words, said):
    """What a command shows and writes: text, figures and pages byte by byte, runs by their tables."""
    if words[0] == "run":
        return fingerprint(folder / "again")
    files = [*folder.glob("x/**/*"), *folder.glob("run/*.png"), *folder.glob("run/*.html")]
    return said, {str(path.relative_to(folder)): path.read_bytes() for path in files if path.is_file()}


@pytest.mark.verify
def test_commands(cosim, tmp_path):
    """At least 400 with HOSTILE_N=200."""
    whole, folder, expected = tmp_path / "whole", tmp_path / "case", {}
    whole.mkdir()
    ended = cosim("run", *sets_of_trace(write_trace(tmp_path)), "--out", "run", cwd=whole)
    assert ended.status == 0, ended.err
    for words in set(COMMANDS):
        shutil.copytree(whole, folder)
        ended = cosim(*words, cwd=folder, cpu_s=60.0)
        assert ended.status == 0 and not ended.wrong, (words, ended)
        expected[words] = made(folder, words, ended.out)
        shutil.rmtree(folder)
    tally = Tally("commands on damaged folders")
    for number in range(2 * N):
        rng = random.Random(SEED * 30_011 + number)
        shutil.copytree(whole, folder)
        harm, words = rng.choice(HARMS), rng.choice(COMMANDS)
        said = harm(folder / "run", rng)
        ended = cosim(*words, cwd=folder, cpu_s=60.0)
        wrong = ended.wrong
        if words[0] == "verify":
            wrong = "" if ended.status == 1 and "Traceback" not in ended.err else wrong or "not found"
        elif words[0] in ("measure", "report", "resume") and ended.status == 1 and "damaged" in ended.err:
            wrong = wrong if "Traceback" in ended.err else ""  # figures of sound tables are shown, then all damage
        elif not wrong and ended.status == 0 and made(folder, words, ended.out) != expected[words]:
            wrong = "something else than of the whole run, and status 0"
        tally.add(words[0], ended, f"{number} {said}; cosim {' '.join(words)}", wrong)
        shutil.rmtree(folder)
    tally.conclude()
