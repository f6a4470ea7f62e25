"""Runs killed at random moments, some again and again, go on to the tables of a run never interrupted."""

import random
import signal

import pytest

from results.verify import verify
from tests.fingerprint import fingerprint
from tests.hostile import SEED, N
from tests.hostile.scenes import write_town
from tests.processes import set_words, sets_of_trace

ATTACKS = ("replay", "stale", "sybil")
KEYS = (
    "traffic.warmup_s=5", "traffic.duration_s=12", "traffic.step_s=0.5", "record.block_steps=3",
    "driver.model=cautious",
    *(f"attacks.{i}.{key}" for i, name in enumerate(ATTACKS) for key in (f"attack={name}", "share_p=0.2", "start_s=0")),
)  # fmt: skip
"""Attacks with memories, and a driver whose commands belong to the traffic."""


@pytest.mark.verify
def test_ten_of_a_run(cosim, tmp_path):
    sets = [*sets_of_trace(write_town(tmp_path)), *set_words(KEYS)]
    ended = cosim("run", *sets, "--out", "whole", cwd=tmp_path, cpu_s=30)
    assert ended.status == 0, ended.err
    want = fingerprint(tmp_path / "whole")
    rng, lasts_s, n_kills, n_runs = random.Random(SEED), ended.cpu_s, 0, max(10, N // 20)
    for number in range(n_runs):
        out, words = tmp_path / f"broken-{number}", ("run", *sets, "--out", f"broken-{number}")
        for _ in range(1 + number % 3):
            signum = rng.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
            ended = cosim(
                *words, cwd=tmp_path, cpu_s=30, kill_after_s=rng.uniform(0.1, 0.9) * lasts_s, signum=int(signum)
            )
            n_kills += ended.status != 0
            assert ended.status in (0, -signal.SIGKILL, -signal.SIGTERM, 130, 143), ended  # -15: before it listens
            assert ended.status < 0 or not ended.wrong, ended
            if not out.exists():  # nothing was written yet
                continue
            if (out / "manifest.json").exists():  # otherwise the same command begins anew in what is there
                assert verify(out)[1] == [], (number, signum)
                words = ("resume", f"broken-{number}")
        ended = cosim(*words, cwd=tmp_path, cpu_s=30)
        assert ended.status == 0, ended.err
        assert fingerprint(out) == want, number
        about, problems = verify(out)
        assert about["status"] == "finished" and problems == []
        left = {path.name for path in out.iterdir()} - {path.name for path in (tmp_path / "whole").iterdir()}
        assert not left, left
    print(f"\nkills, seed {SEED}: {n_runs} runs killed {n_kills} times, all with the tables of the whole one")
