"""The slots of a sidelink round: messages are generated, transmitted and received, and busy subchannels are counted.

Transmissions of a slot are summed in the order of their processes' keys, so that the order of rows has no effect.

In the kernels, `u` is the row of a unit in `log.unit`, `a` is the number of one of its transmissions, and `s` is the
slot. The lists of a slot are linked: `log.head_sent` has the first transmission of each slot, u * MAX_SENT + a, and
`log.next_sent` the one that follows each, or NONE. `log.head_check` and `log.next_check` link units in the same way.

References
----------
.. [3] 3GPP TS 38.321 V16.12, clause 5.22.1.1; TS 36.321 V14.13, clause 5.14.1.1: counter, probability of keeping.
.. [4] ETSI TS 103 574 V1.1.1, clause 5: channel busy ratio, channel occupancy ratio and its limits.
"""

from math import erfc

import numpy as np

from cosim.addons.sidelink.admission import admit, check
from cosim.addons.sidelink.choice import draw, draw_counter
from cosim.addons.sidelink.records import MAX_SENT, N_HISTORY, N_USED
from cosim.base.hash_rng import mix
from cosim.base.hash_rng import unit as uniform
from cosim.base.kernel import kernel
from cosim.radio.dtypes import COLLISION, FADING, HALF_DUPLEX, NEVER, NONE, RECEIVED

_TO_QUANTILE = np.uint64(52)
_KEEP, _PAYLOAD = np.uint64(0x51DF), np.uint64(0x51E0)


@kernel
def _succeeds(sinr, unit, hashed):
    """Whether a block with this SINR is decoded: a normal distribution in dB, whose far tails need no draw."""
    if sinr >= unit.clear_sinr:
        return True
    if sinr <= unit.dead_sinr:
        return False
    x = (10.0 * np.log10(sinr) - unit.sinr_db) / unit.spread_db
    return uniform(hashed) < 0.5 * erfc(-x * 0.7071067811865476)


