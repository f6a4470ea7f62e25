"""What is computed ahead of its step is what the step would have computed itself."""

import numpy as np
import pytest

from cosim.addons.compare.scenarios import ScriptedScene
from cosim.base.threads import CORES, n_threads, use_threads
from cosim.runs.speed.ahead import Ahead
from cosim.step import perception
from cosim.step.cycle import step
from cosim.step.state import State
from tests.drive import drive
from tests.fingerprint import fingerprint
from tests.scene import assert_same, parts_of, play

N = 6
CSMA = 'radio.model="csma"'


@pytest.mark.verify
@pytest.mark.parametrize(
    "setting",
    [
        pytest.param(("traffic.step_s=0.5",), id="every other step senses"),
        pytest.param(("record.block_steps=2",), id="every other step is the last of a block"),
    ],
)
def test_a_run_with_one_thread_has_the_same_tables(tmp_path, setting):
    two, one = (drive(tmp_path / str(n), f"compute.threads={n}", "traffic.duration_s=12", *setting) for n in (2, 1))
    assert fingerprint(two) == fingerprint(one)


@pytest.fixture
def threads(request):
    """So many threads of kernels, or as many as there are, while a test runs."""
    before = n_threads()
    use_threads(min(request.param, CORES))
    yield n_threads()
    use_threads(before)


@pytest.mark.parametrize("expected", [1, 2, None])
@pytest.mark.parametrize("at_once", [False, True])
@pytest.mark.parametrize("threads", [1, 2], indirect=True)
def test_each_world_is_sensed_whichever_was_expected(expected, at_once, threads):
    """The next world is expected before its step begins, the one after it, or none at all."""
    want, _ = play(N, CSMA)
    scene = ScriptedScene.load()
    parts, found = parts_of(scene, CSMA), []
    worlds = [scene.world(number) for number in range(N + 2)]
    with Ahead(parts, parts.perception) as ahead:
        state = State.start(parts)
        for number in range(N):
            if expected and not at_once:
                ahead.expect(worlds[number + expected], at_once=False)
            state, result = step(worlds[number], state, parts, ahead.of(worlds[number]))
            found.append(result.sensed)
            if expected and at_once:
                ahead.expect(worlds[number + expected], at_once=True)
    assert_same(found, want)
    assert ("sweep" in ahead.watch.seconds) == bool(expected)
    shares = bool(expected) and threads > 1
    assert ("links" in ahead.watch.seconds) == shares == ("pairs" in ahead.watch.seconds)


@pytest.mark.skipif(CORES < 2, reason="this process may use one core")
@pytest.mark.parametrize("threads", [2], indirect=True)
def test_what_is_expected_before_the_present_step_has_asked_is_found_once(threads):
    """A run expects the next world first, and then asks for the pairs of the present one."""
    scene, asked = ScriptedScene.load(), []
    worlds = [scene.world(number) for number in range(3)]
    parts = parts_of(scene, near_pairs=lambda world: asked.append(world.step) or world.step)
    with Ahead(parts, parts.perception) as ahead:
        for world in worlds[:2]:
            ahead.expect(world, at_once=False)
        assert [ahead.of(world).near_pairs() for world in worlds[:2]] == [0, 1]
        assert ahead.of(worlds[2]).near_pairs is None, "it was not expected"
    assert asked == [0, 1]


@pytest.mark.parametrize("small", [True, False])
def test_sweeps_begin_before_the_present_ones_are_read_if_these_stay(monkeypatch, small):
    """Images of a few vehicles are kept until the step after the next one; those of many are written over."""
    if not small:
        monkeypatch.setattr(perception, "_SMALL_BYTES", 0)
    scene = ScriptedScene.load()
    parts, worlds = parts_of(scene), [scene.world(number) for number in range(3)]
    with Ahead(parts, parts.perception) as ahead:
        ahead.expect(worlds[0], at_once=True)
        ahead.expect(worlds[1], at_once=False)
        present = ahead.of(worlds[0])
        images = present.observed().sweeps.range_steps
        images[:] = 0  # as if they had been read
        if not small:
            present.sweeps_are_read()
        after = ahead.of(worlds[1]).observed().sweeps.range_steps
        assert np.shares_memory(images, after) != small
        assert images.any() != small
        ahead.expect(worlds[2], at_once=True)
        assert np.shares_memory(images, ahead.of(worlds[2]).observed().sweeps.range_steps), "two are enough"
