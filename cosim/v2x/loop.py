"""The air as a sequence of events: carrier sense, back-off, interference and reception, packet by packet.

One binary heap of (time, kind, rank of the radio by key); generations are merged in from the sorted packets.
A preamble is decided 4 µs after it arrives: lazily, when the receiver is next touched. Times are integer
nanoseconds and powers mW. A radio has one frame on the air at most, so a frame is named by its sender's row.
"""

import numpy as np

from cosim.rng import mix, unit
from cosim.v2x.kernel import inlined, kernel, pop, push
from cosim.v2x.reception import HEADER_NS, PREAMBLE_NS
from cosim.v2x.records import (
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
    NOBODY,
    QUEUE,
    RANGE,
    RECEIVED,
)  # fmt: skip
from cosim.v2x.relays import RELAY, hear, is_full, speak, wait

_END, _GENERATE, _GATE, _ACCESS = range(4)
_TO_QUANTILE = np.uint64(52)
_BACKOFF = np.uint64(0xB0)
_PAYLOAD = np.uint64(0xF0)


@kernel
def _draw_slots(mac, key, chance, cw):
    h = mix(mix(mix(chance, _BACKOFF), key), np.uint64(mac.n_draws))
    mac.n_draws += 1
    return np.int32(unit(h) * (cw + 1))


