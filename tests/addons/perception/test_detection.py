"""Average precision and awareness on a scene, by hand."""

import pytest

from cosim.addons.perception import detection
from tests.results.tiny import fleet


@pytest.fixture
def scene(tiny):
    """Vehicle 0 stands facing east; 1 is 20 m ahead of it, 2 is 20 m behind; 50 steps; all well visible.

    It detects 1 exactly in every step, and, in every second step, a ghost 40 m ahead with a higher score. Vehicle 1
    attacks: its lists do not count.
    """
    size = {"length_m": 4, "width_m": 2, "height_m": 1.5}
    vehicles = fleet("honest", "malicious", last_step=49)
    vehicles.append({"vehicle": 2, "vehicle_class": "car", "last_step": 49, **size})
    vehicles.append({**fleet("honest")[0], "vehicle": 3, "first_step": 1, "last_step": 0})
    x = {0: 0.0, 1: 20.0, 2: -20.0}
    actors, observability, detections, fused = [], [], [], []
    for step in range(50):
        actors += [{"step": step, "actor": v, "x_m": x[v], "z_m": 0.75} for v in x]
        observability += [
            {"step": step, "observer": 0, "actor": v, "n_points": 90, "n_unoccluded": 100} for v in (1, 2)
        ]
        seen = {"step": step, "observer": 0, "z_m": 0.75, "transmitted": True, **size}
        detections.append(seen | {"observer": 1, "detection_index": 1, "x_m": 60, "score": 1})
        detections.append(seen | {"detection_index": 1, "x_m": 20, "score": 0.6, "truth_actor": 1, "truth_iou": 1})
        fused.append(
            {"step": step, "observer": 0, "fused_index": 1, "score": 0.6, "ego_detected": True, "source_index": 1}
        )
        if step % 2:
            detections.append(seen | {"detection_index": 2, "x_m": 40, "score": 0.9})
        if step >= 40:
            detections.append(seen | {"detection_index": 3, "x_m": 9, "score": 1, "origin": "fabricated"})
        if step >= 45:
            fused.append(
                {"step": step, "observer": 3, "fused_index": 2, "score": 0.7, "fabricated": True, "source_index": 3}
            )
    return tiny(
        50, vehicles=vehicles, actors=actors, observability=observability, detections=detections, fused=fused
    )  # fmt: skip


def test_precision_on_a_scene(scene):
    """Fused: 50 hits of 50, AP 100. Local: 25 ghosts rank first, so precision is at most 50 / 75 everywhere.

    At level easy a ghost at 40 m, 960 px * 1.5 m / 38 m = 38 px high, is too small to count.
    """
    frame = detection.precision(scene).set_index(["boxes", "class", "level"])
    assert frame.ap40["fused", "car", "easy"] == pytest.approx(100)
    assert frame.ap11["local", "car", "moderate"] == pytest.approx(100 * 50 / 75)
    assert frame.ap11["local", "car", "easy"] == pytest.approx(100)
    assert frame.n_truth["fused", "car", "all"] == 50  # the one behind does not count
    assert frame.n_frames.unique().tolist() == [50]
    near = detection.precision(scene, range_m=30, nearest_m=10).set_index(["boxes", "class", "level"])
    assert near.ap40["local", "car", "all"] == pytest.approx(100)  # neither the ghosts at 40 m nor those at 9 m
    few = detection.precision(scene, max_frames=10)
    assert few.n_frames.unique().tolist() == [10] and few.n_truth.max() == 10


def test_awareness_on_a_scene(scene):
    """Of the two within 30 m it knows the one ahead."""
    frame = detection.awareness(scene, range_m=30)
    assert frame.n_present.tolist() == [100, 100] and frame.share.tolist() == [0.5, 0.5]
    assert detection.awareness(scene, range_m=30, min_score=0.7).share.tolist() == [0, 0]
