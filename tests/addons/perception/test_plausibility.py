"""Signs that annotations or detections mean something else: said of sets that are wrong, and of none that is right."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cosim.addons.perception import opv2v
from cosim.addons.perception.plausibility import remarks
from cosim.addons.perception.recorded import RecordedBoxes, moved
from tests.addons.perception.test_readers import opv2v_file, vehicle


@pytest.fixture
def data(tmp_path):
    """Six cars around an agent that looks 40 degrees to the left, and detections of all that are a little off."""
    rng = np.random.default_rng(5)
    box = np.array([[20 * math.cos(a) + 30, 20 * math.sin(a) + 12, 0.8, 4.5, 1.8, 1.5, a + 0.3] for a in range(6)])
    opv2v_file(tmp_path / "s/0/000000.yaml", [30, 12, 0, 0, 40, 0], {n: vehicle(b) for n, b in enumerate(box)})
    data = opv2v.read(tmp_path)
    found = data.truth.box + rng.normal(0, 0.1, box.shape) * [1, 1, 1, 1, 0.5, 0.5, 0.3]
    zeros = np.zeros(6, int)
    return replace(data, found=RecordedBoxes(zeros, zeros, data.truth.label, found, np.full(6, 0.5)))


def changed(boxes, change):
    box = boxes.box.copy()
    change(box)
    return replace(boxes, box=box)


def scaled(by):
    def change(box):
        box[:, 3:6] *= by

    return change


def exchanged(box):
    box[:, [3, 4]] = box[:, [4, 3]]


def turned(box):
    box[:, 6] += math.pi / 2


def mirrored(box):
    box[:, 6] *= -1


def other_order(box):
    box[:, [3, 4, 5]] = box[:, [5, 4, 3]]


def lowered(box):
    box[:, 2] -= 0.75


def test_a_right_set_has_none(data):
    assert remarks(data) == ()
    assert remarks(replace(data, found=changed(data.found, lambda box: turned(box) or turned(box)))) == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (scaled(0.5), "are 0.5, 0.5,"), (scaled(2), "are 2, 2,"), (exchanged, "length and width exchanged"),
            (mirrored, "are turned by"), (other_order, "in another order"),
        (turned, "are turned by"), (lowered, "half of a height below"),
    ],
)  # fmt: skip
def test_detections(data, change, said):
    (found,) = remarks(replace(data, found=changed(data.found, change)))
    assert said in found


@pytest.mark.parametrize(
    ("change", "said"),
    [(scaled(0.5), "2.2 m long"), (scaled(2), "9.0 m long"), (exchanged, "1.8 m long and 4.5 m wide")],
)
def test_annotations(data, change, said):
    assert said in remarks(replace(data, truth=changed(data.truth, change)))[0]


def test_an_agent_with_a_wrong_pose(data):
    """Twelve detections of an agent lie 200 m beside the objects."""
    box = np.concatenate([data.found.box, data.found.box]) + [200, 0, 0, 0, 0, 0, 0]
    zeros = np.zeros(12, int)
    found = RecordedBoxes(zeros, zeros, np.full(12, "car", object), box, np.full(12, 0.5))
    assert "0 of 12 detections of agent 0 lie within 2 m of an object" in remarks(replace(data, found=found))[0]


def test_classes_that_no_object_has(data):
    found = replace(data.found, label=np.array(["car"] * 4 + ["lorry"] * 2, object))
    assert remarks(replace(data, found=found)) == ()  # detections of OPV2V have none
    (said,) = remarks(replace(data, found=found, has_classes=True))
    assert said.endswith("no object has them: 2 lorry.")


def test_detections_in_another_frame(data):
    motion = data.world_from[0][0]
    twice = moved(data.found.box, motion)  # boxes of the world that were taken for those of the LiDAR
    (said,) = remarks(replace(data, found=replace(data.found, box=twice)))
    assert "as boxes of the world 6 would" in said
    local = moved(data.found.box, np.linalg.inv(motion)) * [1, -1, 1, 1, 1, 1, -1]
    (said,) = remarks(replace(data, found=replace(data.found, box=moved(local, motion))))
    assert "with y to the right of the LiDAR 6 would" in said
