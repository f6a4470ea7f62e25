"""Tracks between positions: by hand, and laws of cutting and interpolation."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.addons.traces.positions import Fixes
from cosim.addons.traces.tracks import TrackParams, on_own_steps, steps, tracks


def fixes_of(*rows):
    """Positions (actor, time_s, x_m, y_m), sorted."""
    table = np.array(sorted(rows), float)
    actor = table[:, 0].astype(int)
    return Fixes([f"v{i}" for i in range(actor.max() + 1)], [""] * (actor.max() + 1), actor, table[:, 1], table[:, 2:])


def seen(fixes, step_s=1.0, max_gap_s=30.0, **more):
    """What is seen: (step, name of the track) and its place."""
    found = tracks(fixes, TrackParams(step_s, max_gap_s, **more))
    return {
        (here.step, found.names[t]): tuple(np.round(xy, 9))
        for here in steps(fixes, found, step_s) for t, xy in zip(here.track, here.xy_m, strict=True)
    }, found  # fmt: skip


def test_by_hand():
    # v0 is seen at 0.5 s and 2.5 s, 20 m apart: at 1 s a quarter of the way, at 2 s three quarters. v1 stands on 1 s.
    places, found = seen(fixes_of((0, 0.5, 0, 0), (0, 2.5, 20, 0), (1, 1, 7, 7)))
    assert places == {(1, "v0"): (5, 0), (2, "v0"): (15, 0), (1, "v1"): (7, 7)}
    assert found.first_step.tolist() == [1, 1] and found.last_step.tolist() == [2, 1] and found.n_steps == 3


def test_a_gap_makes_another_track_of_the_same_vehicle():
    rows = [(0, 0, 0, 0), (0, 10, 100, 0), (0, 41, 200, 0), (0, 42, 210, 0)]
    places, found = seen(fixes_of(*rows), max_gap_s=30.0)
    assert found.names == ["v0", "v0"] and found.report["gaps"] == 1
    assert found.first_step.tolist() == [0, 41] and found.last_step.tolist() == [10, 42]
    assert {step for step, _ in places} == {*range(11), 41, 42}
    assert seen(fixes_of(*rows), max_gap_s=31.0)[1].names == ["v0"]


def test_a_jump_makes_another_vehicle_until_the_first_can_have_driven_there():
    _, found = seen(fixes_of((0, 0, 0, 0), (0, 1, 71, 0), (0, 2, 90, 0)), max_speed_mps=70.0)
    assert found.names == ["v0", "v0/2"] and found.report["jumps"] == 1
    _, found = seen(fixes_of((0, 0, 0, 0), (0, 1, 9, 0), (0, 2, 900, 0), (0, 3, 29, 0)), max_speed_mps=70.0)
    assert found.names == ["v0", "v0/2", "v0"] and found.report["jumps"] == 2


def test_another_vehicle_does_not_take_a_name_of_the_trace():
    fixes = fixes_of((0, 0, 0, 0), (0, 1, 900, 0), (1, 0, 0, 9), (1, 1, 0, 9))
    _, found = seen(Fixes(["1", "1/2"], ["", ""], fixes.actor, fixes.time_s, fixes.xy_m))
    assert found.names == ["1", "1/2", "1/3"]


def test_the_bound_on_the_error():
    # 10 s and 100 m at up to 20 m/s: sqrt(200^2 - 100^2) / 2 = 86.60 m for the nine steps between.
    _, found = seen(fixes_of((0, 0, 0, 0), (0, 10, 100, 0)))
    assert found.report["error_bound_median_m"] == pytest.approx(86.6025, abs=1e-3)
    assert found.report["interpolated_share"] == pytest.approx(9 / 11)


def interval_s(*times_s):
    return on_own_steps(fixes_of(*((0, t, t, 0) for t in times_s)))[1]


def test_the_interval_of_a_trace():
    assert interval_s(*(0.04 * k for k in range(50))) == 0.04
    assert interval_s(0, 7.3, 15.1) == 1.0
    assert interval_s(0, 5) == 1.0  # rarer than every second is interpolated
    assert interval_s(0) == 1.0
    assert interval_s(*np.random.default_rng(1).uniform(0, 60, 300)) == 1.0


@pytest.mark.parametrize("hz", [12.5, 15, 24, 25, 30, 30000 / 1001, 50, 60])
@pytest.mark.parametrize("digits", [2, 3, 9])
def test_times_of_frames_that_a_file_rounds_are_put_back(hz, digits):
    """Ten minutes; frames are rounded to 10 ms, 1 ms or not at all, and some are missing."""
    if digits == 2 and hz > 40:
        return
    k = np.delete(np.arange(int(600 * hz)), [3, 4, 77])
    fixes = fixes_of(*((0, t, 0, 0) for t in np.round(k / hz, digits)))
    placed, step_s = on_own_steps(fixes)
    assert step_s == pytest.approx(1 / hz, rel=1e-6)
    np.testing.assert_allclose(placed.time_s, k / hz, atol=2e-3 / hz)
    assert tracks(placed, TrackParams(step_s, 1.0)).report["interpolated_share"] == pytest.approx(0, abs=0.001)


@pytest.mark.parametrize(
    ("times", "x", "says"),
    [(range(0, 600, 100), range(0, 72, 12), "100 s apart"), (range(6), range(0, 7200, 1200), "ask for 1,200 m/s")],
)
def test_positions_of_which_none_can_be_joined_are_in_other_units(times, x, says):
    fixes = Fixes(["a"], [""], np.zeros(6, int), np.array(times, float), np.column_stack([x, np.zeros(6)]))
    with pytest.raises(ValueError, match=f"of 5 pairs .* only 0 are joined: .*{says}"):
        tracks(fixes, TrackParams(1.0, 30.0))


def test_nothing_on_a_step_is_told():
    with pytest.raises(ValueError, match="Lower --step-s"):
        seen(fixes_of((0, 0.4, 0, 0)))


@settings(max_examples=60)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 400), st.integers(-9, 9)), min_size=1, max_size=40),
       st.sampled_from([0.5, 1.0, 2.5]))  # fmt: skip
def test_twin_of_numpy_interp(rows, step_s):
    """Inside a track, positions are those of `numpy.interp`; a step is in at most one track of an actor."""
    fixes = fixes_of(*{(a, t / 10): (a, t / 10, x, 0) for a, t, x in rows}.values())
    try:
        places, _ = seen(fixes, step_s, max_gap_s=5.0, max_speed_mps=1e9)
    except ValueError:
        return
    at = [(step, name.split("/")[0]) for step, name in places]
    assert len(set(at)) == len(at)
    for (step, name), (x, _) in places.items():
        mine = fixes.actor == int(name.split("/")[0][1:])
        assert x == pytest.approx(np.interp(step * step_s, fixes.time_s[mine], fixes.xy_m[mine, 0]), abs=1e-6)
    for number in range(fixes.actor.max() + 1):  # every step within a short enough gap is there
        times = fixes.time_s[fixes.actor == number]
        for early, late in pairwise(times):
            if late - early <= 5.0:
                inside = [s for s in range(100) if early <= s * step_s <= late]
                assert all((s, f"v{number}") in at for s in inside)
