"""Threads that sense groups of observers in turn sense what one thread senses."""

import numpy as np
import pytest

from cosim.base.threads import n_threads, use_threads
from cosim.config.config import load
from cosim.step import perception
from cosim.step.parts import perception_of
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from sensors.evidence import AreaParams
from tests.scene import assert_same
from tests.sensors.town import blocks, traffic


@pytest.mark.parametrize("group", [20, 256])
def test_groups_and_threads_change_nothing(monkeypatch, group):
    rng, config = np.random.default_rng(5), load(None, ["lidar.profile=vlp16"])
    (boxes, shape), city, n = traffic(rng, 350), blocks(rng), 350
    world = World(
        0, np.arange(n), rng.integers(0, 2**63, n).astype(np.uint64), shape.astype(np.uint8), boxes, np.zeros(n),
        shape == 0, np.zeros(n, np.uint8),
    )  # fmt: skip
    observers, threads, found = np.flatnonzero(world.equipped), n_threads(), []
    assert len(observers) > 2 * perception.FEW
    asked = perception.BoxQuestions(
        boxes, np.zeros((n, 2)), AreaParams(),
        np.repeat(np.arange(len(observers)), n), np.tile(np.arange(n), len(observers)),
        np.arange(len(observers)), np.arange(len(observers)),
    )  # fmt: skip
    for n in (1, threads):
        monkeypatch.setattr(perception, "GROUP", 1024 if n == 1 else group)
        use_threads(n)
        own, watch = perception_of(config, city), Stopwatch()
        for _ in range(2):  # the second time in the same memory
            observed = own(world, observers, watch)
        found.append((observed, own.answers(observed.sweeps, asked)))
        assert watch.seconds.keys() == {"sweep", "detect"}
    use_threads(threads)
    assert len(found[0][0].detections) > len(observers)
    assert_same(found[0], found[1], leave_out=())
