"""The event loop: frames by hand, and what must hold for all of them."""

from dataclasses import fields, replace
from itertools import chain

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.radio.channel import Access, AccessParams, ChannelRules, ChannelState, Links, Packets, PhyOutcome, run_window
from cosim.radio.phy import ReceiverParams
from tests.cosim.radio.ns3 import DCF

US, MS = 1_000, 1_000_000
EXACT = ReceiverParams()
CHANCE = np.uint64(7)
EXACT_DCF = ChannelRules(CHANCE, EXACT, DCF)
EXACT_EDCA = ChannelRules(CHANCE, EXACT, AccessParams())


def net(dbm, fades=False, key=None) -> Links:
    """Links from a matrix of mean powers [dBm]; -inf is none."""
    dbm = np.asarray(dbm, float)
    n = len(dbm)
    a, b = np.nonzero(np.isfinite(dbm) & ~np.eye(n, dtype=bool))
    power = (10 ** (dbm[a, b] / 10)).astype(np.float32)
    kind = np.full(len(a), 2 if fades else 0, np.uint8)
    key = np.arange(1, n + 1, dtype=np.uint64) if key is None else key
    return Links(key, np.searchsorted(a, np.arange(n + 1)), b, power, kind)


def say(sender, at_ns, payload=300, access=Access.BE, lifetime_ns=100 * MS, seq=None) -> Packets:
    sender, at_ns = np.atleast_1d(sender), np.atleast_1d(at_ns)
    n = len(sender)
    return Packets(
        sender, np.arange(n, dtype=np.uint64) if seq is None else np.asarray(seq, np.uint64), at_ns,
        np.broadcast_to(payload, n), np.broadcast_to(access, n).astype(np.uint8), np.broadcast_to(lifetime_ns, n),
        np.arange(n),
    )  # fmt: skip


def hear(links, packets, until_ns=50 * MS, receiver=EXACT, access=DCF, **more):
    return run_window(ChannelState.start(), links, packets, until_ns, ChannelRules(CHANCE, receiver, access), **more)[1]


def outcomes(outcome):
    """{(tag, receiver row): outcome}"""
    tag = np.repeat(outcome.tag, np.diff(outcome.ptr))
    return {
        (int(t), int(r)): PhyOutcome(f) for t, r, f in zip(tag, outcome.receiver, outcome.reception, strict=True)
    }  # fmt: skip


PAIR = [[0, -70], [-70, 0]]


def test_one_frame_on_an_idle_channel():
    out = hear(net(PAIR), say(0, 1 * MS))
    # AIFS = 32 + 2 x 13 = 58 us; 300 B last 496 us.
    assert out.start_ns.tolist() == [1 * MS + 58 * US]
    assert out.end_ns.tolist() == [1 * MS + 554 * US]
    assert outcomes(out) == {(0, 1): PhyOutcome.RECEIVED}
    # The hearer senses it from 4 us after its start, the sender all along.
    assert out.busy * 50_000 == pytest.approx([496, 492])
    assert out.busy_strong * 50_000 == pytest.approx([0, 496])


def test_its_g5_waits_by_priority():
    for access, aifsn in zip(Access, (2, 3, 6, 9), strict=True):
        out = hear(net(PAIR), say(0, 0, access=access), access=AccessParams())
        assert out.start_ns.tolist() == [32 * US + 13 * US * aifsn]


def test_of_one_radio_the_urgent_frame_goes_first():
    out = hear(net(PAIR), say([0, 0], [0, 0], access=[Access.BK, Access.VO]), access=AccessParams())
    assert out.start_ns[1] < out.start_ns[0]
    assert set(outcomes(out).values()) == {PhyOutcome.RECEIVED}


def test_too_weak_is_range_and_noise_is_fading():
    # -93 dBm is below the -92 dBm of the receiver; -110 does not even exist.
    assert outcomes(hear(net([[0, -93, -110], [-np.inf] * 3, [-np.inf] * 3]), say(0, 0))) == {
        (0, 1): PhyOutcome.RANGE, (0, 2): PhyOutcome.RANGE
    }  # fmt: skip


def test_who_senses_the_other_waits():
    out = hear(net(PAIR), say([0, 1], [0, 300 * US]))
    # The second comes while the first is on the air (58 ... 554 us), waits for its end and AIFS, and its back-off.
    wait, part = divmod(int(out.start_ns[1]) - 554 * US - 58 * US, 13 * US)
    assert part == 0
    assert 0 <= wait <= 15
    assert set(outcomes(out).values()) == {PhyOutcome.RECEIVED}


