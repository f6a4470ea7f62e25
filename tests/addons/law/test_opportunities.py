"""Chances of evaluation against a literal twin, and what they depend on."""

import numpy as np
import pytest

from cosim.addons.law.opportunities import ViewTimes, chances, detected_p_of
from sensors.expected_returns import ExpectedReturns
from sensors.statistical_detector import DetectorParams, IdealDetector, StatisticalDetector


def random_views(rng, n_observers=8, n_bodies=20):
    own = np.sort(rng.choice(n_bodies, n_observers, replace=False))
    there = rng.random((n_observers, n_bodies)) < 0.4
    there[np.arange(n_observers), own] = False
    o, body = np.nonzero(there)
    inside = rng.random(len(o)) < 0.8
    return ViewTimes(
        own=own, ptr=np.searchsorted(o, np.arange(n_observers + 1)), body=body, seen_p=rng.random(len(o)) * inside,
        inside=inside, detected_p=rng.random(len(o)), n_false=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("self_reports", [True, False])
def test_chances_as_by_their_definition(self_reports):
    views = random_views(np.random.default_rng(2))
    subject, evaluator = (x.ravel() for x in np.meshgrid(np.arange(8), np.arange(8)))
    subject, evaluator = subject[subject != evaluator], evaluator[subject != evaluator]
    found = chances(views, subject, evaluator, self_reports)

    def of(values, observer, actor):
        rows = range(views.ptr[observer], views.ptr[observer + 1])
        return next((float(values[k]) for k in rows if views.body[k] == actor), 0.0)

    for row, (s, v) in enumerate(zip(subject, evaluator, strict=True)):
        p, listed = [], []
        for actor in range(20):
            if actor == views.own[s] and self_reports:  # its self-report
                p.append(of(views.seen_p, v, actor))
                listed.append(of(views.inside, v, actor))
            elif actor == views.own[v]:  # the subject detects the evaluator, who knows where it is
                p.append(of(views.detected_p, s, actor) * self_reports)
                listed.append(p[-1])
            elif actor != views.own[s]:
                p.append(of(views.seen_p, v, actor) * of(views.detected_p, s, actor))
                listed.append(of(views.inside, v, actor) * of(views.detected_p, s, actor))
        assert found.none_p[row] == pytest.approx(np.prod(1 - np.array(p)))
        assert found.n_listed[row] == pytest.approx(sum(listed))


def test_nothing_in_common_is_never_evaluated():
    none = np.zeros(0)
    views = ViewTimes(np.array([0, 1]), np.zeros(3, int), none.astype(int), none, none.astype(bool), none, 0.0)
    found = chances(views, np.array([0]), np.array([1]), True)
    assert found.none_p == [1.0]


def test_detectors():
    found = ExpectedReturns(np.array([0.0, 0.25, 400.0]), np.array([10.0, 10.0, 400.0]))
    label, range_m = np.zeros(3, np.uint8), np.ones(3)
    assert detected_p_of(IdealDetector(DetectorParams(model="ideal")))(found, label, range_m).tolist() == [0, 0.25, 1]
    avod = detected_p_of(StatisticalDetector(DetectorParams()))(found, label, range_m)
    assert avod[0] == 0 and 0 < avod[1] < 0.25 * 0.2 and avod[2] == pytest.approx(0.7545, abs=0.01)
    with pytest.raises(ValueError, match="has no method recall"):
        detected_p_of(object())
