"""Chance: known values, independence of order, and the looks of uniform noise."""

import numpy as np
import pytest
from scipy import stats

from cosim.base import rng


def test_mix_is_splitmix64():
    """First outputs of SplitMix64 from seed 1234567, as published with the reference implementation."""
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    got = rng.keys(np.uint64(1234567), np.arange(3))
    assert got.tolist() == expected


def test_a_draw_depends_on_its_own_identity_only():
    prefix = rng.key(7, rng.Stream.DETECTION, 12)
    who = np.array([5, 900, 3], np.uint64)
    alone = rng.uniforms(prefix, who[1:2], n=4)
    assert np.array_equal(rng.uniforms(prefix, who, n=4)[1], alone[0])
    assert np.array_equal(rng.uniforms(prefix, who[::-1], n=4)[1], alone[0])
    assert np.array_equal(rng.uniforms(prefix, who, n=2)[1], alone[0, :2])


def test_streams_steps_seeds_and_ids_draw_apart():
    draws = [
        rng.uniforms(rng.key(seed, stream, step), np.arange(200), n=2).ravel()
        for seed in (0, 1) for stream in (rng.Stream.SWEEP, rng.Stream.CLUTTER) for step in (0, 1)
    ]  # fmt: skip
    flat = np.concatenate(draws)
    assert len(np.unique(flat)) == len(flat)
    correlation = np.corrcoef(draws) - np.eye(len(draws))
    assert np.abs(correlation).max() < 5 / np.sqrt(400)


def test_uniform():
    u = rng.uniforms(rng.key(3, rng.Stream.UPLINK), np.arange(50_000), np.arange(50_000)[::-1], n=2)
    assert 0 <= u.min() and u.max() < 1
    assert stats.kstest(u.ravel(), "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(u.T)[0, 1]) < 5 / np.sqrt(50_000)


def test_name_key_is_a_hash_of_the_name():
    assert rng.name_key("vehicle/a") == rng.name_key("vehicle/a")
    assert rng.name_key("vehicle/a") != rng.name_key("person/a")


@pytest.mark.parametrize(("step", "names"), [(2, np.array([3.2, 3.9])), (2.5, np.array([3])), (2, ([3], [0.5]))])
def test_own_draws_take_whole_numbers(step, names):
    """They were cut off: places in one metre, and times in one second, had the same draws."""
    with pytest.raises(ValueError, match="takes whole numbers"):
        rng.draws(1, step, names)
    assert rng.draws(1, 2, np.zeros(0)).shape == (0, 1)