def test_hidden_senders_collide():
    hidden = [[0, -np.inf, -70], [-np.inf, 0, -70], [-70, -70, 0]]
    out = hear(net(hidden), say([0, 1], [0, 100 * US]))
    # Equally strong: the later one is not even looked at, the earlier one is destroyed.
    assert outcomes(out) == {(0, 2): PhyOutcome.COLLISION, (1, 2): PhyOutcome.BUSY}
    # The stronger by 20 dB survives if it is the first, not if it is the second ...
    near = [[0, -np.inf, -60], [-np.inf, 0, -80], [-70, -70, 0]]
    assert outcomes(hear(net(near), say([0, 1], [0, 100 * US]))) == {
        (0, 2): PhyOutcome.RECEIVED,
        (1, 2): PhyOutcome.BUSY,
    }
    assert outcomes(hear(net(near), say([1, 0], [0, 100 * US]))) == {
        (0, 2): PhyOutcome.COLLISION,
        (1, 2): PhyOutcome.BUSY,
    }
    # ... unless it comes within the preamble's first 4 us, or the receiver captures.
    assert outcomes(hear(net(near), say([1, 0], [0, 3 * US]))) == {(0, 2): PhyOutcome.BUSY, (1, 2): PhyOutcome.RECEIVED}
    capture = ReceiverParams(capture=True, capture_window_s=1.0)
    assert outcomes(hear(net(near), say([1, 0], [0, 100 * US]), receiver=capture)) == {
        (0, 2): PhyOutcome.COLLISION, (1, 2): PhyOutcome.RECEIVED
    }  # fmt: skip


def test_who_sends_does_not_hear():
    out = hear(net(PAIR), say([0, 1], [0, 2 * US]))  # the second offsets within the first one's 4 us
    assert outcomes(out) == {(0, 1): PhyOutcome.HALF_DUPLEX, (1, 0): PhyOutcome.HALF_DUPLEX}


def test_old_and_surplus_packets_are_dropped():
    long = say([0] * 4, [0, 1, 2, 3], payload=2000, lifetime_ns=[100 * MS, 6 * MS, 6 * MS, 100 * MS])
    out = hear(net(PAIR), long)  # each lasts 2.77 ms, so the third cannot end by 8 ms when the second is over
    assert [PhyOutcome(f) for f in out.outcome] == [
        PhyOutcome.RECEIVED,
        PhyOutcome.RECEIVED,
        PhyOutcome.EXPIRED,
        PhyOutcome.RECEIVED,
    ]
    assert np.diff(out.ptr).tolist() == [1, 1, 0, 1]
    out = hear(net(PAIR), long, access=replace(DCF, queue_max=2))
    assert PhyOutcome.QUEUE in out.outcome


def test_congestion_control_spaces_frames():
    out = hear(net(PAIR), say([0] * 3, [0, 1, 2], lifetime_ns=200 * MS), 200 * MS, gap_ns=np.array([50 * MS, 0]))
    gaps = out.start_ns[1:] - out.end_ns[:-1]
    assert np.all((gaps >= 50 * MS) & (gaps < 51 * MS))


def crowd(n, seed, side_m=600.0):
    """Radios on a plane (log-distance 2.75), and each one's frames in 50 ms."""
    g = np.random.default_rng(seed)
    xy = g.uniform(0, side_m, (n, 2))
    d = np.maximum(np.linalg.norm(xy[:, None] - xy[None], axis=2), 1.0)
    dbm = 23 - 47.86 - 27.5 * np.log10(d)
    key = g.permutation(10 * n)[:n].astype(np.uint64)
    m = 4 * n
    sender = g.integers(0, n, m)
    packets = say(sender, g.integers(0, 50 * MS, m), g.integers(50, 1400, m), g.integers(0, 4, m), seq=np.arange(m))
    return np.where(dbm > -110, dbm, -np.inf), key, packets


def table(outcome, key):
    """Everything known of an outcome, by names that rows and order do not change."""
    p = np.repeat(np.arange(len(outcome.tag)), np.diff(outcome.ptr))
    receptions = sorted(
        zip(
            outcome.sender_key[p].tolist(), outcome.seq[p].tolist(), key[outcome.receiver].tolist(),
            outcome.reception.tolist(), strict=True,
        )
    )  # fmt: skip
    names = ("sender_key", "seq", "outcome", "start_ns", "end_ns")
    return receptions, sorted(zip(*(getattr(outcome, x).tolist() for x in names), strict=True))


