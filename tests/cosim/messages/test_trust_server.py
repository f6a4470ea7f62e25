"""Links of the server: delays, losses, retries, capacity of cells, outages."""

import pickle

import numpy as np
import pytest

from cosim.base import rng
from cosim.messages.cellular import CellularParams, delay_s, transfer_delay_s, within_capacity
from cosim.messages.trust_server import (
    Downlink,
    DownlinkState,
    LinkStats,
    SentReports,
    ServerParams,
    TrustBroadcast,
    Uplink,
    UplinkState,
)
from trust.tables import SERVER, EvaluationMessages, TrustScores

KEY = rng.key(3, rng.Stream.UPLINK, 1)


def keys(n):
    return np.arange(n, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)


def reports_of(n, step=0, each=2):
    m = n * each
    zeros, ones = np.zeros(m, int), np.ones(m)
    ptr = np.arange(n + 1) * each
    messages = EvaluationMessages(step, np.arange(n), ptr, zeros, zeros, ones, ones)
    return SentReports(messages, np.full(n, each))


def arrived(up, state, time_s):
    """The state, and the evaluators of each report that reached the server."""
    state, here = up.arrived(state, time_s)
    return state, [m.evaluator.tolist() for m in here]


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
    state, stats = up.by_cellular(UplinkState(), reports_of(1000), keys(1000), np.zeros((1000, 2)), 10.0)
    assert stats.n_reports == 1000 == stats.n_reached + stats.n_lost
    assert stats.n_lost == pytest.approx(200, abs=40)
    assert stats.uplink_bytes == 1000 * (18 + 20 + 8 + 96 + 16 + 2 * 12)
    state, here = arrived(up, state, 10.05)
    assert not here  # nothing before the shortest delay
    state, here = arrived(up, state, 20.0)
    assert sum(map(len, here)) == stats.n_reached
    assert not arrived(up, state, 99.0)[1]  # nothing twice


def test_a_report_without_evaluations_is_not_sent():
    up = Uplink(ServerParams(), 3, 1.0)
    state, stats = up.by_cellular(UplinkState(), reports_of(5, each=0), keys(5), np.zeros((5, 2)), 0.0)
    assert stats == LinkStats() and not arrived(up, state, 9.0)[1]


def test_evaluations_that_the_server_will_drop_are_sent():
    """A trusted roadside unit overrules them at the server; the vehicle that sends them does not know that."""
    up = Uplink(ServerParams(cellular=CellularParams(uplink_loss_p=0.0)), 3, 1.0)
    key, xy_m = keys(5), np.zeros((5, 2))
    _, all_used = up.by_cellular(UplinkState(), reports_of(5), key, xy_m, 0.0)
    dropped = reports_of(5)._replace(used=reports_of(5, each=0).used)
    state, stats = up.by_cellular(UplinkState(), dropped, key, xy_m, 0.0)
    assert stats == all_used and stats.uplink_bytes == 5 * 182
    assert arrived(up, state, 9.0)[1] == [[0, 1, 2, 3, 4]]


def test_capacity_is_counted():
    p = ServerParams(cellular=CellularParams(cell_up_bytes_per_s=1820.0, uplink_loss_p=0.0))  # ten reports of 182 B
    _, stats = Uplink(p, 3, 1.0).by_cellular(UplinkState(), reports_of(25), keys(25), np.zeros((25, 2)), 0.0)
    assert (stats.n_reached, stats.n_over_capacity, stats.n_lost) == (10, 15, 0)


def test_the_first_reception_by_a_roadside_unit_counts_once():
    up = Uplink(ServerParams(uplink="rsu", backhaul_s=0.02), 3, 1.0)
    # Message 0 is received by both units, at 5.3 and 5.1 s; 2 by one; 1 by none.
    message, received_s = np.array([0, 2, 0]), np.array([5.3, 5.2, 5.1])
    state, stats = up.by_rsu(UplinkState(), reports_of(3), message, received_s)
    assert (stats.n_reports, stats.n_reached, stats.n_lost) == (3, 2, 1)
    assert not arrived(up, state, 5.119)[1]
    state, here = arrived(up, state, 5.12)
    assert here == [[0]] and arrived(up, state, 5.22)[1] == [[2]]


