"""The slots of a sidelink round: sensing, choice of resources, transmissions and receptions.

A resource is a slot and some consecutive subchannels. A process sends one kind of message of one station. It reserves
the same subchannels again after its period, and announces this in the control part of its transmission. Each receiver
that decodes the announcement remembers it.

Transmissions of a slot are summed in the order of their processes' keys, so that the order of rows has no effect.

References
----------
.. [1] 3GPP TS 38.214 V16.10, clause 8.1.4: resources of mode 2.
.. [2] 3GPP TS 36.213 V14.16, clause 14.1.1.6: resources of mode 4.
.. [3] 3GPP TS 38.321 V16.12, clause 5.22.1.1; TS 36.321 V14.13, clause 5.14.1.1: counter, probability of keeping.
.. [4] ETSI TS 103 574 V1.1.1, clause 5: channel busy ratio, channel occupancy ratio and its limits.
"""

from math import erfc
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from cosim.radio.dtypes import COLLISION, EXPIRED, FADING, HALF_DUPLEX, NEVER, NONE, RECEIVED
from sensors.hash_rng import mix, unit
from sensors.kernel import kernel

MAX_SENT = 3
"""Largest number of transmissions of a message."""
N_HISTORY = 24
"""Latest transmissions of a process that are remembered."""
N_USED = 10
"""Periods of the channel busy ratio over which a station's occupancy is counted."""
_TO_QUANTILE = np.uint64(52)
_SELECT, _KEEP, _PAYLOAD, _RANK, _COUNTER = (np.uint64(k) for k in range(0x51DE, 0x51DE + 5))
RAISE = 10**0.3
"""Factor of one step of the threshold, 3 dB [1]_ [2]_."""

PROCESS = np.dtype([
    ("key", "u8"), ("station", "u8"),
    ("next_slot", "i8"),  # of the first transmission that is reserved; NEVER without a reservation
    ("generated", "i8"),  # slot of the latest message; NONE before the first one
    ("gap", "i4", MAX_SENT), ("sub", "i2", MAX_SENT),  # slots after the first transmission, and first subchannels
    ("width", "i2"), ("n_sent", "i2"), ("period", "i4"), ("counter", "i4"), ("n_missed", "i4"), ("n_draws", "u4"),
    ("slots", "i8", N_HISTORY), ("subs", "i2", N_HISTORY), ("widths", "i2", N_HISTORY), ("n_past", "u4"),
])  # fmt: skip
"""A process: its reservation, and its latest transmissions."""

STATION = np.dtype([
    ("key", "u8"), ("busy", "i8"), ("cbr", "f8"), ("used", "i4", N_USED), ("used_now", "i4"), ("ignores", "u1"),
])  # fmt: skip
"""A station: busy subchannels of the present period, busy ratio of the period before, subchannels it has used."""

ENTRY = np.dtype([
    ("slot", "i8"), ("last", "i8"), ("period", "i4"), ("sub", "i2"), ("width", "i2"), ("rsrp_mw", "f4"),
    ("station", "i4"), ("next", "i4"),
])  # fmt: skip
"""A reservation that a station has decoded: the reserved slot, and its repetitions up to `last`."""

UNIT = np.dtype([
    ("key", "u8"), ("generated", "i8"), ("deadline", "i8"), ("process", "i4"), ("station", "i4"), ("width", "i2"),
    ("n_sent", "i2"), ("outcome", "u1"), ("announces", "u1"), ("threshold_mw", "f8"), ("sinr_db", "f8"),
    ("spread_db", "f8"), ("clear_sinr", "f8"), ("dead_sinr", "f8"), ("slot", "i8", MAX_SENT), ("sub", "i2", MAX_SENT),
    ("rows", "i8"),
])  # fmt: skip
"""A transport block of the round: what is sent, by which process, and where."""


