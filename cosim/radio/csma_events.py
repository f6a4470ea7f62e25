"""CSMA/CA as a sequence of events: carrier sense, back-off, interference and reception, packet by packet.

Events are in one binary heap, sorted by time, kind and rank of the station by key. Generations of packets are not in
the heap: they are taken from the packets, which are sorted by time. Whether a preamble is detected is decided 4 µs
after it arrives; the decision is computed when the receiver is next accessed. Times are integer nanoseconds, powers are
mW. A station has at most one frame on the air, so a frame is identified by its transmitter's row. Functions that are
called for each receiver take only the two rules that they need, because passing the whole of `Air` would cost more time
than their work.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from cosim.base.hash_rng import mix, unit
from cosim.base.kernel import inlined, kernel
from cosim.radio.dtypes import (
    BUSY,
    COLLISION,
    DETECTING,
    EXPIRED,
    FADING,
    FREE,
    HALF_DUPLEX,
    LOCKED,
    N_ACCESS,
    NEVER,
    NONE,
    QUEUE,
    RANGE,
    RECEIVED,
    Constants,
)
from cosim.radio.event_heap import comes_before, pop, push
from cosim.radio.forwarding import TIMER, enqueue_forward, is_full, on_receive, schedule_timers
from cosim.radio.phy import HEADER_NS, PREAMBLE_NS

_END, _GENERATE, _GATE, _ACCESS = range(4)
_TO_QUANTILE = np.uint64(52)
_BACKOFF = np.uint64(0xB0)
_PAYLOAD = np.uint64(0xF0)


class Air(NamedTuple):
    """The stations of a window, their links and rules."""

    phys: ndarray
    macs: ndarray
    row_of_rank: ndarray
    ptr: ndarray  # where each station's links begin
    receiver: ndarray  # of each link, then of each link of frames on the air since an earlier window
    mean_mw: ndarray
    fading: ndarray
    arrival_mw: ndarray  # of the frame on the air
    quantiles: ndarray
    jam_mw: ndarray  # of constant jammers at each station; empty where nothing jams
    react_mw: ndarray  # of reactive jammers at each station, while a frame is on the air that they detect
    is_jammed: ndarray  # whether a reactive jammer detects each station's frames
    aifs_ns: ndarray
    cw: ndarray
    c: Constants
    rng_key: np.uint64


class Log(NamedTuple):
    """Packets, and the outcome of each at each receiver."""

    packets: ndarray
    outcome: ndarray
    receiver: ndarray


class Heap(NamedTuple):
    """Room for events."""

    times: ndarray
    codes: ndarray


@kernel
def _draw_slots(mac, key, air, a):
    h = mix(mix(mix(air.rng_key, _BACKOFF), key), np.uint64(mac.n_draws))
    mac.n_draws += 1
    return np.int32(unit(h) * (air.cw[a] + 1))


@kernel
def _elapse(phy, mac, aifs_ns, slot_ns, t):
    """Count back-offs down over the idle time until `t`."""
    free_ns = max(phy.idle_ns, phy.eifs_ns)
    phy.active = mac.n_queued > 0
    for a in range(N_ACCESS):
        if mac.slots[a] > 0:
            start = max(free_ns + aifs_ns[a], mac.since_ns[a])
            if t > start:
                k = min((t - start) // slot_ns, mac.slots[a])
                mac.slots[a] -= k
                mac.since_ns[a] = start + k * slot_ns
            if mac.slots[a] > 0:
                phy.active = 1


@inlined
def _go_busy(phy, mac, air, t):
    if phy.busy == 0:
        phy.busy = 1
        phy.busy_since_ns = t
        if phy.active:
            _elapse(phy, mac, air.aifs_ns, air.c.slot_ns, t)


@kernel
def _access_ns(phy, mac, aifs_ns, slot_ns, a):
    """Earliest access of a queue while the medium stays idle."""
    free_ns = max(phy.idle_ns, phy.eifs_ns)
    begin_ns = max(free_ns + aifs_ns[a], mac.since_ns[a])
    return begin_ns + mac.slots[a] * slot_ns


@inlined
def _schedule(heap, n, t, kind, mac):
    """Put an event of a station into the heap of `n` events; returns the new size."""
    return push(heap.times, heap.codes, n, t, (kind << 32) | mac.rank)


@kernel
def _arm(phy, mac, aifs_ns, slot_ns, heap, n):
    """Schedule the station's next access, if it has something to send and may."""
    if mac.n_queued == 0 or mac.gated or phy.busy:
        return n
    soonest = np.int64(NEVER)  # not a literal, for whose type `push` would be compiled once more
    for a in range(N_ACCESS):
        if mac.count[a] > 0:
            soonest = min(soonest, _access_ns(phy, mac, aifs_ns, slot_ns, a))
    if soonest < mac.armed_ns:  # an earlier event would check again
        mac.armed_ns = soonest
        n = _schedule(heap, n, soonest, _ACCESS, mac)
    return n