@kernel
def _elapse(phy, mac, aifs_ns, c, t):
    """Count back-offs down over the idle time until `t`."""
    free_ns = max(phy.idle_ns, phy.eifs_ns)
    phy.active = mac.n_queued > 0
    for a in range(N_ACCESS):
        if mac.slots[a] > 0:
            start = max(free_ns + aifs_ns[a], mac.since_ns[a])
            if t > start:
                k = min((t - start) // c.slot_ns, mac.slots[a])
                mac.slots[a] -= k
                mac.since_ns[a] = start + k * c.slot_ns
            if mac.slots[a] > 0:
                phy.active = 1


@inlined
def _go_busy(phy, mac, aifs_ns, c, t):
    if phy.busy == 0:
        phy.busy = 1
        phy.busy_since_ns = t
        if phy.active:
            _elapse(phy, mac, aifs_ns, c, t)


@kernel
def _access_ns(phy, mac, aifs_ns, c, a):
    return max(max(phy.idle_ns, phy.eifs_ns) + aifs_ns[a], mac.since_ns[a]) + mac.slots[a] * c.slot_ns


@kernel
def _arm(phy, mac, aifs_ns, c, times, codes, n):
    """Schedule the radio's next access, if it has something to send and may."""
    if mac.n_queued == 0 or mac.gated or phy.busy:
        return n
    soonest = NEVER
    for a in range(N_ACCESS):
        if mac.count[a] > 0:
            soonest = min(soonest, _access_ns(phy, mac, aifs_ns, c, a))
    if soonest < mac.armed_ns:  # an earlier event looks again when it fires
        mac.armed_ns = soonest
        n = push(times, codes, n, soonest, (_ACCESS << 32) | mac.rank)
    return n


@inlined
def _go_idle(phy, mac, aifs_ns, c, times, codes, n, t):
    phy.busy = 0
    phy.idle_ns = t
    phy.busy_ns += t - phy.busy_since_ns
    if phy.active:
        n = _arm(phy, mac, aifs_ns, c, times, codes, n)
    return n


@kernel
def _request(phy, mac, aifs_ns, cw, c, chance, t, a):
    """A queue that was empty asks for the medium: at once if idle, else after a back-off."""
    if phy.busy:
        if mac.slots[a] == 0:
            mac.slots[a] = _draw_slots(mac, phy.key, chance, cw[a])
    else:
        _elapse(phy, mac, aifs_ns, c, t)
        if mac.slots[a] == 0:
            mac.since_ns[a] = t + aifs_ns[a]
    phy.active = 1


@inlined
def _close(phy, radios, packets, c, t):
    """Judge the payload received since the last change of interference."""
    if t > phy.chunk_ns:
        if phy.n_air > 1:
            phy.hurt = 1
        unwanted_mw = c.noise_mw + max(phy.energy_mw - phy.frame_mw, 0.0)
        if phy.frame_mw < c.sinr_clean * unwanted_mw:
            p = packets[radios[phy.frame_from].packet]
            share = (t - phy.chunk_ns) / (p.airtime_ns - HEADER_NS)
            error = np.exp(c.curve_a - c.curve_b * np.log(phy.frame_mw / unwanted_mw))
            phy.log_psr -= share * (p.payload_bytes + c.overhead_bytes) / 336.0 * error
        phy.chunk_ns = t


@inlined
def _settle(phy, mac, radios, packets, cause, aifs_ns, c, t):
    """Decide a preamble whose detection time is over: lock, or miss it."""
    due = phy.frame_ns + PREAMBLE_NS
    if t < due:
        return
    phy.phase = FREE
    if phy.frame_mw >= c.detectable_mw:
        if phy.frame_mw >= c.sinr_min * (c.noise_mw + max(phy.energy_mw - phy.frame_mw, 0.0)):
            phy.phase = LOCKED
            phy.chunk_ns = phy.frame_ns + HEADER_NS
            phy.log_psr = 0.0
            phy.hurt = 0
        else:
            cause[_slot(phy, radios, packets)] = COLLISION
    if phy.phase == LOCKED or phy.energy_mw >= c.cca_mw:
        _go_busy(phy, mac, aifs_ns, c, due)


@inlined
def _slot(phy, radios, packets):
    """Where the fate of the frame at hand is written."""
    return packets[radios[phy.frame_from].packet].slot + phy.frame_edge


@kernel
def _start(radios, macs, s, packet, packets, edges, cause, receiver, aifs_ns, quantiles, c, chance, t):
    """A frame goes on the air: what each neighbour's receiver makes of its first microseconds."""
    ear = radios[s]
    if ear.phase == DETECTING and ear.frame_mw >= c.detectable_mw:
        cause[_slot(ear, radios, packets)] = HALF_DUPLEX
    ear.phase = FREE
    _go_busy(ear, macs[s], aifs_ns, c, t)
    ear.packet = packet
    frame = packets[packet]
    frame.start_ns = t
    frame.fate = RECEIVED
    prefix = mix(mix(chance, ear.key), frame.seq)
    edge_receiver, edge_mw, edge_fading, arrival_mw = edges
    first, slot = frame.edge, frame.slot
    for k in range(frame.degree):
        e = first + k
        j = edge_receiver[e]
        phy = radios[j]
        h = mix(prefix, phy.key)
        mean_mw = edge_mw[e]
        power = np.float64(mean_mw * quantiles[edge_fading[e], np.int64(h >> _TO_QUANTILE)])
        receiver[slot + k] = j
        detectable = power >= c.detectable_mw
        fate = BUSY if detectable else FADING if mean_mw >= c.detectable_mw else RANGE
        if power < c.floor_mw:
            arrival_mw[e] = 0.0
            cause[slot + k] = fate
            continue
        arrival_mw[e] = power
        if phy.phase == DETECTING:
            _settle(phy, macs[j], radios, packets, cause, aifs_ns, c, t)
        if phy.phase == LOCKED:
            _close(phy, radios, packets, c, t)
            if detectable and t - phy.frame_ns <= c.capture_ns and power > c.capture_ratio * phy.frame_mw:
                cause[_slot(phy, radios, packets)] = COLLISION
                phy.phase = FREE
        phy.energy_mw += power
        phy.n_air += 1
        if power >= c.cca_mw:
            if phy.n_strong == 0:
                phy.strong_since_ns = t
            phy.n_strong += 1
        if phy.packet != NOBODY:
            if detectable:
                fate = HALF_DUPLEX
        elif (phy.phase == FREE or (phy.phase == DETECTING and power > phy.frame_mw)) and (
            # A weak frame matters only where it tips carrier sense.
            detectable or (phy.phase == FREE and phy.busy == 0 and phy.energy_mw >= c.cca_mw)
        ):
            if phy.phase == DETECTING and phy.frame_mw >= c.detectable_mw:
                cause[_slot(phy, radios, packets)] = BUSY
            phy.phase = DETECTING
            phy.frame_from = s
            phy.frame_edge = k
            phy.frame_mw = power
            phy.frame_ns = t
        cause[slot + k] = fate


@kernel
def _end(radios, macs, s, packets, edges, cause, aifs_ns, cw, c, chance, times, codes, n, t, passing):
    """A frame leaves the air: payloads are decided, media fall idle."""
    ear, mouth = radios[s], macs[s]
    frame = packets[ear.packet]
    number = frame.tag - passing.rules.first_tag if passing.rules.max_hops > 1 else NOBODY
    prefix = mix(mix(chance, ear.key), frame.seq)
    edge_receiver, _, _, arrival_mw = edges
    first, slot = frame.edge, frame.slot
    for k in range(frame.degree):
        power = np.float64(arrival_mw[first + k])
        if power == 0.0:
            continue
        j = edge_receiver[first + k]
        phy = radios[j]
        if phy.phase == DETECTING:
            _settle(phy, macs[j], radios, packets, cause, aifs_ns, c, t)
        if phy.phase == LOCKED:
            _close(phy, radios, packets, c, t)
            if phy.frame_from == s:
                phy.phase = FREE
                h = mix(mix(prefix, phy.key), _PAYLOAD)
                if phy.log_psr == 0.0 or unit(h) < np.exp(phy.log_psr):
                    cause[slot + k] = RECEIVED
                    phy.eifs_ns = 0
                    if number >= 0:
                        n = hear(passing, passing.frames[number], j, t, times, codes, n)
                else:
                    cause[slot + k] = COLLISION if phy.hurt else FADING
                    phy.eifs_ns = t + c.eifs_ns
        phy.n_air -= 1
        phy.energy_mw = phy.energy_mw - power if phy.n_air > 0 else 0.0
        if power >= c.cca_mw:
            phy.n_strong -= 1
            if phy.n_strong == 0:
                phy.strong_ns += t - phy.strong_since_ns
        if phy.busy and phy.phase != LOCKED and phy.packet == NOBODY and phy.energy_mw < c.cca_mw:
            n = _go_idle(phy, macs[j], aifs_ns, c, times, codes, n, t)
    ear.packet = NOBODY
    a = frame.access
    mouth.slots[a] = _draw_slots(mouth, ear.key, chance, cw[a])
    mouth.since_ns[a] = t
    ear.active = 1
    if mouth.gap_ns > 0:
        mouth.gate_ns = t + mouth.gap_ns
        if mouth.n_queued > 0:
            mouth.gated = 1
            n = push(times, codes, n, mouth.gate_ns, (_GATE << 32) | mouth.rank)
    if ear.energy_mw < c.cca_mw:
        n = _go_idle(ear, mouth, aifs_ns, c, times, codes, n, t)
    return n


@kernel
def _take(mac, packets, a, t):
    """Next packet of a queue that is still alive; expired ones are dropped on the way."""
    while mac.count[a] > 0:
        p = mac.head[a]
        mac.head[a] = packets[p].next
        mac.count[a] -= 1
        mac.n_queued -= 1
        if packets[p].expires_ns >= t:
            return p
        packets[p].fate = EXPIRED
    return NOBODY


@kernel
def _join(phy, mac, packets, p, aifs_ns, cw, c, chance, times, codes, n, t):
    """A frame comes into its radio's queue, and asks for the medium where nothing is before it."""
    a = packets[p].access
    if mac.count[a] >= c.queue_max:
        packets[p].fate = QUEUE
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
            n = push(times, codes, n, mac.gate_ns, (_GATE << 32) | mac.rank)
    elif mac.count[a] == 1:
        _request(phy, mac, aifs_ns, cw, c, chance, t, a)
        n = _arm(phy, mac, aifs_ns, c, times, codes, n)
    return n


@kernel
def _pending(radios, macs, packets, passing, times, codes):
    """The heap of what an earlier window has set in motion."""
    n = wait(passing, times, codes, 0)
    for j in range(len(radios)):
        mac = macs[j]
        if radios[j].packet != NOBODY:
            p = packets[radios[j].packet]
            n = push(times, codes, n, p.start_ns + p.airtime_ns, (_END << 32) | mac.rank)
        if mac.armed_ns != NEVER:
            n = push(times, codes, n, mac.armed_ns, (_ACCESS << 32) | mac.rank)
        if mac.gated:
            n = push(times, codes, n, mac.gate_ns, (_GATE << 32) | mac.rank)
    return n


HEAP, NEW, PACKETS, SLOTS = range(4)
"""Where the loop stands: events (-1: not begun), next packet to come, packets and outcomes so far."""


@kernel
def run_until(
    until_ns, radios, macs, row_of_rank, packets, at, n_given, ptr, max_degree, edges, cause, receiver,
    aifs_ns, cw, quantiles, c, chance, times, codes, passing,
):  # fmt: skip
    """Play all events before `until_ns`. Packets from `at[NEW]` to `n_given` come in by generation; relays go behind.

    Returns False, to be called again with more room, when the next event might not find enough for relays.
    """
    n = at[HEAP]
    if n < 0:
        n = _pending(radios, macs, packets, passing, times, codes)
    new = at[NEW]
    while True:
        if passing.rules.max_hops > 1 and (
            is_full(passing, max_degree) or at[PACKETS] == len(packets) or at[SLOTS] + max_degree > len(cause)
        ):
            at[HEAP], at[NEW] = n, new
            return False
        t, code = (times[0], codes[0]) if n > 0 else (NEVER, 0)
        if new < n_given:
            frame = packets[new]
            generate = (_GENERATE << 32) | macs[frame.sender].rank
            if frame.generated_ns < t or (frame.generated_ns == t and generate < code):
                t, code = frame.generated_ns, generate
        if t >= until_ns:
            break
        kind, who = code >> 32, code & 0xFFFFFFFF
        j = passing.copies[who].radio if kind == RELAY else row_of_rank[who]
        phy, mac = radios[j], macs[j]
        if phy.phase == DETECTING:
            _settle(phy, mac, radios, packets, cause, aifs_ns, c, t)
        if kind == _GENERATE:
            n = _join(phy, mac, packets, new, aifs_ns, cw, c, chance, times, codes, n, t)
            new += 1
            continue
        n = pop(times, codes, n)
        if kind == _END:
            n = _end(radios, macs, j, packets, edges, cause, aifs_ns, cw, c, chance, times, codes, n, t, passing)
        elif kind == RELAY:
            if passing.copies[who].waits:
                p = at[PACKETS]
                speak(passing, who, packets[p], phy.key, ptr, at[SLOTS], t)
                at[PACKETS] += 1
                at[SLOTS] += packets[p].degree
                n = _join(phy, mac, packets, p, aifs_ns, cw, c, chance, times, codes, n, t)
        elif kind == _GATE:
            mac.gated = 0
            for a in range(N_ACCESS):
                if mac.count[a] > 0:
                    _request(phy, mac, aifs_ns, cw, c, chance, t, a)
            n = _arm(phy, mac, aifs_ns, c, times, codes, n)
        elif t == mac.armed_ns:
            mac.armed_ns = NEVER
            if phy.busy:
                continue
            winner = NOBODY
            for a in range(N_ACCESS):
                if mac.count[a] > 0 and _access_ns(phy, mac, aifs_ns, c, a) <= t:
                    if winner == NOBODY:
                        winner = _take(mac, packets, a, t)
                    else:  # two queues of one radio collide: the lower one backs off
                        mac.slots[a] = _draw_slots(mac, phy.key, chance, cw[a])
                        mac.since_ns[a] = t
            if winner == NOBODY:
                n = _arm(phy, mac, aifs_ns, c, times, codes, n)
            else:
                frame = packets[winner]
                _start(radios, macs, j, winner, packets, edges, cause, receiver, aifs_ns, quantiles, c, chance, t)
                n = push(times, codes, n, t + frame.airtime_ns, (_END << 32) | mac.rank)
    for j in range(len(radios)):
        phy, mac = radios[j], macs[j]
        if phy.phase == DETECTING:
            _settle(phy, mac, radios, packets, cause, aifs_ns, c, until_ns)
        if phy.busy:
            phy.busy_ns += until_ns - phy.busy_since_ns
            phy.busy_since_ns = until_ns
        if phy.n_strong > 0:
            phy.strong_ns += until_ns - phy.strong_since_ns
            phy.strong_since_ns = until_ns
    return True