class Rules(NamedTuple):
    """Parameters of the slots, in linear units; times are in slots."""

    rng_key: np.uint64
    n_subchannels: int
    rbs: int  # of a subchannel
    noise_mw: float  # of a resource block
    control_sinr: float  # least SINR at which the control part is decoded
    rsrp_mw: float  # threshold of a resource element, before it is raised
    share: float  # of the candidates that must remain
    first: int  # of the selection window, after generation
    last: int
    lead: int  # of the re-evaluation before the first transmission; 0: none
    max_gap: int  # between transmissions of one message
    aligned: bool  # whether candidates begin at multiples of their width only
    ranked: bool  # whether the candidates of least received power are chosen [2]_
    power_step: int  # period of the slots whose power is averaged
    power_slots: int
    forced_period: int  # 0: the interval of the messages
    keep_p: float
    counter_low: int
    counter_high: int
    short_period: int  # below this period counters are multiplied
    long_slots: int  # by this over the period, rounded up
    reselect_after: int  # unused reservations
    busy_mw: float  # of a subchannel
    busy_slots: int
    limited: bool  # whether occupancy is limited
    with_repeats: bool  # whether one announcement names all transmissions of a message


class Air(NamedTuple):
    """Stations and links of a round, and room for the sums of a slot."""

    ptr: ndarray
    receiver: ndarray
    mean_mw: ndarray
    fading: ndarray
    key: ndarray
    quantiles: ndarray
    leak: ndarray  # power per resource block on each subchannel, by width and first subchannel of the transmission
    allowed: ndarray  # whether each period [slots] may be reserved
    jam_mw: ndarray  # per resource block
    react_mw: ndarray
    is_jammed: ndarray
    density_mw: ndarray  # per station and subchannel: power of a resource block in this slot
    arrival_mw: ndarray  # per link, in this slot
    stamp: ndarray  # slot of the station's sums
    sends: ndarray  # slot in which the station sends
    touched: ndarray
    busy_round: ndarray


class Memory(NamedTuple):
    """What lasts from slot to slot: processes, stations, and what they have decoded."""

    process: ndarray
    own: ndarray  # first process of each station
    next_own: ndarray  # next process of the same station
    station: ndarray
    head: ndarray  # first entry of each station
    entry: ndarray
    at: ndarray  # number of entries


class Log(NamedTuple):
    """Units of the round and the outcome at each receiver."""

    unit: ndarray
    reception: ndarray  # per transmission and link of the unit, from unit.rows on
    sinr: ndarray  # sum over the transmissions so far, per link of the unit
    head_sent: ndarray  # transmissions of each slot
    next_sent: ndarray
    head_check: ndarray
    next_check: ndarray


class Room(NamedTuple):
    """Room for one choice: candidates by slot and position."""

    block_mw: ndarray
    power_mw: ndarray
    order: ndarray
    rank: ndarray


@kernel
def _succeeds(sinr, me, h):
    """Whether a block with this SINR is decoded: a normal distribution in dB, whose far tails need no draw."""
    if sinr >= me.clear_sinr:
        return True
    if sinr <= me.dead_sinr:
        return False
    x = (10.0 * np.log10(sinr) - me.sinr_db) / me.spread_db
    return unit(h) < 0.5 * erfc(-x * 0.7071067811865476)


@kernel
def _draw(process, rules, purpose):
    h = mix(mix(mix(rules.rng_key, purpose), process.key), np.uint64(process.n_draws))
    process.n_draws += 1
    return unit(h)