@inlined
def _go_idle(phy, mac, air, heap, n, t):
    phy.busy = 0
    phy.idle_ns = t
    phy.busy_ns += t - phy.busy_since_ns
    if phy.active:
        n = _arm(phy, mac, air.aifs_ns, air.c.slot_ns, heap, n)
    return n


@kernel
def _request(phy, mac, air, t, a):
    """A queue that was empty requests the medium: for its AIFS from now if it is idle, otherwise after a back-off."""
    if phy.busy:
        if mac.slots[a] == 0:
            mac.slots[a] = _draw_slots(mac, phy.key, air, a)
    else:
        _elapse(phy, mac, air.aifs_ns, air.c.slot_ns, t)
        if mac.slots[a] == 0:
            mac.since_ns[a] = t + air.aifs_ns[a]
    phy.active = 1


@inlined
def _close(phy, phys, packets, c, t):
    """Add the success of the payload received since the last change of interference."""
    if t > phy.chunk_ns:
        if phy.n_air > 1:
            phy.hurt = 1
        unwanted_mw = c.noise_mw + phy.jam_mw + max(phy.energy_mw - phy.frame_mw, 0.0)
        if phy.frame_mw < c.sinr_clean * unwanted_mw:
            p = packets[phys[phy.frame_from].packet]
            share = (t - phy.chunk_ns) / (p.airtime_ns - HEADER_NS)
            sinr = phy.frame_mw / unwanted_mw
            error = np.exp(c.curve_a - c.curve_b * np.log(sinr))
            phy.log_psr -= share * (p.payload_bytes + c.overhead_bytes) / 336.0 * error
        phy.chunk_ns = t


@inlined
def _settle(phy, mac, air, log, t):
    """Decide whether the receiver detects a preamble, once the time for this is over."""
    due, c = phy.frame_ns + PREAMBLE_NS, air.c
    if t < due:
        return
    phy.phase = FREE
    if phy.frame_mw >= c.detectable_mw:
        phy.jam_mw = 0.0
        if air.jam_mw.size > 0:
            j = air.row_of_rank[mac.rank]
            phy.jam_mw = air.jam_mw[j]
        unwanted_mw = c.noise_mw + phy.jam_mw + max(phy.energy_mw - phy.frame_mw, 0.0)
        if phy.frame_mw >= c.sinr_min * unwanted_mw:
            phy.phase = LOCKED
            phy.chunk_ns = phy.frame_ns + HEADER_NS
            phy.log_psr = 0.0
            if air.jam_mw.size > 0 and air.is_jammed[phy.frame_from]:
                phy.jam_mw += air.react_mw[air.row_of_rank[mac.rank]]
            phy.hurt = phy.jam_mw > 0.0
        else:
            log.outcome[_slot(phy, air.phys, log.packets)] = COLLISION
    if phy.phase == LOCKED or phy.energy_mw >= c.cca_mw:
        _go_busy(phy, mac, air, due)


