"""Generation rules: when a message is generated, what it includes again, what it does not, and how long it is."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from cosim.base.codes import ObjectClass
from cosim.messages import cpm
from cosim.messages.content import SELF, SENSED, Detections, encoded_cpm_bytes
from cosim.messages.cpm_generation import CpmState, Generators, Inclusion, beyond_limit, generate
from cosim.messages.cpm_params import CpmParams
from tests.sensors.town import boxes_at

CAR, PEDESTRIAN = 0, 1


OWN = (0, CAR, 0, 0)
"""The report of the first observer of itself."""


def list_of(*rows):
    """Detections from (observer, label, x, yaw in degrees); the first of each observer is its report of itself."""
    observer, label, x, yaw = (np.array(column) for column in zip(*rows, strict=True))
    n = len(rows)
    k = np.arange(n) - np.searchsorted(observer, observer)
    boxes = boxes_at(np.column_stack([x, np.zeros((n, 2))]), yaw_rad=np.radians(yaw.astype(float)))
    return Detections.perceived(
        observer, k, label.astype(np.uint8), boxes, np.ones(n), np.zeros(n, np.int32),
        np.where(k == 0, SELF, SENSED).astype(np.uint8),
    )  # fmt: skip


ETSI = CpmParams(rules="etsi")


def generated(state, seen, time_s, params=ETSI, gap_s=0.0):
    """One step, in which every observer may send one message; the observers are numbered without gaps."""
    n = int(seen.observer.max(initial=-1)) + 1
    at = Generators(np.arange(n) << 16, np.arange(n), np.zeros((n, 2)), np.full(n, gap_s))
    return generate(state, seen, seen.observer, at, time_s, params)


def story(*frames, params=ETSI, gap_s=0.0):
    """What is included in each (time, detections)."""
    state, out = CpmState(), []
    for time_s, seen in frames:
        state, content = generated(state, seen, time_s, params, gap_s)
        out.append(content.included.tolist())
    return out


def test_what_stands_is_sent_once_a_second():
    parked = list_of(OWN, (0, CAR, 30, 0))
    assert story(*((t / 10, parked) for t in range(12))) == [[t in (0, 10)] * 2 for t in range(12)]


def test_tracks_tell_people_apart_that_stand_together():
    """A second pedestrian 1 m beside one that was just sent is new: by place it would be the same one."""
    one = list_of(OWN, (0, PEDESTRIAN, 20, 0))
    two = list_of(OWN, (0, PEDESTRIAN, 20, 0), (0, PEDESTRIAN, 21, 0))
    at = Generators(np.array([0]), np.array([0]), np.zeros((1, 2)), np.zeros(1))
    found = []
    for tracks in (None, ([-1, 7], [-1, 7, 9])):
        of_one, of_two = (None, None) if tracks is None else (np.array(t) for t in tracks)
        state, _ = generate(CpmState(), one, one.observer, at, 0.0, ETSI, of_one)
        state, content = generate(state, two, two.observer, at, 0.2, ETSI, of_two)
        found.append(content.included.tolist())
    assert found == [[False, False, False], [False, False, True]]


@pytest.mark.parametrize("others_send_between", [False, True])
def test_who_sends_seldom_remembers_what_was_left_out(others_send_between):
    """A sweep every 2 s, room for one object: the parked car comes first once, then the one that moves 3 m."""
    at = Generators(np.array([0]), np.array([0]), np.zeros((1, 2)), np.zeros(1), interval_s=2.0)
    params, state, found = CpmParams(rules="etsi", max_objects=1), CpmState(), []
    nothing = list_of(OWN).take(np.zeros(0, int))
    for k in range(4):
        seen = list_of(OWN, (0, CAR, 30, 0), (0, CAR, 60 + 3 * k, 0))
        state, content = generate(state, seen, seen.observer, at, 2.0 * k, params)
        found.append(content.included[1:].tolist())
        if others_send_between:
            state, _ = generate(state, nothing, nothing.observer, at, 2.0 * k + 1.0, params)
    assert found == [[True, False], [False, True], [False, True], [False, True]]


def test_moved_turned_and_new():
    def at(x, yaw=0.0):
        return list_of(OWN, (0, CAR, x, yaw))

    # 3.9 m is not enough, 4.2 m since the last inclusion is; then 3 degrees are not, and 5 are.
    frames = [(0.0, at(30)), (0.1, at(33.9)), (0.2, at(34.2)), (0.3, at(34.2, 3)), (0.4, at(34.2, 5))]
    assert [car for _, car in story(*frames)] == [True, False, True, False, True]
    # Across 180 degrees too.
    assert [car for _, car in story((0.0, at(30, 179)), (0.1, at(30, -179)))] == [True, False]
    late = list_of(OWN, (0, CAR, 30, 0), (0, CAR, 60, 0))
    assert story((0.0, at(30)), (0.1, late))[1] == [False, False, True]


def test_people_go_together_after_half_a_second():
    crowd = list_of(OWN, (0, PEDESTRIAN, 10, 0), (0, PEDESTRIAN, 20, 0))
    more = list_of(OWN, (0, PEDESTRIAN, 10, 0), (0, PEDESTRIAN, 20, 0), (0, PEDESTRIAN, 30, 0))
    first, again, new, wait, over = story((0, crowd), (0.4, crowd), (0.5, more), (0.9, more), (1.0, more))
    assert first == [True] * 3 and again == [False] * 3
    assert new == [False, True, True, True]  # half a second is over
    assert wait == [False] * 4 and over == [True] * 4
    assert story((0, crowd), (0.1, more))[1] == [False, False, False, True]  # a new one goes alone


def with_speed(x, speed, own=0.0):
    """A vehicle with this speed of its own sees a car at `x` whose speed is known unless it is NaN."""
    seen = list_of(OWN, (0, CAR, x, 0))
    return replace(seen, speed_mps=np.array([own, np.nan]), velocity_mps=np.array([[np.nan] * 2, [0.0, speed]]))


def test_a_change_of_speed_by_more_than_half_a_metre_per_second():
    def second(*speeds):
        return [seen for _, seen in story(*((i / 10, with_speed(30, v)) for i, v in enumerate(speeds)))]

    assert second(5.0, 5.5, 5.625) == [True, False, True]
    assert second(5.0, 4.4, 4.5) == [True, True, False]
    assert second(np.nan, 9.0, 20.0) == [True, False, False], "no rule where one of the speeds is unknown"
    own = [(i / 10, with_speed(30, 5.0, v)) for i, v in enumerate((3.0, 3.5, 3.75))]
    assert [first for first, _ in story(*own)] == [True, False, True], "of the vehicle itself, as stated"


def test_what_was_left_out_for_a_second_is_not_new():
    """A parked car has score + 1 (time). One that has moved 8 m and turned 8 degrees since its last inclusion has
    score + 2, and there is room for one. The parked one was included at 0 s, and the vehicle waits at 1.1 s.
    """
    params, state, found = replace(ETSI, max_objects=1, interval_s=0.2), CpmState(), []
    at = Generators(np.array([0]), np.array([0]), np.zeros((1, 2)), np.zeros(1))
    for k, time_s in enumerate((0.0, 0.6, 1.0, 1.1, 1.2)):
        own, parked, moving = OWN, (0, CAR, 30, 0), (0, CAR, 60 + 8 * k, 8 * k)
        seen = list_of(own, parked, moving) if k else list_of(own, parked)
        tracks = np.array([-1, 0, 1][: len(seen)])
        state, content = generate(state, seen, seen.observer, at, time_s, params, tracks)
        found.append([Inclusion(i).name for i in content.inclusion[1:]])
    assert found[2:] == [["OVER_LIMIT", "INCLUDED"], ["WAITING", "WAITING"], ["OVER_LIMIT", "INCLUDED"]]


def test_the_largest_changes_come_first():
    """Of three known objects, the first moved 3.9 m (0.49 of 8 m), the second turned 6 degrees (0.75 of 8)."""

    def at(x, yaw):
        seen = list_of(OWN, (0, CAR, 30 + x, 0), (0, CAR, 60, yaw), (0, CAR, 90, 0))
        return replace(seen, score=np.zeros(4))

    late = (1.0, at(3.9, 6))
    sent = story((0.0, at(0, 0)), late, params=replace(ETSI, max_objects=1))
    assert sent[0] == [True, True, False, False], "equal utility: by number"
    sent = story((0.0, at(0, 0)), late, params=replace(ETSI, max_objects=3))
    assert sent[1] == [True] * 4
    first = story((0.0, at(0, 0)), (0.1, at(0, 0)), (0.2, at(3.9, 6)), params=replace(ETSI, max_objects=2))
    assert first[1] == [False, False, False, True] and first[2] == [False, False, True, False]
    message, utility = np.array([0, 0, 0, 1, 1]), np.array([1.0, 3.0, 3.0, 0.0, 9.0])
    over = beyond_limit(message, utility, np.array([1, 2, 3, 1, 2]), 1)
    assert over.tolist() == [True, False, True, True, False]


@pytest.mark.parametrize(("gap_s", "interval_s", "every"), [(0, 0.1, 1), (0.25, 0.1, 3), (0.1, 0.5, 5), (60, 0.1, 10)])
def test_messages_keep_the_interval_and_congestion_control(gap_s, interval_s, every):
    """An object that moves 5 m per tenth of a second, always to be included when a message is generated."""
    frames = [(t / 10, list_of(OWN, (0, CAR, 5 * t, 0))) for t in range(21)]
    sent = story(*frames, params=replace(ETSI, interval_s=interval_s), gap_s=gap_s)
    assert [car for _, car in sent] == [t % every == 0 for t in range(21)]
    state = CpmState()
    for time_s, seen in frames[:2]:
        state, content = generated(state, seen, time_s, replace(ETSI, interval_s=interval_s), gap_s)
    expected = Inclusion.INCLUDED if every == 1 else Inclusion.WAITING
    assert content.inclusion[1] == expected


def test_sensors_are_described_once_a_second():
    parked = list_of(OWN, (0, CAR, 30, 0))
    for rules, times in (("all", {0, 10, 20}), ("etsi", {0, 10, 20})):
        state, found = CpmState(), set()
        for t in range(25):
            state, content = generated(state, parked, t / 10, CpmParams(rules=rules, length="uper"))
            found |= {t} if content.has_sensors[0] else set()
        assert found == times


def test_lengths_are_those_of_the_encoder():
    """2,000 random messages: encoded object by object, with 44 bytes of the network and 96 of the signature."""
    g = np.random.default_rng(7)
    n = 2000
    count = g.integers(0, 12, n)
    message, d = np.repeat(np.arange(n), count), int(count.sum())
    moves, label = g.random(d) < 0.5, g.integers(0, 4, d)
    velocity = np.where(moves[:, None], g.uniform(-30, 30, (d, 2)), np.nan)
    objects = replace(
        list_of(*[(int(m), int(c), 0, 0) for m, c in zip(message, label, strict=True)]), velocity_mps=velocity
    )
    has_sensors = g.random(n) < 0.5
    length, envelope = encoded_cpm_bytes(objects, message, has_sensors)
    xyz, lwh = g.uniform(-100, 100, (d, 3)), g.uniform(0.3, 12, (d, 3))
    encoded = cpm.CpmObjects.of(np.arange(d) % 65536, label, xyz, lwh, g.uniform(-3, 3, d), g.random(d), velocity)
    begin = np.cumsum(count) - count
    for m in range(n):
        part = encoded.between(begin[m], begin[m] + count[m])
        head = cpm.CpmHead(m, m, m, m, 0, 60.0, None, bool(has_sensors[m]))
        assert length[m] == 140 + len(cpm.cpm(head, int(count[m]), part))
        if count[m] == 0:
            segment = replace(head, segment=(2, 2), has_sensors=False)
            assert envelope[m] == 140 + len(cpm.cpm(segment, 0, part))
    own = replace(objects.take(np.zeros(1, int)), speed_mps=np.array([3.0]), velocity_mps=np.full((1, 2), np.nan))
    assert (
        encoded_cpm_bytes(own, np.zeros(1, int), np.ones(1, bool))[0][0]
        == 140 + cpm.cpm_bytes(np.zeros((1, 4), int), n_moving=np.eye(4, dtype=int)[[own.label[0]]])[0]
    )
    assert len(ObjectClass) == 4


def test_quality_of_a_detected_object_is_above_the_threshold():
    """The least perception quality that clause 6.1.2.3 can give to what was just detected, over all histories.

    Quality is the mean of three ratings of 0 to 15, rounded down: moving averages (each new value counts half) of the
    score, here 0, and of being detected, and the age in tenths of a second. The rate is the highest, 10 Hz.
    """
    lowest = 15
    for before in range(13):
        for hits in itertools.product((0, 1), repeat=max(before - 1, 0)):
            detected = 1.0
            for hit in (*hits, 1) if before else ():
                detected = (detected + hit) / 2
            lowest = min(lowest, (int(15 * detected) + min(before, 15)) // 3)
    assert lowest == 4
