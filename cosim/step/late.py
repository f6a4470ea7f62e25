"""Messages that arrive later than the round in which they were sent: what they are, and who received them."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.base.ragged import distinct, rows_of
from cosim.radio.message_round import EarlierMessages, LinkReceptions, MessageRound, Receptions, RoundKind, by_link
from cosim.step.exchange import Exchange
from cosim.step.known import Uses


@dataclass(frozen=True, slots=True)
class LateMessages:
    """M messages of one kind that went on after their own round, and what happened to them in a round of this step.

    Copies of one message are messages of their own here.
    """

    kind: RoundKind
    step: Int[ndarray, "m"]
    """Step in which each message was sent."""
    sender: Int[ndarray, "m"]
    """As `Exchange.sender`; -1 for roadside units and for senders whose messages are not accepted."""
    author: Int[ndarray, "m"]
    """The same, but also of senders whose messages are not accepted: they are received, and then dropped."""
    round: MessageRound
    links: LinkReceptions

    @staticmethod
    def of(earlier: EarlierMessages, n_vehicles: int) -> "LateMessages":
        """From the result of a round; the first `n_vehicles` stations are vehicles."""
        name, links = earlier.name, by_link(earlier.round, n_vehicles)
        author = np.where(name < -1, not_accepted(name), name)
        return LateMessages(earlier.kind, earlier.step, name.clip(-1), author, earlier.round, links)

    def pairs(self) -> tuple[Int[ndarray, "r"], Int[ndarray, "r"]]:
        """For each reception of a vehicle's message by a vehicle: actor number of the sender, row of the receiver."""
        found = self.of_vehicles()
        return self.author[found.message] >> 16, found.receiver

    def of_vehicles(self) -> Receptions:
        """Receptions by vehicles of the messages of vehicles: in the order of `pairs`."""
        found = self.links.vehicles
        return found.take(self.author[found.message] >= 0)


def not_accepted(name: Int[ndarray, "m"]) -> Int[ndarray, "m"]:
    """Name on the air of a message whose sender is not accepted, from `Exchange.sender`; and the other way round."""
    return -2 - name


def of_this_step(exchange: Exchange, late: Iterable[LateMessages], kind: RoundKind) -> list[Receptions]:
    """Receptions of detection messages of this step that arrived during the round of evaluation messages.

    Messages are rows of `Senders`, as in the receptions of their own round.
    """
    found = []
    for messages in late:
        if messages.kind == kind:
            row, is_there = rows_of(messages.sender, exchange.sender)
            is_there &= messages.step == exchange.now.step
            got = messages.links.vehicles.take(is_there[messages.links.vehicles.message])
            found.append(replace(got, message=row[got.message]))
    return found


def joined(parts: list[Receptions]) -> Uses:
    """Receivers and messages of all receptions, each pair once, sorted by receiver, then message."""
    keys = [Uses(part.receiver, part.message).key() for part in parts]
    found, _ = distinct(np.concatenate(keys))
    return Uses.of_key(found)