@inlined
def _slot(phy, phys, packets):
    """Where the outcome of the frame being received is written."""
    return packets[phys[phy.frame_from].packet].slot + phy.frame_edge


@kernel
def _start(air, log, s, packet, t):
    """Start a transmission, and compute the effect of its first microseconds on each receiver in range."""
    phys, macs, c, outcome = air.phys, air.macs, air.c, log.outcome
    sender = phys[s]
    if sender.phase == DETECTING and sender.frame_mw >= c.detectable_mw:
        outcome[_slot(sender, phys, log.packets)] = HALF_DUPLEX
    sender.phase = FREE
    _go_busy(sender, macs[s], air, t)
    sender.packet = packet
    frame = log.packets[packet]
    frame.start_ns = t
    frame.outcome = RECEIVED
    prefix = mix(mix(air.rng_key, sender.key), frame.seq)
    first, slot = frame.edge, frame.slot
    for k in range(frame.degree):
        e = first + k
        j = air.receiver[e]
        phy = phys[j]
        h = mix(prefix, phy.key)
        mean_mw = air.mean_mw[e]
        quantile = np.int64(h >> _TO_QUANTILE)
        power = np.float64(mean_mw * air.quantiles[air.fading[e], quantile])
        log.receiver[slot + k] = j
        detectable = power >= c.detectable_mw
        result = BUSY if detectable else FADING if mean_mw >= c.detectable_mw else RANGE
        if power < c.floor_mw:
            air.arrival_mw[e] = 0.0
            outcome[slot + k] = result
            continue
        air.arrival_mw[e] = power
        if phy.phase == DETECTING:
            _settle(phy, macs[j], air, log, t)
        if phy.phase == LOCKED:
            _close(phy, phys, log.packets, c, t)
            in_time = t - phy.frame_ns <= c.capture_ns
            if detectable and in_time and power > c.capture_ratio * phy.frame_mw:
                outcome[_slot(phy, phys, log.packets)] = COLLISION
                phy.phase = FREE
        phy.energy_mw += power
        phy.n_air += 1
        if power >= c.cca_mw:
            if phy.n_strong == 0:
                phy.strong_since_ns = t
            phy.n_strong += 1
        is_free = phy.phase == FREE
        is_stronger = phy.phase == DETECTING and power > phy.frame_mw
        # A weak frame matters only where it tips carrier sense.
        matters = detectable or (is_free and phy.busy == 0 and phy.energy_mw >= c.cca_mw)
        if phy.packet != NONE:
            if detectable:
                result = HALF_DUPLEX
        elif (is_free or is_stronger) and matters:
            if phy.phase == DETECTING and phy.frame_mw >= c.detectable_mw:
                outcome[_slot(phy, phys, log.packets)] = BUSY
            phy.phase = DETECTING
            phy.frame_from = s
            phy.frame_edge = k
            phy.frame_mw = power
            phy.frame_ns = t
        outcome[slot + k] = result


