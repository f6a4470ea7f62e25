"""Rounds of messages over the shared channel: who gets what, when, how often, and where the rest goes."""

import numpy as np
import pytest

from cosim.v2x import csma
from cosim.v2x.channel import AccessParams
from cosim.v2x.dcc import DccParams
from cosim.v2x.exchange import Fate, RelayParams, View
from cosim.v2x.obstruction import Sight, Walls
from cosim.v2x.propagation import PropagationParams
from cosim.v2x.reception import ReceiverParams

QUIET = PropagationParams(model="free_space", shadowing=False, fading="none", blockage="none", reach_m=5000)


def line(n, apart_m):
    return np.column_stack([np.arange(n) * apart_m, np.zeros(n), np.full(n, 1.6)])


def names_of(n):
    return np.arange(1, n + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)


def rounds(xyz, length, n=1, talks=None, reach_m=300.0, propagation=QUIET, air=None, names=None, **relay):
    """Results of n rounds, half a second apart, of a tenth of a second each."""
    air = csma.Air.start(None, 5) if air is None else air
    talks = np.ones(len(xyz), bool) if talks is None else talks
    names = names_of(len(xyz)) if names is None else names
    return [
        csma.broadcast(
            air, xyz, names, talks, np.broadcast_to(length, len(xyz)), i, 0.5 * i, 0.2, reach_m, propagation,
            ReceiverParams(), AccessParams(), DccParams(), RelayParams(**relay),
        ) for i in range(n)
    ]  # fmt: skip


def pairs(heard):
    return set(zip(heard.receiver.tolist(), heard.sender.tolist(), strict=True))


def test_without_fading_or_load_exactly_the_pairs_within_reach_hear():
    xyz = line(12, 90.0)
    for i in range(12):  # one at a time: nothing to collide with
        ((heard, frames),) = rounds(xyz, 300, talks=np.arange(12) == i)
        near = np.flatnonzero(np.abs(xyz[:, 0] - xyz[i, 0]) <= 300)
        assert pairs(heard) == {(r, i) for r in near.tolist() if r != i}
        assert (frames.fate == Fate.RECEIVED).all() and len(frames.fate) == len(near) - 1
        # 40 us + 8 us * ceil((22 + 8 * 336) / 48) = 496 us on the air, after 58 + 6 slots of silence at most
        assert (heard.latency_s >= 496e-6).all() and (heard.latency_s < 700e-6).all()


def test_latency_and_causality():
    xyz = line(60, 10.0)
    for heard, frames in rounds(xyz, 500, n=3):
        assert len(pairs(heard)) == len(heard.receiver)  # nobody twice
        assert (heard.receiver != heard.sender).all()  # nobody their own
        assert (heard.latency_s > 0).all() and (heard.latency_s <= 0.2).all()
        assert frames.busy is not None and (frames.busy > 0.1).all() and (frames.busy <= 1).all()
        assert frames.sent_bytes == 60 * 536


def test_everything_in_reach_is_accounted_for():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 800, (150, 2)), np.full(150, 1.6)])
    (heard, frames), *_ = rounds(xyz, 700, propagation=PropagationParams(model="log_distance"))
    apart = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    assert len(frames.fate) == (apart <= 300).sum() - 150
    assert (frames.fate == Fate.RECEIVED).sum() == len(heard.receiver)
    assert {Fate.RECEIVED, Fate.PROPAGATION, Fate.COLLISION} <= set(frames.fate.tolist())


def test_a_long_message_needs_all_its_segments():
    xyz = line(2, 100.0)
    ((heard, frames),) = rounds(xyz, 3000, talks=np.array([True, False]))
    assert pairs(heard) == {(1, 0)}
    assert frames.n_transmissions.tolist() == [3, 0] and len(frames.fate) == 3
    weak = PropagationParams(model="log_distance", exponent=3.0, shadowing=False)
    got = [rounds(xyz, length, n=200, propagation=weak) for length in (1000, 3000)]
    whole, cut = (np.mean([len(heard.receiver) for heard, _ in many]) / 2 for many in got)
    frame = np.mean([np.mean(frames.fate == Fate.RECEIVED) for _, frames in got[1]])
    assert 0.3 < cut < whole < 1
    assert cut == pytest.approx(frame**3, abs=0.1)  # segments fade independently


