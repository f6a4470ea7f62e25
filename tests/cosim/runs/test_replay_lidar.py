"""A run's sweeps, cast again from its tables: the same returns."""

import numpy as np
import pandas as pd
import pytest

from cosim.runs import replay_lidar
from results.archive import open_run
from sensors.evidence import observability
from tests.drive import drive


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("replay_lidar") / "run", "traffic.duration_s=6", "traffic.warmup_s=120")


@pytest.mark.parametrize("rotates", [False, True])
def test_the_same_returns(folder, tmp_path, rotates):
    if rotates:  # the speeds in the tables are those by which actors moved during a sweep
        asked = ("lidar.profile=vlp32c", "lidar.rotation_hz=10", "traffic.duration_s=3", "traffic.warmup_s=120")
        folder = drive(tmp_path / "run", *asked)
    run = open_run(folder)
    config = replay_lidar.config_of(run)
    city = replay_lidar.city_of(config)
    recorded, n = run.observability, 0
    for world in replay_lidar.worlds(run):
        observers = np.flatnonzero(world.equipped)
        seen = observability(replay_lidar.sweep(config, city, world, observers), world.boxes, world.shape)
        again = pd.DataFrame({
            "observer": world.actor[observers[seen.observer]], "actor": world.actor[seen.actor],
            "n_points": seen.n_returns, "n_unoccluded": seen.n_unoccluded,
        })  # fmt: skip
        here = recorded[recorded.step == world.step].drop(columns="step").reset_index(drop=True)
        pd.testing.assert_frame_equal(again.astype(np.int64), here[again.columns].astype(np.int64))
        n += len(here)
    assert n == len(recorded) > 0