seeds = st.integers(0, 10_000)
few = settings(max_examples=15)


@few
@given(seeds)
def test_nobody_receives_early_or_twice_or_their_own(seed):
    dbm, key, packets = crowd(30, seed)
    out = hear(net(dbm, True, key), packets, 60 * MS, access=AccessParams())
    assert np.all(out.start_ns >= out.generated_ns)
    assert np.all(out.end_ns >= out.start_ns)
    p = np.repeat(np.arange(len(out.tag)), np.diff(out.ptr))
    assert not np.any(key[out.receiver] == out.sender_key[p])
    pair = p * len(key) + out.receiver
    assert len(np.unique(pair)) == len(pair)
    aired = np.flatnonzero(out.outcome == PhyOutcome.RECEIVED)
    for sender in np.unique(out.sender_key):  # one frame at a time
        own = aired[out.sender_key[aired] == sender]
        order = own[np.argsort(out.start_ns[own])]
        assert np.all(out.start_ns[order][1:] >= out.end_ns[order][:-1])
    heard = out.reception == PhyOutcome.RECEIVED
    for receiver in np.unique(out.receiver):  # nobody hears while sending
        own = aired[out.sender_key[aired] == key[receiver]]
        for q in p[heard & (out.receiver == receiver)]:
            assert not np.any((out.start_ns[own] < out.end_ns[q]) & (out.end_ns[own] > out.start_ns[q]))
    assert np.all((out.busy >= 0) & (out.busy <= 1))


@few
@given(seeds)
def test_rows_and_order_do_not_matter(seed):
    dbm, key, packets = crowd(25, seed)
    first = table(hear(net(dbm, True, key), packets, 60 * MS), key)
    assert table(hear(net(dbm, True, key), packets, 60 * MS), key) == first
    g = np.random.default_rng(seed)
    to = g.permutation(len(key))  # new row -> old row
    row_of = np.argsort(to)
    shuffled = replace(packets, sender=row_of[packets.sender])
    mixed = g.permutation(len(packets))
    shuffled = Packets(**{f.name: getattr(shuffled, f.name)[mixed] for f in fields(Packets)})
    assert table(hear(net(dbm[np.ix_(to, to)], True, key[to]), shuffled, 60 * MS), key[to]) == first


@few
@given(seeds, st.lists(st.integers(1, 59_999), min_size=1, max_size=6))
def test_windows_can_be_cut_anywhere(seed, cuts_us):
    dbm, key, packets = crowd(25, seed)
    links = net(dbm, True, key)
    whole = hear(links, packets, 60 * MS)
    state, parts, busy = ChannelState.start(), [], np.zeros(len(key))
    for until in [*sorted({c * US for c in cuts_us}), 60 * MS]:
        mine = (packets.generated_ns >= state.now_ns) & (packets.generated_ns < until)
        some = Packets(**{f.name: getattr(packets, f.name)[mine] for f in fields(Packets)})
        span = until - state.now_ns
        state, out = run_window(state, links, some, until, EXACT_DCF)
        parts.append(table(out, key))
        busy += out.busy * span
    assert sorted(chain.from_iterable(r for r, _ in parts)) == table(whole, key)[0]
    assert sorted(chain.from_iterable(p for _, p in parts)) == table(whole, key)[1]
    assert busy / (60 * MS) == pytest.approx(whole.busy, abs=1e-12)


@few
@given(seeds)
def test_a_vehicle_out_of_range_changes_nothing(seed):
    here, key_here, said_here = crowd(20, seed)
    there, _, said_there = crowd(12, seed + 1)
    n, m = len(here), len(there)
    both = np.full((n + m, n + m), -np.inf)
    both[:n, :n], both[n:, n:] = here, there
    key = np.concatenate([key_here, 10_000 + np.arange(m, dtype=np.uint64)])
    key[n] = 3_000_000  # keys before, between and after
    packets = Packets(**{
        f.name: np.concatenate([
            getattr(said_here, f.name), getattr(said_there, f.name) + (n if f.name == "sender" else 0)
        ]) for f in fields(Packets)
    })  # fmt: skip
    alone = table(hear(net(here, True, key_here), said_here, 60 * MS), key_here)
    together = table(hear(net(both, True, key), packets, 60 * MS), key)
    local = set(key_here.tolist())
    assert [r for r in together[0] if r[0] in local] == alone[0]
    assert [p for p in together[1] if p[0] in local] == alone[1]


