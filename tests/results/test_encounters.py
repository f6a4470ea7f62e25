"""The encounter tracker: by hand, against closed forms, and against a brute-force twin."""

import copy
import math
import pickle

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from results.encounters import EncounterParams, EncounterTracker
from results.recorder import Recorder
from tests.seeds import seeds

NULLS = (
    "gap_s",
    "trust_ab",
    "trust_ba",
    "source_ab",
    "source_ba",
    "age_ab_s",
    "age_ba_s",
    "trusted_after_ab_s",
    "trusted_after_ba_s",
)


def rows_of(columns):
    """Column arrays as a list of dicts, null as None."""
    rows = []
    for i in range(len(columns["a"])):
        row = {name: columns[name][i].item() for name in columns if not name.endswith("__valid")}
        for name in NULLS:
            if not columns[f"{name}__valid"][i]:
                row[name] = None
        rows.append(row)
    return rows


def follow(tracks, params, dt_s=1.0, before_close=lambda tracker, step, opened, pairs: None):
    """Encounters of tracks (step x actor x 2, NaN while not on the road), all pairs given to the tracker."""
    tracker, rows = EncounterTracker(params, dt_s), []
    for step, points in enumerate(tracks):
        present = np.flatnonzero(~np.isnan(points[:, 0]))
        a, b = (present[index] for index in np.triu_indices(len(present), 1))
        distance = np.hypot(*(points[a] - points[b]).T)
        closed, opened = tracker.update(step, a, b, distance, distance < params.radius_m / 2, present)
        rows += rows_of(closed)
        before_close(tracker, step, opened, (a, b))
    return rows + rows_of(tracker.close(len(tracks)))


def on_a_line(*distances):
    """Two actors at these distances, None while the second one is away."""
    return np.array([[(0.0, 0.0), (math.nan,) * 2 if d is None else (d, 0.0)] for d in distances])


def brute_force(tracks, radius_m, hysteresis_s, dt_s):
    """One pair after another, one step after another."""
    n_steps, n_actors, _ = tracks.shape
    rows = []
    for a in range(n_actors):
        for b in range(a + 1, n_actors):
            distance = np.hypot(*(tracks[:, a] - tracks[:, b]).T)
            there = ~np.isnan(distance)
            contact = [s for s in range(n_steps) if there[s] and distance[s] <= radius_m]
            stretches = []
            for s in contact:
                if stretches:
                    last = stretches[-1][-1]
                    if (s - last - 1) * dt_s < max(hysteresis_s, 1e-9) and there[last:s].all():
                        stretches[-1].append(s)
                        continue
                stretches.append([s])
            for i, steps in enumerate(stretches):
                start, end = steps[0], steps[-1] + 1
                gone = next((s for s in range(end, n_steps) if not there[s]), None)
                m_over = max(1, math.ceil(hysteresis_s / dt_s - 1e-9))
                over = end + m_over <= n_steps or gone is not None
                away_before = start > 0 and not there[start - 1]
                rows.append({
                    "a": a, "b": b, "start_step": start, "end_step": end,
                    "censored_left": start == 0, "censored_right": not over,
                    "entered": bool(away_before), "departed": gone == end,
                    "gap_s": None if i == 0 else (start - stretches[i - 1][-1] - 1) * dt_s,
                    "min_distance_m": distance[steps].min(), "mean_distance_m": distance[steps].mean(),
                    "los_share": (distance[steps] < radius_m / 2).mean(),
                })  # fmt: skip
    return rows


def by_key(rows):
    return sorted(rows, key=lambda row: (row["a"], row["b"], row["start_step"]))


@settings(max_examples=60)
@given(
    seeds, st.sampled_from([0.0, 0.5, 1.0, 2.0, 3.5]), st.sampled_from([0.5, 1.0]), st.booleans()
)  # fmt: skip
def test_twin_on_random_walks(seed, hysteresis_s, dt_s, leaving):
    rng = np.random.default_rng(seed)
    tracks = np.cumsum(rng.normal(0, 4, (40, 9, 2)), axis=0) + rng.uniform(-20, 20, (9, 2))
    if leaving:  # every actor is on the road in one stretch, as ids are never reused
        first, last = np.sort(rng.integers(0, 45, (2, 9)), axis=0)
        steps = np.arange(40)[:, None]
        tracks[(steps < first) | (steps > last)] = math.nan
    params = EncounterParams(radius_m=25, hysteresis_s=hysteresis_s, pairs="all")
    told, twin = by_key(follow(tracks, params, dt_s)), by_key(brute_force(tracks, 25, hysteresis_s, dt_s))
    assert len(told) == len(twin)
    for row, other in zip(told, twin, strict=True):
        for name, value in other.items():
            assert row[name] == (pytest.approx(value, rel=1e-5) if isinstance(value, float) else value), name
        assert row["duration_s"] == pytest.approx((row["end_step"] - row["start_step"]) * dt_s)


