"""What a driver leaves alone, and what threads leave alone."""

import pytest

from results.archive import open_run
from tests.drive import simulate
from tests.fingerprint import fingerprint

KEYS = (
    "traffic.step_s=0.5", "sensing_interval_s=0.5", "traffic.duration_s=8", "traffic.warmup_s=100",
    "attacks.0.start_s=3", "attacks.0.share_p=0.3", "fleet.penetration_p=0.5",
)  # fmt: skip


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("driver")

    def run(name, *keys):
        return simulate(folder / name, *KEYS, *keys)

    return run


@pytest.mark.verify
def test_without_a_believed_object_every_table_is_that_of_the_open_loop(drive):
    """Under `local` a vehicle believes its own detector alone, and what that reports is SUMO's business."""
    open_loop = fingerprint(drive("open", "trust.method=local"))
    closed = fingerprint(drive("closed", "trust.method=local", "driver.model=cautious"))
    assert closed == open_loop


@pytest.mark.verify
def test_threads_change_nothing_of_a_closed_loop(drive):
    keys = ("driver.model=cautious", "trust.method=any")
    one, two = drive("one", *keys, "compute.threads=1"), drive("two", *keys, "compute.threads=2")
    assert fingerprint(one) == fingerprint(two)
    reactions = open_run(one).reactions
    assert len(reactions) and reactions.fabricated.any()
    assert (reactions.deceleration_mps2 > 1).any()
