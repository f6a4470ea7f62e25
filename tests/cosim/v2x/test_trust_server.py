"""The way to the server and back: delays, losses, second attempts, full cells, outages."""

import numpy as np
import pytest

from cosim import rng
from cosim.radio.message_round import Receptions
from cosim.v2x.cellular import CellularParams, delay_s, transfer_delay_s, within_capacity
from cosim.v2x.trust_server import Downlink, LinkStats, ServerParams, TrustBroadcast, Uplink

CHANCE = rng.key(3, rng.Stream.UPLINK, 1)


def keys(n):
    return np.arange(n, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)


def told(n, step=0, verdicts=2):
    m = n * verdicts
    return EvaluationMessages(
        step, np.arange(n), np.arange(n + 1) * verdicts, np.zeros(m, int), np.zeros(m, int), np.ones(m), np.ones(m)
    )


def heard(receiver, sender, received_s):
    n, received_s = len(sender), np.asarray(received_s, float)
    zero = np.zeros(n)
    return Receptions(
        np.asarray(receiver), np.asarray(sender), np.ones(n, int), received_s / 2, zero, received_s / 2, zero
    )


def test_delays_have_their_minimum_and_mean():
    u = (np.arange(100_000) + 0.5) / 100_000
    delay = delay_s(u, CellularParams())
    assert delay.min() >= 0.05
    assert delay.mean() == pytest.approx(0.15, rel=0.001)
    # Gamma of shape 2 and mean 0.1: standard deviation 0.1 / sqrt(2)
    assert delay.std() == pytest.approx(0.1 / np.sqrt(2), rel=0.01)


def test_second_attempts_lose_less_and_take_longer():
    p = CellularParams()
    for retries in (0, 1, 2):
        journey = transfer_delay_s(CHANCE, keys(200_000), 0.3, retries, p)
        assert np.mean(np.isinf(journey)) == pytest.approx(0.3 ** (retries + 1), rel=0.05)
        # Mean number of attempts of what arrives: sum of k 0.7 0.3^(k - 1) over k = 1 ... retries + 1, by their share.
        k = np.arange(1, retries + 2)
        attempts = (k * 0.7 * 0.3 ** (k - 1)).sum() / (1 - 0.3 ** (retries + 1))
        assert journey[np.isfinite(journey)].mean() == pytest.approx(0.15 * attempts, rel=0.01)
    once = transfer_delay_s(CHANCE, keys(1000), 0.3, 0, p)
    again = transfer_delay_s(CHANCE, keys(1000), 0.3, 2, p)
    assert np.array_equal(once[np.isfinite(once)], again[np.isfinite(once)])  # who needs no second attempt is as before


def test_a_full_cell_drops_what_it_cannot_take():
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
    up.by_cellular(told(1000), keys(1000), np.zeros((1000, 2)), 10.0)
    t = up.last
    assert t.n_reports == 1000 == t.n_reached + t.n_lost
    assert t.n_lost == pytest.approx(200, abs=40)
    assert t.up_bytes == 1000 * (18 + 20 + 8 + 96 + 16 + 2 * 12)
    assert not up.arrived(10.05)  # nothing before the shortest delay
    assert sum(len(m.evaluator) for m in up.arrived(20.0)) == t.n_reached
    assert not up.arrived(99.0)  # nothing twice


def test_a_report_without_verdicts_is_not_sent():
    up = Uplink(ServerParams(), 3, 1.0)
    up.by_cellular(told(5, verdicts=0), keys(5), np.zeros((5, 2)), 0.0)
    assert up.last == LinkStats() and not up.arrived(9.0)


def test_capacity_is_counted():
    p = ServerParams(cellular=CellularParams(cell_up_bytes_per_s=1820.0, uplink_loss_p=0.0))  # ten reports of 182 B
    up = Uplink(p, 3, 1.0)
    up.by_cellular(told(25), keys(25), np.zeros((25, 2)), 0.0)
    assert (up.last.n_reached, up.last.n_over_capacity, up.last.n_lost) == (10, 15, 0)


