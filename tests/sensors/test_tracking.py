"""Tracks: by hand, against a slow twin, and against Stone Soup."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.stats import multivariate_normal

from sensors.tracking import track as tracking
from sensors.tracking.motion import existence_gain, expected_speed, mean_motion, predicted, updated
from sensors.tracking.params import TrackingParams
from sensors.tracking.track import track
from sensors.tracking.tracks import Found, Observers, TrackMemory, Tracks
from tests.seeds import seeds
from tests.sensors.one_track_at_a_time import StoneSoup, Twin

P = TrackingParams(model="constant_velocity")


def one_track(**changed):
    """A car's track that moves east, at time 0, with errors along and across the axis that differ."""
    motion = [[1.0, 3.0, 1.0, 0.5, 2.0], [2.0, 0.0, 0.91, 0.5, 1.0]]
    made = Tracks(
        observer=np.array([7]), object_id=np.array([0]), label=np.zeros(1, np.uint8), n_hits=np.array([1]),
        time_s=np.zeros(1), first_s=np.zeros(1), last_s=np.zeros(1), axis=np.array([[1.0, 0.0]]),
        motion_p=np.array([[1.0, 0.0]]), motion=np.array([[motion, motion]]), existence=np.zeros(1),
    )  # fmt: skip
    return replace(made, **changed)


def states(tracks):
    """Place and velocity of the first track, east and north, and its covariances along and across."""
    motion, (cos, sin) = mean_motion(tracks)[0], tracks.axis[0]
    turn = np.array([[cos, -sin], [sin, cos]])
    return turn @ motion[:, 0], turn @ motion[:, 1], motion[:, 2:]


def found(observer, label, xy_m, yaw_rad, score=0.5, after_s=0.0):
    n = len(observer)
    return Found(
        np.asarray(observer, np.int64), np.broadcast_to(np.asarray(label, np.uint8), n), np.asarray(xy_m, float),
        np.broadcast_to(np.asarray(yaw_rad, float), n), np.broadcast_to(np.asarray(score, float), n),
        np.full(n, np.nan), np.full(n, after_s),
    )  # fmt: skip


def sensing(numbers, time_s, speed_mps=0.0):
    n = len(numbers)
    return Observers(np.asarray(numbers, np.int64), np.full(n, float(time_s)), np.full(n, float(speed_mps)))


def test_prediction_by_hand():
    # t = 2, q = 0.3, along the axis: P_xx = 1 + 2 * 2 * 0.5 + 4 * 2 + 0.3 * 8 / 3 = 11.8,
    # P_xv = 0.5 + 2 * 2 + 0.3 * 4 / 2 = 5.1, P_vv = 2 + 0.3 * 2 = 2.6; x = 1 + 2 * 3 = 7
    p = TrackingParams(steady_noise=(0.3, 1.0, 1.0, 1.0), accelerating_p=0.0)
    later = predicted(one_track(), np.array([2.0]), p)
    place, _, covariance = states(later)
    assert place == pytest.approx([7.0, 2.0]) and later.time_s[0] == 2.0
    assert covariance[0] == pytest.approx([11.8, 5.1, 2.6])
    # across it: 0.91 + 2 + 4 + 0.8 = 7.71, 0.5 + 2 + 0.6 = 3.1, 1 + 0.6 = 1.6
    assert covariance[1] == pytest.approx([7.71, 3.1, 1.6])


