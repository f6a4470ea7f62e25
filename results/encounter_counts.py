"""What happens in encounters, added to those under way: kernels of `results.encounters`.

`pair` is a << 32 | b of each encounter under way, a < b, and `slot` says where the columns hold it. What an actor does
to another counts as `ab` if it has the smaller number, else as `ba`.
"""

import numpy as np

from cosim.base.kernel import compiled
from cosim.base.ragged import partners


@compiled
def index(pair, slot):
    """The encounters by actor: where those of each begin, then the other actor and the slot of each of them."""
    a, b = pair >> 32, pair & 0xFFFFFFFF
    n = 0
    for k in range(len(pair)):
        n = max(n, b[k] + 1)
    return partners(a, b, slot, n)


@compiled
def slots(begin, partner, held, one, other):
    """Slot of the encounter of each two actors, -1 where none is under way; fast where `one` stays for many rows.

    The first three are what `index` returns.
    """
    n = len(begin) - 1
    found = np.empty(len(one), np.int64)
    last = -1  # the actor in `one` whose encounters `slot_with` holds
    met_by = np.full(n, -1, np.int32)  # of each actor, the last one whose encounters included it
    slot_with = np.empty(n, np.int32)
    for row in range(len(one)):
        if one[row] != last:
            last = one[row]
            if last < n:
                for k in range(begin[last], begin[last + 1]):
                    met_by[partner[k]] = last
                    slot_with[partner[k]] = held[k]
        whom = other[row]
        is_met = whom < n and met_by[whom] == last
        found[row] = slot_with[whom] if is_met else -1
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
