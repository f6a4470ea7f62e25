"""Tracks inter-reception times, encounters and starts of attacks from step to step. The cycle does not read them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.base.ragged import distinct, rows_of
from cosim.radio.message_round import RoundKind
from cosim.step.broadcast import Broadcast
from cosim.step.comparing import Compared
from cosim.step.evaluate import Evaluated
from cosim.step.exchange import Exchange
from cosim.step.inbox import Inbox
from cosim.step.known import Known
from cosim.step.late import LateMessages
from cosim.step.listing import Listed
from cosim.step.perception import Observed
from cosim.step.trackers.attack_start import AttackStartTracker
from cosim.step.trackers.encounters import Encounters
from cosim.step.trackers.inter_reception import InterReceptionTracker, pairs_within_range
from cosim.step.trust import LookedUp
from results.encounters import Rows

Rounds = tuple[Broadcast, Broadcast]
"""The rounds of detection messages and of evaluation messages."""
_ROW_BITS = 20
"""There are fewer than 2^20 vehicles in a step."""

ReceptionTrackers = tuple[InterReceptionTracker, InterReceptionTracker]
"""The trackers of the same two rounds."""


@dataclass(frozen=True, slots=True)
class Reach:
    """Messages within range in one round, and the inter-reception times that ended."""

    n_in_range: Int[ndarray, "n"]
    """For each of `Vehicles`, the messages of vehicles within whose range it is."""
    inter_reception: Rows
    """Columns of the table `packet_inter_reception`."""


def track_receptions(
    trackers: ReceptionTrackers, exchange: Exchange, rounds: Rounds, inbox: Inbox
) -> tuple[Rounds, ReceptionTrackers, tuple[Reach, Reach]]:
    """Update the inter-reception times with both rounds; return the vehicles in range and the ended intervals.

    The rounds are returned as `_without_late_copies`.
    """
    rounds = _without_late_copies(rounds, exchange, inbox)
    first, cpms = _track_round(trackers[0], exchange, rounds, RoundKind.CPM)
    second, reports = _track_round(trackers[1], exchange, rounds, RoundKind.EVALUATION)
    return rounds, (first, second), (cpms, reports)


def _track_round(
    tracker: InterReceptionTracker, exchange: Exchange, rounds: Rounds, kind: RoundKind
) -> tuple[InterReceptionTracker, Reach]:
    broadcast = rounds[kind]
    actor, received, found = exchange.vehicles.actor, broadcast.links.vehicles, broadcast.round
    frames = found.frames
    # The type for which the kernel is compiled.
    given = frames.message, frames.receiver, received.message, received.receiver
    message, receiver, heard, heard_by = (np.asarray(rows, np.int32) for rows in given)
    sent = exchange.senders.vehicle[broadcast.length_bytes > 0]
    n_sent = np.bincount(sent, minlength=len(actor))
    pair, got, n_in_range = pairs_within_range(
        found.station, message, receiver, frames.hop, exchange.senders.vehicle, heard, heard_by, actor, n_sent
    )
    step = exchange.now.step
    late = late_of(rounds, kind)
    if late:  # a message that arrives late counts in the step in which it arrives
        of_vehicles = [messages.of_vehicles() for messages in late]
        sent_in = [messages.step[found.message] for messages, found in zip(late, of_vehicles, strict=True)]
        arrived = np.concatenate([_codes(actor, messages) for messages in late])
        is_direct = np.concatenate([found.hops == 1 for found in of_vehicles])
        is_earlier = np.concatenate(sent_in) < step
        row, is_there = rows_of(arrived, pair)
        got[row[is_there]] = True
        _, was_in_range = rows_of(arrived, tracker.pair)
        in_range = is_direct | (is_earlier & was_in_range)  # else the message was forwarded beyond range
        new, _ = distinct(arrived[~is_there & in_range])
        at = np.searchsorted(pair, new)
        pair, got = np.insert(pair, at, new), np.insert(got, at, True)
    silent = actor[n_sent == 0]
    tracker, rows = tracker.next(step, pair, got, silent)
    return tracker, Reach(n_in_range, rows)


def _codes(actor: Int[ndarray, "n"], messages: LateMessages) -> Int[ndarray, "r"]:
    """Pairs of sender and receiver of messages that arrived late, as `InterReceptionTracker.pair`."""
    sender, receiver = messages.pairs()
    return sender << 32 | actor[receiver]


def late_of(rounds: Rounds, kind: RoundKind, clouds: bool = False) -> list[LateMessages]:
    """Messages of one kind that went on in a round of this step, or the clouds that were sent behind them."""
    late = (one for broadcast in rounds for one in (broadcast.late_clouds if clouds else broadcast.late))
    return [messages for messages in late if messages.kind == kind]


def _without_late_copies(rounds: Rounds, exchange: Exchange, inbox: Inbox) -> Rounds:
    """The rounds, in which no vehicle receives a late copy of a detection message that it has already.

    Late copies of a message are messages of their own (`LateMessages`), and an attacker may send many. `inbox` has the
    messages of earlier steps and who received them before this step.
    """
    late = late_of(rounds, RoundKind.CPM)
    if not late:
        return rounds
    numbers = [_numbers(messages, exchange, inbox) for messages in late]
    seen = _received(rounds[RoundKind.CPM], np.concatenate(numbers), exchange, inbox)
    found = []
    for broadcast in rounds:
        kept = []
        for messages in broadcast.late:
            if messages.kind == RoundKind.CPM:
                first, codes = _first_receptions(messages, numbers.pop(0), seen)
                seen = np.append(seen, codes)
                links = messages.links._replace(vehicles=messages.links.vehicles.take(first))
                messages = replace(messages, links=links)
            kept.append(messages)
        found.append(replace(broadcast, late=tuple(kept)))
    return found[0], found[1]


def _numbers(messages: LateMessages, exchange: Exchange, inbox: Inbox) -> Int[ndarray, "m"]:
    """A number for each message: its row in the inbox, behind which follow those of this step; -1 if unknown."""
    row, is_earlier = inbox.rows(messages.step, messages.sender)
    now, is_now = rows_of(messages.author, exchange.sender)
    is_now &= messages.step == exchange.now.step
    row = np.where(is_now, len(inbox.step) + now, row)
    return np.where(is_now | is_earlier, row, -1)


def _received(broadcast: Broadcast, asked: Int[ndarray, "m"], exchange: Exchange, inbox: Inbox) -> Int[ndarray, "r"]:
    """A number for each message that is asked and each vehicle that received it, in its own round or earlier."""
    is_asked = np.zeros(len(inbox.step) + len(exchange.senders), bool)
    is_asked[asked[asked >= 0]] = True
    held = inbox.cpms
    rows = np.flatnonzero(is_asked[held.message])
    receiver, is_there = rows_of(held.receiver[rows], exchange.vehicles.actor)
    before = held.message[rows[is_there]] << _ROW_BITS | receiver[is_there]
    now = broadcast.links.vehicles
    number = len(inbox.step) + now.message
    rows = np.flatnonzero(is_asked[number])
    return np.append(before, number[rows] << _ROW_BITS | now.receiver[rows])


def _first_receptions(
    messages: LateMessages, number: Int[ndarray, "m"], seen: Int[ndarray, "r"]
) -> tuple[Int[ndarray, "k"], Int[ndarray, "c"]]:
    """Rows of receptions that are no copies, and the numbers of those of known messages, as in `_received`.

    Receptions of unknown messages, such as earlier ones that are not accepted, are kept as they are.
    """
    received = messages.links.vehicles
    of_message = number[received.message]
    is_known = of_message >= 0
    by_time = np.argsort(received.received_s, kind="stable")
    by_time = by_time[is_known[by_time]]
    codes = of_message << _ROW_BITS | received.receiver
    found, first = np.unique(codes[by_time], return_index=True)
    is_new = ~np.isin(found, seen)
    is_kept = ~is_known
    is_kept[by_time[first[is_new]]] = True
    return np.flatnonzero(is_kept), found[is_new]


def count_in_encounters(
    encounters: Encounters,
    exchange: Exchange,
    rounds: Rounds,
    looked_up: LookedUp,
    messages: Known,
    compared: Compared,
) -> Encounters:
    """Add a step's messages, look-ups and evaluations to the open encounters."""
    actor, vehicle = exchange.vehicles.actor, messages.vehicle
    used, lists, row = looked_up.messages, compared.lists, exchange.vehicles.senses
    is_known = np.stack([found.is_known for found in looked_up.lookups], axis=1)
    by = row[lists.of_member()]
    observer = vehicle[messages.detections.message[lists.member]]
    is_new = messages.is_new(lists.of_member(), lists.member)
    by, observer = by[is_new], observer[is_new]
    pair = by * len(actor) + observer
    pairs, n = distinct(pair[by != observer])
    evaluator, observer = np.divmod(pairs, max(len(actor), 1))
    for tracker in encounters:
        for broadcast in rounds:
            found = broadcast.links.vehicles
            tracker.count_messages(actor[vehicle[found.message]], actor[found.receiver])
            for late in broadcast.late:
                sender, receiver = late.pairs()
                tracker.count_messages(sender, actor[receiver])
        user, sender = row[used.receiver], vehicle[used.message]
        tracker.note_trust(actor[user], actor[sender], is_known)
        tracker.count_evaluations(actor[evaluator], actor[observer], n)
    return encounters


def track_attacks(
    attack_start: AttackStartTracker, exchange: Exchange, observed: Observed, listed: Listed, evaluated: Evaluated
) -> AttackStartTracker:
    """Note the vehicles that attack: with false detections or evaluations, with phantoms, or on the channel."""
    vehicles, sending = exchange.vehicles, exchange.sending
    attacker = [exchange.world.actor[listed.objects.observer[listed.truth.lied]]]
    if observed.caused_by is not None:
        attacker.append(exchange.world.actor[observed.caused_by[observed.caused_by >= 0]])
    if evaluated.lied.any():
        by = evaluated.lists.owner[evaluated.lists.of_member()[evaluated.lied]]
        attacker.append(vehicles.actor[exchange.senders.vehicle[by]])
    if sending is not None:
        jams = (sending.jam_dbm > -np.inf) | (sending.react_dbm > -np.inf)
        floods = (sending.n_copies > 0) | (sending.n_reports > 0)
        attacker.append(vehicles.actor[(sending.delay_s > 0) | floods | jams])
    return attack_start.next(exchange.now.step, np.concatenate(attacker))
