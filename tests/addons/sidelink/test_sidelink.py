"""Sidelink: closed forms of semi-persistent scheduling, laws of a round, and what the standard forbids."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from cosim.addons.sidelink import records
from cosim.addons.sidelink.memory import SidelinkState, log_of, memory_of, room_of
from cosim.addons.sidelink.slots import run_slots
from cosim.base import rng
from cosim.radio.channel import Links
from cosim.radio.dtypes import HALF_DUPLEX, NEVER, NONE, RECEIVED
from cosim.radio.medium import MEDIA
from cosim.radio.message_round import ChannelAbuse, Messages, Outcome, RoundKind, Stations
from cosim.radio.params import RadioParams, RelayParams
from cosim.radio.propagation import PropagationParams, fading_class, fading_quantiles
from cosim.radio.sidelink_params import LteParams, NrParams, SidelinkParams
from cosim.radio.sidelink_phy import lte_block_sizes, lte_carrier, lte_curve, nr_block_bits, nr_carrier
from tests.refusals import refused_in_one_line

SIDELINKS = ("nr_mode2", "lte_mode4")
HIGHWAY = PropagationParams(model="highway")


def alone(n, n_messages, **given):
    """Stations that all generate in slot 0 and then every 100 slots, each with the same mean power at all others.

    Returns the resource of each message [station, message], the units and their log.
    """
    run, unit, log, _, n_subchannels = parts_of(n, n_messages, **given)
    run(0, 100 * n_messages + 101)
    resource = (unit["slot"][:, 0] % 100 * n_subchannels + unit["sub"][:, 0]).reshape(n, n_messages)
    return resource, unit, log


def parts_of(n, n_messages, *, seed, power_mw=0.0, window=100, n_subchannels=5, counters=None, lead=0, **given):
    """What `alone` runs: a function that carries out slots, and what it writes."""
    params = RadioParams(model="nr_mode2", sidelink=SidelinkParams(reservation_s=0.1, limits_occupancy=False, **given))
    medium = MEDIA["nr_mode2"](params, 0.4, seed, None)
    rules = medium.rules._replace(last=window, n_subchannels=n_subchannels, lead=lead)
    key = rng.keys(np.uint64(seed), np.arange(n))
    receiver = np.array([[j for j in range(n) if j != i] for i in range(n)], np.int64).ravel()
    power = np.full(len(receiver), power_mw)
    links = Links(key, (n - 1) * np.arange(n + 1), receiver, power, np.zeros(len(receiver), np.uint8))
    stations = Stations(key, np.zeros((n, 3)), n)
    unit = np.zeros(n * n_messages, records.UNIT)
    unit["station"] = unit["process"] = np.repeat(np.arange(n), n_messages)
    unit["generated"] = np.tile(100 * np.arange(n_messages), n)
    unit["key"] = rng.keys(np.uint64(3), key[unit["station"]], unit["generated"])
    unit["width"] = unit["n_sent"] = 1
    unit["slot"], n_slots = NEVER, 100 * n_messages + 101
    unit["deadline"], unit["clear_sinr"], unit["spread_db"] = n_slots - 1, 1e-9, 1.0
    process, station = np.zeros(n, records.PROCESS), np.zeros(n, records.STATION)
    process["key"], process["station"], station["key"] = key, key, key
    process["next_slot"], process["generated"] = NEVER, NONE
    if counters is not None:  # all hold the same resource
        process["next_slot"], process["counter"], process["period"] = 50, counters, 100
        process["width"] = process["n_sent"] = 1
    memory = memory_of(process, station, np.full(n, NONE), SidelinkState(), unit, links, rules, 0)
    log, air = log_of(unit, links, n_slots), medium.air(links, stations)
    arrival = np.lexsort((unit["key"], unit["generated"]))

    def run(first, end):
        due = (unit["generated"][arrival] >= first) & (unit["generated"][arrival] < end)
        run_slots(0, first, end, arrival[due], air, memory, log, room_of(rules), rules)

    return run, unit, log, memory, n_subchannels


def within_three_errors(sample, expected):
    error = np.std(sample, ddof=1) / np.sqrt(len(sample))
    assert abs(np.mean(sample) - expected) <= 3 * error, (np.mean(sample), expected, error)


def runs(resource):
    """Lengths of the runs of one resource, without the last one of each station, which the end cuts."""
    out = []
    for row in resource:
        change = np.flatnonzero(np.diff(row)) + 1
        out += list(np.diff(np.r_[0, change]))
    return np.array(out)


def run_length_p(keep_p, longest):
    """Probability of each number of transmissions on one resource: a geometric number of counters from 5 to 15."""
    counter = np.zeros(longest + 1)
    counter[5:16] = 1 / 11
    block, total = counter.copy(), np.zeros(longest + 1)
    share = 1 - keep_p
    for _ in range(200):
        total += share * block
        block, share = np.convolve(block, counter)[: longest + 1], share * keep_p
    return total


@pytest.mark.verify
def test_collision_probability_of_random_choices():
    """N stations that have sensed nothing choose among M resources: one is alone with (1 - 1/M)^(N - 1)."""
    n, m = 40, 100 * 2
    single = []
    for seed in range(60):
        resource, _, _ = alone(n, 1, seed=seed, n_subchannels=2)
        _, where, count = np.unique(resource[:, 0], return_inverse=True, return_counts=True)
        single.append(np.mean(count[where] == 1))
    within_three_errors(single, (1 - 1 / m) ** (n - 1))


def test_half_duplex_loss():
    """Two stations choose the same of W slots with 1/W, and then do not hear each other."""
    n, lost = 12, []
    for seed in range(60):
        _, _, log = alone(n, 1, seed=seed, power_mw=1e-6, window=25)
        blocks = log.reception.reshape(n, records.MAX_SENT, n - 1)[:, 0]
        lost.append(np.mean(blocks == HALF_DUPLEX))
    within_three_errors(lost, 1 / 25)


@pytest.mark.parametrize("keep_p", [0.0, 0.4, 0.8])
def test_run_length_from_the_keep_probability(keep_p):
    resource, _, _ = alone(60, 1200, seed=5, keep_p=keep_p)
    length = runs(resource[:, :])
    p = run_length_p(keep_p, 600)
    within_three_errors(length, np.arange(601) @ p)
    for bound in (8, 15, 25):
        within_three_errors(length <= bound, p[: bound + 1].sum())


def test_bursts_of_collisions():
    """Stations on one resource do not hear each other. Their collisions last until one of them selects again."""
    keep_p, longest = 0.4, []
    g = np.random.default_rng(1)
    for seed in range(300):
        resource, _, _ = alone(2, 60, seed=seed, power_mw=1e-6, keep_p=keep_p, counters=g.integers(5, 16, 2))
        same = resource[0] == resource[1]
        longest.append(int(np.argmin(same)) if not same.all() else len(same))
    beyond = 1 - np.cumsum(run_length_p(keep_p, 600))
    for bound in (5, 8, 12):
        within_three_errors(np.array(longest) > bound, beyond[bound] ** 2)


@pytest.mark.parametrize("lead", [0, 3])
def test_re_evaluation_leaves_a_resource_that_another_station_announced(lead):
    """A station chooses a slot at generation. Before it sends, it hears that another one has reserved this slot."""
    moved = 0
    for seed in range(20):
        run, unit, _, memory, _ = parts_of(2, 1, seed=seed, lead=lead)
        run(0, 1)
        chosen, sub = unit["slot"][0, 0], unit["sub"][0, 0]
        memory.reservation[1] = (chosen, chosen, 0, sub, 1)  # row 0 is for the first announcement of the round
        memory.entry[0] = (1, 1.0)
        memory.n_entries[0] = 1
        run(1, 201)
        moved += unit["slot"][0, 0] != chosen or unit["sub"][0, 0] != sub
        if chosen <= 3:  # too late for a check
            assert unit["slot"][0, 0] == chosen
        assert unit["slot"][0, 0] <= 100
    assert moved == 0 if lead == 0 else moved >= 17


def test_re_evaluation_may_choose_another_subchannel_of_the_same_slot():
    """All free resources are alike: 4 of the 5 w - 1 in the w slots that are left lie in the slot of the first choice.

    The check comes 3 slots before it, and the window ends 8 slots after generation, so w = 8 - (slot - 3)."""
    same, expected = [], []
    for seed in range(300):
        run, unit, _, memory, _ = parts_of(2, 1, seed=seed, lead=3, window=8)
        run(0, 1)
        chosen, sub = unit["slot"][0, 0], unit["sub"][0, 0]
        if chosen > 3:
            memory.reservation[1] = (chosen, chosen, 0, sub, 1)
            memory.entry[0] = (1, 1.0)
            memory.n_entries[0] = 1
            run(1, 60)
            same.append(unit["slot"][0, 0] == chosen)
            expected.append(4 / (5 * (8 - (chosen - 3)) - 1))
    within_three_errors(np.array(same) - np.array(expected), 0.0)


@pytest.mark.parametrize("model", SIDELINKS)
def test_a_message_delayed_beyond_its_round_is_never_sent(model):
    """By attack `delay`. It is lost at every station in range, also in the round that begins at 0."""
    medium = medium_of(model)
    xyz = np.column_stack([20.0 * np.arange(5), np.zeros(5), np.full(5, 1.6)])
    stations, state = Stations(rng.keys(np.uint64(1), np.arange(5)), xyz, 5), medium.start()
    messages = Messages(np.array([0, 1]), np.array([300, 300]), delay_s=np.array([0.0, 0.07]))
    for k in range(3):
        state, happened = medium.broadcast(state, RoundKind.CPM, k, 0.1 * k, stations, messages)
        frames, is_late = happened.frames, happened.frames.message == 1
        assert (frames.outcome[is_late] == Outcome.EXPIRED).all() and is_late.sum() == 4
        assert frames.n_transmissions.tolist() == [1, 0] and (happened.receptions.message == 0).all()


def test_stations_that_hear_each_other_do_not_collide():
    """With more resources than stations, each selection after the first avoids all that is reserved."""
    resource, _, log = alone(30, 60, seed=2, power_mw=1e-5, keep_p=0.0, n_subchannels=1)
    late = resource[:, 45:]
    assert all(len(set(column)) >= 28 for column in late.T)
    assert (log.reception.reshape(30, 60, records.MAX_SENT, 29)[:, 45:, 0] == RECEIVED).mean() > 0.97


def stations_of(n, seed=1, length_m=1500.0):
    g = np.random.default_rng(seed)
    xyz_m = np.column_stack([g.uniform(0, length_m, n), 4.0 * g.integers(0, 4, n), np.full(n, 1.6)])
    return Stations(rng.keys(np.uint64(seed), np.arange(n)), xyz_m, n)


def two(apart_m):
    """Two stations at 1.6 m."""
    return Stations(rng.keys(np.uint64(1), np.arange(2)), np.array([[0.0, 0, 1.6], [apart_m, 0, 1.6]]), 2)


def one_message(medium, stations, length_bytes):
    """What happens in the first round, in which the first station sends."""
    messages = Messages(np.array([0]), np.array([length_bytes]))
    return medium.broadcast(medium.start(), RoundKind.CPM, 0, 0.0, stations, messages)[1]


def medium_of(model, round_s=0.04, **given):
    return MEDIA[model](RadioParams(model=model, propagation=HIGHWAY, **given), round_s, 7, None)


def steps(medium, stations, n_steps, state=None, first=0, length=350):
    state, out = medium.start() if state is None else state, []
    messages = Messages.one_each(np.full(len(stations), length))
    for k in range(first, first + n_steps):
        for kind in RoundKind:
            state, happened = medium.broadcast(state, kind, k, 0.1 * k + 0.04 * kind, stations, messages)
            out.append(happened)
    return state, out


def rows(happened, stations):
    found, frames = happened.receptions, happened.frames
    key = stations.key
    received = sorted(zip(
        key[found.receiver].tolist(), key[happened.station[found.message]].tolist(), found.latency_s.tolist(),
        strict=True,
    ))  # fmt: skip
    outcomes = sorted(zip(
        key[frames.receiver].tolist(), key[happened.station[frames.message]].tolist(), frames.outcome.tolist(),
        strict=True,
    ))  # fmt: skip
    return received, outcomes, dict(zip(key.tolist(), frames.cbr.tolist(), strict=True))


@pytest.mark.parametrize("model", SIDELINKS)
def test_order_of_rows_has_no_effect(model):
    stations = stations_of(60)
    order = np.random.default_rng(3).permutation(60)
    turned = Stations(stations.key[order], stations.xyz_m[order], 60)
    given = {"sidelink": SidelinkParams(n_transmissions=2)}
    _, one = steps(medium_of(model, **given), stations, 20)
    _, other = steps(medium_of(model, **given), turned, 20)
    for a, b in zip(one, other, strict=True):
        assert rows(a, stations) == rows(b, turned)


@pytest.mark.parametrize("model", SIDELINKS)
def test_a_resumed_state_goes_on_bit_for_bit(model):
    stations = stations_of(50)
    medium = medium_of(model)
    _, whole = steps(medium, stations, 16)
    state, _ = steps(medium, stations, 8)
    state = pickle.loads(pickle.dumps(replace(state, cache=None)))
    _, rest = steps(medium, stations, 8, state, first=8)
    for a, b in zip(whole[16:], rest, strict=True):
        assert rows(a, stations) == rows(b, stations)


def test_a_round_does_not_change_the_state_it_was_given():
    stations, medium = stations_of(40), medium_of("nr_mode2")
    state, _ = steps(medium, stations, 5)
    before = pickle.dumps(state)
    steps(medium, stations, 3, state, first=5)
    assert pickle.dumps(state) == before


@pytest.mark.parametrize("model", SIDELINKS)
def test_far_stations_and_changes_of_the_traffic(model):
    """Stations out of range change nothing; stations may come and go."""
    stations = stations_of(40)
    far = Stations(
        np.r_[stations.key, rng.keys(np.uint64(99), np.arange(30))],
        np.vstack([stations.xyz_m, stations_of(30, 2).xyz_m + [50_000.0, 0, 0]]), 70,
    )  # fmt: skip
    medium = medium_of(model)
    _, near_only = steps(medium, stations, 12)
    state, with_far = steps(medium, far, 12)
    near_keys = set(stations.key.tolist())
    for a, b in zip(near_only, with_far, strict=True):
        received = [row for row in rows(b, far)[0] if row[1] in near_keys]
        assert rows(a, stations)[0] == received
    fewer = Stations(far.key[5:50], far.xyz_m[5:50], 45)
    steps(medium, fewer, 3, state, first=12)


@pytest.mark.parametrize("model", SIDELINKS)
def test_times_and_halves_of_a_round(model):
    stations = stations_of(60)
    _, out = steps(medium_of(model, sidelink=SidelinkParams(n_transmissions=2)), stations, 10)
    for happened in out:
        found, frames = happened.receptions, happened.frames
        assert (found.access_delay_s > 0).all() and (found.received_s <= 0.04 + 1e-9).all()
        assert (found.generation_offset_s <= 0.02).all()
        pair = found.receiver * 1000 + found.message
        assert len(np.unique(pair)) == len(pair) and (found.receiver != happened.station[found.message]).all()
        got = frames.outcome == Outcome.RECEIVED
        assert sorted((frames.receiver[got] * 1000 + frames.message[got]).tolist()) == sorted(pair.tolist())
        assert frames.n_duplicate == 0  # both transmissions are one reception
        assert (frames.cbr >= 0).all() and (frames.cbr <= 1).all() and (frames.n_transmissions <= 2).all()


@pytest.mark.verify
def test_losses_come_in_bursts_at_the_same_delivery():
    """Links with a delivery ratio of 0.7 to 0.8: with `csma` losses are independent, with the sidelink they are not."""
    after, far = {}, {}
    for model in ("csma", *SIDELINKS):
        found = []
        for seed in (1, 2, 3):
            stations, medium = stations_of(150, seed, 1000.0), medium_of(model)
            state, got = medium.start(), np.full((200, 150, 150), -1, np.int8)
            for k in range(200):
                state, happened = medium.broadcast(
                    state, RoundKind.CPM, k, 0.1 * k, stations, Messages.one_each(np.full(150, 350))
                )
                frames = happened.frames
                got[k, happened.station[frames.message], frames.receiver] = frames.outcome == Outcome.RECEIVED
            found.append(got[50:, (got[50:] >= 0).all(0)].astype(bool))
        links = np.concatenate(found, axis=1)
        links = links[:, (links.mean(0) >= 0.7) & (links.mean(0) < 0.8)]
        lost = ~links
        after[model] = (lost[1:] & lost[:-1]).sum() / lost[:-1].sum() / lost.mean()
        far[model] = np.mean(np.concatenate([np.diff(np.flatnonzero(link)) for link in links.T]) > 5)
    print(after, far)
    assert after["csma"] == pytest.approx(1.0, abs=0.1)
    assert all(after[model] > 1.5 and far[model] > 3 * far["csma"] for model in SIDELINKS)


def test_repetitions_help_on_an_empty_channel():
    """A station at the edge of the range is heard more often if each message is sent twice."""
    stations = two(900.0)
    share = []
    for n_transmissions in (1, 2, 3):
        medium = medium_of(
            "nr_mode2", sidelink=SidelinkParams(n_transmissions=n_transmissions), range_m=1000.0, nr=NrParams(mcs=14)
        )  # fmt: skip
        _, out = steps(medium, stations, 100)
        share.append(np.mean([len(h.receptions.receiver) / 2 for h in out]))
    assert share[0] < share[1] < share[2]


@pytest.mark.parametrize("control_sinr_db", [0.0, 3.0])
def test_a_copy_counts_if_its_control_part_is_decoded(control_sinr_db):
    """One sender, receivers around it with a mean SNR of 1 dB and Rayleigh fading: the share by drawing two SNRs."""
    propagation = PropagationParams(
        model="free_space", fading="rayleigh", shadowing=False, blockage="none", interference_range_m=20_000,
        cutoff_dbm=-140,
    )  # fmt: skip
    sidelink = SidelinkParams(n_transmissions=2, control_sinr_db=control_sinr_db)
    params = RadioParams(model="nr_mode2", range_m=20_000, propagation=propagation, sidelink=sidelink)
    medium = MEDIA["nr_mode2"](params, 0.2, 7, None)
    rules, carrier = medium.rules, medium.carrier
    snr = 10**0.1
    distance_m = 10 ** ((23 - 10 * np.log10(snr * rules.noise_mw * rules.rbs) - 47.86) / 20)  # 47.86 dB at 1 m
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    around = distance_m * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    xyz = np.vstack([np.zeros((1, 3)), around]) + [0, 0, 1.6]
    stations = Stations(rng.keys(np.uint64(1), np.arange(401)), xyz, 401)
    state, n_received = medium.start(), 0
    for k in range(40):
        message = Messages(np.array([0]), np.array([80]))
        state, happened = medium.broadcast(state, RoundKind.CPM, k, k * 0.4, stations, message)
        n_received += len(happened.receptions.receiver)
    quantiles = fading_quantiles()[fading_class(np.array([distance_m]), "rayleigh")[0]]
    sinr = snr * np.random.default_rng(1).choice(quantiles, (500_000, 2))
    is_decoded = sinr >= 10 ** (control_sinr_db / 10)

    def payload_p(of):
        return ndtr((10 * np.log10(np.maximum(of, 1e-12)) - carrier.sinr_db[0]) / carrier.spread_db[0])

    first, second = is_decoded.T
    after_first = 1 - first * payload_p(sinr[:, 0])
    both = (sinr * is_decoded).sum(axis=1)
    lost_p = after_first * (1 - second * payload_p(both))
    assert n_received / 16_000 == pytest.approx(1 - lost_p.mean(), abs=0.016)  # four standard errors


def test_busy_ratio_of_one_message():
    """One message of two subchannels in a round of 40 slots with five subchannels: 2 / 200, for the sender too.

    At 900 m the loss is 106.9 dB. A subchannel has -87 dBm, and its neighbours about 18 dB less: below -94 dBm.
    """
    stations = two(900.0)
    plain = replace(HIGHWAY, shadowing=False, blockage="none", fading="none")
    medium = MEDIA["nr_mode2"](RadioParams(model="nr_mode2", propagation=plain, range_m=1000.0), 0.04, 7, None)
    assert medium.carrier.width(np.array([200]))[0] == 2 and medium.carrier.n_subchannels == 5
    happened = one_message(medium, stations, 200)
    assert happened.frames.cbr.tolist() == [2 / 200, 2 / 200]
    assert happened.receptions.receiver.tolist() == [1]


def test_occupancy_is_limited_on_a_busy_channel():
    """Stations drop messages above the limits of TS 103 574, unless they ignore congestion control."""
    stations = stations_of(400, length_m=300.0)
    limited = medium_of("nr_mode2", nr=NrParams(mcs=5))
    free = medium_of("nr_mode2", nr=NrParams(mcs=5), sidelink=SidelinkParams(limits_occupancy=False))
    expired = [np.mean([np.mean(h.frames.outcome == Outcome.EXPIRED) for h in steps(m, stations, 12)[1][-6:]])
               for m in (limited, free)]  # fmt: skip
    assert expired[0] > 0.05 and expired[1] == 0
    none = np.full(400, -np.inf)
    abuse = ChannelAbuse(none, none, np.ones(400, bool))
    ignoring = replace(stations, abuse=abuse)
    assert all((h.frames.outcome != Outcome.EXPIRED).all() for h in steps(limited, ignoring, 12)[1])


def test_a_jammer_silences_its_neighbours():
    stations = stations_of(20, length_m=200.0)
    jam = np.full(20, -np.inf)
    jam[0] = 33.0
    jammed = replace(stations, abuse=ChannelAbuse(jam, np.full(20, -np.inf), np.zeros(20, bool)))
    medium = medium_of("nr_mode2")
    clean = sum(len(h.receptions.receiver) for h in steps(medium, stations, 5)[1])
    noisy = sum(len(h.receptions.receiver) for h in steps(medium, jammed, 5)[1])
    assert noisy < 0.2 * clean


def test_long_messages_are_segmented():
    """688 bytes fit the whole pool of NR at MCS 7; 1,500 bytes need three segments of at most that."""
    medium = medium_of("nr_mode2")
    assert medium.carrier.largest_bytes == 688
    stations = two(20.0)
    happened = one_message(medium, stations, 1500)
    assert happened.frames.n_transmissions.tolist() == [3] and happened.receptions.receiver.tolist() == [1]


def test_transport_blocks():
    """TS 38.214: one subchannel of 10 resource blocks, MCS 7 (QPSK, 526/1024), 24 reference signals, PSCCH of 3 x 10.

    120 x 10 elements, less 360 of the first control part and ceil(72 x 1.125 / (2 x 526/1024)) = 79 of the second:
    761; times 2 x 526/1024 = 781.8; rounded down to a multiple of 8 = 776; the next size is 808.
    """
    assert nr_block_bits(10, 7, dmrs=24, control_symbols=3, control_rbs=10) == 808
    # MCS 17 (64QAM, 438/1024): the second control part stays QPSK, ceil(81 / (2 x 438/1024)) = 95 elements; 745 times
    # 6 x 438/1024 = 1911.9, rounded down to a multiple of 16 = 1904; the next size is 1928.
    assert nr_block_bits(10, 17, dmrs=24, control_symbols=3, control_rbs=10) == 1928
    # MCS 12 (16QAM, 434/1024) on 30: 3168 - 96 elements, 5208 bits; 5184 is 40.5 times 128, and ties are rounded up:
    # 5248 + 24 is a multiple of 8.
    assert nr_block_bits(30, 12, dmrs=24, control_symbols=3, control_rbs=12) == 5248
    assert nr_carrier(10, 15, 10, 7, 24, 3, 10).n_subchannels == 5  # 52 resource blocks
    lte = lte_carrier(10, 10, 7)
    assert lte.block_bits[0] == 968  # I_TBS 7 on 10 - 2 = 8 resource blocks: table 7.1.7.2.1-1 of TS 36.213
    assert lte.block_bits[1] == 2216  # on 18
    assert lte_block_sizes()[6, :4].tolist() == [328, 176, 256, 392]  # as in the table


def test_block_errors_of_lte():
    """Tables of ns-3 for 2,560 bits: QPSK of rate 0.44 needs 0.5205 bits per bit, where QPSK carries 0.5205 at 0.45 dB.

    MCS 7 on 8 resource blocks: (968 + 24) / (8 x 9 x 12 x 2) = 0.574, between 1.35 dB (0.51) and 2.50 dB (0.60).
    """
    x, weight = np.polynomial.hermite_e.hermegauss(60)  # a normal variable
    for _, at_db, needs in ((0.37, -0.55, 0.4458), (0.44, 0.45, 0.5205), (0.51, 1.35, 0.5902)):
        s = np.sqrt(10 ** (at_db / 10))  # each bit is a sign of amplitude s in noise of variance 1 [per dimension]
        bits = 1 - weight @ np.log2(1 + np.exp(-2 * s * (s + x))) / weight.sum()
        assert bits == pytest.approx(needs, abs=1e-3)
    assert lte_carrier(10, 10, 7).sinr_db[0] == pytest.approx(1.35 + (0.574 - 0.51) / 0.09 * 1.15, abs=0.01)
    assert all((np.diff(lte_curve(bits)[:, 1]) > 0).all() for bits in (2, 4))


def test_in_band_emission():
    """TS 38.101-1: on the neighbouring resource block, QPSK leaks 20 log 0.175 - 3 = -18.1 dB of its power there."""
    carrier = nr_carrier(10, 15, 10, 7, 24, 3, 10)
    leak = carrier.leak()
    assert leak[2, 1, 1] == leak[2, 1, 2] == 1 / 20
    near_db = 10 * np.log10(leak[1, 0, 1] * 10)
    assert -21.0 < near_db < -18.1  # falls by 5 dB over ten resource blocks, mean -20.1
    assert leak[1, 0, 3] < leak[1, 0, 2] < leak[1, 0, 1]


def refused(match, **given):
    with refused_in_one_line(match):
        RadioParams(**given)


def test_what_the_standard_forbids_is_refused_in_one_line():
    nr, lte = {"model": "nr_mode2"}, {"model": "lte_mode4"}
    refused("radio.nr.mcs = 0 leaves", **nr, nr=NrParams(mcs=0))
    refused("radio.lte.mcs = 0 leaves", **lte, lte=LteParams(mcs=0))
    refused("radio.relay.max_hops = 2 needs", **nr, relay=RelayParams(max_hops=2))
    refused("radio.sidelink.window_s = 0.0005 s must", **nr, sidelink=SidelinkParams(window_s=0.0005))
    refused("radio.sidelink.window_s = 0.01 s must be", **lte, sidelink=SidelinkParams(window_s=0.01))
    refused('radio.model = "lte_mode4" allows', **lte, sidelink=SidelinkParams(n_transmissions=3))
    refused("radio.sidelink.reservation_s = 0.15 s is no", **nr, sidelink=SidelinkParams(reservation_s=0.15))
    refused("radio.sidelink.reservation_s = 0.03 s is no", **lte, sidelink=SidelinkParams(reservation_s=0.03))
    refused("radio.nr.subchannel_rbs = 75 is more", **nr, nr=NrParams(subchannel_rbs=75))
    for make in (
        lambda: SidelinkParams(keep_p=0.5),
        lambda: SidelinkParams(share=0.3),
        lambda: SidelinkParams(counter=(9, 5)),
        lambda: SidelinkParams(rsrp_threshold_dbm=-111),
        lambda: NrParams(bandwidth_mhz=5),
        lambda: NrParams(subchannel_rbs=11),
        lambda: NrParams(control_rbs=20),
        lambda: LteParams(bandwidth_mhz=15),
    ):
        with refused_in_one_line(r"^radio\.(sidelink|nr|lte)\."):
            make()
    with pytest.raises(ValueError, match="a round of"):
        medium_of("nr_mode2", round_s=0.006)
    RadioParams(nr=NrParams(mcs=0))  # without effect under csma
