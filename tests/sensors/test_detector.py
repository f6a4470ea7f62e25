"""The choice of a detector: a detector of one's own, canonical order, points in boxes, and refused reports."""

from dataclasses import dataclass

import numpy as np
import pytest

from cosim.base.hash_rng import normals, uniforms
from sensors.boxes import Boxes, iou_3d
from sensors.detector import DETECTORS, detect
from sensors.evidence import observability, points_in_boxes
from sensors.reports import Reports
from sensors.scene import LABEL_OF_SHAPE
from sensors.statistical_detector import DetectorParams
from tests.sensors.town import draws_of, exact, traffic


@dataclass(frozen=True, kw_only=True)
class BernoulliParams:
    detection_p: float = 0.8
    sigma_m: float = 0.3


class Bernoulli:
    """Detects every actor with a return with one probability; normal errors of the centre."""

    Params = BernoulliParams

    def __init__(self, params):
        self.params = params

    def detect(self, sweeps, seen, boxes, label, draws):
        keys = draws.pair_step(seen)
        detected = (seen.n_returns > 0) & (uniforms(keys, 1)[:, 0] < self.params.detection_p)
        rows = np.flatnonzero(detected)
        actor = seen.actor[rows]
        true = boxes.take(actor)
        error_m = self.params.sigma_m * normals(keys[rows], 4)[:, 1:]
        found = Boxes(true.xyz_m + error_m, true.lwh_m, true.yaw_rad)
        return Reports.of_actors(seen, rows, label[actor], found, np.full(len(rows), 0.9))


def draws(street, seed=0):
    return draws_of(np.random.default_rng(seed), len(street[0].observers), len(street[2]))


@pytest.fixture(scope="module", params=[*DETECTORS, "own"])
def detector(request):
    if request.param == "own":
        return Bernoulli(Bernoulli.Params())
    return DETECTORS[request.param](DetectorParams(model=request.param))


def test_order_and_points(street, detector):
    found = detect(detector, *street, draws(street))
    order = np.lexsort([found.boxes.xyz_m[:, 1], found.boxes.xyz_m[:, 0], -found.score, found.observer])
    assert (order == np.arange(len(order))).all() and len(order) > 100
    assert (found.n_points == points_in_boxes(street[0], found.observer, found.boxes)).all()


def test_no_observers(detector):
    boxes, shape = traffic(np.random.default_rng(0), 5)
    sweeps = exact(boxes, shape, [])
    keys = draws_of(np.random.default_rng(0), 0, 5)
    found = detect(detector, sweeps, observability(sweeps, boxes, shape), boxes, LABEL_OF_SHAPE[shape], keys)
    assert len(found.observer) == len(found.boxes) == 0


def test_ideal_reports_every_actor_with_a_return_exactly(street):
    _, seen, boxes, label = street
    found = detect(DETECTORS["ideal"](DetectorParams(model="ideal")), *street, draws(street))
    visible = seen.n_returns > 0
    pairs = list(zip(seen.observer[visible], seen.actor[visible], strict=True))
    assert sorted(zip(found.observer, found.actor, strict=True)) == pairs
    assert not found.is_false_positive.any() and (found.label == label[found.actor]).all() and (found.score == 1).all()
    assert iou_3d(found.boxes, boxes.take(found.actor)) == pytest.approx(np.ones(len(found.observer)))
    # A true box holds at least the returns of its actor, but for one at an edge, which rounding to steps puts outside.
    own = {(o, a): n for o, a, n in zip(seen.observer, seen.actor, seen.n_returns, strict=True)}
    short = [
        own[o, a] - n for o, a, n in zip(found.observer, found.actor, found.n_points, strict=True) if n < own[o, a]
    ]
    assert short in ([], [1])


def test_a_detector_of_ones_own(street):
    # 0.8 of those with a return, within four standard errors; errors of 0.3 m in each direction.
    found, n = detect(Bernoulli(BernoulliParams()), *street, draws(street)), (street[1].n_returns > 0).sum()
    assert len(found.score) == pytest.approx(0.8 * n, abs=4 * np.sqrt(0.16 * n))
    assert (found.boxes.xyz_m - street[2].take(found.actor).xyz_m).std(axis=0) == pytest.approx([0.3] * 3, rel=0.1)


def test_keys_of_the_wrong_number_are_refused(street):
    few = draws_of(np.random.default_rng(0), 1, 1)
    with pytest.raises(ValueError, match="draws"):
        detect(DETECTORS["avod"](DetectorParams()), *street, few)
