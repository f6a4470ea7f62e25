"""Choice of resources in the selection window of the sidelink, from what a station has sensed.

References
----------
.. [1] 3GPP TS 38.214 V16.10, clause 8.1.4: resources of mode 2.
.. [2] 3GPP TS 36.213 V14.16, clause 14.1.1.6: resources of mode 4.
.. [3] 3GPP TS 38.321 V16.12, clause 5.22.1.1; TS 36.321 V14.13, clause 5.14.1.1: counter, probability of keeping.
"""

import numpy as np

from cosim.addons.sidelink.records import N_HISTORY
from cosim.base.hash_rng import mix, unit
from cosim.base.kernel import kernel
from cosim.radio.dtypes import NEVER, NONE

_SELECT, _RANK, _COUNTER = (np.uint64(k) for k in (0x51DE, 0x51E1, 0x51E2))
RAISE = 10**0.3
"""Factor of one step of the threshold, 3 dB [1]_ [2]_."""


@kernel
def draw(process, rules, purpose):
    h = mix(mix(mix(rules.rng_key, purpose), process.key), np.uint64(process.n_draws))
    process.n_draws += 1
    return unit(h)


@kernel
def draw_counter(process, rules):
    times = 1
    if process.period < rules.short_period:
        times = -((-rules.long_slots) // max(process.period, rules.long_slots // 5))
    low, high = rules.counter_low * times, rules.counter_high * times
    return low + np.int32(draw(process, rules, _COUNTER) * (high - low + 1))


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
    """Mark a slot that is reserved, and each slot from which the own period leads to it."""
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
    begin = memory.ptr[i]
    for e in range(begin, begin + memory.n_entries[i]):
        entry = memory.entry[e]
        if entry.rsrp_mw > above_mw:
            held = memory.reservation[entry.reservation]
            slot = held.slot
            while slot <= held.last:
                if slot >= first:
                    _mark_periodic(
                        block_mw,
                        slot,
                        held.sub,
                        held.width,
                        np.float64(entry.rsrp_mw),
                        period,
                        first,
                        n_slots,
                        n_places,
                        stride,
                        width,
                    )
                if held.period <= 0:
                    break
                slot += held.period


@kernel
def _count_up_to(block_mw, n, limit_mw):
    count = 0
    for k in range(n):
        if block_mw[k] <= limit_mw:
            count += 1
    return count


@kernel
def _mean_power(power_mw, s, i, period, air, memory, rules, first, n_slots, n_places, stride, width):
    """Power of a resource block of each candidate, summed over its earlier slots, in steps of 1/256 of the noise.

    Whole numbers have the same sum in every order. Slots a period apart are averaged, or 100 ms apart where the period
    is longer or there is none.
    """
    step = period if 0 < period < rules.long_slots else rules.long_slots
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
                    y -= (y // step) * step
                    while y < n_slots:
                        for x in range(n_places):
                            total = 0.0
                            for c in range(x * stride, x * stride + width):
                                total += air.leak[other.widths[k], other.subs[k], c]
                            power = mean_mw * total / width
                            if power >= rules.noise_mw:  # weaker ones are not told from noise
                                power_mw[y * n_places + x] += np.floor(power / rules.noise_mw * 256.0)
                        y += step
            q = memory.next_own[q]


@kernel
def _before(room, a, b):
    """Whether candidate a has less power than b, or as much and the lower rank."""
    power_a, power_b = room.power_mw[a], room.power_mw[b]
    if power_a != power_b:
        return power_a < power_b
    return room.rank[a] < room.rank[b]


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
def choose(u, s, air, memory, log, room, rules):
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
        _mean_power(room.power_mw, s, i, period, air, memory, rules, first, n_slots, n_places, stride, width)
        _keep_quietest(room, process, rules, n, limit_mw, wanted)
        n_left = _count_up_to(block_mw, n, limit_mw)
    me.threshold_mw = limit_mw
    chosen = _nth_up_to(block_mw, n, limit_mw, np.int64(draw(process, rules, _SELECT) * n_left))
    me.slot[0] = first + chosen // n_places
    me.sub[0] = (chosen % n_places) * stride
    count = 1
    while count < me.n_sent:
        # Further transmissions: other slots, all within `max_gap` of each other.
        for k in range(n):
            slot = first + k // n_places
            for a in range(count):
                apart = abs(slot - me.slot[a])
                if apart == 0 or apart > rules.max_gap:
                    block_mw[k] = np.inf
        n_left = _count_up_to(block_mw, n, limit_mw)
        if n_left == 0:
            break
        chosen = _nth_up_to(block_mw, n, limit_mw, np.int64(draw(process, rules, _SELECT) * n_left))
        slot = first + chosen // n_places
        a = count  # transmissions are in the order of their slots
        while a > 0 and me.slot[a - 1] > slot:
            me.slot[a] = me.slot[a - 1]
            me.sub[a] = me.sub[a - 1]
            a -= 1
        me.slot[a] = slot
        me.sub[a] = (chosen % n_places) * stride
        count += 1
    me.n_sent = count
    return True