@kernel
def _end(air, log, heap, n, s, t, forwarding):
    """End a transmission: decide which payloads are received, and make the medium idle."""
    phys, macs, c, outcome = air.phys, air.macs, air.c, log.outcome
    sender, sender_mac = phys[s], macs[s]
    frame = log.packets[sender.packet]
    number = frame.tag if forwarding.rules.max_hops > 1 else NONE
    prefix = mix(mix(air.rng_key, sender.key), frame.seq)
    first, slot = frame.edge, frame.slot
    for k in range(frame.degree):
        power = np.float64(air.arrival_mw[first + k])
        if power == 0.0:
            continue
        j = air.receiver[first + k]
        phy = phys[j]
        if phy.phase == DETECTING:
            _settle(phy, macs[j], air, log, t)
        if phy.phase == LOCKED:
            _close(phy, phys, log.packets, c, t)
            if phy.frame_from == s:
                phy.phase = FREE
                h = mix(mix(prefix, phy.key), _PAYLOAD)
                if phy.log_psr == 0.0 or unit(h) < np.exp(phy.log_psr):
                    outcome[slot + k] = RECEIVED
                    phy.eifs_ns = 0
                    if number >= 0:
                        n = on_receive(forwarding, forwarding.frames[number], j, t, heap.times, heap.codes, n)
                else:
                    outcome[slot + k] = COLLISION if phy.hurt else FADING
                    phy.eifs_ns = t + c.eifs_ns
        phy.n_air -= 1
        phy.energy_mw = phy.energy_mw - power if phy.n_air > 0 else 0.0
        if power >= c.cca_mw:
            phy.n_strong -= 1
            if phy.n_strong == 0:
                phy.strong_ns += t - phy.strong_since_ns
        is_occupied = phy.phase == LOCKED or phy.packet != NONE
        if phy.busy and not is_occupied and phy.energy_mw < c.cca_mw:
            n = _go_idle(phy, macs[j], air, heap, n, t)
    sender.packet = NONE
    a = np.int64(frame.access)
    sender_mac.slots[a] = _draw_slots(sender_mac, sender.key, air, a)
    sender_mac.since_ns[a] = t
    sender.active = 1
    if sender_mac.gap_ns > 0:
        sender_mac.gate_ns = t + sender_mac.gap_ns
        if sender_mac.n_queued > 0:
            sender_mac.gated = 1
            n = _schedule(heap, n, sender_mac.gate_ns, _GATE, sender_mac)
    if sender.energy_mw < c.cca_mw:
        n = _go_idle(sender, sender_mac, air, heap, n, t)
    return n


@kernel
def _dequeue(mac, packets, a, t):
    """Remove the first packet that can be transmitted in its lifetime, and return it. Drop those before it."""
    while mac.count[a] > 0:
        p = mac.head[a]
        mac.head[a] = packets[p].next
        mac.count[a] -= 1
        mac.n_queued -= 1
        if t + packets[p].airtime_ns <= packets[p].expires_ns:
            return p
        packets[p].outcome = EXPIRED
    return NONE


@kernel
def _enqueue(phy, mac, packets, p, air, heap, n, t):
    """Put a frame into its station's queue. If it is the first, request the medium."""
    a = np.int64(packets[p].access)
    if mac.count[a] >= air.c.queue_max:
        packets[p].outcome = QUEUE
        return n
    if mac.count[a] == 0:
        mac.head[a] = p
    else:
        packets[mac.tail[a]].next = p
    mac.tail[a] = p
    mac.count[a] += 1
    mac.n_queued += 1
    if mac.gap_ns > 0 and t < mac.gate_ns:
        if mac.gated == 0:
            mac.gated = 1
            n = _schedule(heap, n, mac.gate_ns, _GATE, mac)
    elif mac.count[a] == 1:
        _request(phy, mac, air, t, a)
        n = _arm(phy, mac, air.aifs_ns, air.c.slot_ns, heap, n)
    return n


@kernel
def _pending(air, packets, forwarding, heap):
    """Fill the heap with the events scheduled in an earlier window."""
    n = schedule_timers(forwarding, heap.times, heap.codes, np.int64(0))
    for j in range(len(air.phys)):
        mac = air.macs[j]
        if air.phys[j].packet != NONE:
            p = packets[air.phys[j].packet]
            n = _schedule(heap, n, p.start_ns + p.airtime_ns, _END, mac)
        if mac.armed_ns != NEVER:
            n = _schedule(heap, n, mac.armed_ns, _ACCESS, mac)
        if mac.gated:
            n = _schedule(heap, n, mac.gate_ns, _GATE, mac)
    return n


