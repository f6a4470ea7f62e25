"""Links of the server: delays, losses, retries, capacity of cells, outages."""

import pickle

import numpy as np
import pytest

from cosim import rng
from cosim.radio.message_round import Receptions
from cosim.v2x.cellular import CellularParams, delay_s, transfer_delay_s, within_capacity
from cosim.v2x.trust_server import Downlink, LinkStats, ServerParams, TrustBroadcast, Uplink

KEY = rng.key(3, rng.Stream.UPLINK, 1)


def keys(n):
    return np.arange(n, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)


def told(n, step=0, verdicts=2):
    m = n * verdicts
    return Told(
        step, np.arange(n), np.arange(n + 1) * verdicts, np.zeros(m, int), np.zeros(m, int), np.ones(m), np.ones(m)
    )


def received(receiver, message, received_s):
    n, received_s = len(message), np.asarray(received_s, float)
    zero = np.zeros(n)
    receiver, message = np.asarray(receiver), np.asarray(message)
    return Receptions(receiver, message, np.ones(n, int), received_s / 2, zero, received_s / 2, zero)


def test_delays_have_their_minimum_and_mean():
    u = (np.arange(100_000) + 0.5) / 100_000
    delay = delay_s(u, CellularParams())
    assert delay.min() >= 0.05
    assert delay.mean() == pytest.approx(0.15, rel=0.001)
    # Gamma of shape 2 and mean 0.1: standard deviation 0.1 / sqrt(2)
    assert delay.std() == pytest.approx(0.1 / np.sqrt(2), rel=0.01)


def test_retries_lose_less_and_take_longer():
    p = CellularParams()
    for retries in (0, 1, 2):
        journey = transfer_delay_s(KEY, keys(200_000), 0.3, retries, p)
        assert np.mean(np.isinf(journey)) == pytest.approx(0.3 ** (retries + 1), rel=0.05)
        # Mean number of attempts of what arrives: sum of k 0.7 0.3^(k - 1) over k = 1 ... retries + 1, by their share.
        k = np.arange(1, retries + 2)
        attempts = (k * 0.7 * 0.3 ** (k - 1)).sum() / (1 - 0.3 ** (retries + 1))
        assert journey[np.isfinite(journey)].mean() == pytest.approx(0.15 * attempts, rel=0.01)
    once = transfer_delay_s(KEY, keys(1000), 0.3, 0, p)
    again = transfer_delay_s(KEY, keys(1000), 0.3, 2, p)
    assert np.array_equal(once[np.isfinite(once)], again[np.isfinite(once)])  # without need of a retry nothing changes


def test_a_full_cell_drops_messages_beyond_its_capacity():
    # Two cells: 10 messages of 100 B in the one, 3 in the other; 500 B each.
    xy = np.column_stack([np.repeat([10.0, 1200.0], [10, 3]), np.zeros(13)])
    taken = within_capacity(xy, np.full(13, 100), keys(13), 500.0, 1000.0)
    assert taken[:10].sum() == 5 and taken[10:].all()
    order = np.random.default_rng(0).permutation(13)
    again = within_capacity(xy[order], np.full(13, 100), keys(13)[order], 500.0, 1000.0)
    assert np.array_equal(again, taken[order])


def test_reports_arrive_and_are_counted():
    p = ServerParams(cellular=CellularParams(uplink_loss_p=0.2, n_retries=0))
    up = Uplink(p, 3, 1.0)
    stats = up.send_cellular(told(1000), keys(1000), np.zeros((1000, 2)), 10.0)
    t = stats
    assert t.n_reports == 1000 == t.n_reached + t.n_lost
    assert t.n_lost == pytest.approx(200, abs=40)
    assert t.uplink_bytes == 1000 * (18 + 20 + 8 + 96 + 16 + 2 * 12)
    assert not up.arrived(10.05)  # nothing before the shortest delay
    assert sum(len(m.evaluator) for m in up.arrived(20.0)) == t.n_reached
    assert not up.arrived(99.0)  # nothing twice


def test_a_report_without_verdicts_is_not_sent():
    up = Uplink(ServerParams(), 3, 1.0)
    stats = up.send_cellular(told(5, verdicts=0), keys(5), np.zeros((5, 2)), 0.0)
    assert stats == LinkStats() and not up.arrived(9.0)


def test_capacity_is_counted():
    p = ServerParams(cellular=CellularParams(cell_up_bytes_per_s=1820.0, uplink_loss_p=0.0))  # ten reports of 182 B
    up = Uplink(p, 3, 1.0)
    stats = up.send_cellular(told(25), keys(25), np.zeros((25, 2)), 0.0)
    assert (stats.n_reached, stats.n_over_capacity, stats.n_lost) == (10, 15, 0)


def test_the_first_reception_by_a_roadside_unit_counts_once():
    up = Uplink(ServerParams(uplink="rsu", backhaul_s=0.02), 3, 1.0)
    # Message 0 is received by both units, at 0.3 and 0.1 s; 2 by one; 1 by none.
    by = received([0, 0, 1], [0, 2, 0], [0.3, 0.2, 0.1])
    stats = up.send_rsu(told(3), by.message, by, 5.0)
    assert (stats.n_reports, stats.n_reached, stats.n_lost) == (3, 2, 1)
    assert not up.arrived(5.119)
    assert [m.evaluator.tolist() for m in up.arrived(5.12)] == [[0]]
    assert [m.evaluator.tolist() for m in up.arrived(5.22)] == [[2]]


