"""Luck that lasts: a function of who, whom and when, normal at every moment, and forgotten after a while."""

import numpy as np
import pytest

from cosim.base import rng
from cosim.base.hash_rng import persistent_normals
from cosim.config.config import load
from sensors.lidar import beams

WHO, WHOM = np.arange(40_000, dtype=np.uint64), np.arange(40_000, dtype=np.uint64)[::-1].copy()
PREFIX = rng.key(7, rng.Stream.DETECTION_MEMORY)


def lasting(time_s, who=WHO, whom=WHOM):
    return persistent_normals(rng.keys(PREFIX, who, whom), 2, time_s, 3.0)


def test_normals_are_normal():
    z = rng.normals(PREFIX, WHO, n=3)
    assert z.mean() == pytest.approx(0, abs=0.01) and z.std() == pytest.approx(1, abs=0.01)
    assert np.mean(np.abs(z) < 1) == pytest.approx(0.6827, abs=0.005) and np.isfinite(z).all()


@pytest.mark.parametrize("time_s", [0.0, 0.1, 1.7, 1000.0])
def test_normal_at_every_moment(time_s):
    z = lasting(time_s)
    assert z.mean() == pytest.approx(0, abs=0.015) and z.std() == pytest.approx(1, abs=0.015)
    assert np.corrcoef(z.T)[0, 1] == pytest.approx(0, abs=0.015)


def test_correlation_fades():
    # With moments of its own for each row, a lag of d memories with d <= 1 falls within one interval with chance
    # 1 - d; measured once over a million rows: 0.72 at half a memory, 0.28 at one, 0 from two on.
    first = lasting(50.0)[:, 0]
    for lag_s, expected in ((0.0, 1.0), (1.5, 0.72), (3.0, 0.28), (6.0, 0.0), (9.0, 0.0)):
        assert np.mean(first * lasting(50.0 + lag_s)[:, 0]) == pytest.approx(expected, abs=0.02)


def test_order_and_company_change_nothing():
    some = np.array([17, 3, 39_999])
    assert (lasting(12.3)[some] == lasting(12.3, WHO[some], WHOM[some])).all()


def test_a_beam_table_of_ones_own():
    config = load(None, ["lidar.elevation_deg=[-20.0, -4.5, 0.0, 3]", "lidar.n_azimuths=90", "lidar.fov_deg=180"])
    grid = beams(config.lidar)
    assert np.degrees(grid.elevation_rad) == pytest.approx([-20, -4.5, 0, 3])
    assert np.degrees(np.diff(grid.azimuth_rad)) == pytest.approx([2.0] * 89)
    with pytest.raises(ValueError, match="ascending"):
        beams(load(None, ["lidar.elevation_deg=[1.0, -1.0]"]).lidar)