@pytest.mark.parametrize("lateral_m", [0.0, 30.0, 99.0])
def test_opposite_lanes(lateral_m):
    """Two cars at v1, v2 in opposite lanes d apart are within r for 2 sqrt(r^2 - d^2) / (v1 + v2)."""
    dt, r, v1, v2 = 0.1, 100.0, 13.9, 8.3
    t = np.arange(0, 60, dt)
    zero = np.zeros_like(t)
    tracks = np.stack([np.stack([v1 * t - 400, zero], 1), np.stack([260 - v2 * t, zero + lateral_m], 1)], axis=1)
    (row,) = follow(tracks, EncounterParams(radius_m=r, pairs="all"), dt)
    assert row["duration_s"] == pytest.approx(2 * math.sqrt(r**2 - lateral_m**2) / (v1 + v2), abs=dt)
    assert row["min_distance_m"] == pytest.approx(lateral_m, abs=(v1 + v2) * dt)
    assert not (row["censored_left"] or row["censored_right"] or row["entered"] or row["departed"])


def test_censoring_by_hand():
    params = EncounterParams(radius_m=10, hysteresis_s=3, pairs="all")
    (whole,) = follow(on_a_line(5, 5, 5), params)
    assert whole["censored_left"] and whole["censored_right"] and whole["duration_s"] == 3
    # Contact lost two steps before the end: it may still come back, so it counts as censored at 2 s.
    (pause,) = follow(on_a_line(50, 5, 5, 50, 50), params)
    assert pause["censored_right"] and pause["duration_s"] == 2 and not pause["censored_left"]
    # Lost three steps before the end: over.
    (over,) = follow(on_a_line(50, 5, 5, 50, 50, 50), params)
    assert not over["censored_right"] and over["duration_s"] == 2


def test_counts_and_first_contact():
    """Messages and evaluations are counted by direction; trust is that at its beginning."""

    def talk(tracker, step, opened, pairs):
        a, b = (side[opened] for side in pairs)
        if len(opened):
            tracker.first_contact(
                b, a, np.full(len(a), 0.25), np.full(len(a), 0), np.full(len(a), 0), np.full(len(a), 7.0)
            )
            tracker.first_contact(
                a, b, np.full(len(a), 0.5), np.full(len(a), 2), np.full(len(a), 3), np.full(len(a), 0.0)
            )
        tracker.count_messages(np.array([0, 0, 1, 5]), np.array([1, 1, 0, 0]))
        tracker.count_evaluations(np.array([1, 0]), np.array([0, 1]), np.array([4, 1]))

    tracks = on_a_line(50, 5, 5, 50, 50)
    (row,) = follow(tracks, EncounterParams(radius_m=10, hysteresis_s=0, pairs="all"), before_close=talk)
    assert (row["n_messages_ab"], row["n_messages_ba"]) == (4, 2)  # two steps
    assert (row["n_evaluations_ab"], row["n_evaluations_ba"]) == (2, 8)
    assert (row["trust_ba"], row["source_ba"], row["age_ba_s"]) == (0.25, 0, 7)
    assert (row["trust_ab"], row["source_ab"], row["age_ab_s"]) == (0.5, 2, None)


def test_what_follows_the_last_contact_counts_only_if_contact_comes_again():
    """Near in steps 0 and 2, then apart: what is sent in steps 0 to 2 counts; trust of step 3 comes too late."""

    def talk(tracker, step, opened, pairs):
        tracker.count_messages(np.array([0]), np.array([1]))
        tracker.count_evaluations(np.array([1]), np.array([0]), np.array([2]))
        tracker.note_trust(np.array([0, 1]), np.array([1, 0]), np.array([[step >= 3], [step >= 1]]))

    tracks = on_a_line(5, 50, 5, 50, 50, 50, 50)
    (row,) = follow(tracks, EncounterParams(radius_m=10, hysteresis_s=3, pairs="all"), before_close=talk)
    assert (row["start_step"], row["end_step"]) == (0, 3)
    assert (row["n_messages_ab"], row["n_evaluations_ba"]) == (3, 6)
    assert row["trusted_after_ab_s"] is None and row["trusted_after_ba_s"] == 1


