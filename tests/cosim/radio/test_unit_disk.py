"""The disk model: exactly who is in reach, hop by hop, and chance by name."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim import rng
from cosim.radio.medium import RadioParams
from cosim.radio.message_round import Outcome, RelayParams, neighbours
from cosim.radio.unit_disk import UnitDiskParams, broadcast

CHANCE = rng.key(5, rng.Stream.RADIO_DETECTIONS, 3)


def crowd(n, seed=0, side_m=1000.0):
    xy = np.random.default_rng(seed).uniform(0, side_m, (n, 2))
    return xy, np.arange(n, dtype=np.uint64) * 7919


def send(xy, names, talks=None, reach_m=300.0, timeout_s=0.1, max_hops=1, relay_reach_m=600.0, **disk):
    talks = np.ones(len(xy), bool) if talks is None else talks
    length = np.full(len(xy), 300)
    relay = RelayParams(max_hops=max_hops, reach_m=relay_reach_m)
    return broadcast(xy, names, talks, length, CHANCE, reach_m, timeout_s, UnitDiskParams(**disk), relay)


def test_without_loss_exactly_the_pairs_within_reach_hear():
    xy, names = crowd(80)
    heard, account = send(xy, names, reach_m=200.0, loss_p=0.0)
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    expected = {(r, s) for r in range(80) for s in range(80) if r != s and apart[r, s] <= 200}
    assert set(zip(heard.receiver.tolist(), heard.sender.tolist(), strict=True)) == expected
    assert len(account.fate) == len(expected) and (account.fate == Outcome.RECEIVED).all()
    np.testing.assert_allclose(np.sort(account.distance_m), np.sort(heard.distance_m))
    np.testing.assert_allclose(heard.distance_m, apart[heard.receiver, heard.sender])
    assert (heard.hops == 1).all() and (heard.latency_s > 0).all()


def test_hops_are_the_shortest_path_in_the_contact_graph():
    """Ten vehicles on a line, 100 m apart, 150 m reach: k places away is k hops."""
    xy = np.stack([np.arange(10) * 100.0, np.zeros(10)], axis=1)
    heard, account = send(
        xy, np.arange(10, dtype=np.uint64), np.arange(10) == 0,
        reach_m=150.0, loss_p=0.0, max_hops=4, relay_reach_m=1e4,
    )  # fmt: skip
    assert heard.receiver.tolist() == [1, 2, 3, 4]
    assert heard.hops.tolist() == [1, 2, 3, 4]
    assert (np.diff(heard.latency_s) > 0).all()
    # 1 sends to 2 (and back to 0, the origin: not a reception); 2 to 1 (duplicate) and 3; 3 to 2 and 4.
    assert account.n_transmissions.tolist() == [4] + [0] * 9
    assert (account.n_relayed, account.n_duplicate, account.sent_bytes) == (3, 2, 1200)


def test_relay_stops_beyond_its_range():
    xy = np.stack([np.arange(10) * 100.0, np.zeros(10)], axis=1)
    heard, _ = send(
        xy, np.arange(10, dtype=np.uint64), np.arange(10) == 0,
        reach_m=150.0, loss_p=0.0, max_hops=10, relay_reach_m=250.0,
    )  # fmt: skip
    assert heard.receiver.tolist() == [1, 2, 3]  # 300 m away is told, and does not tell on


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), hops=st.integers(1, 3))
def test_laws(seed, hops):
    xy, names = crowd(60, seed)
    params = dict(reach_m=180.0, loss_p=0.4)
    heard, account = send(xy, names, max_hops=hops, **params)
    more, _ = send(xy, names, max_hops=hops + 1, **params)
    pairs = set(zip(heard.receiver.tolist(), heard.sender.tolist(), strict=True))
    assert len(pairs) == len(heard.receiver)  # nobody twice
    assert (heard.receiver != heard.sender).all()  # nobody their own
    assert pairs <= set(zip(more.receiver.tolist(), more.sender.tolist(), strict=True))
    assert np.sum(account.fate == Outcome.RECEIVED) == len(heard.receiver) + account.n_duplicate
    # Order of radios does not matter.
    order = np.random.default_rng(seed).permutation(60)
    shuffled, _ = send(xy[order], names[order], max_hops=hops, **params)
    assert {(order[r], order[s]) for r, s in zip(shuffled.receiver, shuffled.sender, strict=True)} == pairs


def test_a_vehicle_out_of_reach_changes_nothing():
    xy, names = crowd(60)
    far, far_names = np.vstack([xy, [[1e6, 1e6]]]), np.append(names, np.uint64(99))
    near = send(xy, names, loss_p=0.3, max_hops=2)[0]
    both = send(far, far_names, loss_p=0.3, max_hops=2)[0]
    for name in ("receiver", "sender", "hops", "latency_s"):
        assert np.array_equal(getattr(near, name), getattr(both, name))


def test_loss_is_the_share_asked_for():
    xy, names = crowd(400, side_m=800.0)
    _, account = send(xy, names, loss_p=0.2, reach_m=300.0)
    expected = len(account.fate) * 0.2
    assert abs(np.sum(account.fate == Outcome.PROPAGATION) - expected) < 5 * np.sqrt(expected * 0.8)


def test_late_messages_are_dropped():
    xy, names = crowd(40)
    heard, account = send(xy, names, loss_p=0.0, latency_min_s=0.05, latency_max_s=0.15, timeout_s=0.1, reach_m=500.0)
    assert (heard.latency_s <= 0.1).all()
    assert 0.4 < np.mean(account.fate == Outcome.LATE) < 0.6


@pytest.mark.parametrize("n", [0, 1])
def test_alone(n):
    heard, account = send(np.zeros((n, 2)), np.zeros(n, np.uint64))
    assert len(heard.receiver) == 0 and len(account.fate) == 0


def test_neighbours_are_sorted_and_symmetric():
    xy, _ = crowd(50)
    a, b, distance = neighbours(xy, 250.0)
    key = a * 50 + b
    assert (np.diff(key) > 0).all()
    assert set(key.tolist()) == set((b * 50 + a).tolist())
    assert (distance <= 250).all()


def test_bad_parameters():
    with pytest.raises(ValueError, match="Metres, not kilometres"):
        RadioParams(reach_m=0.3)
    with pytest.raises(ValueError, match=r"radio\.disk\.latency_max_s"):
        UnitDiskParams(latency_min_s=1.0)
    with pytest.raises(ValueError, match=r"radio\.relay\.timer_max_s"):
        RelayParams(timer_min_s=1.0)


def test_relay_by_probability_is_as_frequent_as_asked():
    xy, names = crowd(301, side_m=100.0)
    relay = RelayParams(max_hops=2, rule="probability", forward_p=0.3)
    _, account = broadcast(
        xy, names, np.arange(301) == 0, np.full(301, 300), CHANCE, 300.0, 0.1, UnitDiskParams(loss_p=0.0), relay
    )
    assert abs(account.n_relayed - 90) < 5 * np.sqrt(90 * 0.7)