def test_the_first_roadside_unit_that_hears_counts_once():
    up = Uplink(ServerParams(uplink="rsu", backhaul_s=0.02), 3, 1.0)
    # Message 0 is heard by both units, at 0.3 and 0.1 s; 2 by one; 1 by none.
    by = heard([0, 0, 1], [0, 2, 0], [0.3, 0.2, 0.1])
    up.by_roadside(told(3), by.sender, by, 5.0)
    assert (up.last.n_reports, up.last.n_reached, up.last.n_lost) == (3, 2, 1)
    assert not up.arrived(5.119)
    assert [m.evaluator.tolist() for m in up.arrived(5.12)] == [[0]]
    assert [m.evaluator.tolist() for m in up.arrived(5.22)] == [[2]]


def test_nothing_goes_up_while_the_server_is_out():
    for way in ("cellular", "rsu"):
        p = ServerParams(uplink=way, outages=((10.0, 20.0),), cellular=CellularParams(uplink_loss_p=0.0))
        up = Uplink(p, 3, 1.0)
        for time_s in (5.0, 10.0, 15.0, 19.0, 20.0):
            if way == "cellular":
                up.by_cellular(told(4), keys(4), np.zeros((4, 2)), time_s)
            else:
                by = heard([0] * 4, range(4), [0.1] * 4)
                up.by_roadside(told(4), by.sender, by, time_s)
            out = 10 <= time_s < 20
            assert (up.last.n_reached, up.last.n_outage) == ((0, 4) if out else (4, 0))
    p = ServerParams(outages=((10.0, 20.0),))
    up = Uplink(p, 3, 1.0)
    up.by_cellular(told(100), keys(100), np.zeros((100, 2)), 9.9)  # under way when it begins
    assert up.last.n_outage > 0 and up.last.n_reached > 0


def edition(time_s, value=0.3):
    return TrustBroadcast(time_s, np.arange(3), np.full(3, value))


def test_trust_comes_down_and_grows_old():
    p = ServerParams(outages=((6.0, 16.0),), cellular=CellularParams(downlink_loss_p=0.0))
    down, everybody = Downlink(p, 3), np.arange(3)
    down.publish(edition(0.0), 0, everybody, keys(3))
    assert (down.n_addressed, down.n_informed) == (3, 3)
    assert not down.known(everybody, everybody, everybody, 0.0)[1].any()
    for time_s in (5.0, 12.0):
        value, known, age = down.known(everybody, everybody, everybody, time_s)
        assert known.all() and (value == 0.3).all() and (age == time_s).all()
    down.publish(edition(5.99, 0.8), 6, everybody, keys(3))  # would arrive in the outage
    assert down.n_informed == 0
    assert (down.known(everybody, everybody, everybody, 20.0)[0] == 0.3).all()


def test_roadside_units_pass_an_edition_on_once():
    down, everybody = Downlink(ServerParams(uplink="rsu"), 3), np.arange(3)
    down.publish(edition(1.0), 1, everybody, keys(3))
    assert down.pending_rsu_broadcast(1.005) is None  # 10 ms of backhaul
    assert down.pending_rsu_broadcast(1.4).time_s == 1.0
    assert down.pending_rsu_broadcast(1.5) is None
    by = heard([0, 1, 1], [0, 0, 1], [0.2, 0.3, 0.1])
    down.receive_from_rsu(by.receiver, by, everybody, 1.4)
    assert (down.n_addressed, down.n_informed) == (3, 2)
    assert down.known(everybody, everybody, everybody, 1.55)[1].tolist() == [False, True, False]
    assert down.known(everybody, everybody, everybody, 1.65)[1].tolist() == [True, True, False]


def test_a_newer_edition_replaces_an_older_one_that_comes_late():
    p = ServerParams(cellular=CellularParams(downlink_loss_p=0.0))
    down, me = Downlink(p, 3), np.array([0])
    down.publish(edition(0.0, 0.1), 0, me, keys(1))
    down.publish(edition(1e-3, 0.9), 1, me, keys(1))
    seen = [float(down.known(me, me, me, t)[0][0]) for t in np.linspace(0, 3, 200)]
    last = seen.index(0.9)
    assert set(seen[last:]) == {0.9}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"outages": ((5.0, 5.0),)}, r"server\.outages\[0\] = \[5, 5\] s is no span"),
        ({"outages": ((-1.0, 5.0),)}, "outages"),
    ],
)
def test_bad_parameters(wrong, words):
    with pytest.raises(ValueError, match=words):
        ServerParams(**wrong)
    with pytest.raises(ValueError, match=r"server\.cellular\.delay_mean_s"):
        CellularParams(delay_mean_s=0.01)
