"""What is followed from step to step beside the cycle: inter-reception times, and what happens within encounters."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.radio.message_round import MessageRound, Receptions
from cosim.ragged import counting_order
from cosim.trackers.encounters import EncounterTrackers
from cosim.trackers.inter_reception import InterReceptionTracker, contained, unique_pairs
from results.encounters import Rows
from trust.tables import ObjectLists


def pairs_in_range(happened: MessageRound, n: int) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    """Senders of messages, and the other vehicles within range of them: each pair of station rows once, sorted."""
    frames = happened.frames
    sender = happened.station[frames.message]
    own = np.flatnonzero((frames.hop == 1) & (sender < n) & (frames.receiver < n))
    return unique_pairs(sender[own].astype(np.int64), frames.receiver[own].astype(np.int64), n)


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
    n = len(actor)
    order = counting_order(vehicle[received.message], n)  # receptions go by receiver
    got = contained(sender, receiver, vehicle[received.message[order]], received.receiver[order])
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
    evaluator, observer = lists.of_member(), vehicle[message[lists.member]]
    others, n = evaluator != observer, len(actor)
    pair = evaluator[others] * n + observer[others]
    begins = np.flatnonzero(np.diff(pair, prepend=-1))  # lists go by evaluator, then by message
    count = np.diff(begins, append=len(pair))
    trackers.count_evaluations(actor[pair[begins] // n], actor[pair[begins] % n], count)
