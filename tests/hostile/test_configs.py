"""Hostile configs: accepted, or refused in one line within ten seconds."""

import tomllib
import traceback
from collections import Counter
from pathlib import Path

import pytest

from tests.hostile import SEED, N
from tests.hostile.configs import TooLong, attempt, cases

KEPT = tomllib.loads((Path(__file__).parent / "kept.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("case", KEPT["configs"], ids=lambda case: case["set"][0][:40])
def test_kept(case):
    assert attempt(case["set"]) == case["is"]


@pytest.mark.verify
def test_generated():
    """2,000 with HOSTILE_N=2000."""
    counts, wrong = Counter(), []
    for sets in cases(SEED, N):
        try:
            counts[attempt(sets)] += 1
        except (Exception, TooLong) as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            wrong.append(f"{[s[:80] for s in sets]}: {type(error).__name__}: {str(error)[:100]} ({last.name})")
    print(f"\nconfigs, seed {SEED}: {dict(counts)}, {len(wrong)} wrong of {N}")
    assert not wrong, "\n".join(wrong)