def test_two_motions_by_hand():
    """A track along x, both motions equally likely, at 1 and 3 m/s, with variances 1 of place and velocity.

    After 1 s half of the objects have had a chance to change, and a quarter of these accelerate: 0.5 x 0.5 + 0.5 x 0.75
    = 0.625 are steady. Of these, 0.5 x 0.875 / 0.625 = 0.7 were: v = 0.7 x 1 + 0.3 x 3 = 1.6, P_vv = 1 + 0.7 x 0.36 +
    0.3 x 1.96 = 1.84, P_xx = 1 + 1.84. Of the others, 5 / 6 accelerated before: v = 16 / 6, P_vv = 1 + 4 x 5 / 36, and
    with q = 3, P_xx = 1 + P_vv + 1. Across, both stay at 0.
    """
    p = TrackingParams(
        steady_noise=(1e-12, 1, 1, 1), acceleration_noise=(3, 1, 1, 1), accelerating_p=0.25,
        motion_memory_s=1 / np.log(2), position_sigma_m=(1, 1, 1, 1),
    )  # fmt: skip
    motion = np.array([[[0, v, 1, 0, 1], [0, 0, 1, 0, 1]] for v in (1.0, 3.0)])[None]
    later = predicted(one_track(motion_p=np.array([[0.5, 0.5]]), motion=motion), np.ones(1), p)
    vv = 1 + 5 / 9
    assert later.motion_p[0] == pytest.approx([0.625, 0.375])
    assert later.motion[0, 0] == pytest.approx(np.array([[1.6, 1.6, 2.84, 1.84, 1.84], [0, 0, 2, 1, 1]]))
    expected = [[16 / 6, 16 / 6, 2 + vv, vv + 1.5, vv + 3], [0, 0, 3, 2.5, 4]]
    assert later.motion[0, 1] == pytest.approx(np.array(expected))
    # A detection at x = 3 and y = 1, with variance 1 along each axis: Bayes' rule.
    after = updated(later, found([7], 0, [[3.0, 1.0]], 0.0), p)
    steady = 0.625 * multivariate_normal([1.6, 0], np.diag([3.84, 3])).pdf([3, 1])
    other = 0.375 * multivariate_normal([16 / 6, 0], np.diag([3 + vv, 4])).pdf([3, 1])
    assert after.motion_p[0] == pytest.approx([steady / (steady + other), other / (steady + other)])
    assert after.motion[0, 0, 0, 0] == pytest.approx(1.6 + 2.84 / 3.84 * 1.4)
    # Mean and variance of both together: those of a mixture.
    w = after.motion_p[0]
    v, each = after.motion[0, :, 0, 1], after.motion[0, :, 0, 4]
    assert states(after)[1][0] == pytest.approx(w @ v)
    assert states(after)[2][0, 2] == pytest.approx(w @ (each + v**2) - (w @ v) ** 2)


def test_a_car_that_brakes_is_less_certain_than_one_that_drives_on():
    """At 10 m/s for 6 s; then one of them brakes by 4 m/s². A filter with one acceleration would state the same."""
    p, memory = P, TrackMemory()
    for second in range(8):
        braked_m = 2.0 * max(second - 6, 0) ** 2
        seen = found([1, 1], 0, [[10.0 * second, 0.0], [10.0 * second - braked_m, 50.0]], 0.0, 0.9)
        memory, state = track(memory, sensing([1], second), seen, p)
    assert state.object_id.tolist() == [0, 1]
    assert np.sqrt(state.variance[0, 0]) < 0.2 < 3 * 0.2 < np.sqrt(state.variance[1, 0])
    assert state.velocity_mps[0] == pytest.approx([10, 0], abs=0.1) and 5 < state.velocity_mps[1, 0] < 9


def test_update_by_hand():
    # Heading north, so "along" is y and "across" is -x. r = 0.3² = 0.09.
    # Across: P_xx = 0.91, s = 1, gains 0.91 and 0.5. A detection 2 m west of the track is 2 m to its left:
    # x = 1 - 0.91 * 2 = -0.82, vx = 3 - 0.5 * 2 = 2; P = 0.91 * 0.09, 0.5 * 0.09, 1 - 0.25.
    # Along: P_xx = 1, s = 1.09, gains 1 / 1.09 and 0.5 / 1.09. It is 1.09 m north: y = 2 + 1, vy = 0 + 0.5.
    p = TrackingParams(position_sigma_m=(0.3, 1.0, 1.0, 1.0), existence_memory_s=0.0)
    north = np.array([[[2.0, 0.0, 1.0, 0.5, 2.0], [-1.0, -3.0, 0.91, 0.5, 1.0]]] * 2)[None]
    after = updated(one_track(axis=np.array([[0.0, 1.0]]), motion=north), found([7], 0, [[-1.0, 3.09]], 0.0), p)
    place, velocity, covariance = states(after)
    assert place == pytest.approx([-0.82, 3.0]) and velocity == pytest.approx([2.0, 0.5])
    assert covariance[1] == pytest.approx([0.0819, 0.045, 0.75])
    assert covariance[0] == pytest.approx([0.09 / 1.09, 0.045 / 1.09, 2 - 0.25 / 1.09])
    assert after.n_hits[0] == 2 and after.existence[0] == pytest.approx(p.existence_again)  # a score of 0.5 adds 0


