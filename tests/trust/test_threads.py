"""Threads change the time, not the answer."""

import numpy as np
import pytest

from cosim.base.threads import CORES, n_threads, use_threads
from tests.bench.trust import street
from trust.evaluation import evaluate
from trust.fusion import SensorEvidence, fuse
from trust.matching import match
from trust.params import TrustParams
from trust.tables import FusionInput


@pytest.fixture
def threads():
    """Sets the number of threads that work may use; what was is restored."""
    before = n_threads()
    yield use_threads
    use_threads(before)


@pytest.mark.parametrize("one_per_vehicle", [False, True])
def test_the_answer_is_the_same(threads, one_per_vehicle):
    params = TrustParams(one_per_vehicle=one_per_vehicle)
    table, pairs, lists, sender_trust = street(700)
    answers = []
    for n in (1, CORES):
        threads(n)
        groups = match(lists, table, pairs, params)
        m, g = lists.member.size, groups.seeds().size
        evaluations = evaluate(lists, groups, table, np.arange(m) % 120, np.arange(m) % 3 > 0, params)
        evidence = SensorEvidence(np.arange(g) % 20, np.arange(g) % 3 > 0, np.arange(g) % 5 > 0)
        fused = fuse(
            FusionInput(lists, groups, table, lists, evaluations, evaluations),
            sender_trust,
            evidence,
            np.ones(len(table)),
            params,
        )
        answers.append((groups.seed, fused.score))
    for one, many in zip(*answers, strict=True):
        np.testing.assert_array_equal(one, many)
