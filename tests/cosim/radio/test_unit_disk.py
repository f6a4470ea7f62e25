"""The unit disk medium: exactly the stations in range, hop by hop; draws by key."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.radio.message_round import Messages, Outcome, RoundKind, Stations
from cosim.radio.params import RadioParams, RelayParams, UnitDiskParams
from cosim.radio.unit_disk import UnitDiskMedium

STEP = 3


def crowd(n, seed=0, side_m=1000.0):
    xy = np.random.default_rng(seed).uniform(0, side_m, (n, 2))
    return xy, np.arange(n, dtype=np.uint64) * 7919


def send(
    xy, keys, sends=None, range_m=300.0, timeout_s=0.1, max_hops=1, forward_range_m=600.0, rule="contention",
    forward_p=0.5, messages=None, **disk,
):  # fmt: skip
    """(receptions, frames) of one round."""
    sends = np.ones(len(xy), bool) if sends is None else sends
    relay = RelayParams(max_hops=max_hops, forward_range_m=forward_range_m, rule=rule, forward_p=forward_p)
    medium = UnitDiskMedium(RadioParams(range_m=range_m, unit_disk=UnitDiskParams(**disk), relay=relay), timeout_s, 5)
    stations = Stations(keys, np.column_stack([xy, np.full(len(xy), 1.5)]), len(xy))
    messages = Messages.one_each(np.where(sends, 300, 0)) if messages is None else messages
    _, happened = medium.broadcast(medium.start(), RoundKind.CPM, STEP, 0.0, stations, messages)
    return happened.receptions, happened.frames


def test_without_loss_exactly_the_stations_in_range_receive():
    xy, keys = crowd(80)
    found, frames = send(xy, keys, range_m=200.0, loss_p=0.0)
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    expected = {(r, s) for r in range(80) for s in range(80) if r != s and apart[r, s] <= 200}
    assert set(zip(found.receiver.tolist(), found.message.tolist(), strict=True)) == expected
    assert len(frames.outcome) == len(expected) and (frames.outcome == Outcome.RECEIVED).all()
    np.testing.assert_allclose(np.sort(frames.distance_m), np.sort(found.distance_m))
    np.testing.assert_allclose(found.distance_m, apart[found.receiver, found.message])
    assert (found.hops == 1).all() and (found.latency_s > 0).all()


def send_on_line(sends=None, max_hops=4, forward_range_m=1e4, messages=None):
    """One round of ten vehicles on a line, 100 m apart, with a range of 150 m."""
    xy, keys = np.stack([np.arange(10) * 100.0, np.zeros(10)], axis=1), np.arange(10, dtype=np.uint64)
    relay = {"max_hops": max_hops, "forward_range_m": forward_range_m}
    return send(xy, keys, sends, range_m=150.0, loss_p=0.0, messages=messages, **relay)


def test_hops_are_the_shortest_path_in_the_contact_graph():
    """k positions away is k hops."""
    found, frames = send_on_line(np.arange(10) == 0)
    assert found.receiver.tolist() == [1, 2, 3, 4]
    assert found.hops.tolist() == [1, 2, 3, 4]
    assert (np.diff(found.latency_s) > 0).all()
    # 1 sends to 2 (and back to 0, the origin: not a reception); 2 to 1 (duplicate) and 3; 3 to 2 and 4.
    assert frames.n_transmissions.tolist() == [4] + [0] * 9
    assert (frames.n_relayed, frames.n_duplicate, frames.sent_bytes) == (3, 2, 1200)


def test_forwarding_stops_beyond_its_range():
    found, _ = send_on_line(np.arange(10) == 0, max_hops=10, forward_range_m=250.0)
    assert found.receiver.tolist() == [1, 2, 3]  # the one 300 m away receives, and does not forward


def test_who_refuses_a_message_receives_it_and_does_not_forward_it():
    """On the line, 3 refuses the message of 0 and forwards that of 1."""
    messages = Messages(np.array([0, 1]), np.array([300, 300]), refused=np.array([(0 << 32) + 3, (1 << 32) + 9]))
    found, _ = send_on_line(messages=messages)
    assert found.receiver[found.message == 0].tolist() == [1, 2, 3]
    assert found.receiver[found.message == 1].tolist() == [0, 2, 3, 4, 5]


@settings(max_examples=30)
@given(seed=st.integers(0, 1000), hops=st.integers(1, 3))
def test_laws(seed, hops):
    xy, keys = crowd(60, seed)
    params = dict(range_m=180.0, loss_p=0.4)
    found, frames = send(xy, keys, max_hops=hops, **params)
    more, _ = send(xy, keys, max_hops=hops + 1, **params)
    pairs = set(zip(found.receiver.tolist(), found.message.tolist(), strict=True))
    assert len(pairs) == len(found.receiver)  # each pair once
    assert (found.receiver != found.message).all()  # no own message
    assert pairs <= set(zip(more.receiver.tolist(), more.message.tolist(), strict=True))
    assert np.sum(frames.outcome == Outcome.RECEIVED) == len(found.receiver) + frames.n_duplicate
    # The order of stations has no effect.
    order = np.random.default_rng(seed).permutation(60)
    shuffled, _ = send(xy[order], keys[order], max_hops=hops, **params)
    assert {(order[r], order[s]) for r, s in zip(shuffled.receiver, shuffled.message, strict=True)} == pairs


def test_loss_is_the_share_asked_for():
    xy, keys = crowd(400, side_m=800.0)
    _, frames = send(xy, keys, loss_p=0.2, range_m=300.0)
    expected = len(frames.outcome) * 0.2
    assert abs(np.sum(frames.outcome == Outcome.PROPAGATION) - expected) < 5 * np.sqrt(expected * 0.8)


def test_late_messages_are_dropped():
    xy, keys = crowd(40)
    found, frames = send(xy, keys, loss_p=0.0, latency_min_s=0.05, latency_max_s=0.15, timeout_s=0.1, range_m=500.0)
    assert (found.latency_s <= 0.1).all()
    assert 0.4 < np.mean(frames.outcome == Outcome.LATE) < 0.6


@pytest.mark.parametrize("n", [0, 1])
def test_at_most_one_station(n):
    found, frames = send(np.zeros((n, 2)), np.zeros(n, np.uint64))
    assert len(found.receiver) == 0 and len(frames.outcome) == 0


def test_bad_parameters():
    with pytest.raises(ValueError, match="Metres, not kilometres"):
        RadioParams(range_m=0.3)
    with pytest.raises(ValueError, match=r"radio\.unit_disk\.latency_max_s"):
        UnitDiskParams(latency_min_s=1.0)
    with pytest.raises(ValueError, match=r"radio\.relay\.timer_max_s"):
        RelayParams(timer_min_s=1.0)


def test_forwarding_by_probability_has_the_given_rate():
    xy, keys = crowd(301, side_m=100.0)
    _, frames = send(xy, keys, np.arange(301) == 0, max_hops=2, rule="probability", forward_p=0.3, loss_p=0.0)
    assert abs(frames.n_relayed - 90) < 5 * np.sqrt(90 * 0.7)


def test_several_messages_of_one_station_have_draws_of_their_own():
    xy, keys = crowd(200, side_m=100.0)
    one, _ = send(xy, keys, np.arange(200) == 7, loss_p=0.5)
    messages = Messages(np.array([7, 7, 7]), np.array([300, 0, 300]), np.array([0.0, 0.0, 0.01]))
    found, frames = send(xy, keys, messages=messages, loss_p=0.5)
    assert frames.n_transmissions.tolist() == [1, 0, 1] and set(found.message.tolist()) == {0, 2}
    first, third = (found.take(found.message == m) for m in (0, 2))
    assert np.array_equal(first.receiver, one.receiver) and np.array_equal(first.latency_s, one.latency_s)
    assert not np.array_equal(first.receiver, third.receiver) and (third.generation_offset_s == 0.01).all()
