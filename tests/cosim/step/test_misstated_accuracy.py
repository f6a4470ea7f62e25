"""An attacker that misstates accuracies: what receivers believe of it, by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from cosim.config.config import resolve_data
from cosim.messages import cpm
from cosim.messages.content import FABRICATED, Detections
from cosim.step.accuracy import DetectorAccuracy, Reporters, aged, pose_variance, stated
from cosim.step.comparing import RelativeAccuracy, _permitted_share
from cosim.step.perception import BoxQuestions
from sensors.association import (
    LEAST_VARIANCE_M2,
    MOST_VARIANCE_M2,
    Gate,
    bounded,
    certainty,
    pairs_across,
)
from sensors.evidence import AreaParams
from sensors.tracking.params import TrackingParams
from tests.cosim.attacks.plain import NAMES, play
from tests.cosim.door.test_mistakes import returns, told
from tests.sensors.town import boxes_at

CONFIG = resolve_data({"gnss": {"std_m": 0.2, "heading_std_deg": 0.0}}, "a test", None)
"""Nothing but a detector's error of 0.3 m, the default, and a position error of 0.2 m: (0.36 m)^2 = 0.13 m2."""


def ghosts(*factors, x_m=0.0, moves=False):
    """Persons who do not exist, in a box of 0.5 m, standing or without a track, as they are stated."""
    n = len(factors)
    boxes = boxes_at(np.tile([x_m, 0.0, 0.9], (n, 1)), (0.5, 0.5, 1.8))
    listed = Detections(
        observer=np.zeros(n, int), detection_index=np.arange(1, n + 1), label=np.ones(n, np.uint8), boxes=boxes,
        score=np.ones(n), n_points=np.ones(n, int), origin=np.full(n, FABRICATED, np.uint8),
        transmitted=np.ones(n, bool), velocity_mps=np.full((n, 2), 0.0 if moves else np.nan),
        accuracy_factor=np.array(factors, float),
    )  # fmt: skip
    pose = pose_variance(np.zeros(n, bool), CONFIG)
    reporters = Reporters(np.zeros((n, 3)), np.zeros(n), pose, np.zeros(n))
    return stated(listed, None, reporters, np.full(n, np.nan), DetectorAccuracy(), CONFIG)


def test_stated_variances():
    """0.13 m2 times the square of the factor. 13 m2 count as (2 m)^2, and 0.00013 m2 as (0.02 m)^2. Fusion knows no
    such bounds, because large variances hurt the liar: 0.09 m2 are relative to the vehicle."""
    found = ghosts(1, 3, 10, 0.1, 0.03)
    np.testing.assert_allclose(found.variance_m2[:, 0], [0.13, 1.17, MOST_VARIANCE_M2, 0.0013, LEAST_VARIANCE_M2])
    np.testing.assert_allclose(found.variance_m2[:, 2], found.variance_m2[:, 0])
    np.testing.assert_allclose(found.relative_m2[:, 0], [0.09, 0.81, 9.0, 0.0009, 0.000081])
    np.testing.assert_allclose(np.sqrt(found.heading_variance), [0.2, 0.6, 2.0, 0.02, 0.006])
    np.testing.assert_allclose(np.sqrt(found.size_variance), [0.1, 0.3, 1.0, 0.01, 0.003])


@pytest.mark.parametrize(("factor", "gate_m"), [(0.1, 1.10), (1, 1.547), (3, 3.460), (10, 6.167)])
def test_the_gate(factor, gate_m):
    """With 1 % outside, the gate is sqrt(-2 ln 0.01) = 3.035 standard deviations of the difference: of 0.13 m2 and
    0.0013, 0.13, 1.17 or 4 m2."""
    own = ghosts(1)
    for x_m, is_one in ((gate_m - 0.01, 1), (gate_m + 0.01, 0)):
        other = ghosts(factor, x_m=x_m)
        i, _, _ = pairs_across(
            own.boxes, own.label, own.variance_m2, other.boxes, other.label, other.variance_m2, Gate(0.01, 0.1)
        )
        assert len(i) == is_one


def test_the_share_of_a_denial():
    """After 0.8 s, the velocity's variance adds 0.64 of itself, and the random acceleration of pedestrians q 0.512 / 3.

    A person without a track has 0.6^2 + 1^2 = 1.36 m2/s2 along its heading and 1 m2/s2 across. Along the heading that
    is reported, with an error of 0.2 rad, it has 1.36 - 0.36 (1 - exp(-0.08)) / 2 = 1.34616. No factor makes it more,
    so that the share of the region that is compared is at least that of two axes with 4 m2 of 4 + 0.64 x 1.34616 + q
    0.512 / 3 and of 4 + 0.64 x 1.01384 + q 0.512 / 3.
    """
    more_m2 = 4 + 0.64 * np.array([1.34616, 1.01384]) + TrackingParams().acceleration_noise[1] * 0.512 / 3
    least = 4 / np.sqrt(more_m2.prod())
    old = aged(ghosts(1, 3, 10, 1000, 0.1), np.full(5, 0.8), TrackingParams())
    want = [1.0, 1.0, least, least, 1.0]
    np.testing.assert_allclose(certainty(old.variance_m2), want, rtol=1e-6)
    np.testing.assert_allclose(ghosts(1, 3, 0.1).velocity_variance[:, 0], [1.34616, 1.34616, 0.0134616], rtol=1e-5)
    moving = ghosts(1, 3, 1000, 0.1, moves=True).velocity_variance
    np.testing.assert_allclose(moving[:, 0], [0.01, 0.09, 1.18, 0.0001])
    np.testing.assert_allclose(moving[:, 2], moving[:, 0])


