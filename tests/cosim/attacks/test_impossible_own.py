"""Attackers that make their own detections impossible to send: they lose the message, not what they perceived."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.attacks.adversary import with_perceived, without_faults
from cosim.base.codes import DetectionFault
from cosim.messages.content import FABRICATED, SELF, SENSED, Detections
from sensors.boxes import Boxes
from tests.drive import cosim

XYZ_M = np.zeros((3, 3))


def perceived():
    """Two vehicles in rows 0 and 2 of the world: self reports, and two and one detections."""
    observer, index = np.array([0, 0, 0, 2, 2]), np.array([0, 1, 2, 0, 1])
    boxes = Boxes(np.column_stack([np.arange(5.0), np.zeros(5), np.ones(5)]), np.full((5, 3), 2.0), np.zeros(5))
    origin = np.where(index == 0, SELF, SENSED).astype(np.uint8)
    return Detections.perceived(observer, index, np.zeros(5, np.uint8), boxes, np.full(5, 0.5), np.ones(5, int), origin)


def sent(made):
    """What is listed of detections that an attack has made, and the number of those that cannot be sent."""
    listed, n_dropped = without_faults(made, XYZ_M)
    return with_perceived(listed, perceived()), n_dropped


def keys(listed):
    return list(zip(listed.observer.tolist(), listed.identity.tolist(), listed.detection_index.tolist(), strict=True))


def test_honest_lists_are_left_alone():
    before = perceived()
    assert with_perceived(before, before) is before


def test_a_score_of_seven_is_not_sent_and_stays_in_the_list_as_it_was_perceived():
    before = perceived()
    listed, n_dropped = sent(replace(before, score=np.array([0.5, 7.0, 0.5, 0.5, 0.5])))
    assert n_dropped[DetectionFault.BAD_SCORE] == 1 == n_dropped.sum()
    assert keys(listed) == keys(before) and listed.score.tolist() == [0.5] * 5
    assert listed.transmitted.tolist() == [True, False, True, True, True]
    assert listed.origin.tolist() == before.origin.tolist()


def test_another_number_is_another_detection():
    """Number 2 becomes 9: fabricated; 2 itself is withheld. Number 1 twice: one is dropped, and 2 withheld."""
    listed, _ = sent(replace(perceived(), detection_index=np.array([0, 1, 9, 0, 1])))
    assert keys(listed) == [(0, 0, 0), (0, 0, 1), (0, 0, 2), (0, 0, 9), (2, 0, 0), (2, 0, 1)]
    assert listed.origin.tolist() == [SELF, SENSED, SENSED, FABRICATED, SELF, SENSED]
    assert listed.transmitted.tolist() == [True, True, False, True, True, True]
    listed, n_dropped = sent(replace(perceived(), detection_index=np.array([0, 1, 1, 0, 1])))
    assert n_dropped[DetectionFault.REPEATED_NUMBER] == 1
    assert keys(listed) == keys(perceived()) and listed.transmitted.tolist() == [True, True, False, True, True]


def test_who_calls_a_detection_sensed_or_fabricated_changes_nothing():
    before = perceived()
    listed, _ = sent(replace(before, origin=np.full(5, FABRICATED, np.uint8)))
    assert listed.origin.tolist() == before.origin.tolist()
    more = Detections.by_key([before, replace(before.take(np.array([1])), detection_index=np.array([7]))])
    listed, _ = sent(more)
    assert listed.origin.tolist() == [SELF, SENSED, SENSED, FABRICATED, SELF, SENSED]


def test_of_a_vehicle_that_perceives_nothing_all_is_fabricated():
    nobody = perceived().take(np.zeros(0, int))
    listed = with_perceived(perceived(), nobody)
    assert (listed.origin == FABRICATED).all() and len(listed) == 5


LOUD = """
from dataclasses import replace
import numpy as np
from sensors.boxes import Boxes


class Loud:
    def detections(self, listed, context):
        own = context.own_rows(listed)
        rows = own[listed.detection_index[own] > 0]
        score, xyz_m, label = listed.score.copy(), listed.boxes.xyz_m.copy(), listed.label.copy()
        index, velocity = listed.detection_index.copy(), listed.velocity_mps.copy()
        how = rows % 5
        score[rows[how == 0]] = 7.0
        xyz_m[rows[how == 1]] = 1e300
        velocity[rows[how == 2]] = np.inf
        label[rows[how == 3]] = 99
        index[rows[how == 4]] = 1
        boxes = replace(listed.boxes, xyz_m=xyz_m)
        return replace(listed, score=score, boxes=boxes, label=label, detection_index=index, velocity_mps=velocity)
"""


@pytest.mark.verify
def test_such_an_attack_does_not_end_the_run(tmp_path):
    """In the default world. In the plain one it is `tests/test_hostile.py`."""
    (tmp_path / "m.py").write_text(LOUD)
    (tmp_path / "m.toml").write_text(
        'preset = "modern"\n[traffic]\nduration_s = 4\nwarmup_s = 60\n[[attacks]]\nattack = "m.py:Loud"\n'
        "share_p = 0.8\nstart_s = 1\n"
    )
    ended = cosim("run", "m.toml", "--json", "--out", "run", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "bad_score" in ended.stdout and "unknown_class" in ended.stdout and "not_finite" in ended.stdout
