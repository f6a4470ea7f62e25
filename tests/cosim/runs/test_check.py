"""Notes before a run on what looks like a mistake."""

import pytest

from cosim.config.config import load
from cosim.runs.check import remarks_on

SLOW = "radio.model=unit_disk", "radio.unit_disk.latency_max_s=0.3", "traffic.step_s=0.2", "sensing_phase=random"


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        (("radio.range_m=1500",), "no frame arrives from farther than radio.propagation.interference_range_m = 1000 m"),
        (("radio.range_m=1500", "radio.model=nr_mode2"), "interference_range_m = 1000 m"),
        (("radio.range_m=1500", "radio.propagation.interference_range_m=2000"), ""),
        (("radio.range_m=1500", "radio.model=unit_disk"), ""),
        (SLOW, "latency_max_s = 0.3 s is longer than a round of 0.08 s"),
        ((*SLOW, "radio.timeout_s=0.5"), "whatever radio.timeout_s is"),
        ((*SLOW, "sensing_phase=common"), ""),
    ],
)
def test_messages_that_no_station_can_receive(sets, said):
    notes = [note for note in remarks_on(load(None, list(sets)), None) if "radio." in note]
    assert [said in note for note in notes] == [True] * bool(said)
