"""Threads change the time, not the answer."""

import numba
import numpy as np
import pytest

from cosim.base.threads import threads_for
from tests.bench.trust import street
from trust.evaluation import evaluate
from trust.fusion import SensorEvidence, fuse
from trust.matching import match
from trust.params import TrustParams
from trust.tables import FusionInput


@pytest.fixture
def threads():
    """Sets the number of threads that Numba may use; what was is restored."""
    before = numba.get_num_threads()
    yield numba.set_num_threads
    numba.set_num_threads(before)


@pytest.mark.parametrize("one_per_vehicle", [False, True])
def test_the_answer_is_the_same(threads, one_per_vehicle):
    params = TrustParams(one_per_vehicle=one_per_vehicle)
    table, pairs, lists, sender_trust = street(700)
    answers = []
    for n in (1, numba.config.NUMBA_NUM_THREADS):
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


def test_little_work_takes_one_thread(threads):
    threads(numba.config.NUMBA_NUM_THREADS)
    with threads_for(10) as n:
        assert n == numba.get_num_threads() == 1
    with threads_for(1e9) as n:
        assert n == numba.config.NUMBA_NUM_THREADS
    assert numba.get_num_threads() == numba.config.NUMBA_NUM_THREADS
