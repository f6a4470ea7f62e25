"""Messages that arrive in a later step than that in which they were sent, in a run over `csma`."""

import numpy as np
import pytest

from cosim.step.inbox import _with_new
from cosim.step.known import Uses
from results.archive import open_run
from tests.drive import drive

SETTINGS = (
    "traffic.step_s=0.2", "sensing_phase=random", "traffic.duration_s=5", "traffic.warmup_s=120", "record.level=full",
    "fleet.penetration_p=1", "radio.dcc.t_off_s=[0.2,0.21,0.22,0.25,1.0]", "trust.host=local", "record.block_steps=10",
)  # fmt: skip
LIFETIME_S = 0.4


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return open_run(drive(tmp_path_factory.mktemp("late") / "run", *SETTINGS))


def test_long_messages_arrive_in_later_steps(run):
    """An evaluation message waits until 0.2 s after the detection message, and both rounds end after 0.16 s."""
    got = run.receptions
    late = got[got.message_step < got.step]
    assert len(late) > 100 and "evaluation" in set(late.message_type)
    assert not got.duplicated(["message_step", "message_type", "sender", "receiver"]).any()
    assert not (got.message_step > got.step).any()


def test_no_message_lasts_longer_than_it_may(run):
    """From the beginning of a step, detection messages have 0.4 s and evaluation messages 0.8 s; the evaluation round
    begins 0.08 s after the step."""
    got = run.receptions
    since_s = got.generation_offset_s + got.latency_s
    assert (since_s[got.message_type == "cpm"] <= LIFETIME_S + 1e-3).all()
    assert (since_s[got.message_type == "evaluation"] <= 2 * LIFETIME_S - 0.08 + 1e-3).all()
    in_steps = (got.step - got.message_step) * 0.2
    begin_s = np.where(got.message_type == "evaluation", 0.08, 0.0)
    assert (begin_s + since_s <= in_steps + 0.16 + 1e-3).all()  # in a round of the step in which it is written


def test_every_frame_has_one_outcome(run):
    """In the sums of the table, as in the histogram by distance: received and lost frames are all in range."""
    radio = run.radio
    lost = radio.filter(like="n_lost_").sum(axis=1)
    assert (radio.n_delivered + lost == radio.n_in_range).all()
    assert radio.n_lost_late.sum() == 0
    n_late = len(run.receptions[run.receptions.message_step < run.receptions.step])
    assert n_late and radio.n_delivered.sum() >= len(run.receptions)


def test_only_receptions_that_are_not_held_are_added():
    """Against NumPy's set difference; receptions that arrive twice are added once."""
    rng = np.random.default_rng(2)
    held, more = (Uses(*rng.integers(0, 30, (2, n))) for n in (300, 200))
    both = _with_new(held, more, 30)
    pairs = [set(zip(uses.receiver.tolist(), uses.message.tolist(), strict=True)) for uses in (held, more)]
    added = list(zip(both.receiver[300:].tolist(), both.message[300:].tolist(), strict=True))
    assert added == sorted(pairs[1] - pairs[0]) and len(added) > 50
    nobody = Uses(np.zeros(0, np.int64), np.zeros(0, np.int64))
    assert len(_with_new(nobody, nobody, 0).receiver) == 0
    assert len(_with_new(nobody, more, 30).receiver) == len(pairs[1])


@pytest.fixture(scope="module")
def with_units(tmp_path_factory):
    """A run with roadside units, forwarding, and vehicles whose messages are dropped because they are revoked."""
    sets = (
        *("traffic.step_s=0.2", "sensing_phase=random", "traffic.duration_s=4", "traffic.warmup_s=120"),
        *("trust.server_period_s=1", "radio.relay.max_hops=3", "server.uplink=rsu", "rsu.n_at_junctions=6"),
        *("pseudonyms.revocation=immediate", "pseudonyms.revoke_below=0.3", "pseudonyms.min_evaluations=1"),
    )
    return open_run(drive(tmp_path_factory.mktemp("units") / "run", "record.level=full", *sets))


def test_messages_of_revoked_senders_are_received_late_too(with_units):
    """Receivers drop them; they are rows of `receptions` all the same, as those that arrive in their own round are."""
    got, refused = with_units.receptions, with_units.pseudonyms.set_index("pseudonym").refused_step
    late = got[got.message_step < got.step]
    assert (late.message_step >= late.sender.map(refused)).sum() > 20
    assert with_units.vehicle_channel.n_received.sum() == with_units.latency_histogram.n_delivered.sum() == len(got)


def test_what_roadside_units_hear_and_say_more_than_once_counts_once(with_units):
    """Forwarded copies of a report reach several units in several rounds; those of a broadcast, a vehicle."""
    run, server = with_units, with_units.server
    assert server.n_late.sum() > 20
    assert (server.n_reached + server.n_late).sum() <= server.n_reports.sum()
    used = run.trust_lookups[run.trust_lookups.source == "server"]
    computed = (used.step * 0.2 - used.age_s).round(1)
    n_used = len(set(zip(used.receiver, computed, strict=True)))
    assert n_used <= server.n_informed.sum() <= server.n_addressed.sum()
