"""Detection messages in the cycle: rules, redundancy and lengths, and the table that says what was left out."""

import numpy as np
import pytest

from cosim.messages.content import SELF, encoded_cpm_bytes
from cosim.messages.cpm_generation import CpmState, Inclusion
from cosim.radio.segmentation import ENVELOPE_BYTES, FRAME_BYTES, segments
from cosim.runs import channel_rows, recording
from cosim.step.cycle import step
from cosim.step.state import State
from tests.scene import ScriptedScene, assert_same, parts_of, play

FAST = ("sensing_interval_s=0.5", "traffic.step_s=0.5", "radio.unit_disk.loss_p=0")


class Kept:
    """Rows of tables in memory."""

    tables = ("cpm_content",)

    def __init__(self):
        self.rows = []

    def append(self, table, step, columns):
        if table == "cpm_content":
            self.rows.append({name: np.asarray(values) for name, values in columns.items()})


def test_an_object_that_reports_itself_is_left_out():
    """All vehicles hear each other in step 0; from then on, what they see of each other is redundant."""
    steps, _ = play(2, *FAST, "cpm.redundancy=self_announcement")
    for number, sensed in enumerate(steps):
        listed, content = sensed.listed.objects, sensed.listed.content
        equipped = np.isin(sensed.listed.truth.actor_row, sensed.vehicles.row)
        of_others = (listed.origin != SELF) & sensed.listed.truth.is_real & equipped
        assert of_others.any() and (~equipped & sensed.listed.truth.is_real).any()
        expected = np.where(of_others & (number > 0), Inclusion.REDUNDANT, Inclusion.INCLUDED)
        assert content.inclusion[sensed.listed.truth.is_real].tolist() == expected[sensed.listed.truth.is_real].tolist()
        assert (listed.transmitted == content.included).all()


def test_without_choices_no_state_is_kept():
    _, state = play(3, *FAST)
    assert_same(state.cpm, CpmState())


@pytest.mark.parametrize(
    "choice",
    [
        (),
        ("cpm.rules=etsi", "cpm.length=uper", "cpm.max_objects=1"),
        ("cpm.redundancy=distance", "cpm.redundancy_sender_m=500"),
    ],
)
def test_the_table_counts_every_object_once(choice):
    scene = ScriptedScene.load()
    parts = parts_of(scene, *FAST, *choice)
    state, kept = State.start(parts), Kept()
    for number in range(6):
        state, result = step(scene.world(number), state, parts)
        recording.step(kept, result, parts.config.traffic.step_s)
        rows, sensed = kept.rows[-1], result.sensed
        reasons = [rows[name] for name in channel_rows.INCLUSIONS]
        assert (sum(reasons) == rows["n_objects"]).all() and (rows["sender"] == sensed.senders.pseudonym).all()
        objects, message = sensed.listed.objects, sensed.listed.detections.message
        others = objects.transmitted & (objects.origin != SELF)
        assert rows["n_included"].tolist() == np.bincount(message[others], minlength=len(rows["sender"])).tolist()
        assert (rows["length_bytes"] > 0).tolist() == (sensed.rounds[0].round.frames.n_transmissions > 0).tolist()
        if "cpm.length=uper" in choice:
            sent = np.flatnonzero(objects.transmitted)
            length, _ = encoded_cpm_bytes(objects.take(sent), message[sent], sensed.listed.content.has_sensors)
            on_air = rows["length_bytes"] > 0
            assert rows["length_bytes"][on_air].tolist() == length[on_air].tolist()
            assert (rows["n_included"] <= 1).all()
    total = {name: sum(row[name].sum() for row in kept.rows) for name in channel_rows.INCLUSIONS}
    assert (total["n_over_limit"] > 0) == ("cpm.max_objects=1" in choice)
    assert (total["n_redundant"] > 0) == ("cpm.redundancy=distance" in choice)
    assert (total["n_not_due"] > 0) == ("cpm.rules=etsi" in choice)


def test_congestion_control_gates_the_messages():
    """Relaxed, it asks for 0.4 s here; messages are possible every 0.1 s, but are sent at 0, 0.4 and 0.8 s."""
    steps, _ = play(
        9, "sensing_interval_s=0.1", "traffic.step_s=0.1", "radio.model=csma", "cpm.rules=etsi",
        "radio.dcc.t_off_s=[0.4, 0.4, 0.4, 0.4, 1.0]",
    )  # fmt: skip
    waiting = [(s.listed.content.inclusion == Inclusion.WAITING).all() for s in steps]
    assert waiting == [number % 4 != 0 for number in range(9)]
    # Adaptive control asks for 25 ms where a frame lasts less than 0.75 ms and a station may fill 3 % of the time.
    adaptive, state = play(
        3, "sensing_interval_s=0.1", "traffic.step_s=0.1", "radio.model=csma", "cpm.rules=etsi",
        "radio.dcc.algorithm=adaptive",
    )  # fmt: skip
    assert not any((s.listed.content.inclusion == Inclusion.WAITING).any() for s in adaptive)
    assert 0 < state.medium.dcc.airtime_ns.max() < 750_000
    free, _ = play(3, "sensing_interval_s=0.1", "traffic.step_s=0.1", "radio.model=unit_disk", "cpm.rules=etsi")
    assert not any((s.listed.content.inclusion == Inclusion.WAITING).any() for s in free)


@pytest.mark.parametrize("envelope", [ENVELOPE_BYTES, 170])
def test_segments_repeat_the_envelope(envelope):
    """2,800 bytes: the content is split among as few frames as hold it, each with an envelope of its own."""
    length = np.array([envelope, FRAME_BYTES, FRAME_BYTES + 1, 2800, 9000])
    n, each = segments(length, np.full(5, envelope))
    assert (each <= FRAME_BYTES).all() and n[:3].tolist() == [1, 1, 2] and each[:2].tolist() == [envelope, FRAME_BYTES]
    content = length - envelope
    assert (n[2:] == -(-content[2:] // (FRAME_BYTES - envelope))).all()
    assert ((n * (each - envelope) >= content) & (n * (each - envelope) < content + n)).all()
