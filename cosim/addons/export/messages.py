"""Received messages with the self reports in them, for the layouts of misbehaviour data sets."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Int
from numpy import ndarray

from results.moments import Clouds, File, Selection, Unit, at_steps

TABLES = ("actors", "vehicles", "pseudonyms", "detections", "receptions")

RECEIVERS = 40
"""Receivers of one unit of work."""

POSE = ["x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "acceleration_mps2"]


def units_of(
    selection: Selection,
    files: Callable[[list[int], Clouds], Iterator[File]],
) -> list[Unit]:
    """Units of work that each make the files of some receivers."""
    units = []
    for begin in range(0, len(selection.vehicles), RECEIVERS):
        block = list(selection.vehicles[begin : begin + RECEIVERS])
        name = f"receivers {block[0]} to {block[-1]}"
        units.append(Unit(name, partial(files, block)))
    return units


@dataclass(frozen=True, slots=True)
class ReceivedMessages:
    """What some vehicles sensed of themselves and received."""

    own: pd.DataFrame
    """step, vehicle and `POSE`: true states, by vehicle and step."""
    messages: pd.DataFrame
    """receiver, step, received_step, sender (pseudonym), vehicle that sent, send_s, receive_s, `POSE` as reported,
    is_attack; by receiver and time of reception."""


def message_steps(selection: Selection) -> Int[ndarray, "s"]:
    """The chosen steps, and those in which messages were sent that vehicles received in the chosen steps."""
    got = selection.run.parts("receptions", ["message_step"], at_steps(selection.steps))
    sent = [part.message_step.unique() for part in got]
    return np.unique(np.concatenate([selection.steps, *sent]))


def receptions_of(selection: Selection, receivers: list[int]) -> pd.DataFrame:
    """Receptions of perception messages by these vehicles in the chosen steps, with `send_s` and `receive_s`.

    The column step is that of the message, `received_step` that of the reception.
    """
    columns = ["step", "message_step", "sender", "receiver", "generation_offset_s", "latency_s"]
    where = at_steps(selection.steps) & pc.field("receiver").isin(receivers)
    where &= pc.field("message_type") == "cpm"
    got = selection.run.table("receptions", columns, where)
    got = got.rename(columns={"step": "received_step", "message_step": "step"})
    got["send_s"] = got.step * selection.run.dt_s + got.generation_offset_s
    got["receive_s"] = got.send_s + got.latency_s
    return got


class ExportedMessages:
    """All messages with a self report that were sent, or received, in the chosen steps."""

    def __init__(self, selection: Selection) -> None:
        self.selection = selection
        self._run = selection.run
        self._steps = message_steps(selection)
        where = at_steps(self._steps) & (pc.field("detection_index") == 0)
        found = self._run.table("detections", ["step", "observer", *POSE, "transmitted"], where)
        found = found[found.transmitted]
        if found.empty:
            raise ValueError(
                f"{self._run.path} holds no self report in these steps. Set trust.self_reports = true and run again."
            )
        subjects = self._run.subjects
        start = subjects.attack_start_step.astype("Float64").fillna(np.inf).astype(float)
        vehicle = found.observer.map(subjects.vehicle).astype(np.int64)
        self.sent = found.drop(columns="transmitted").assign(
            vehicle=vehicle, is_attack=found.step.to_numpy() >= found.observer.map(start).to_numpy()
        )
        """step, observer (pseudonym), vehicle, `POSE` as reported, is_attack."""
        self._digits = len(str(int(found.observer.max())))

    def number(
        self,
        step: Int[ndarray, "n"],
        pseudonym: Int[ndarray, "n"],
    ) -> Int[ndarray, "n"]:
        """Identifiers of messages, each used once in a run.

        Parameters
        ----------
        step, pseudonym
            Step of each message, and pseudonym of its sender.

        Returns
        -------
        Whole numbers: the step, and the pseudonym in the last digits.
        """
        shifted = np.asarray(step, np.int64) * 10**self._digits
        return shifted + np.asarray(pseudonym, np.int64)

    def own(self, vehicles: list[int]) -> pd.DataFrame:
        """True states of vehicles in the steps of `message_steps`; acceleration is the change since the step before."""
        columns = ["step", "actor", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps"]
        found = self._run.table("actors", columns, pc.field("actor").isin(vehicles))
        found = found.sort_values(["actor", "step"])
        before = found.groupby("actor")[["step", "speed_mps"]].shift()
        change = (found.speed_mps - before.speed_mps) / self._run.dt_s
        found["acceleration_mps2"] = change.where(found.step - before.step == 1, 0.0)
        found = found[found.step.isin(self._steps)]
        return found.rename(columns={"actor": "vehicle"}).sort_values(["vehicle", "step"], ignore_index=True)

    def units(
        self,
        files: Callable[["ExportedMessages", list[int], Clouds], Iterator[File]],
    ) -> list[Unit]:
        """Units of work that each make the files of some receivers."""
        return units_of(self.selection, partial(files, self))

    def remarks(self) -> tuple[str, ...]:
        """How many received messages are in no file, because they hold no self report; nothing if all are."""
        got = receptions_of(self.selection, list(self.selection.vehicles))
        told = self.sent[["step", "observer"]].rename(columns={"observer": "sender"})
        n_silent = len(got) - len(got.merge(told))
        why = f"{n_silent:,} of {len(got):,} received messages are left out: they hold no self report."
        return (why,) if n_silent else ()

    def received(self, receivers: list[int]) -> ReceivedMessages:
        """What these vehicles received."""
        got = receptions_of(self.selection, receivers)
        sent = self.sent.rename(columns={"observer": "sender"})
        got = got.merge(sent, on=["step", "sender"])
        order = ["receiver", "receive_s", "sender"]
        return ReceivedMessages(self.own(receivers), got.sort_values(order, ignore_index=True))
