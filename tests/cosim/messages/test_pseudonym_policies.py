"""When pseudonyms change, by hand: one vehicle that drives straight on, or in circles."""

import numpy as np
import pytest

from cosim.base import rng
from cosim.messages.pseudonyms import (
    C2c,
    C2cParams,
    Disposable,
    DisposableParams,
    Pseudonyms,
    PseudonymState,
    Scms,
    ScmsParams,
)
from cosim.world import World
from sensors.scene import Shape
from tests.sensors.town import boxes_at

DT_S = 10.0


def at(step, place):
    """A world with one vehicle at this place."""
    return World(
        step=step, actor=np.array([0]), name_key=np.array([rng.name_key("vehicle/a")], np.uint64),
        shape=np.array([Shape.CAR], np.uint8),
        boxes=boxes_at((*place, 0.75), (4.4, 1.8, 1.5)),
        speed_mps=np.zeros(1), equipped=np.ones(1, bool), attack=np.zeros(1, np.uint8),
    )  # fmt: skip


def change_times(policy, xy_m, seed=3):
    """Times [s] at which a vehicle with these places, ten seconds apart, takes another pseudonym."""
    pseudonyms, state, found = Pseudonyms(policy, seed, DT_S), PseudonymState(), []
    for step, place in enumerate(xy_m):
        state, ended = pseudonyms.issue(state, at(step, place), np.array([0]))
        if len(ended.pseudonym):
            found.append(step * DT_S)
    return np.array(found)


@pytest.mark.parametrize("enters_silently", [False, True])
def test_three_messages_are_three_also_where_a_vehicle_enters_before_its_first_one(enters_silently):
    """With `disposable` and three messages, sent in steps 1, 2, ..., the fourth has another pseudonym."""
    pseudonyms = Pseudonyms(Disposable(DisposableParams(n_messages=3)), 3, DT_S)
    state, used, row = PseudonymState(), [], np.array([0])
    for step in range(0 if enters_silently else 1, 5):
        state, _ = pseudonyms.issue(state, at(step, (0.0, 0.0)), row)
        pseudonym = state.of(row)
        if step > 0:
            state = pseudonyms.counted(state, row)
            used += pseudonym.tolist()
    assert used == [0, 0, 0, 1]


def draws(n_changes, seed=3):
    key = np.array([rng.name_key("vehicle/a")], np.uint64)
    return rng.uniforms(rng.key(seed, rng.Stream.PSEUDONYM), key, np.array([n_changes]), n=4)[0]


STRAIGHT = np.column_stack([10.0 * DT_S * np.arange(400), np.zeros(400)])
"""10 m/s, so that 800 m take 80 s."""


@pytest.mark.parametrize(("reading", "waits"), [("then", True), ("both", False)])
def test_c2c(reading, waits):
    """First after U(800, 1500) m; later after 800 m, which take 80 s, and 2 to 6 min then, or 2 to 6 min altogether."""
    found = change_times(C2c(C2cParams(reading=reading)), STRAIGHT)
    assert found[0] == np.ceil((800 + 700 * draws(0)[0]) / 10.0 / DT_S) * DT_S
    for number, gap_s in enumerate(np.diff(found)[:5], 1):
        further_s = 120 + 240 * draws(number)[1]
        assert gap_s == np.ceil((waits * 80.0 + further_s) / DT_S) * DT_S
    assert len(found) > 6


def test_scms_counts_from_the_place_of_the_last_change():
    """At 10 m/s, 5 min take 3 km: changes every 300 s. In a circle of 1 km across, whatever the way, there is none."""
    assert np.diff(change_times(Scms(ScmsParams()), STRAIGHT)).tolist() == [300.0] * 12
    angle = 10.0 * DT_S * np.arange(400) / 500.0
    circle = 500.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert not len(change_times(Scms(ScmsParams()), circle))
    assert len(change_times(Scms(ScmsParams(distance="driven")), circle)) > 10


def test_a_pseudonym_is_in_use_until_the_next_one():
    """A vehicle that sends in every fifth step, with two messages per pseudonym.

    Trust in a pseudonym may be computed between its last message and the first of the next one.
    """
    pseudonyms, state, used = Pseudonyms(Disposable(DisposableParams(n_messages=2)), 3, 0.2), PseudonymState(), []
    for step in range(1, 30, 5):
        state, ended = pseudonyms.issue(state, at(step, (0.0, 0.0)), np.array([0]))
        state = pseudonyms.counted(state, np.array([0]))
        used += list(zip(ended.from_step.tolist(), ended.to_step.tolist(), strict=True))
    assert used == [(1, 10), (11, 20)]
    last = pseudonyms.in_use(state)
    assert (last.from_step.tolist(), last.to_step.tolist()) == ([21], [26])
