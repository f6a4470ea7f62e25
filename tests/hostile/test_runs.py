"""Whole runs with hostile configs: finished and whole, or refused in one line that leaves nothing behind."""

import shutil
import tomllib
from pathlib import Path

import pytest

from results.verify import verify
from tests.hostile import SEED, N, Tally
from tests.hostile.configs import cases
from tests.hostile.scenes import write_town, write_trace
from tests.processes import Ended, set_words, sets_of_trace

KEPT = tomllib.loads((Path(__file__).parent / "kept.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def bases(tmp_path_factory):
    """Words of two short runs: of a trace, and of SUMO with drivers that brake."""
    folder = tmp_path_factory.mktemp("scenes")
    town = sets_of_trace(write_town(folder / "town"))
    keys = ("traffic.warmup_s=5", "driver.model=cautious", "traffic.step_s=0.5", "record.block_steps=6")
    town += set_words(keys)
    return {"trace": sets_of_trace(write_trace(folder)), "town": town}


def judged(ended: Ended, out: Path) -> str:
    """What is wrong with how a run ended or with what it left; empty for nothing."""
    if ended.wrong:
        return ended.wrong
    if not out.exists():
        return "" if ended.status else "status 0 without a folder"
    about, problems = verify(out)
    if problems:
        return f"status {ended.status} with a folder of which {problems[0]}"
    return (
        "" if about["status"] == ("failed" if ended.status else "finished") else f"a folder that is {about['status']}"
    )


def attempt(cosim, base, sets, folder, with_metrics=True):
    """One run, with or without all its metrics and its picture: how it ended, and what is wrong."""
    folder.mkdir()
    words = [*base, *set_words(sets), "--out", "run"]
    ended = cosim("run", *words, "--json", cwd=folder) if with_metrics else cosim("simulate", *words, cwd=folder)
    wrong = judged(ended, folder / "run")
    shutil.rmtree(folder)
    return ended, wrong


@pytest.mark.verify
@pytest.mark.parametrize("case", KEPT["runs"], ids=lambda case: case["set"][0][:40])
def test_kept(cosim, bases, tmp_path, case):
    ended, wrong = attempt(cosim, bases[case["of"]], case["set"], tmp_path / "one")
    assert not wrong
    assert ended.status == case["status"], ended.err


@pytest.mark.verify
def test_generated(cosim, bases, tmp_path):
    tally = Tally("runs with hostile configs")
    for number, sets in enumerate(cases(SEED, N)):
        base = "town" if number % 4 == 3 else "trace"
        ended, wrong = attempt(cosim, bases[base], sets, tmp_path / f"case-{number}", number % 5 == 0)
        tally.add(base, ended, f"{base} {[s[:120] for s in sets]}", wrong)
    tally.conclude()