CONFIDENCE = next(member.of for member in cpm._COORDINATE.members if member.name == "confidence")


def test_receivers_believe_what_the_standard_can_say():
    """A confidence of a coordinate is 1 to 4094 units of 1 cm, at 95 %: 1.96 standard deviations. 4095 stands for more
    and 4096 for none. What receivers believe, 2 cm to 2 m, is within these."""
    least, most = CONFIDENCE.low, CONFIDENCE.high - 2
    assert (least, most) == (1, 4094)
    assert 0.01 * least < 1.96 * np.sqrt(LEAST_VARIANCE_M2) < 1.96 * np.sqrt(MOST_VARIANCE_M2) < 0.01 * most
    wrong = np.array([[value, 0.0, value] for value in (0.0, -1.0, np.inf, np.nan)])
    found = bounded(wrong)[:, 0]
    np.testing.assert_allclose(found, [LEAST_VARIANCE_M2, MOST_VARIANCE_M2, MOST_VARIANCE_M2, MOST_VARIANCE_M2])


@pytest.mark.parametrize("value", ["0.0", "-1.0", "np.inf", "np.nan"])
def test_an_own_attack_that_states_nonsense_is_told(tmp_path, value):
    said = told(tmp_path, "attack", returns(
        "attack", "detections",
        f"replace(it, accuracy_factor=np.where(context.attacker[it.observer], {value}, it.accuracy_factor))",
    ))  # fmt: skip
    assert "accuracy_factor" in said and "but 0.001 to 1000 is expected" in said


def test_an_own_attack_may_not_misstate_the_accuracy_of_others(tmp_path):
    said = told(tmp_path, "attack", returns(
        "attack", "detections", "replace(it, accuracy_factor=np.full(len(it), 2.0))"
    ))  # fmt: skip
    assert "changed detections of other vehicles" in said


STATED = ("variance_m2", "velocity_variance", "relative_m2", "heading_variance", "size_variance")
GHOSTS = {"attack": "ghost_insertion", "ids": ["v00", "v07"]}
WORLD = {"trust": {"matching": "gates"}, "gnss": {"std_m": 0.2, "heading_std_deg": 0.2}}


def lists_of(*attacks):
    return [result.sensed.listed.objects for result in play(attacks, 3, tables=(), **WORLD).results]


@pytest.mark.parametrize("content", ["fabricated", "detections"])
def test_only_what_the_attacker_chooses_changes(content):
    """Every other column, and every row of others, is the same bit for bit."""
    liar = {"attack": "misstated_accuracy", "together_with": 0, "factor": 0.5, "content": content}
    for was, now in zip(lists_of(GHOSTS), lists_of(GHOSTS, liar), strict=True):
        lied = np.isin(now.observer, [NAMES.index("v00"), NAMES.index("v07")])
        lied &= (now.origin == FABRICATED) if content == "fabricated" else (now.detection_index > 0)
        assert 0 < lied.sum() < len(lied)
        np.testing.assert_array_equal(now.accuracy_factor, np.where(lied, 0.5, 1.0))
        for name in STATED:
            a, b = getattr(was, name), getattr(now, name)
            np.testing.assert_array_equal(a[~lied], b[~lied])
            np.testing.assert_allclose(0.25 * a[lied], b[lied])
        np.testing.assert_array_equal(was.detection_index, now.detection_index)
        np.testing.assert_array_equal(was.boxes.xyz_m, now.boxes.xyz_m)
        np.testing.assert_array_equal(was.score, now.score)


def test_a_factor_of_one_is_the_truth():
    truth = {"attack": "misstated_accuracy", "together_with": 0, "factor": 1.0, "content": "all"}
    for was, now in zip(lists_of(GHOSTS), lists_of(GHOSTS, truth), strict=True):
        for name in (*STATED, "score"):
            np.testing.assert_array_equal(getattr(was, name), getattr(now, name))


class _FreeSpace:
    """A sweep with free space within 1 m of the origin of the plane."""

    def answers(self, sweeps, asked):
        """No returns, and whether each box may stand where it is asked about."""
        return None, np.hypot(*asked.boxes.xyz_m[:, :2].T) > 1.0


@pytest.mark.parametrize(("factor", "share"), [(0.1, 0.0), (1, 0.0), (3, 0.8), (10, 0.8)])
def test_where_free_space_is_asked(factor, share):
    """The four other places are sqrt(2) standard deviations away: of 0.13 m2 times the square of the factor, 0.05,
    0.51, 1.53 and 2.83 m. From 1 m on they are permitted, so that 4 of 5 parts of the denial count by visibility."""
    ghost = ghosts(factor)
    lists = SimpleNamespace(member=np.zeros(1, int), of_member=lambda: np.zeros(1, int))
    plausible, none = np.zeros(1, bool), np.zeros(0, int)
    asked = BoxQuestions(ghost.boxes, np.zeros((1, 2)), AreaParams(), none, none, none, none)
    accuracy = RelativeAccuracy(ghost.variance_m2, np.zeros(1))
    found = _permitted_share(_FreeSpace(), None, lists, plausible, asked, accuracy)
    np.testing.assert_allclose(found, [share])