def test_no_uplink_during_an_outage():
    for way in ("cellular", "rsu"):
        p = ServerParams(uplink=way, outages=((10.0, 20.0),), cellular=CellularParams(uplink_loss_p=0.0))
        up = Uplink(p, 3, 1.0)
        for time_s in (5.0, 10.0, 15.0, 19.0, 20.0):
            if way == "cellular":
                stats = up.send_cellular(told(4), keys(4), np.zeros((4, 2)), time_s)
            else:
                by = received([0] * 4, range(4), [0.1] * 4)
                stats = up.send_rsu(told(4), by.message, by, time_s)
            out = 10 <= time_s < 20
            assert (stats.n_reached, stats.n_outage) == ((0, 4) if out else (4, 0))
    p = ServerParams(outages=((10.0, 20.0),))
    up = Uplink(p, 3, 1.0)
    stats = up.send_cellular(told(100), keys(100), np.zeros((100, 2)), 9.9)  # under way when it begins
    assert stats.n_outage > 0 and stats.n_reached > 0


def broadcast(time_s, value=0.3):
    return TrustBroadcast(time_s, np.arange(3), np.full(3, value))


def test_trust_values_are_received_and_age():
    p = ServerParams(outages=((6.0, 16.0),), cellular=CellularParams(downlink_loss_p=0.0))
    down, all_vehicles = Downlink(p, 3), np.arange(3)
    stats = down.publish(broadcast(0.0), 0, all_vehicles, keys(3))
    assert (stats.n_addressed, stats.n_informed) == (3, 3)
    assert not down.lookup(all_vehicles, all_vehicles, 0.0)[1].any()
    for time_s in (5.0, 12.0):
        value, known, age = down.lookup(all_vehicles, all_vehicles, time_s)
        assert known.all() and (value == 0.3).all() and (age == time_s).all()
    stats = down.publish(broadcast(5.99, 0.8), 6, all_vehicles, keys(3))  # would arrive in the outage
    assert stats.n_informed == 0
    assert (down.lookup(all_vehicles, all_vehicles, 20.0)[0] == 0.3).all()


def test_roadside_units_transmit_a_broadcast_once():
    down, all_vehicles = Downlink(ServerParams(uplink="rsu"), 3), np.arange(3)
    stats = down.publish(broadcast(1.0), 1, all_vehicles, keys(3))
    assert down.pending_rsu_broadcast(1.005) is None  # 10 ms of backhaul
    assert down.pending_rsu_broadcast(1.4).time_s == 1.0
    assert down.pending_rsu_broadcast(1.5) is None
    by = received([0, 1, 1], [0, 0, 1], [0.2, 0.3, 0.1])
    stats = down.receive_from_rsu(by.receiver, by, all_vehicles, 1.4)
    assert (stats.n_addressed, stats.n_informed) == (3, 2)
    assert down.lookup(all_vehicles, all_vehicles, 1.55)[1].tolist() == [False, True, False]
    assert down.lookup(all_vehicles, all_vehicles, 1.65)[1].tolist() == [True, True, False]


def test_a_newer_broadcast_replaces_an_older_one_that_arrives_late():
    p = ServerParams(cellular=CellularParams(downlink_loss_p=0.0))
    down, me = Downlink(p, 3), np.array([0])
    down.publish(broadcast(0.0, 0.1), 0, me, keys(1))
    down.publish(broadcast(1e-3, 0.9), 1, me, keys(1))
    seen = [float(down.lookup(me, me, t)[0][0]) for t in np.linspace(0, 3, 200)]
    last = seen.index(0.9)
    assert set(seen[last:]) == {0.9}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"outages": ((5.0, 5.0),)}, r"server\.outages\[0\] = \[5, 5\] s is not an interval"),
        ({"outages": ((-1.0, 5.0),)}, "outages"),
    ],
)
def test_bad_parameters(wrong, words):
    with pytest.raises(ValueError, match=words):
        ServerParams(**wrong)
    with pytest.raises(ValueError, match=r"server\.cellular\.delay_mean_s"):
        CellularParams(delay_mean_s=0.01)


def test_a_lookup_changes_nothing_and_unused_broadcasts_expire():
    p = ServerParams(cellular=CellularParams(downlink_loss_p=0.0))
    down, me = Downlink(p, 3), np.array([5000])
    for step in range(3):
        down.publish(broadcast(float(step), 0.1 * step), step, me, keys(1))
    before = pickle.dumps(down)
    assert not down.lookup(me, np.array([1]), 0.0)[1].any() and down.lookup(me, np.array([1]), 9.0)[0] == 0.2
    assert pickle.dumps(down) == before
    late = down.lookup(me, np.array([1]), 9.0)
    down.expire(me, 9.0)
    assert [np.array_equal(*pair) for pair in zip(late, down.lookup(me, np.array([1]), 9.0), strict=True)] == [True] * 3
    assert len(pickle.dumps(down)) < len(before) + 70_000 and list(down._broadcasts) == [2]