@kernel
def _draw_counter(process, rules):
    times = 1
    if process.period < rules.short_period:
        times = -((-rules.long_slots) // max(process.period, rules.long_slots // 5))
    low, high = rules.counter_low * times, rules.counter_high * times
    return low + np.int32(_draw(process, rules, _COUNTER) * (high - low + 1))


@kernel
def _mark(block_mw, slot, sub, width, value_mw, first, n_slots, n_places, stride, own_width):
    """Raise the candidates that overlap these subchannels of a slot of the window to a power."""
    y = slot - first
    if y < 0 or y >= n_slots:
        return
    for x in range(n_places):
        begin = x * stride
        if begin < sub + width and sub < begin + own_width:
            k = y * n_places + x
            block_mw[k] = max(block_mw[k], value_mw)


@kernel
def _mark_periodic(block_mw, slot, sub, width, value_mw, period, first, n_slots, n_places, stride, own_width):
    """The same for a slot that is reserved, and for each slot from which the own period leads to it."""
    if period > 0 and slot >= first + n_slots:
        slot -= -((first + n_slots - 1 - slot) // period) * period
    while slot >= first:
        _mark(block_mw, slot, sub, width, value_mw, first, n_slots, n_places, stride, own_width)
        if period <= 0:
            return
        slot -= period


@kernel
def _n_known(process):
    """Number of transmissions of a process that are remembered."""
    n = np.int64(process.n_past)
    return n if n < N_HISTORY else N_HISTORY


@kernel
def _own_slots(block_mw, memory, i, period, rules, first, n_slots, n_places, stride, width):
    """Exclude the slots that others may have reserved while the station sent and could not hear them."""
    q = memory.own[i]
    while q != NONE:
        other = memory.process[q]
        for k in range(_n_known(other)):
            if period > 0:
                slot = other.slots[k] + period
                while first <= slot < first + n_slots:
                    _mark(block_mw, slot, 0, rules.n_subchannels, np.inf, first, n_slots, n_places, stride, width)
                    slot += period
        q = memory.next_own[q]


@kernel
def _pending(block_mw, u, log, memory, period, first, n_slots, n_places, stride, width, n_subchannels):
    """Exclude the slots in which the station sends other messages of this round, or has reserved resources."""
    q = memory.own[log.unit[u].station]
    while q != NONE:
        other = memory.process[q]
        if other.next_slot != NEVER:
            for a in range(other.n_sent):
                slot = other.next_slot + other.gap[a]
                _mark_periodic(
                    block_mw, slot, 0, n_subchannels, np.inf, period, first, n_slots, n_places, stride, width
                )
        q = memory.next_own[q]
    for step in (-1, 1):
        v = u + step
        while 0 <= v < len(log.unit) and log.unit[v].station == log.unit[u].station:
            other = log.unit[v]
            for a in range(other.n_sent):
                if other.slot[a] != NEVER:
                    _mark(block_mw, other.slot[a], 0, n_subchannels, np.inf, first, n_slots, n_places, stride, width)
            v += step


@kernel
def _announced(block_mw, memory, i, period, above_mw, first, n_slots, n_places, stride, width):
    """Mark the candidates that other stations have reserved with the power of their announcements."""
    e = memory.head[i]
    while e != NONE:
        entry = memory.entry[e]
        if entry.rsrp_mw > above_mw:
            slot = entry.slot
            while slot <= entry.last:
                if slot >= first:
                    _mark_periodic(
                        block_mw,
                        slot,
                        entry.sub,
                        entry.width,
                        np.float64(entry.rsrp_mw),
                        period,
                        first,
                        n_slots,
                        n_places,
                        stride,
                        width,
                    )
                if entry.period <= 0:
                    break
                slot += entry.period
        e = entry.next


@kernel
def _count_up_to(block_mw, n, limit_mw):
    count = 0
    for k in range(n):
        if block_mw[k] <= limit_mw:
            count += 1
    return count


@kernel
def _mean_power(power_mw, s, i, air, memory, rules, first, n_slots, n_places, stride, width):
    """Power of a resource block of each candidate, summed over its earlier slots, in steps of 1/256 of the noise.

    Whole numbers have the same sum in every order.
    """
    for k in range(n_slots * n_places):
        power_mw[k] = 0.0
    for edge in range(air.ptr[i], air.ptr[i + 1]):
        mean_mw = np.float64(air.mean_mw[edge])
        q = memory.own[air.receiver[edge]]
        while q != NONE:
            other = memory.process[q]
            for k in range(_n_known(other)):
                back = s - other.slots[k]
                if 0 < back <= rules.power_slots:
                    y = other.slots[k] - first
                    y -= (y // rules.power_step) * rules.power_step
                    while y < n_slots:
                        for x in range(n_places):
                            total = 0.0
                            for c in range(x * stride, x * stride + width):
                                total += air.leak[other.widths[k], other.subs[k], c]
                            power = mean_mw * total / width
                            if power >= rules.noise_mw:  # weaker ones are not told from noise
                                power_mw[y * n_places + x] += np.floor(power / rules.noise_mw * 256.0)
                        y += rules.power_step
            q = memory.next_own[q]


@kernel
def _before(room, a, b):
    return room.power_mw[a] < room.power_mw[b] or (room.power_mw[a] == room.power_mw[b] and room.rank[a] < room.rank[b])


@kernel
def _sift(room, i, n):
    order = room.order
    while True:
        down = 2 * i + 1
        if down >= n:
            return
        if down + 1 < n and _before(room, order[down], order[down + 1]):
            down += 1
        if not _before(room, order[i], order[down]):
            return
        order[i], order[down] = order[down], order[i]
        i = down


@kernel
def _keep_quietest(room, process, rules, n, limit_mw, wanted):
    """Exclude all but the candidates of least power, as many as wanted; ties are broken at random."""
    m = 0
    prefix = mix(mix(mix(rules.rng_key, _RANK), process.key), np.uint64(process.n_draws))
    process.n_draws += 1
    for k in range(n):
        if room.block_mw[k] <= limit_mw:
            room.order[m] = k
            room.rank[k] = mix(prefix, np.uint64(k))
            m += 1
    if m <= wanted:
        return
    for i in range(m // 2 - 1, -1, -1):
        _sift(room, i, m)
    while m > wanted:
        m -= 1
        room.block_mw[room.order[0]] = np.inf
        room.order[0] = room.order[m]
        _sift(room, 0, m)


@kernel
def _nth_up_to(block_mw, n, limit_mw, wanted):
    for k in range(n):
        if block_mw[k] <= limit_mw:
            if wanted == 0:
                return k
            wanted -= 1
    return NONE


@kernel
def _choose(u, s, air, memory, log, room, rules):
    """Choose the resources of a unit in its selection window [1]_ [2]_. Returns False if the window is empty."""
    me, block_mw = log.unit[u], room.block_mw
    process, i = memory.process[me.process], me.station
    first, last = s + rules.first, min(me.generated + rules.last, me.deadline)
    n_slots, width = last - first + 1, np.int64(me.width)
    if n_slots < 1:
        return False
    stride = width if rules.aligned else 1
    n_places = rules.n_subchannels // width if rules.aligned else rules.n_subchannels - width + 1
    n, period = n_slots * n_places, process.period
    wanted = np.int64(np.ceil(rules.share * n - 1e-9))
    for k in range(n):
        block_mw[k] = 0.0
    _own_slots(block_mw, memory, i, period, rules, first, n_slots, n_places, stride, width)
    if not rules.ranked and _count_up_to(block_mw, n, 0.0) < wanted:  # step 5a of [1]_
        for k in range(n):
            block_mw[k] = 0.0
    _pending(block_mw, u, log, memory, period, first, n_slots, n_places, stride, width, rules.n_subchannels)
    wanted = min(wanted, _count_up_to(block_mw, n, 0.0))
    if wanted == 0:
        return False
    _announced(block_mw, memory, i, period, rules.rsrp_mw, first, n_slots, n_places, stride, width)
    limit_mw = rules.rsrp_mw
    n_left = _count_up_to(block_mw, n, limit_mw)
    while n_left < wanted:
        limit_mw *= RAISE
        n_left = _count_up_to(block_mw, n, limit_mw)
    if rules.ranked:
        _mean_power(room.power_mw, s, i, air, memory, rules, first, n_slots, n_places, stride, width)
        _keep_quietest(room, process, rules, n, limit_mw, wanted)
        n_left = _count_up_to(block_mw, n, limit_mw)
    log.unit[u].threshold_mw = limit_mw
    chosen = _nth_up_to(block_mw, n, limit_mw, np.int64(_draw(process, rules, _SELECT) * n_left))
    log.unit[u].slot[0] = first + chosen // n_places
    log.unit[u].sub[0] = (chosen % n_places) * stride
    count = 1
    while count < me.n_sent:
        # Further transmissions: other slots, all within `max_gap` of each other.
        for k in range(n):
            slot = first + k // n_places
            for a in range(count):
                apart = abs(slot - log.unit[u].slot[a])
                if apart == 0 or apart > rules.max_gap:
                    block_mw[k] = np.inf
        n_left = _count_up_to(block_mw, n, limit_mw)
        if n_left == 0:
            break
        chosen = _nth_up_to(block_mw, n, limit_mw, np.int64(_draw(process, rules, _SELECT) * n_left))
        slot, sub, a = first + chosen // n_places, (chosen % n_places) * stride, count
        while a > 0 and log.unit[u].slot[a - 1] > slot:
            log.unit[u].slot[a], log.unit[u].sub[a] = log.unit[u].slot[a - 1], log.unit[u].sub[a - 1]
            a -= 1
        log.unit[u].slot[a], log.unit[u].sub[a] = slot, sub
        count += 1
    log.unit[u].n_sent = count
    return True


@kernel
def _reserve(u, memory, log, rules):
    """Let the process hold the resources that were chosen for a unit, with a new counter."""
    me = log.unit[u]
    process = memory.process[me.process]
    process.width, process.n_sent, process.n_missed = me.width, me.n_sent, 0
    for a in range(me.n_sent):
        process.gap[a], process.sub[a] = me.slot[a] - me.slot[0], me.sub[a]
    process.counter = _draw_counter(process, rules) if process.period > 0 else 1
    process.next_slot = me.slot[0]


@kernel
def _schedule(u, s, begin, log):
    """Enter the transmissions of a unit into the lists of their slots, by key."""
    for a in range(log.unit[u].n_sent):
        node, at = u * MAX_SENT + a, log.unit[u].slot[a] - begin
        before, here = NONE, log.head_sent[at]
        while here != NONE and log.unit[here // MAX_SENT].key < log.unit[u].key:
            before, here = here, log.next_sent[here]
        log.next_sent[node] = here
        if before == NONE:
            log.head_sent[at] = node
        else:
            log.next_sent[before] = node


@kernel
def _uses_reservation(u, s, process, log, rules):
    """Use the process's reservation for a unit, if it comes in time and is wide enough."""
    me = log.unit[u]
    if process.next_slot == NEVER:
        return False
    while process.next_slot < s + rules.first:
        if process.period <= 0:
            return False
        process.next_slot += process.period
        process.n_missed += 1
    if process.n_missed >= rules.reselect_after:
        return False
    last = process.next_slot + process.gap[process.n_sent - 1]
    if last > min(me.generated + rules.last, me.deadline) or process.width < me.width:
        return False
    me.width, me.n_sent = process.width, min(process.n_sent, me.n_sent)
    for a in range(me.n_sent):
        me.slot[a], me.sub[a] = process.next_slot + process.gap[a], process.sub[a]
    return True


@kernel
def _occupancy_limit(cbr):
    """Largest share of the subchannels that a station may use, by the channel busy ratio (PPPP 5 of [4]_)."""
    if cbr <= 0.3:
        return 1.0
    if cbr <= 0.65:
        return 0.03
    if cbr <= 0.8:
        return 0.006
    return 0.003


@kernel
def _admit(u, s, begin, air, memory, log, room, rules):
    """A unit is generated: use the reservation of its process or choose resources, unless occupancy is exhausted."""
    me = log.unit[u]
    process, station = memory.process[me.process], memory.station[me.station]
    interval = s - process.generated if process.generated != NONE else 0
    process.generated = s
    if rules.limited and station.ignores == 0:
        used = np.int64(station.used_now)
        for k in range(N_USED):
            used += station.used[k]
        room_left = _occupancy_limit(station.cbr) * N_USED * rules.busy_slots * rules.n_subchannels - used
        while me.n_sent > 1 and me.n_sent * me.width > room_left:
            me.n_sent -= 1
        if me.n_sent * me.width > room_left:
            me.n_sent = 0
            me.outcome = EXPIRED
            return
    if not _uses_reservation(u, s, process, log, rules):
        process.next_slot = NEVER
        wanted = rules.forced_period if rules.forced_period > 0 else interval
        process.period = wanted if 0 < wanted < len(air.allowed) and air.allowed[wanted] else 0
        if not _choose(u, s, air, memory, log, room, rules):
            me.n_sent = 0
            me.outcome = EXPIRED
            return
        _reserve(u, memory, log, rules)
        if rules.lead > 0 and me.slot[0] - rules.lead > s:
            at = me.slot[0] - rules.lead - begin
            log.next_check[u] = log.head_check[at]
            log.head_check[at] = u
    station.used_now += me.n_sent * me.width
    _schedule(u, s, begin, log)


@kernel
def _is_taken(u, memory, log):
    """Whether another station has announced a resource that was chosen for a unit."""
    me = log.unit[u]
    period = memory.process[me.process].period
    e = memory.head[me.station]
    while e != NONE:
        entry = memory.entry[e]
        if entry.rsrp_mw > me.threshold_mw:
            for a in range(me.n_sent):
                if entry.sub < me.sub[a] + me.width and me.sub[a] < entry.sub + entry.width:
                    slot = entry.slot
                    while slot <= entry.last:
                        ahead = slot - me.slot[a]
                        if ahead == 0 or (period > 0 and ahead > 0 and ahead % period == 0):
                            return True
                        if entry.period <= 0:
                            break
                        slot += entry.period
        e = entry.next
    return False


@kernel
def _unschedule(u, begin, log):
    """Remove the transmissions of a unit from the lists of their slots."""
    for a in range(log.unit[u].n_sent):
        node, at = u * MAX_SENT + a, log.unit[u].slot[a] - begin
        before, here = NONE, log.head_sent[at]
        while here != node:
            before, here = here, log.next_sent[here]
        if before == NONE:
            log.head_sent[at] = log.next_sent[node]
        else:
            log.next_sent[before] = log.next_sent[node]


@kernel
def _check(u, s, begin, air, memory, log, room, rules):
    """Re-evaluation: choose again if another station has announced the chosen resource meanwhile [1]_."""
    if not _is_taken(u, memory, log):
        return
    me = log.unit[u]
    wanted = me.n_sent
    _unschedule(u, begin, log)
    if _choose(u, s, air, memory, log, room, rules):
        memory.station[me.station].used_now -= (wanted - me.n_sent) * me.width
        _reserve(u, memory, log, rules)
    _schedule(u, s, begin, log)


@kernel
def _announce(receiver, s, u, a, rsrp_mw, memory, log, rules):
    """Remember at a receiver which resources a transmission reserves."""
    me = log.unit[u]
    process = memory.process[me.process]
    count = me.n_sent - a if rules.with_repeats else 1
    for k in range(count):
        slot, sub = me.slot[a + k], me.sub[a + k]
        if k > 0:
            _remember(receiver, slot, slot, 0, sub, me.width, rsrp_mw, memory)
        if me.announces:
            times = max(1, -(-rules.last // process.period)) if process.period < rules.last else 1
            _remember(
                receiver, slot + process.period, slot + times * process.period, process.period, sub, me.width, rsrp_mw,
                memory,
            )  # fmt: skip


@kernel
def _remember(receiver, slot, last, period, sub, width, rsrp_mw, memory):
    e = memory.at[0]
    entry = memory.entry[e]
    entry.slot, entry.last, entry.period, entry.sub, entry.width = slot, last, period, sub, width
    entry.rsrp_mw, entry.station, entry.next = rsrp_mw, receiver, memory.head[receiver]
    memory.head[receiver] = e
    memory.at[0] = e + 1


@kernel
def _begin_transmission(u, a, s, memory, log, rules):
    """Count the transmission, decide whether its resources are kept, and move the reservation on."""
    me = log.unit[u]
    process = memory.process[me.process]
    k = process.n_past % N_HISTORY
    process.slots[k], process.subs[k], process.widths[k] = s, me.sub[a], me.width
    process.n_past += 1
    if a > 0:
        return
    me.announces = 0
    if process.period > 0:
        if process.counter == 1 and _draw(process, rules, _KEEP) < rules.keep_p:
            process.counter += _draw_counter(process, rules)
        me.announces = process.counter > 1
        process.counter -= 1
    process.n_missed = 0
    process.next_slot = me.slot[0] + process.period if me.announces else NEVER


@kernel
def _powers(u, a, s, n_touched, air, log, rules):
    """Add the power of one transmission to the sums of its receivers; returns the number of receivers so far."""
    me, leak, s_n = log.unit[u], air.leak, rules.n_subchannels
    i, width, sub = np.int64(me.station), np.int64(me.width), np.int64(me.sub[a])
    prefix = mix(mix(mix(rules.rng_key, _PAYLOAD), me.key), np.uint64(s))
    air.sends[i] = s
    for edge in range(air.ptr[i], air.ptr[i + 1]):
        j = air.receiver[edge]
        h = mix(prefix, air.key[j])
        power = air.mean_mw[edge] * air.quantiles[air.fading[edge], np.int64(h >> _TO_QUANTILE)]
        air.arrival_mw[edge] = power
        if air.stamp[j] != s:
            air.stamp[j] = s
            air.touched[n_touched] = j
            n_touched += 1
            for c in range(s_n):
                air.density_mw[j, c] = 0.0
        for c in range(s_n):
            air.density_mw[j, c] += power * leak[width, sub, c]
    return n_touched


@kernel
def _receive(u, a, s, air, memory, log, rules):
    """Outcome of one transmission at each receiver, and the announcements that they decode."""
    me, leak = log.unit[u], air.leak
    i, width, sub = np.int64(me.station), np.int64(me.width), np.int64(me.sub[a])
    first, degree = air.ptr[i], air.ptr[i + 1] - air.ptr[i]
    prefix = mix(mix(mix(rules.rng_key, _PAYLOAD), me.key), np.uint64(s))
    per_rb = leak[width, sub, sub]
    scale = 1.0 / 12.0  # resource elements of a resource block
    for k in range(degree):
        j = air.receiver[first + k]
        row = me.rows + a * degree + k
        if air.sends[j] == s:
            log.reception[row] = HALF_DUPLEX
            continue
        power = np.float64(air.arrival_mw[first + k]) * per_rb
        total = 0.0
        for c in range(sub, sub + width):
            total += air.density_mw[j, c]
        noise = rules.noise_mw + air.jam_mw[j]
        if air.is_jammed[i]:
            noise += air.react_mw[j]
        sinr = power / (noise + max(total / width - power, 0.0))
        at = me.rows // MAX_SENT + k
        if a == 0:
            log.sinr[at] = 0.0
        log.sinr[at] += sinr
        if sinr < rules.control_sinr:
            log.reception[row] = COLLISION if power >= rules.control_sinr * noise else FADING
            continue
        h = mix(mix(prefix, air.key[j]), _PAYLOAD)
        if _succeeds(log.sinr[at], me, h):
            log.reception[row] = RECEIVED
        else:
            log.reception[row] = COLLISION if _succeeds(power / noise, me, h) else FADING
        if power * scale > rules.rsrp_mw and (me.announces or rules.with_repeats):
            _announce(j, s, u, a, np.float32(power * scale), memory, log, rules)


@kernel
def _count_busy(s, n_touched, air, memory, rules):
    """Count the subchannels of this slot whose power exceeds the threshold of the channel busy ratio [4]_."""
    for k in range(n_touched):
        j = air.touched[k]
        if air.sends[j] == s:
            continue
        n = 0
        for c in range(rules.n_subchannels):
            if air.density_mw[j, c] * rules.rbs > rules.busy_mw:
                n += 1
        memory.station[j].busy += n
        air.busy_round[j] += n


@kernel
def count_kept(entry, n, now, ptr):
    """Write where each station's entries begin, of the first n that still reserve something at the slot `now`."""
    ptr[:] = 0
    for e in range(n):
        if entry[e].last >= now:
            ptr[entry[e].station + 1] += 1
    for j in range(len(ptr) - 1):
        ptr[j + 1] += ptr[j]


@kernel
def copy_kept(entry, n, now, at, kept):
    """Copy these entries, station by station; `at` is where the next one of each station goes."""
    for e in range(n):
        if entry[e].last >= now:
            kept[at[entry[e].station]] = entry[e]
            at[entry[e].station] += 1


@kernel
def next_period(station, rules):
    """Begin a new period of the channel busy ratio at all stations."""
    for j in range(len(station)):
        me = station[j]
        me.cbr = me.busy / (rules.busy_slots * rules.n_subchannels)
        me.busy = 0
        for k in range(N_USED - 1, 0, -1):
            me.used[k] = me.used[k - 1]
        me.used[0] = me.used_now
        me.used_now = 0


@kernel
def run_slots(begin, first, end, arrival, air, memory, log, room, rules):
    """Carry out the slots from `first` to `end`.

    The lists of `log` begin with the slot `begin`. `arrival` are the units that are generated before `end`, in this
    order. In a slot, units are generated and choose their resources first, from what was sensed before it.
    """
    new = 0
    for s in range(first, end):
        if s % rules.busy_slots == 0:
            next_period(memory.station, rules)
        while new < len(arrival) and log.unit[arrival[new]].generated <= s:
            _admit(arrival[new], s, begin, air, memory, log, room, rules)
            new += 1
        u = log.head_check[s - begin]
        while u != NONE:
            after = log.next_check[u]
            _check(u, s, begin, air, memory, log, room, rules)
            u = after
        if log.head_sent[s - begin] == NONE:
            continue
        n_touched = 0
        node = log.head_sent[s - begin]
        while node != NONE:
            _begin_transmission(node // MAX_SENT, node % MAX_SENT, s, memory, log, rules)
            n_touched = _powers(node // MAX_SENT, node % MAX_SENT, s, n_touched, air, log, rules)
            node = log.next_sent[node]
        node = log.head_sent[s - begin]
        while node != NONE:
            _receive(node // MAX_SENT, node % MAX_SENT, s, air, memory, log, rules)
            node = log.next_sent[node]
        node = log.head_sent[s - begin]
        while node != NONE:
            me = log.unit[node // MAX_SENT]
            memory.station[me.station].busy += me.width
            air.busy_round[me.station] += me.width
            node = log.next_sent[node]
        _count_busy(s, n_touched, air, memory, rules)
