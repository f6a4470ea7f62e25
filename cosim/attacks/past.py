"""What attackers had in earlier messages. Vehicles send at different steps: an age in messages is no age in steps."""

from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.attacks.attack import AttackContext, per_actor
from cosim.base.ragged import rows_of

T = TypeVar("T")


def of_earlier_messages(
    context: AttackContext, sends: Bool[ndarray, "n"], items: T, by: Int[ndarray, "k"], n_messages: int
) -> list[tuple[T, Int[ndarray, "r"], Int[ndarray, "r"]]]:
    """Store the items of this step's messages, and return those of the messages `n_messages` before.

    Parameters
    ----------
    context
        Its memory has the items, under "past", and the number of messages of each actor, under "n_messages".
    sends
        Actors that have a message in this step, by row of the world.
    items
        Anything that has K rows.
    by
        Actor of each item: row of the world.
    n_messages
        Age of the items that are returned, in messages of their actor.

    Returns
    -------
    By the step of the items, oldest first: the items of that step, which of them are so old, and the actor of each of
    these as a row of the world. An actor with fewer messages has those of its oldest message. Items of actors that
    have left the road are forgotten.
    """
    actor = context.world.actor
    number = per_actor(context, "n_messages", np.zeros(len(actor), bool), 0.0)
    per_actor(context, "n_messages", sends, number + 1)
    past = context.memory.get("past", [])
    oldest, searched = number - n_messages, sends.copy()
    kept, found = [], []
    for of_step in [*past, (items, actor[by], number[by])]:
        old, of, at = of_step
        row, is_needed = rows_of(of, actor)
        is_needed &= at >= oldest[row]
        if is_needed.any():
            kept.append(of_step)
        here = np.flatnonzero(is_needed & searched[row])
        if len(here):
            found.append((old, here, row[here]))
            searched[row[here]] = False
    context.memory["past"] = kept
    return found
