"""Hostile messages: dropped and counted, or the part that makes them is named in one line."""

import pytest

from results.archive import open_run
from tests.hostile import SEED, N, Tally
from tests.hostile.scenes import write_trace
from tests.hostile.test_runs import attempt
from tests.processes import set_words, sets_of_trace

KINDS = ("content", "content", "content", "rows", "hooks", "many")


@pytest.mark.verify
def test_generated(cosim, tmp_path):
    base = sets_of_trace(write_trace(tmp_path))
    tally = Tally("hostile messages")
    for number in range(max(12, N)):
        kind = KINDS[number % len(KINDS)]
        case = SEED * 100_003 + number
        sets = ["attacks.0.attack=tests.hostile.messages:Nonsense", f"attacks.0.case={case}", f"attacks.0.kind={kind}"]
        ended, wrong = attempt(cosim, base, sets, tmp_path / "one", number % 5 == 0)
        if not wrong and ended.status and (kind in ("content", "many") or "messages.py:" not in ended.err):
            wrong = f"status {ended.status}: {ended.err}"
        tally.add(kind, ended, f"{kind} {case}", wrong)
    tally.conclude()


@pytest.mark.verify
def test_what_is_dropped_is_counted(cosim, tmp_path):
    """5,000 boxes of each of two attackers in each of six steps: at most 255 objects of each are sent."""
    base = sets_of_trace(write_trace(tmp_path))
    sets = ["attacks.0.attack=tests.hostile.messages:Nonsense", "attacks.0.case=3", "attacks.0.kind=many"]
    words = set_words(sets)
    ended = cosim("run", *base, *words, "--out", "run", cwd=tmp_path)
    assert ended.status == 0, ended.err
    run = open_run(tmp_path / "run")
    sent = run.detections.groupby(["step", "observer"], observed=True).size()
    assert sent.max() <= 255
    role = run.subjects.role
    malicious = role.index[role == "malicious"]
    fabricated = run.detections[(run.detections.origin == "fabricated") & run.detections.observer.isin(malicious)]
    n_steps = run.detections.step.nunique()
    assert run.dropped_detections.n.sum() + len(fabricated) == 5000 * len(malicious) * n_steps
