"""A step is a function of world, state and parts: it consumes the state, and nothing else changes."""

import copy
import pickle

import numpy as np
import pytest

from cosim.addons.compare.scenarios import ScriptedScene
from cosim.radio.medium import MEDIA
from cosim.runs.checkpoint import decode, encode
from cosim.step import comparing
from cosim.step.cycle import step
from cosim.step.state import State
from tests.scene import assert_same, parts_of
from trust.models import MODELS

KINDS = {
    "server over cellular": (),
    "trust in vehicles": ("trust.host=local",),
    "csma with forwarding": ("radio.model=csma", "radio.relay.max_hops=2", "radio.evaluations=piggybacked"),
    "messages as standardised": (
        "radio.model=csma",
        "cpm.rules=etsi",
        "cpm.length=uper",
        "cpm.redundancy=dynamics",
        "cpm.max_objects=2",
        "sensing_interval_s=0.5",
        "traffic.step_s=0.5",
    ),
    "beta": ("trust.model=beta", "pseudonyms.policy=disposable", "cpm.rules=etsi", "attacks.0.start_s=2"),
    "tracks": ("tracking.model=constant_velocity",),
}


@pytest.fixture(params=KINDS, scope="module")
def midway(request):
    """Scene, parts, and the state after four steps."""
    scene = ScriptedScene.load()
    parts = parts_of(scene, *KINDS[request.param])
    state = State.start(parts)
    for number in range(4):
        state, _ = step(scene.world(number), state, parts)
    return scene, parts, state


def onwards(scene, parts, state):
    """Results of the next three steps."""
    results = []
    for number in range(4, 7):
        state, result = step(scene.world(number), state, parts)
        results.append(result)
    return results


def test_a_state_is_consumed_once(midway):
    scene, parts, state = midway
    state = state.copy()
    step(scene.world(4), state, parts)
    with pytest.raises(RuntimeError, match="consumed"):
        step(scene.world(4), state, parts)


@pytest.mark.parametrize(
    "again", [State.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s)), lambda s: decode(b"".join(encode(s)))]
)
def test_copies_continue_to_identical_results(midway, again):
    scene, parts, state = midway
    assert_same(onwards(scene, parts, state.copy()), onwards(scene, parts, again(state)))


def test_a_copy_shares_nothing(midway):
    scene, parts, state = midway
    before = pickle.dumps(state)
    onwards(scene, parts, state.copy())
    assert pickle.dumps(state) == before


def test_vehicles_may_be_compared_in_parts(midway, monkeypatch):
    """Some parts have a vehicle, and some have none."""
    scene, parts, state = midway
    at_once = onwards(scene, parts, state.copy())
    monkeypatch.setattr(comparing, "_PART", 1)
    assert_same(onwards(scene, parts, state.copy()), at_once)


def test_asking_changes_nothing(midway):
    _, parts, state = midway
    vehicle, subject = (a.ravel() for a in np.meshgrid(np.arange(3), np.arange(3)))
    state = state.copy()
    before = pickle.dumps(state)
    first = parts.trust.lookup(state.trust, vehicle, subject, 3.9)
    assert pickle.dumps(state) == before
    assert_same(parts.trust.lookup(state.trust, vehicle, subject, 3.9), first)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("medium", MEDIA)
def test_the_state_of_every_model_and_medium_is_kept_for_resume(model, medium):
    parts = parts_of(ScriptedScene.load(), f"trust.model={model}", f"radio.model={medium}")
    assert isinstance(decode(b"".join(encode(State.start(parts)))), State)