def test_relay_goes_on_hop_by_hop():
    xyz = line(8, 250.0)
    first = np.arange(8) == 0
    reached = {}
    for hops in (1, 2, 3):
        ((heard, frames),) = rounds(xyz, 300, talks=first, max_hops=hops, reach_m=260.0)
        reached[hops] = dict(zip(heard.receiver.tolist(), heard.hops.tolist(), strict=True))
        assert frames.n_relayed == hops - 1
    assert reached == {1: {1: 1}, 2: {1: 1, 2: 2}, 3: {1: 1, 2: 2, 3: 3}}


def test_who_overhears_a_relay_keeps_silent():
    """Ten radios 180 to 270 m away: the contention lets one or two speak, not ten."""
    bunch = np.column_stack([180.0 + 10.0 * np.arange(10), np.zeros(10), np.full(10, 1.6)])
    xyz = np.vstack([[[0, 0, 1.6]], bunch, [[500, 0, 1.6]]])
    ((heard, frames),) = rounds(xyz, 300, talks=np.arange(12) == 0, max_hops=2, reach_m=280.0)
    assert (11, 0) in pairs(heard)
    assert 1 <= frames.n_relayed <= 4
    assert frames.n_duplicate >= 9 - 4


def test_relay_by_probability_is_as_frequent_as_asked_and_silences_nobody():
    """Two hundred radios around one sender, all of which hear it: a binomial number passes it on."""
    rng = np.random.default_rng(2)
    xyz = np.column_stack([rng.uniform(-100, 100, (201, 2)), np.full(201, 1.6)])
    one = np.arange(201) == 0
    n_relayed = []
    for p in (0.0, 0.3):
        ((heard, frames),) = rounds(xyz, 300, talks=one, max_hops=2, rule="probability", forward_p=p)
        assert len(heard.receiver) == 200
        n_relayed.append(frames.n_relayed)
    assert n_relayed[0] == 0 and abs(n_relayed[1] - 60) < 5 * np.sqrt(60 * 0.7)


def test_the_same_for_any_order_and_beside_a_stranger():
    rng = np.random.default_rng(3)
    xyz = np.column_stack([rng.uniform(0, 600, (60, 2)), np.full(60, 1.6)])
    names = names_of(60)
    air = PropagationParams(model="log_distance")
    base = [pairs(heard) for heard, _ in rounds(xyz, 400, n=2, propagation=air, max_hops=2)]
    order = rng.permutation(60)
    mixed = rounds(xyz[order], 400, n=2, propagation=air, names=names[order], max_hops=2)
    assert [{(order[r], order[s]) for r, s in pairs(heard)} for heard, _ in mixed] == base
    far = np.vstack([xyz, [[50_000, 0, 1.6]]])
    more = rounds(far, 400, n=2, propagation=air, names=names_of(61), max_hops=2)
    assert [pairs(heard) for heard, _ in more] == base


def test_a_wall_only_takes():
    """Two groups in the open, and the same with a house between them."""
    rng = np.random.default_rng(1)
    side = rng.uniform(0, 40, (40, 2))
    side[20:, 0] += 120
    xyz = np.column_stack([side, np.full(40, 1.6)])
    house = [(np.array([[60.0, -50], [100, -50], [100, 90], [60, 90]]), [], 0.0, 20.0)]
    urban = PropagationParams(blockage="none")
    counts = []
    for walls in ([], house):
        air = csma.Air.start(Sight.of(Walls.of(walls)), 5)
        many = rounds(xyz, 300, n=20, propagation=urban, air=air)
        across = [sum((r < 20) != (s < 20) for r, s in pairs(heard)) for heard, _ in many]
        counts.append(sum(across))
    assert counts[1] < 0.9 * counts[0]