@kernel
def _announce(u, a, memory, log, rules):
    """Write down which resources a transmission reserves; returns the row of the first one."""
    unit, begin = log.unit[u], memory.n_reservations[0]
    period = memory.process[unit.process].period
    count = unit.n_sent - a if rules.with_repeats else 1
    for k in range(a, a + count):
        slot, sub = unit.slot[k], unit.sub[k]
        if k > a:  # a later transmission of the same message
            _add_reservation(slot, slot, 0, sub, unit.width, memory)
        if unit.announces:  # the same resource in the periods that begin in a selection window, one at least
            n_periods = max(1, -(-rules.last // period))
            _add_reservation(slot + period, slot + n_periods * period, period, sub, unit.width, memory)
    return begin


@kernel
def _add_reservation(slot, last, period, sub, width, memory):
    row = memory.reservation[memory.n_reservations[0]]
    row.slot, row.last, row.period = slot, last, period
    row.sub, row.width = sub, width
    memory.n_reservations[0] += 1


@kernel
def _remember(receiver, begin, rsrp_mw, memory):
    """Remember at a receiver the reservations from row `begin` on."""
    for row in range(begin, memory.n_reservations[0]):
        entry = memory.entry[memory.ptr[receiver] + memory.n_entries[receiver]]
        entry.reservation, entry.rsrp_mw = row, rsrp_mw
        memory.n_entries[receiver] += 1


@kernel
def _begin_transmission(u, a, s, memory, log, rules):
    """Count the transmission, decide whether its resources are kept, and move the reservation on."""
    unit = log.unit[u]
    process = memory.process[unit.process]
    k = process.n_past % N_HISTORY
    process.slots[k] = s
    process.subs[k] = unit.sub[a]
    process.widths[k] = unit.width
    process.n_past += 1
    if a > 0:
        return
    unit.announces = 0
    if process.period > 0:
        if process.counter == 1 and draw(process, rules, _KEEP) < rules.keep_p:
            process.counter += draw_counter(process, rules)
        unit.announces = process.counter > 1
        process.counter -= 1
    process.n_missed = 0
    process.next_slot = unit.slot[0] + process.period if unit.announces else NEVER


@kernel
def _add_powers(u, a, s, n_touched, air, log, rules):
    """Add the power of one transmission to the sums of its receivers; returns the number of receivers so far."""
    unit, leak = log.unit[u], air.leak
    i = np.int64(unit.station)
    width, sub = np.int64(unit.width), np.int64(unit.sub[a])
    seed = _seed(unit, s, rules)
    air.sends[i] = s
    for edge in range(air.ptr[i], air.ptr[i + 1]):
        j = air.receiver[edge]
        hashed = mix(seed, air.key[j])
        fading = air.quantiles[air.fading[edge], np.int64(hashed >> _TO_QUANTILE)]
        power = air.mean_mw[edge] * fading
        air.arrival_mw[edge] = power
        if air.stamp[j] != s:
            air.stamp[j] = s
            air.touched[n_touched] = j
            n_touched += 1
            for c in range(rules.n_subchannels):
                air.density_mw[j, c] = 0.0
        for c in range(rules.n_subchannels):
            air.density_mw[j, c] += power * leak[width, sub, c]
    return n_touched


@kernel
def _seed(unit, s, rules):
    """Seed of what is drawn at the receivers of a transmission."""
    return mix(mix(mix(rules.rng_key, _PAYLOAD), unit.key), np.uint64(s))


@kernel
def _receive(u, a, s, air, memory, log, rules):
    """Outcome of one transmission at each receiver, and the announcements that they decode."""
    unit, leak = log.unit[u], air.leak
    i = np.int64(unit.station)
    width, sub = np.int64(unit.width), np.int64(unit.sub[a])
    first = air.ptr[i]
    degree = air.ptr[i + 1] - first
    seed = _seed(unit, s, rules)
    per_rb = leak[width, sub, sub]
    per_element = 1.0 / 12.0  # of the power of a resource block
    announced = _announce(u, a, memory, log, rules)
    for k in range(degree):
        j = air.receiver[first + k]
        row = unit.rows + a * degree + k
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
        if sinr < rules.control_sinr:
            log.reception[row] = COLLISION if power >= rules.control_sinr * noise else FADING
            continue
        at = unit.rows // MAX_SENT + k
        log.sinr[at] += sinr
        hashed = mix(mix(seed, air.key[j]), _PAYLOAD)
        if _succeeds(log.sinr[at], unit, hashed):
            log.reception[row] = RECEIVED
        else:
            log.reception[row] = COLLISION if _succeeds(power / noise, unit, hashed) else FADING
        rsrp_mw = power * per_element
        if rsrp_mw > rules.rsrp_mw:
            _remember(j, announced, np.float32(rsrp_mw), memory)


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
def count_entries(ptr, receiver, unit, n_announced, room):
    """Add the largest number of entries that each station gets in a round to `room`."""
    for u in range(len(unit)):
        i = unit[u].station
        for edge in range(ptr[i], ptr[i + 1]):
            room[receiver[edge]] += n_announced[u]


@kernel
def load_entries(old, was, number, entry, ptr, n):
    """Copy the entries of earlier rounds.

    Parameters
    ----------
    old
        State after the round before: `entry`, `ptr`, `n_entries`.
    was, number
        Row of each station in `old`, and present row of each of its reservations, or NONE.
    entry, ptr, n
        Result: the entries, where those of each station begin, and their number.
    """
    before, before_ptr, before_n = old
    for j in range(len(was)):
        if was[j] == NONE:
            continue
        first = before_ptr[was[j]]
        for e in range(first, first + before_n[was[j]]):
            row = number[before[e].reservation]
            if row != NONE:
                entry[ptr[j] + n[j]].reservation = row
                entry[ptr[j] + n[j]].rsrp_mw = before[e].rsrp_mw
                n[j] += 1


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
            admit(arrival[new], s, begin, air, memory, log, room, rules)
            new += 1
        u = log.head_check[s - begin]
        while u != NONE:
            after = log.next_check[u]
            check(u, s, begin, air, memory, log, room, rules)
            u = after
        if log.head_sent[s - begin] == NONE:
            continue
        n_touched = 0
        sent = log.head_sent[s - begin]
        while sent != NONE:
            u, a = sent // MAX_SENT, sent % MAX_SENT
            _begin_transmission(u, a, s, memory, log, rules)
            n_touched = _add_powers(u, a, s, n_touched, air, log, rules)
            sent = log.next_sent[sent]
        sent = log.head_sent[s - begin]
        while sent != NONE:  # only now are all powers of the slot known
            _receive(sent // MAX_SENT, sent % MAX_SENT, s, air, memory, log, rules)
            unit = log.unit[sent // MAX_SENT]
            memory.station[unit.station].busy += unit.width
            air.busy_round[unit.station] += unit.width
            sent = log.next_sent[sent]
        _count_busy(s, n_touched, air, memory, rules)
