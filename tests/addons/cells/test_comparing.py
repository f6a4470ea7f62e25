"""Random messages, compared and fused in cells: each vehicle finds what it finds among all others."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.addons.cells.crew import CellCost
from cosim.addons.cells.perception import CellImages, CellPerception
from cosim.addons.cells.worker import Worker
from cosim.base.ragged import ptr_of
from cosim.step.comparing import FusionOf, KnownObjects, Used, compare
from cosim.step.known import Uses
from cosim.step.stopwatch import Stopwatch
from sensors.boxes import Boxes, overlapping_pairs
from sensors.evidence import AreaParams
from sensors.lidar import Poses
from tests.scene import assert_same
from trust.params import TrustParams
from trust.tables import Detections, Evaluations, ObjectLists

R, M, N_CELLS = 14, 18, 4


class Sees:
    """Stands for the sweeps: what it answers depends on where the vehicle and the box are."""

    detector = SimpleNamespace(recall=lambda n_points, label, range_m: 1 / (1 + n_points + label + range_m / 100))

    def in_area(self, sweeps, o, boxes, area, b, label, own):
        return np.linalg.norm(own.xyz_m[o] - boxes.xyz_m[b], axis=1) < 30

    def answers(self, sweeps, asked):
        count, test = (
            (1e4 * np.abs(np.sin(sweeps.poses.origin_m[o, 0] + asked.boxes.xyz_m[b, 1]))).astype(int)
            for o, b in ((asked.counting, asked.counted), (asked.testing, asked.tested))
        )
        return count % 400, test % 3 > 0


class Here:
    """A crew whose workers are in this process."""

    def __init__(self, workers):
        self.workers, self.cost = workers, CellCost.none(len(workers))

    def ask(self, service, given, keeps=False):
        return [
            None if arguments is None else getattr(worker, service)(*arguments)
            for worker, arguments in zip(self.workers, given, strict=True)
        ]


def drawn(seed, finds_pairs):
    """What R vehicles know, and the evaluations that they use."""
    rng = np.random.default_rng(seed)
    size = rng.integers(1, 7, M)
    message, d = np.repeat(np.arange(M), size), int(size.sum())
    places = rng.uniform(0, 60, (8, 3)) * (1, 1, 0)
    boxes = Boxes(
        places[rng.integers(0, 8, d)] + rng.normal(0, 0.4, (d, 3)), np.tile([4.0, 2, 1.5], (d, 1)), np.zeros(d)
    )
    index = np.arange(d) - np.searchsorted(message, message)
    detections = Detections(message, index, rng.integers(0, 2, d).astype(np.uint8), rng.random(d), index == 0)
    own = np.sort(rng.permutation(M)[:R])
    received = rng.permutation([(v, m) for v in range(R) for m in range(M) if m != own[v] and rng.random() < 0.5])
    pairs = None if finds_pairs else overlapping_pairs(boxes, detections.label, message)
    xyz_m = rng.uniform(0, 60, (R, 3))
    known = KnownObjects(
        detections, boxes, rng.random(d) < 0.8, np.append(0, np.cumsum(size)), rng.random(d) < 0.3, pairs, own,
        Uses(*received.T), Boxes(xyz_m, np.ones((R, 3)), np.zeros(R)),
    )  # fmt: skip
    rows = np.array([(v, m) for v in range(R) for m in range(M) if m != own[v] and rng.random() < 0.5])
    of, member = np.divmod(np.flatnonzero(rng.random(M * d) < 0.5), d)
    made = [Evaluations(rng.uniform(-1, 1, len(of)), rng.random(len(of))) for _ in range(2)]
    used = Used(Uses(*rows.T), True, ObjectLists(ptr_of(of, M), member, np.arange(M)), *made, rng.uniform(0, 80, d))
    return known, used, rng.random(len(rows))


def score(reports):
    """Of objects, by a model of the user's own."""
    return np.bincount(reports.group, reports.trust * reports.visibility, reports.n_groups) / 10


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("denials", ["visibility", "recall"])
@pytest.mark.parametrize("scorer", [None, score], ids=["method", "scorer"])
def test_each_vehicle_finds_in_its_cell_what_it_finds_among_all(seed, denials, scorer):
    known, used, trust = drawn(seed, finds_pairs=seed % 2 == 0)
    params, area, watch = TrustParams(denials=denials), AreaParams(), Stopwatch()
    poses = Poses(known.bodies.xyz_m + 1, known.bodies.yaw_rad)
    recall = Sees.detector.recall if denials == "recall" else None
    want, grouped = compare(Sees(), SimpleNamespace(poses=poses), known, area, params, recall, watch)

    cell = np.random.default_rng(seed).integers(0, N_CELLS - 1, R).astype(np.uint8)  # nobody is in the last one
    observers = tuple(np.flatnonzero(cell == number) for number in range(N_CELLS))
    workers = [Worker(Sees()) for _ in observers]
    for worker, rows in zip(workers, observers, strict=True):
        worker._images = SimpleNamespace(poses=Poses(poses.origin_m[rows], poses.yaw_rad[rows]))
    cells = CellPerception(None, Here(workers), 80.0)
    images = CellImages(poses, observers, cell, cells.crew)
    found, groups = cells.compare(None, images, known, area, params, recall, watch)
    assert_same(found, want)
    assert len(want.lists.member) > R and len(want.traced.list) and want.groups.ego_detected.any()

    variants = [FusionOf(trust, params, scorer), FusionOf(trust**2, replace(params, method="corrected"), None)]
    assert_same(groups.fuse(used, variants), grouped.fuse(used, variants))
    same = replace(used, reported=used.own)
    assert_same(groups.fuse(same, variants), grouped.fuse(same, variants))