def test_trusted_after():
    """Near from step 1; 0 uses a value for 1 from step 3, 1 knew 0 from the start, and once is enough."""

    def talk(tracker, step, opened, pairs):
        if len(opened):
            state = np.array([0])
            tracker.first_contact(np.array([1]), np.array([0]), np.array([0.5]), np.array([0]), state, np.array([9.0]))
        if step >= 3:
            tracker.note_trust(np.array([0, 1]), np.array([1, 0]), np.ones((2, 1), bool))

    (row,) = follow(on_a_line(50, 5, 5, 5, 5), EncounterParams(radius_m=10, pairs="all"), 0.5, talk)
    assert (row["trusted_after_ab_s"], row["trusted_after_ba_s"]) == (1.0, 0.0)


def test_which_pairs_count():
    a, b = np.array([0, 0]), np.array([1, 2])
    near, present = np.array([5.0, 5.0]), np.arange(3)
    for pairs, expected in (("all", [1, 2]), ("equipped", [1]), ("los", [])):
        tracker = EncounterTracker(EncounterParams(radius_m=10, pairs=pairs), 1.0)
        _, opened = tracker.update(0, a, b, near, np.array([False, True]), present, equipped=np.array([True, False]))
        assert b[opened].tolist() == expected
    assert len(tracker) == 0


@pytest.mark.parametrize("n_others", [0, 20])
@pytest.mark.parametrize("n_away", [35, 36, 37])
def test_a_gap_is_known_after_an_absence_of_an_hour_and_not_after_more(n_away, n_others):
    """Of two actors that meet, one is away for 35 to 37 steps of 100 s, and in each 190 other pairs meet or none."""
    tracker = EncounterTracker(EncounterParams(radius_m=10, hysteresis_s=0, pairs="all"), 100.0)
    for step in range(n_away + 1):
        others = 2 + np.arange(step * n_others, step * n_others + n_others)
        present = np.concatenate([[0], [1] if step in (0, n_away) else [], others]).astype(int)
        a, b = (present[index] for index in np.triu_indices(len(present), 1))
        metres = np.where((a == 0) & (b > 1), 50.0, 1.0)
        tracker.update(step, a, b, metres, np.ones(len(a), bool), present)
    (gap_s,) = [row["gap_s"] for row in rows_of(tracker.close(n_away + 1)) if (row["a"], row["b"]) == (0, 1)]
    assert gap_s == (n_away - 1) * 100.0 if n_away < 37 else gap_s is None


def test_memory_is_bounded_by_the_actors_on_the_road():
    """Actors that come and go for long leave nothing behind."""
    tracker = EncounterTracker(EncounterParams(radius_m=10, hysteresis_s=0, pairs="all"), 600.0)
    for step in range(300):
        present = np.arange(step * 20, step * 20 + 20)
        a, b = (present[index] for index in np.triu_indices(20, 1))
        tracker.update(step, a, b, np.ones(len(a)), np.ones(len(a), bool), present)
    assert len(tracker) == 190
    assert len(tracker._past[0]) + len(tracker._pending[0]) < 6000


def test_first_contact_counts_only_when_an_encounter_begins():
    """Given again in the next step, and for a pair out of range, it changes nothing."""

    def talk(tracker, step, opened, pairs):
        trust = np.array([0.25 + 0.25 * step])
        tracker.first_contact(np.array([0]), np.array([1]), trust, np.array([0]), np.array([0]), np.array([1.0]))

    (row,) = follow(on_a_line(50, 5, 5, 50, 50, 50), EncounterParams(radius_m=10, pairs="all"), before_close=talk)
    assert row["trust_ab"] == 0.5


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda tracker: pickle.loads(pickle.dumps(tracker))])
def test_a_copy_goes_on_alone(copied):
    tracker = EncounterTracker(EncounterParams(radius_m=10, pairs="all"), 1.0)
    pair, near, far, los = (np.array([0]), np.array([1])), np.array([5.0]), np.array([50.0]), np.array([True])
    tracker.update(0, *pair, near, los, np.arange(2))
    other = copied(tracker)
    tracker.update(1, *pair, near, los, np.arange(2))
    other.update(1, *pair, far, los, np.arange(2))
    assert tracker.close(2)["duration_s"].tolist() == [2] and other.close(2)["duration_s"].tolist() == [1]


def test_definitions_that_differ_in_hysteresis_alone(tmp_path):
    """Both keep their rows: the hysteresis belongs to the key."""
    near, los, present = np.array([5.0]), np.array([True]), np.arange(2)
    with Recorder(tmp_path, "summary", block_steps=1) as recorder:
        for hysteresis_s in (0.0, 3.0):
            tracker = EncounterTracker(EncounterParams(hysteresis_s=hysteresis_s, pairs="all"), 1.0)
            tracker.update(0, np.array([0]), np.array([1]), near, los, present)
            recorder.append("encounters", 0, tracker.close(1))
    (part,) = (tmp_path / "encounters").iterdir()
    assert pq.read_table(part).column("hysteresis_s").to_pylist() == [0.0, 3.0]