@few
@given(seeds)
def test_every_packet_comes_out_once_whoever_comes_and_goes(seed):
    dbm, key, packets = crowd(25, seed)
    g, state, tags, now = np.random.default_rng(seed), ChannelState.start(), [], 0
    while now < 60 * MS:
        until = now + int(g.integers(100 * US, 4 * MS))
        here = np.flatnonzero(g.random(len(key)) < 0.8)
        row = np.full(len(key), -1)
        row[here] = np.arange(len(here))
        mine = (packets.generated_ns >= now) & (packets.generated_ns < until) & (row[packets.sender] >= 0)
        some = Packets(**{f.name: getattr(packets, f.name)[mine] for f in fields(Packets)})
        some = replace(some, sender=row[some.sender], tag=np.flatnonzero(mine))
        links = net(dbm[np.ix_(here, here)], True, key[here])
        state, out = run_window(state, links, some, until, EXACT_EDCA, np.full(len(here), 2 * MS))
        tags.append((np.flatnonzero(mine), out.tag))
        assert out.sender_key.tolist() == key[packets.sender[out.tag]].tolist()
        assert np.all((out.busy >= 0) & (out.busy <= 1))
        assert np.all(state.phy["energy_mw"] >= 0)
        assert not np.any(state.phy["energy_mw"][state.phy["n_air"] == 0])
        now = until
    state, out = run_window(state, net(dbm, True, key), say([], []), now + 500 * MS, EXACT_EDCA)
    tags.append((np.zeros(0, int), out.tag))
    given_, got = (np.concatenate(x) for x in zip(*tags, strict=True))
    assert sorted(got.tolist()) == sorted(given_.tolist())
    assert not state.phy["busy"].any()


def test_radios_come_and_go():
    three = np.array([[0, -70, -75], [-70, 0, -80], [-75, -80, 0]])
    key = np.array([5, 3, 9], np.uint64)
    # The first leaves while its frame is on the air; the second still hears it, and the third, which has left too, not.
    state, out = run_window(ChannelState.start(), net(three, key=key), say(0, 0), 200 * US, EXACT_DCF)
    assert len(out.tag) == 0
    state, out = run_window(state, net([[0]], key=key[1:2]), say([], []), 2 * MS, EXACT_DCF)
    assert out.sender_key.tolist() == [5]
    assert outcomes(out) == {(0, 0): PhyOutcome.RECEIVED}
    assert len(state.phy) == 2  # its row goes with the next window
    state, out = run_window(state, net(three, key=key), say(2, 3 * MS, seq=[8]), 5 * MS, EXACT_DCF)
    assert outcomes(out) == {(0, 0): PhyOutcome.RECEIVED, (0, 1): PhyOutcome.RECEIVED}
    # What waits at a radio that leaves is lost.
    state, _ = run_window(state, net(three, key=key), say([1, 1], [6 * MS] * 2, seq=[1, 2]), 6 * MS + 99, EXACT_DCF)
    state, out = run_window(state, net(three[:1, :1], key=key[:1]), say([], []), 9 * MS, EXACT_DCF)
    assert [PhyOutcome(f) for f in out.outcome] == [PhyOutcome.EXPIRED] * 2
    assert out.sender_key.tolist() == [3, 3]


def test_an_empty_channel_is_silent():
    nobody = net(np.zeros((0, 0)))
    assert len(hear(nobody, say([], [])).tag) == 0
    out = hear(net(PAIR), say([], []))
    assert not out.busy.any()


def test_faults_are_noticed():
    links = net(PAIR)
    late = say(0, 0, lifetime_ns=400 * US)
    for packets, words in ((late, "lifetime = 0.4 ms of a packet"), (say(0, 0, payload=5000), "payload_bytes = 5000")):
        with pytest.raises(ValueError, match=words):
            hear(links, packets)
    for packets in (say(2, 0), say(0, 0, access=4), say(0, 60 * MS), say([0, 0], [0, 1], seq=[4, 4])):
        with pytest.raises(AssertionError):
            hear(links, packets)
    for wrong in ({"ptr": np.array([0, 1])}, {"fading": links.fading[:1]}, {"receiver": np.array([1, 2])}):
        with pytest.raises(AssertionError):
            replace(links, **wrong)
    with pytest.raises(AssertionError):
        hear(replace(links, key=np.array([4, 4], np.uint64)), say(0, 0))
    with pytest.raises(AssertionError):
        hear(links, say([], []), until_ns=0)
    with pytest.raises(ValueError, match=r"radio\.access\.cw"):
        AccessParams(cw=(3, 7, 15))  # type: ignore[arg-type]