def test_outages_begin_and_end_in_their_steps():
    """Three steps of 0.3 s are 0.8999999999999999 s."""
    is_out = ServerParams(outages=((0.9, 1.8),)).is_out(np.arange(8) * 0.3)
    assert np.flatnonzero(is_out).tolist() == [3, 4, 5]


def test_no_uplink_during_an_outage():
    for way in ("cellular", "rsu"):
        p = ServerParams(uplink=way, outages=((10.0, 20.0),), cellular=CellularParams(uplink_loss_p=0.0))
        up, state = Uplink(p, 3, 1.0), UplinkState()
        for time_s in (5.0, 10.0, 15.0, 19.0, 20.0):
            if way == "cellular":
                state, stats = up.by_cellular(state, reports_of(4), keys(4), np.zeros((4, 2)), time_s)
            else:
                state, stats = up.by_rsu(state, reports_of(4), np.arange(4), np.full(4, time_s + 0.1))
            out = 10 <= time_s < 20
            assert (stats.n_reached, stats.n_outage) == ((0, 4) if out else (4, 0))
    up = Uplink(ServerParams(outages=((10.0, 20.0),)), 3, 1.0)
    _, stats = up.by_cellular(UplinkState(), reports_of(100), keys(100), np.zeros((100, 2)), 9.9)
    assert stats.n_outage > 0 and stats.n_reached > 0  # some are under way when it begins


ALL = np.arange(3)


def broadcast(time_s, value=0.3):
    n, step = 3, np.zeros(3, int)
    scores = TrustScores(
        int(time_s), np.full(n, SERVER), np.arange(n), np.full(n, value), np.full(n, np.nan), np.ones(n),
        np.ones(n, int), step, step, step, step, np.ones(n, bool),
    )  # fmt: skip
    return TrustBroadcast(time_s, scores)


def known(down, state, vehicle, subject):
    """Trust of each subject as its vehicle knows it, NaN for none, and when it was computed."""
    value, computed_s = np.full(len(vehicle), np.nan), np.full(len(vehicle), np.nan)
    for sent, rows, at in down.lookup(state, vehicle, subject):
        value[rows], computed_s[rows] = sent.scores.trust[at], sent.time_s
    return value, computed_s


def test_trust_values_are_received():
    p = ServerParams(outages=((6.0, 16.0),), cellular=CellularParams(downlink_loss_p=0.0))
    down = Downlink(p, 3)
    state, n_informed = down.publish(DownlinkState(), broadcast(0.0), 0, ALL, down.delays_s(0, keys(3)))
    assert n_informed == 3
    state = down.receive(state, ALL, 0.0)
    assert np.isnan(known(down, state, ALL, ALL)[0]).all()
    for time_s in (5.0, 12.0):
        state = down.receive(state, ALL, time_s)
        value, computed_s = known(down, state, ALL, ALL)
        assert (value == 0.3).all() and (computed_s == 0).all()
    state, n_informed = down.publish(
        state, broadcast(5.99, 0.8), 6, ALL, down.delays_s(6, keys(3))
    )  # would arrive in the outage
    assert n_informed == 0
    assert (known(down, down.receive(state, ALL, 20.0), ALL, ALL)[0] == 0.3).all()


def test_roadside_units_transmit_a_broadcast_once():
    down = Downlink(ServerParams(uplink="rsu"), 3)
    state, n_informed = down.publish(DownlinkState(), broadcast(1.0), 1, ALL, down.delays_s(1, keys(3)))
    assert n_informed == 0
    state, sent = down.pending_rsu_broadcast(state, 1, 1.005)
    assert sent is None  # 10 ms of backhaul
    state, sent = down.pending_rsu_broadcast(state, 1, 1.4)
    assert sent.time_s == 1.0
    state, sent = down.pending_rsu_broadcast(state, 2, 1.5)
    assert sent is None
    by, after_s = np.array([0, 1, 1]), np.array([0.2, 0.3, 0.1])
    state, n_informed = down.receive_from_rsu(state, ALL, by, np.full(3, 1), after_s)
    assert n_informed == 2
    state = down.receive(state, ALL, 1.55)
    assert np.isfinite(known(down, state, ALL, ALL)[0]).tolist() == [False, True, False]
    state = down.receive(state, ALL, 1.65)
    assert np.isfinite(known(down, state, ALL, ALL)[0]).tolist() == [True, True, False]


