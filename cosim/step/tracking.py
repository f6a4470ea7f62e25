"""What is followed from step to step beside the cycle: inter-reception times, and what happens within encounters."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.radio.message_round import MessageRound, Receptions
from cosim.step.trackers.encounters import EncounterTrackers
from cosim.step.trackers.inter_reception import InterReceptionTracker, reached, unique_pairs
from results.encounters import Rows
from sensors.kernel import compiled
from trust.tables import ObjectLists


def pairs_in_range(happened: MessageRound, n: int) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    """Senders of messages, and the other vehicles within range of them: each pair of station rows once, sorted."""
    frames = happened.frames
    sender, receiver = _first_hops(happened.station, frames.message, frames.receiver, frames.hop, n)
    return unique_pairs(sender, receiver, n)


@compiled
def _first_hops(station, message, receiver, hop, n):
    """Senders and receivers, below n, of the frames that senders transmit themselves."""
    one, other = np.empty(len(message), np.int32), np.empty(len(message), np.int32)
    m = 0
    for row in range(len(message)):
        one[m], other[m] = station[message[row]], receiver[row]
        m += (hop[row] == 1) & (one[m] < n) & (other[m] < n)
    return one[:m], other[:m]


def track_receptions(
    tracker: InterReceptionTracker, step: int, received: Receptions,
    pairs: tuple[Int[ndarray, "p"], Int[ndarray, "p"]], actor: Int[ndarray, "e"], vehicle: Int[ndarray, "m"],
) -> Rows:  # fmt: skip
    """Rows of the table `packet_inter_reception` after a round of messages.

    Parameters
    ----------
    received
        Receptions between vehicles.
    vehicle
        Sender of each message, a station row.
    """
    sender, receiver = pairs
    got = reached(sender, receiver, len(actor), vehicle[received.message], received.receiver)
    return tracker.update(step, actor[sender], actor[receiver], got)


def count_in_encounters(
    trackers: EncounterTrackers, received: tuple[Receptions, ...], used: Receptions, is_known: Bool[ndarray, "m v"],
    lists: ObjectLists, message: Int[ndarray, "d"], actor: Int[ndarray, "e"], vehicle: Int[ndarray, "m"],
) -> None:  # fmt: skip
    """Add a step's messages, lookups and evaluations to the encounters under way.

    Parameters
    ----------
    is_known
        Whether the trust looked up rests on an evaluation: rows as in `used`, a column per trust variant.
    message
        Of each detection.
    vehicle
        Sender of each message, a station row.
    """
    for found in received:
        trackers.count_messages(actor[vehicle[found.message]], actor[found.receiver])
    trackers.note_trust(actor[used.receiver], actor[vehicle[used.message]], is_known)
    evaluator, observer, n = _evaluated(lists.ptr, lists.member, message, vehicle)
    trackers.count_evaluations(actor[evaluator], actor[observer], n)


@compiled
def _evaluated(ptr, member, message, vehicle):
    """Whose detections each list holds, and how many; a list's own are left out. Lists go by message."""
    one, other, n = np.empty(len(member), np.int32), np.empty(len(member), np.int32), np.empty(len(member), np.int64)
    m = 0
    for v in range(len(ptr) - 1):
        last = v
        for k in range(ptr[v], ptr[v + 1]):
            observer = vehicle[message[member[k]]]
            if observer == v:
                last = v
                continue
            if observer != last:
                one[m], other[m], n[m] = v, observer, 0
                m += 1
                last = observer
            n[m - 1] += 1
    return one[:m], other[:m], n[:m]