def test_a_detection_of_another_moment_by_hand():
    # Seen 0.5 s after the moment, along the axis: it measures x + 0.5 v, whose covariances with x and v are
    # a = 1 + 0.5 * 0.5 = 1.25 and b = 0.5 + 0.5 * 2 = 1.5; s = 1.25 + 0.5 * 1.5 + 0.09 = 2.09. The track expects
    # 1 + 0.5 * 3 = 2.5 there and finds 4.59, so y = 2.09: x = 1 + 1.25, v = 3 + 1.5.
    p = TrackingParams(position_sigma_m=(0.3, 1.0, 1.0, 1.0))
    after = updated(one_track(), found([7], 0, [[4.59, 2.0]], 0.0, after_s=0.5), p)
    place, velocity, covariance = states(after)
    assert place == pytest.approx([2.25, 2.0]) and velocity == pytest.approx([4.5, 0.0])
    expected = [1 - 1.25**2 / 2.09, 0.5 - 1.25 * 1.5 / 2.09, 2 - 1.5**2 / 2.09]
    assert covariance[0] == pytest.approx(expected)
    # A new track expects 6 m/s with a deviation of 4.5 m/s. So it was 3 m back: P_xx = 0.09 + 0.25 * 20.25.
    memory, _ = track(TrackMemory(), sensing([1], 0), found([1], 0, [[4.0, 0.0]], 0.0, after_s=0.5), p)
    place, _, covariance = states(memory.tracks)
    assert place == pytest.approx([1.0, 0.0]) and covariance[0] == pytest.approx([5.1525, -10.125, 20.25])


def test_a_car_that_passes_behind_a_turning_sensor():
    """At 30 m/s, seen without noise 0.05 s late and then 0.05 s early, as its azimuth goes from half a turn to less
    than minus half a turn: no jump of 3 m in its place and no false speed."""
    memory, p = TrackMemory(), replace(P, keep_s=3.0)
    for second in range(8):
        after_s = 0.05 if second < 4 else -0.05
        seen = found([1], 0, [[30.0 * (second + after_s), 0.0]], 0.0, 0.9, after_s)
        memory, state = track(memory, sensing([1], second, 30.0), seen, p)
    assert state.object_id.tolist() == [0] and state.velocity_mps[0] == pytest.approx([30.0, 0.0], abs=0.05)
    assert states(memory.tracks)[0] == pytest.approx([210.0, 0.0], abs=0.01)


def test_existence_by_hand():
    # Log-odds of 1.95 for a new track of score 0.5; a second detection ln 2 memories later counts by half of
    # 1.38 + 1.9 logit(0.75) = 1.38 + 1.9 ln 3; a score of 0.99 counts as 0.88.
    p = replace(P, existence_memory_s=1.0 / np.log(2))
    memory, first = track(TrackMemory(), sensing([1], 0), found([1], 1, [[0.0, 0.0]], 0.0), p)
    assert first.existence_p[0] == pytest.approx(1 / (1 + np.exp(-1.95)))
    _, again = track(memory, sensing([1], 1), found([1], 1, [[0.5, 0.0]], 0.0, 0.75), p)
    assert again.existence_p[0] == pytest.approx(1 / (1 + np.exp(-(1.95 + (1.38 + 1.9 * np.log(3)) / 2))))
    assert existence_gain(np.array([0.99]), np.array([np.inf]), p) == pytest.approx(1.38 + 1.9 * np.log(0.88 / 0.12))


def scene(seed, n_observers=6, n_objects=12, n_moments=9, together=False, most_s=0.05):
    """Moments of a crowded random scene: (observers, detections). Some observers do not sense in some moments. Objects
    are seen up to `most_s` before or after the moment."""
    rng = np.random.default_rng(seed)
    label = rng.choice([0, 0, 1, 2, 3], n_objects).astype(np.uint8)
    yaw = rng.uniform(-np.pi, np.pi, n_objects)
    speed = rng.choice([0.0, 1.0, 5.0, 12.0], n_objects)
    xy = rng.uniform(-20, 20, (n_objects, 2))
    moments, time_s = [], 0.0
    for _ in range(n_moments):
        time_s += 0.3 if together else rng.choice([0.1, 0.5, 1.0])
        heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
        who = np.flatnonzero(rng.random(n_observers) < (1.0 if together else 0.7)) * 3 + 5
        rows = [(o, np.flatnonzero(rng.random(n_objects) < 0.8)) for o in who]
        o = np.concatenate([[k] * len(r) for k, r in rows] or [[]]).astype(np.int64)
        r = np.concatenate([r for _, r in rows] or [[]]).astype(np.int64)
        after_s = rng.uniform(-most_s, most_s, len(r))
        at = xy[r] + ((time_s + after_s) * speed[r])[:, None] * heading[r]
        seen = label[r].copy()
        seen[rng.random(len(r)) < 0.05] = 3  # confused
        moments.append((
            Observers(who, np.full(len(who), time_s), rng.uniform(0, 30, len(who))),
            Found(o, seen, at + rng.normal(0, 0.2, (len(r), 2)), yaw[r] + rng.normal(0, 0.1, len(r)),
                  rng.uniform(0, 1, len(r)), rng.choice([np.nan, 13.9, 27.8], len(r)), after_s),
        ))  # fmt: skip
    return moments