def test_what_was_found_for_one_round_serves_the_next_only_where_nobody_moved():
    rng = np.random.default_rng(7)
    xyz = np.column_stack([rng.uniform(0, 500, (50, 2)), np.full(50, 1.6)])
    kept, fresh = csma.Air.start(None, 5), csma.Air.start(None, 5)
    for i in range(4):
        if i == 2:
            xyz[:, 0] += 40.0 * rng.random(50)  # in place
        fresh.ground = None
        before = kept.ground
        (one, _), (other, _) = (
            csma.broadcast(
                air, xyz, names_of(50), np.ones(50, bool), np.full(50, 400), i, 0.5 * i, 0.2, 300.0,
                PropagationParams(model="log_distance"), ReceiverParams(), AccessParams(), DccParams(), RelayParams(),
            ) for air in (kept, fresh)
        )  # fmt: skip
        assert (kept.ground is before) == (i in (1, 3))
        assert np.array_equal(one.receiver, other.receiver) and np.array_equal(one.latency_s, other.latency_s)


@pytest.mark.parametrize("max_hops", [1, 3])
def test_nobody_and_silence(max_hops):
    ((heard, frames),) = rounds(line(3, 10.0), 300, talks=np.zeros(3, bool), max_hops=max_hops)
    assert len(heard.receiver) == len(frames.fate) == 0 and frames.sent_bytes == 0
    ((heard, frames),) = rounds(line(1, 10.0), 300, max_hops=max_hops)
    assert len(heard.receiver) == len(frames.fate) == 0 and frames.n_transmissions.tolist() == [1]


def test_every_message_has_its_three_times():
    xyz = line(40, 12.0)
    for length in (400, 2500):  # one frame, and two
        for heard, _ in rounds(xyz, length, n=3, max_hops=2):
            assert (heard.generated_s >= 0).all() and (heard.generated_s < 0.1).all()  # in the first half of the round
            assert (heard.access_s >= 58e-6).all()  # AIFS
            assert (heard.latency_s > heard.access_s).all()
            assert (heard.received_s <= 0.2).all()
            first = {}  # a message is generated once, whoever hears it
            for s, at in zip(heard.sender.tolist(), heard.generated_s.tolist(), strict=True):
                assert first.setdefault(s, at) == at


def test_a_lower_power_or_a_longer_message_only_takes():
    rng = np.random.default_rng(4)
    xyz = np.column_stack([rng.uniform(0, 500, (60, 2)), np.full(60, 1.6)])

    def delivered(length, power_dbm):
        air = PropagationParams(model="log_distance", tx_power_dbm=power_dbm)
        return sum(len(heard.receiver) for heard, _ in rounds(xyz, length, n=12, propagation=air, reach_m=500.0))

    powers = [delivered(400, dbm) for dbm in (23.0, 17.0, 11.0)]
    assert powers == sorted(powers, reverse=True) and powers[2] < 0.7 * powers[0]
    lengths = [delivered(n, 23.0) for n in (200, 1300, 4000)]
    assert lengths == sorted(lengths, reverse=True) and lengths[2] < 0.9 * lengths[0]


def test_what_stands_between_is_told():
    xyz = np.array([[0.0, 0, 1.6], [50, 0, 1.6], [120, 0, 1.6], [130, 30, 1.6]])
    house = [(np.array([[70.0, -50], [90, -50], [90, 90], [70, 90]]), [], 0.0, 20.0)]
    urban = PropagationParams(blockage="none")
    ((_, frames),) = rounds(xyz, 300, propagation=urban, air=csma.Air.start(Sight.of(Walls.of(house)), 5))
    across = (frames.origin < 2) != (frames.receiver < 2)
    assert np.array_equal(frames.view == View.WALL, across) and (frames.view[~across] == View.OPEN).all()
    ((_, frames),) = rounds(xyz, 300)
    assert (frames.view == View.UNKNOWN).all()


def test_frames_name_their_ends():
    xyz = line(5, 100.0)
    ((heard, frames),) = rounds(xyz, 300, talks=np.arange(5) == 2, max_hops=2, reach_m=150.0)
    own = frames.hop == 1
    assert set(zip(frames.origin[own].tolist(), frames.receiver[own].tolist(), strict=True)) == {(2, 1), (2, 3)}
    assert set(frames.receiver[~own].tolist()) <= {0, 1, 3, 4}  # the author's own message is not counted back at it
    assert pairs(heard) == {(0, 2), (1, 2), (3, 2), (4, 2)}