@kernel
def _choose(phy, mac, air, packets, t):
    """The packet that accesses the medium now; NONE if every queue has to wait longer."""
    winner = NONE
    for a in range(N_ACCESS):
        if mac.count[a] == 0:
            continue
        if _access_ns(phy, mac, air.aifs_ns, air.c.slot_ns, a) > t:
            continue
        if winner == NONE:
            winner = _dequeue(mac, packets, a, t)
        else:  # internal collision: the queue of lower priority backs off
            mac.slots[a] = _draw_slots(mac, phy.key, air, a)
            mac.since_ns[a] = t
    return winner


HEAP, NEW, PACKETS, SLOTS = range(4)
"""Progress of the event loop: number of events (-1: not begun), next packet to be generated, packets and outcomes so
far."""


@kernel
def run_until(until_ns, air, log, heap, at, n_given, max_degree, forwarding):
    """Process all events before `until_ns`.

    The packets from `at[NEW]` to `n_given` are generated in this window. Forwarded frames are appended after them.
    Returns True at the end. Returns False if the next event may need more room for forwarding: the caller makes room
    and calls again.
    """
    phys, macs, packets = air.phys, air.macs, log.packets
    n = at[HEAP]
    if n < 0:
        n = _pending(air, packets, forwarding, heap)
    new = at[NEW]
    while True:
        if forwarding.rules.max_hops > 1:
            log_is_full = at[PACKETS] == len(packets) or at[SLOTS] + max_degree > len(log.outcome)
            if log_is_full or is_full(forwarding, max_degree):
                at[HEAP], at[NEW] = n, new
                return False
        t, code = NEVER, 0
        if n > 0:
            t, code = heap.times[0], heap.codes[0]
        if new < n_given:
            frame = packets[new]
            generate = (_GENERATE << 32) | macs[frame.sender].rank
            if comes_before(frame.generated_ns, generate, t, code):
                t, code = frame.generated_ns, generate
        if t >= until_ns:
            break
        kind, which = code >> 32, code & 0xFFFFFFFF
        j = forwarding.copies[which].station if kind == TIMER else air.row_of_rank[which]
        phy, mac = phys[j], macs[j]
        if phy.phase == DETECTING:
            _settle(phy, mac, air, log, t)
        if kind == _GENERATE:
            n = _enqueue(phy, mac, packets, new, air, heap, n, t)
            new += 1
            continue
        n = pop(heap.times, heap.codes, n)
        if kind == _END:
            n = _end(air, log, heap, n, j, t, forwarding)
        elif kind == TIMER:
            if forwarding.copies[which].waits:
                p = at[PACKETS]
                enqueue_forward(forwarding, which, packets[p], phy.key, air.ptr, at[SLOTS], t)
                at[PACKETS] += 1
                at[SLOTS] += packets[p].degree
                n = _enqueue(phy, mac, packets, p, air, heap, n, t)
        elif kind == _GATE:
            mac.gated = 0
            for a in range(N_ACCESS):
                if mac.count[a] > 0:
                    _request(phy, mac, air, t, a)
            n = _arm(phy, mac, air.aifs_ns, air.c.slot_ns, heap, n)
        elif t == mac.armed_ns:
            mac.armed_ns = NEVER
            if phy.busy:
                continue
            winner = _choose(phy, mac, air, packets, t)
            if winner == NONE:
                n = _arm(phy, mac, air.aifs_ns, air.c.slot_ns, heap, n)
            else:
                _start(air, log, j, winner, t)
                n = _schedule(heap, n, t + packets[winner].airtime_ns, _END, mac)
    for j in range(len(phys)):
        phy, mac = phys[j], macs[j]
        if phy.phase == DETECTING:
            _settle(phy, mac, air, log, until_ns)
        if phy.busy:
            phy.busy_ns += until_ns - phy.busy_since_ns
            phy.busy_since_ns = until_ns
        if phy.n_strong > 0:
            phy.strong_ns += until_ns - phy.strong_since_ns
            phy.strong_since_ns = until_ns
    return True