def as_rows(found, rows):
    """Class, place, heading, score, limit and time of each of these detections."""
    columns = found.label.astype(int), found.xy_m, found.yaw_rad, found.score, found.limit_mps, found.after_s
    return list(zip(*(column[rows] for column in columns), strict=True))


def played(moments, p=P):
    """The memory at the end, and the states of every moment."""
    memory, states = TrackMemory(), []
    for observers, seen in moments:
        memory, state = track(memory, observers, seen, p)
        states.append(state)
    return memory, states


def agree(one, other, tolerance=1e-9):
    for f in fields(one):
        a, b = np.asarray(getattr(one, f.name), float), np.asarray(getattr(other, f.name), float)
        assert a == pytest.approx(b, abs=tolerance, nan_ok=True), f.name


@settings(max_examples=15)
@given(seed=seeds)
def test_like_the_slow_twin(seed):
    moments, twin = scene(seed), Twin(P)
    _, states = played(moments)
    for (observers, seen), state in zip(moments, states, strict=True):
        for o, t, v in zip(observers.number, observers.time_s, observers.speed_mps, strict=True):
            rows = np.flatnonzero(seen.observer == o)
            said = twin.sense(o, t, v, as_rows(seen, rows))
            for k, (number, age_s, velocity, variance, existence) in zip(rows, said, strict=True):
                assert state.object_id[k] == number and state.age_s[k] == pytest.approx(age_s)
                assert state.velocity_mps[k] == pytest.approx(velocity, abs=1e-7, nan_ok=True)
                assert state.variance[k].sum() == pytest.approx(variance)
                assert state.existence_p[k] == pytest.approx(existence, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_turning_and_moving_the_world_and_renaming_observers_change_nothing_else(seed):
    """Numbers stay the same, and velocities turn."""
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    moments, moved = scene(seed), []
    for observers, seen in moments:
        number, observer = 3 * observers.number + 1, 3 * seen.observer + 1
        place, yaw = seen.xy_m @ turn.T + [300.0, -70.0], seen.yaw_rad + np.arctan2(0.8, 0.6)
        found_there = replace(seen, observer=observer, xy_m=place, yaw_rad=yaw)
        moved.append((replace(observers, number=number), found_there))
    for one, other in zip(played(moments)[1], played(moved)[1], strict=True):
        assert one.object_id.tolist() == other.object_id.tolist()
        assert other.velocity_mps == pytest.approx(one.velocity_mps @ turn.T, abs=1e-7, nan_ok=True)
        assert other.variance == pytest.approx(one.variance)


def test_like_stone_soup():
    """Three observers in a crowd, all objects with one noise: the same numbers, and states within 1e-9."""
    moments = scene(3, n_observers=3, n_objects=9, n_moments=7, most_s=0.0)
    p = replace(P, steady_noise=(1.5, 0.2, 0.7, 1.5), accelerating_p=0.0)
    library, memory, n_moved = {}, TrackMemory(), 0
    for observers, seen in moments:
        memory, state = track(memory, observers, seen, p)
        own = memory.tracks
        for o, t, v in zip(observers.number, observers.time_s, observers.speed_mps, strict=True):
            rows = np.flatnonzero(seen.observer == o)
            said = library.setdefault(o, StoneSoup(p)).sense(t, v, [row[:5] for row in as_rows(seen, rows)])
            for k, (number, xy, velocity, _) in zip(rows, said, strict=True):
                row = np.flatnonzero((own.observer == o) & (own.object_id == number))
                assert state.object_id[k] == number
                place_m, velocity_mps, _ = states(own.take(row))
                assert place_m == pytest.approx(xy, abs=1e-9)
                assert velocity_mps == pytest.approx(velocity, abs=1e-9)
                n_moved += not np.isnan(state.velocity_mps[k]).any()
    assert n_moved > 30


def test_one_that_does_not_sense_keeps_its_tracks():
    memory, _ = track(TrackMemory(), sensing([1, 2], 0), found([1, 2], 0, [[0, 0], [9, 9]], 0.0), P)
    later, _ = track(memory, sensing([2], 1), found([2], 0, [[15, 9]], 0.0), P)
    kept, was = (m.tracks.take(np.flatnonzero(m.tracks.observer == 1)) for m in (later, memory))
    agree(kept, was, 0.0)
    _, state = track(later, sensing([1], 1.5), found([1], 0, [[9.0, 0.0]], 0.0), P)  # predicted over 1.5 s, not 0.5
    assert state.object_id[0] == 0 and state.age_s[0] == 1.5
    gone, _ = track(later, sensing([2], 3), found([], 0, np.zeros((0, 2)), 0.0), P)  # it left: its tracks end too
    assert gone.tracks.observer.tolist() == [2]


def test_a_parked_and_a_turning_car_and_a_pedestrian():
    """A parked car is still, a pedestrian slow; on a circle of 20 m at 6 m/s the velocity lags, by less at 10 Hz."""
    rng, lag = np.random.default_rng(0), {}
    for rate_hz in (1, 2, 10):
        memory, errors = TrackMemory(), []
        for k in range(20 * rate_hz):
            t = k / rate_hz
            heading = 0.3 * t
            xy = [[50.0, 50.0], [20 * np.sin(heading), -20 * np.cos(heading)], [1.3 * t, 80.0]]
            true = np.array([[0.0, 0.0], [6 * np.cos(heading), 6 * np.sin(heading)], [1.3, 0.0]])
            noisy = xy + rng.normal(0, 0.08, (3, 2)) * [[1], [1], [0.4]]
            seen = found([1, 1, 1], [0, 0, 1], noisy, [1.0, heading, 0.0], 0.9)
            memory, state = track(memory, sensing([1], t), seen, P)
            errors.append(np.linalg.norm(state.velocity_mps - true, axis=1))
        still, lag[rate_hz], walking = np.sqrt(np.mean(np.square(errors[5 * rate_hz :]), axis=0))
        assert state.object_id.tolist() == [0, 1, 2] and still < 0.5 and walking < 0.3
    assert lag[10] < lag[2] < lag[1] < 1.5


def test_used_wrongly():
    memory, _ = track(TrackMemory(), sensing([4], 5), found([4], 0, [[0.0, 0.0]], 0.0), P)
    with pytest.raises(ValueError, match="time goes forward"):
        track(memory, sensing([4], 4), found([], 0, np.zeros((0, 2)), 0.0), P)
    with pytest.raises(ValueError, match="does not sense"):
        track(memory, sensing([4], 6), found([5], 0, [[0.0, 0.0]], 0.0), P)
    for observers, seen in ((sensing([5, 4], 6), []), (sensing([4, 5], 6), [5, 4])):
        with pytest.raises(ValueError, match="sorted"):
            track(memory, observers, found(seen, 0, np.zeros((len(seen), 2)), 0.0), P)
    with pytest.raises(ValueError, match="existence_scores"):
        TrackingParams(existence_scores=(0.9, 0.1))
    empty, state = track(TrackMemory(), sensing([], 0), found([], 0, np.zeros((0, 2)), 0.0), P)
    assert not len(empty.tracks) and not len(state.object_id)


def test_many_blocks_are_assigned_as_one(monkeypatch):
    moments = scene(11, n_observers=12, n_objects=25, n_moments=4)
    whole = played(moments)[1]
    monkeypatch.setattr(tracking, "_BLOCK_PAIRS", 7)
    for a, b in zip(whole, played(moments)[1], strict=True):
        agree(a, b, 0.0)


def test_expected_speed_follows_the_limit():
    """By hand: on a motorway of 30 m/s the mean is 0.8 x 30 and the standard deviation 0.6 x 30, whoever looks. On a
    street of 20 m/s they are 10 and 8. On one of 5 m/s, those of the class. Without a map, 0.7 x 20 and 0.4 x 20."""
    limits, own = np.array([30.0, 30.0, 20.0, 5.0, np.nan]), np.array([0.0, 40.0, 0.0, 0.0, 20.0])
    mean_mps, sigma_mps = expected_speed(np.zeros(5, np.uint8), limits, own, P)
    assert mean_mps == pytest.approx([24, 24, 10, 6, 14]) and sigma_mps == pytest.approx([18, 18, 8, 4.5, 8])
    walks = expected_speed(np.ones(5, np.uint8), limits, own, P)
    assert (walks[0] == P.along_mean_mps[1]).all() and (walks[1] == P.along_sigma_mps[1]).all()
