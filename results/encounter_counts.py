"""What happens in encounters, added to those under way: kernels of `results.encounters`.

`pair` is a << 32 | b of each encounter under way, a < b, and `slot` says where the columns hold it. What an actor does
to another counts as `ab` if it has the smaller number, else as `ba`.
"""

import numpy as np

from cosim.base.kernel import compiled


@compiled
def slots(pair, slot, one, other):
    """Slot of the encounter of each two actors, -1 where none is under way; fast where `one` stays for many rows."""
    n = 0
    for k in range(len(pair)):
        n = max(n, (pair[k] & 0xFFFFFFFF) + 1)
    begin = np.zeros(n + 1, np.int64)  # where the encounters of each actor begin
    for k in range(len(pair)):
        begin[(pair[k] >> 32) + 1] += 1
        begin[(pair[k] & 0xFFFFFFFF) + 1] += 1
    for actor in range(n):
        begin[actor + 1] += begin[actor]
    put = begin[:-1].copy()
    partner = np.empty(2 * len(pair), np.int32)
    held = np.empty(2 * len(pair), np.int32)
    for k in range(len(pair)):
        a, b = pair[k] >> 32, pair[k] & 0xFFFFFFFF
        partner[put[a]] = b
        partner[put[b]] = a
        held[put[a]] = slot[k]
        held[put[b]] = slot[k]
        put[a] += 1
        put[b] += 1
    found = np.empty(len(one), np.int64)
    now = -1
    of = np.full(n, -1, np.int32)
    at = np.empty(n, np.int32)
    for row in range(len(one)):
        if one[row] != now:
            now = one[row]
            if now < n:
                for k in range(begin[now], begin[now + 1]):
                    of[partner[k]] = now
                    at[partner[k]] = held[k]
        whom = other[row]
        found[row] = at[whom] if whom < n and of[whom] == now else -1
    return found


@compiled
def count(at, one, other, n, in_contact, ab, ba, later_ab, later_ba):
    """Add `n` to the counters of each slot; 1 each where `n` is empty. Slots that are not in contact have others."""
    for row in range(len(at)):
        k = at[row]
        if k >= 0:
            if in_contact[k]:
                counter = ab if one[row] < other[row] else ba
            else:
                counter = later_ab if one[row] < other[row] else later_ba
            counter[k] += n[row] if len(n) else 1


@compiled
def note(at, one, other, seen, step, ab, ba, step_ab, step_ba):
    """Write down the step in which something is seen for the first time; a column per trust variant."""
    for row in range(len(at)):
        k = at[row]
        if k < 0:
            continue
        is_ab = one[row] < other[row]
        known, since = (ab, step_ab) if is_ab else (ba, step_ba)
        for variant in range(seen.shape[1]):
            if seen[row, variant] and not known[k, variant]:
                known[k, variant] = True
                since[k, variant] = step
