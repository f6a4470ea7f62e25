"""Samples of the steps in which vehicles sense."""

import numpy as np
import pytest

from results.sensing import is_lock_step, sampling_stride, senses
from tests.results.tiny import fleet


@pytest.fixture
def phases(tiny):
    """Five vehicles that sense every fifth step, each at a step of its own."""
    vehicles = [
        vehicle | {"sensing_interval_steps": 5, "sensing_phase_steps": phase}
        for phase, vehicle in enumerate(fleet(*["honest"] * 5))
    ]
    return tiny(100, vehicles=vehicles)


@pytest.mark.parametrize(("least", "stride"), [(0, 1), (4, 4), (5, 6), (10, 11), (14, 14), (15, 16)])
def test_a_sample_has_vehicles_of_all_phases(phases, least, stride):
    assert sampling_stride(phases, least) == stride
    steps = np.arange(0, 100, stride)
    seen = [senses(phases, steps, np.full(len(steps), vehicle)).any() for vehicle in range(5)]
    assert all(seen) and not is_lock_step(phases)


def test_where_all_sense_together_any_stride_will_do(tiny):
    run = tiny(100, vehicles=fleet("honest", "honest", sensing_interval_steps=5, sensing_phase_steps=0))
    assert is_lock_step(run) and [sampling_stride(run, n) for n in (0, 4, 5, 10)] == [1, 4, 5, 10]


def test_a_sample_has_the_same_share_of_slow_and_of_fast_vehicles(tiny):
    """One vehicle senses every second step, one every fifth: of 300 steps 150 and 60. Strides are prime to 2 and 5."""
    every = [{"sensing_interval_steps": n, "sensing_phase_steps": 0} for n in (2, 5)]
    run = tiny(300, vehicles=[vehicle | own for vehicle, own in zip(fleet("honest", "honest"), every, strict=True)])
    assert [sampling_stride(run, n) for n in (0, 2, 4, 8, 10)] == [1, 3, 7, 9, 11]
    steps = np.arange(1, 300, 3)
    assert [senses(run, steps, np.full(100, vehicle)).sum() for vehicle in (0, 1)] == [50, 20]