def test_a_backhaul_longer_than_the_period_delays_broadcasts_and_loses_none():
    """One a second, each 2.5 s on its way: units send that of second 0 at 3 s, and so on. Late copies count once."""
    down, state, sent = Downlink(ServerParams(uplink="rsu", backhaul_s=2.5), 3, late_s=2.5), DownlinkState(), []
    for step in range(6):
        state, _ = down.publish(state, broadcast(float(step)), step, ALL, np.zeros(3))
        state, one = down.pending_rsu_broadcast(state, step, step + 0.4)
        sent.append(None if one is None else one.time_s)
        state = down.receive(state, ALL, step + 0.9)
    assert sent == [None, None, None, 0.0, 1.0, 2.0]

    def got(state, receiver, sent_step):
        n = len(receiver)
        return down.receive_from_rsu(state, ALL, np.array(receiver), np.array(sent_step), np.full(n, 0.1))

    state, n_informed = got(state, [0, 0, 1], [5, 4, 4])
    assert n_informed == 3
    state, n_informed = got(state, [0, 1, 1, 2], [5, 4, 5, 3])
    assert n_informed == 2  # 1 the newer, 2 the oldest
    state = down.receive(state, ALL, 6.0)
    assert known(down, state, ALL, ALL)[1].tolist() == [2.0, 2.0, 0.0]


def test_a_newer_broadcast_replaces_an_older_one_that_arrives_late():
    p = ServerParams(cellular=CellularParams(downlink_loss_p=0.0))
    down, own, seen = Downlink(p, 3), np.array([0]), []
    state, _ = down.publish(DownlinkState(), broadcast(0.0, 0.1), 0, own, down.delays_s(0, keys(1)))
    state, _ = down.publish(state, broadcast(1e-3, 0.9), 1, own, down.delays_s(1, keys(1)))
    for time_s in np.linspace(0, 3, 200):
        state = down.receive(state, own, time_s)
        seen.append(float(known(down, state, own, own)[0][0]))
    assert set(seen[seen.index(0.9) :]) == {0.9}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"outages": ((5.0, 5.0),)}, r"server\.outages\[0\] = \[5, 5\] s is no span of time"),
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
    down, own, state = Downlink(p, 3), np.array([5000]), DownlinkState()
    for step in range(3):
        state, _ = down.publish(state, broadcast(float(step), 0.1 * step), step, own, down.delays_s(step, keys(1)))
    before = pickle.dumps(state)
    assert np.isnan(known(down, state, own, np.array([1]))[0])
    assert pickle.dumps(state) == before and sorted(state.broadcasts) == [0, 1, 2]
    state = down.receive(state, own, 9.0)
    assert known(down, state, own, np.array([1]))[0] == 0.2 and list(state.broadcasts) == [2]


@pytest.mark.parametrize("stranger_loses_it", [False, True])
def test_a_vehicle_that_returns_keeps_what_it_received_for_a_minute(stranger_loses_it):
    """Vehicle 1 has the broadcast of second 0, and is away from second 1 on. The other one decides nothing."""
    down, both, one = Downlink(ServerParams(), 3), np.array([0, 1]), np.array([0])
    state, _ = down.publish(DownlinkState(), broadcast(0.0), 0, both, np.zeros(2))
    state = down.receive(state, both, 0.8)
    state, _ = down.publish(state, broadcast(5.0), 5, one, np.full(1, np.inf if stranger_loses_it else 0.0))
    for time_s, computed_s in ((5.8, 0.0), (60.8, 0.0), (60.81, np.nan)):
        away = down.receive(state, one, time_s - 0.1)
        back = down.receive(away, both, time_s)
        assert known(down, back, both, both)[1][1] == pytest.approx(computed_s, nan_ok=True)
    away = down.receive(down.receive(state, one, 60.0), one, 61.0)
    assert list(away.broadcasts) == ([0] if stranger_loses_it else [5])
