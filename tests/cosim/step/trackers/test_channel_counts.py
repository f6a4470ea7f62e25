"""Counts of frames and messages, against naive twins in plain loops."""

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.step.trackers.attack_start import AttackStartTracker
from cosim.step.trackers.channel_counts import channel_busy_ratio, latency_histogram, pdr_by_distance, vehicle_channel

COLUMNS = {"n_delivered": 0, "n_lost_propagation": 1, "n_lost_collision": 2}
frames = st.lists(st.tuples(st.floats(0, 400), st.integers(0, 2), st.integers(0, 2)), max_size=80)


@given(frames)
def test_pdr_by_distance_twin(rows):
    distance_m = np.array([row[0] for row in rows], float)
    los_state, outcome = (np.array([row[i] for row in rows], np.int64) for i in (1, 2))
    found, total = pdr_by_distance(distance_m, los_state.astype(np.uint8), outcome, COLUMNS)
    cells = Counter((int(d) // 25 * 25, los, out) for d, los, out in rows)
    expected = [
        (low, los, sum(cells[low, los, out] for out in range(3)), *(cells[low, los, out] for out in range(3)))
        for low, los in sorted({(low, los) for low, los, _ in cells})
    ]
    names = ("distance_bin_m", "los_state", "n_in_range", *COLUMNS)
    assert list(zip(*(found[name].tolist() for name in names), strict=True)) == expected
    assert {name: values.item() for name, values in total.items()} == {
        "n_in_range": len(rows), **{name: sum(row[2] == code for row in rows) for name, code in COLUMNS.items()}
    }  # fmt: skip


@given(st.lists(st.floats(0, 5), max_size=50))
def test_latency_histogram_twin(latencies):
    """A bin holds what is at least its lower edge and below the next, a factor of the square root of 2 above."""
    edges = [0.0] + [1e-4 * 2.0 ** (i / 2) for i in range(-2, 33)]
    counts = Counter(max(edge for edge in edges if edge <= latency) for latency in latencies)
    found = latency_histogram(np.array(latencies, float))
    assert dict(zip(found["latency_s"].tolist(), found["n_delivered"].tolist(), strict=True)) == dict(counts)


receivers = st.lists(st.integers(0, 4), max_size=30)


@given(st.tuples(receivers, receivers), st.tuples(receivers, receivers), st.booleans())
def test_vehicle_channel_twin(in_range, received, modelled):
    busy = [np.linspace(0, 1, 7), np.full(7, 0.5) if modelled else None]  # two roadside units behind five vehicles
    counts = [np.bincount(np.array(rows, np.int64), minlength=5) for rows in in_range]
    found = vehicle_channel(5, counts, [np.array(rows, np.int64) for rows in received], channel_busy_ratio(5, busy))
    assert found["n_in_range"].tolist() == [sum(rows.count(v) for rows in in_range) for v in range(5)]
    assert found["n_received"].tolist() == [sum(rows.count(v) for rows in received) for v in range(5)]
    assert found["cbr__valid"].tolist() == [modelled] * 5
    if modelled:
        assert found["cbr"].tolist() == [(v / 6 + 0.5) / 2 for v in range(5)]


def test_attack_start_is_the_first_step():
    tracker = AttackStartTracker()
    for step, attackers in enumerate(([], [2, 2], [0, 2], [0])):
        tracker = tracker.next(step, np.array(attackers, int))
    step, attacked = tracker.first_steps(4)
    assert attacked.tolist() == [True, False, True, False] and step[attacked].tolist() == [2, 1]
