"""The channel busy ratio is a share of the time: that in which frames are on the air, where everybody hears all."""

import pytest

from results.archive import open_run
from tests.drive import simulate
from tests.slow import slow

FREE = (
    "radio.range_m=3000", "radio.propagation.interference_range_m=4000", "radio.propagation.model=free_space",
    "radio.propagation.fading=none", "radio.propagation.shadowing=false", "radio.propagation.blockage=none",
    "traffic.duration_s=4", "traffic.warmup_s=120", "traffic.step_s=0.2", "attacks=[]",
)  # fmt: skip


@pytest.mark.parametrize("phase", [slow("random"), "common"])
def test_as_the_time_on_the_air(tmp_path, phase):
    """At 6 Mbit/s, a frame of n bytes takes 40 us and 8 us for each 48 bits; half of the last 48 are empty, mostly."""
    run = open_run(simulate(tmp_path / "run", *FREE, f"sensing_phase={phase}"))
    radio = run.radio
    on_air_s = radio.n_sent.sum() * (40e-6 + 8e-6 * (22 / 48 + 0.5)) + radio.sent_bytes.sum() * 8 / 6e6
    share = on_air_s / 4
    assert 0.02 < share
    assert radio.cbr.mean() == pytest.approx(share, rel=0.04)
    assert run.vehicle_channel.cbr.mean() == pytest.approx(share, abs=0.004)  # kept in steps of 1/256
