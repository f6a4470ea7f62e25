"""Generation of a message on the sidelink: it uses its process's reservation, or new resources; re-evaluation.

References
----------
.. [1] 3GPP TS 38.214 V16.10, clause 8.1.4: resources of mode 2.
.. [4] ETSI TS 103 574 V1.1.1, clause 5: channel busy ratio, channel occupancy ratio and its limits.
"""

import numpy as np

from cosim.addons.sidelink.choice import choose, draw_counter
from cosim.addons.sidelink.records import MAX_SENT, N_USED
from cosim.base.kernel import kernel
from cosim.radio.dtypes import EXPIRED, NEVER, NONE


@kernel
def _reserve(u, memory, log, rules):
    """Let the process hold the resources that were chosen for a unit, with a new counter."""
    me = log.unit[u]
    process = memory.process[me.process]
    process.width, process.n_sent, process.n_missed = me.width, me.n_sent, 0
    for a in range(me.n_sent):
        process.gap[a] = me.slot[a] - me.slot[0]
        process.sub[a] = me.sub[a]
    process.counter = draw_counter(process, rules) if process.period > 0 else 1
    process.next_slot = me.slot[0]


@kernel
def _schedule(u, s, begin, log):
    """Enter the transmissions of a unit into the lists of their slots, by key."""
    for a in range(log.unit[u].n_sent):
        node = u * MAX_SENT + a
        at = log.unit[u].slot[a] - begin
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
    latest = min(me.generated + rules.last, me.deadline)
    if last > latest or process.width < me.width:
        return False
    me.width, me.n_sent = process.width, min(process.n_sent, me.n_sent)
    for a in range(me.n_sent):
        me.slot[a] = process.next_slot + process.gap[a]
        me.sub[a] = process.sub[a]
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
def admit(u, s, begin, air, memory, log, room, rules):
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
        is_allowed = 0 < wanted < len(air.allowed) and air.allowed[wanted]
        process.period = wanted if is_allowed else 0
        if not choose(u, s, air, memory, log, room, rules):
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
    begin = memory.ptr[me.station]
    for e in range(begin, begin + memory.n_entries[me.station]):
        entry = memory.entry[e]
        if entry.rsrp_mw > me.threshold_mw:
            held = memory.reservation[entry.reservation]
            for a in range(me.n_sent):
                own_end = me.sub[a] + me.width
                held_end = held.sub + held.width
                if held.sub < own_end and me.sub[a] < held_end:
                    slot = held.slot
                    while slot <= held.last:
                        ahead = slot - me.slot[a]
                        if ahead == 0 or (period > 0 and ahead > 0 and ahead % period == 0):
                            return True
                        if held.period <= 0:
                            break
                        slot += held.period
    return False


@kernel
def _unschedule(u, begin, log):
    """Remove the transmissions of a unit from the lists of their slots."""
    for a in range(log.unit[u].n_sent):
        node = u * MAX_SENT + a
        at = log.unit[u].slot[a] - begin
        before, here = NONE, log.head_sent[at]
        while here != node:
            before, here = here, log.next_sent[here]
        if before == NONE:
            log.head_sent[at] = log.next_sent[node]
        else:
            log.next_sent[before] = log.next_sent[node]


@kernel
def check(u, s, begin, air, memory, log, room, rules):
    """Re-evaluation: choose again if another station has announced the chosen resource meanwhile [1]_."""
    if not _is_taken(u, memory, log):
        return
    me = log.unit[u]
    wanted, process = me.n_sent, memory.process[me.process]
    held = process.next_slot
    process.next_slot = NEVER  # the reservation to be replaced takes no resource from this choice
    _unschedule(u, begin, log)
    if choose(u, s, air, memory, log, room, rules):
        memory.station[me.station].used_now -= (wanted - me.n_sent) * me.width
        _reserve(u, memory, log, rules)
    else:
        process.next_slot = held
    _schedule(u, s, begin, log)
