"""The newest sweep and the newest messages of each vehicle, for vehicles that sense at different times."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.law.opportunities import ViewTimes
from cosim.base.ragged import offsets, ranges
from cosim.base.rows import Rows


@dataclass(frozen=True, slots=True)
class NewestReceived(Rows):
    """The newest message of each sender: with which probability each other vehicle has received it."""

    sender: Int[ndarray, "p"]
    """Actor number."""
    receiver: Int[ndarray, "p"]
    p: Float[ndarray, "p"]
    apart_m: Float[ndarray, "p"]
    """Distance of the two when it was sent."""

    @staticmethod
    def none() -> "NewestReceived":
        """No messages."""
        no_number, no_value = np.zeros(0, np.int64), np.zeros(0)
        return NewestReceived(no_number, no_number, no_value, no_value)

    def then(self, newer: "NewestReceived", senders: Int[ndarray, "s"], present: Int[ndarray, "v"]) -> "NewestReceived":
        """These messages after some vehicles have sent newer ones, without vehicles that have left the road.

        Parameters
        ----------
        newer
            The newer messages.
        senders, present
            Actor numbers of those that have sent, and of all equipped vehicles, ascending.
        """
        are_present = np.isin(self.sender, present) & np.isin(self.receiver, present)
        kept = ~np.isin(self.sender, senders) & are_present
        return NewestReceived.concat([self.take(kept), newer])

    def by(self, receivers: Int[ndarray, "r"]) -> "NewestReceived":
        """The messages that these vehicles have received."""
        return self.take(np.isin(self.receiver, receivers))


@dataclass(frozen=True, slots=True)
class SweepTimes:
    """The newest sweep of each vehicle on the road that has sensed."""

    views: ViewTimes
    """What they saw. Observers and bodies are actor numbers here, because rows of the world change."""
    step: Int[ndarray, "e"]
    """When each of them sensed."""

    @staticmethod
    def none() -> "SweepTimes":
        """No sweeps."""
        no_number, no_value = np.zeros(0, np.int64), np.zeros(0)
        ptr, no_sight = np.zeros(1, np.int64), np.zeros(0, bool)
        views = ViewTimes(no_number, ptr, no_number, no_value, no_sight, no_value, 0.0)
        return SweepTimes(views, no_number)

    def then(self, views: ViewTimes, actor: Int[ndarray, "n"], step: int, present: Int[ndarray, "v"]) -> "SweepTimes":
        """These sweeps after some vehicles have sensed, without those of vehicles that have left the road.

        Parameters
        ----------
        views
            The new sweeps, with rows of the world.
        actor
            Actor number of each row of the world.
        step
            The step.
        present
            Actor numbers of all equipped vehicles, ascending.
        """
        new, old = actor[views.own], self.views
        stays = ~np.isin(old.own, new) & np.isin(old.own, present)
        kept = np.flatnonzero(stays)
        own = np.concatenate([old.own[kept], new])
        order = np.argsort(own)
        begin_new = len(old.body) + views.ptr[:-1]
        n_old = np.diff(old.ptr)[kept]
        count = np.concatenate([n_old, np.diff(views.ptr)])[order]
        start = np.concatenate([old.ptr[kept], begin_new])[order]
        rows = ranges(start, count)
        joined = ViewTimes(
            own=own[order],
            ptr=offsets(count),
            body=np.concatenate([old.body, actor[views.body]])[rows],
            seen_p=np.concatenate([old.seen_p, views.seen_p])[rows],
            inside=np.concatenate([old.inside, views.inside])[rows],
            detected_p=np.concatenate([old.detected_p, views.detected_p])[rows],
            n_false=views.n_false,
        )
        steps = np.concatenate([self.step[kept], np.full(len(new), step)])
        return SweepTimes(joined, steps[order])
