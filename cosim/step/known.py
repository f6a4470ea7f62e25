"""The messages that vehicles use in a step: those of the step, then earlier ones."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.ragged import ptr_of, rows_of
from cosim.messages.content import Detections, claims_to_be_own
from cosim.step.ground_truth import GroundTruth
from trust import tables
from trust.matching import Pairs


class Uses(NamedTuple):
    """Messages that vehicles use, sorted by vehicle, then message."""

    receiver: Int[ndarray, "r"]
    """Row of the vehicles that sense."""
    message: Int[ndarray, "r"]
    """Row of `Known`."""

    def key(self) -> Int[ndarray, "r"]:
        """A number for each row, in the order of the rows."""
        return self.receiver.astype(np.int64) << 32 | self.message

    @staticmethod
    def of_key(key: Int[ndarray, "r"]) -> "Uses":
        """Rows from their numbers."""
        return Uses(key >> 32, key & 0xFFFFFFFF)


def without(uses: Uses, others: Uses) -> Uses:
    """Those of these uses that are not among the others."""
    _, is_there = rows_of(uses.key(), others.key())
    rows = np.flatnonzero(~is_there)
    return Uses(uses.receiver[rows], uses.message[rows])


@dataclass(frozen=True, slots=True)
class Known:
    """M messages with detections: those of this step in the order of `Senders`, then earlier ones by step and sender.

    If all vehicles sense in the same steps, all earlier ones are too old.
    """

    objects: Detections
    """`observer` and `target` are rows of this step's world. Boxes are where the messages say. With `extrapolate`, they
    are where their velocities have brought them by this step."""
    truth: GroundTruth
    detections: tables.SentDetections
    """These detections in the form that `trust` uses, with the message as a row of these messages."""
    ptr: Int[ndarray, "m+1"]
    """Row at which the detections of each message begin."""
    withheld: Bool[ndarray, "d"]
    """As in `Listed`."""
    vehicle: Int[ndarray, "m"]
    """Sender of each message: row of `Vehicles`."""
    pseudonym: Int[ndarray, "m"]
    """Pseudonym that each message carries."""
    received: Uses
    """Detection messages of other vehicles that the vehicles that sense use."""
    step: Int[ndarray, "m"]
    """Step of each message."""
    since: Int[ndarray, "s"]
    """First step after each vehicle that senses last sensed. Later messages are new to it."""
    earlier_m: Float[ndarray, "h"]
    """Distance of each detection of the earlier messages from the sensor of its sender when it was made."""
    earlier_pairs: Pairs
    """Overlapping detections among the earlier messages; rows of `objects`."""
    velocity_mps: Float[ndarray, "d 2"]
    """Velocity that each detection claims, east and north; NaN where it claims none."""
    moved_m: Float[ndarray, "d 2"] | None
    """How far the boxes have been moved by their velocities since they were sent, east and north. None if they are
    where the messages say."""

    def is_new(
        self,
        receiver: Int[ndarray, "k"],
        detection: Int[ndarray, "k"],
    ) -> Bool[ndarray, "k"]:
        """Whether the receiver did not know each detection when it last sensed.

        Parameters
        ----------
        receiver
            Rows of the vehicles that sense.
        detection
            Rows of `objects`.
        """
        return self.step[self.detections.message[detection]] >= self.since[receiver]

    def detection_step(self, detection: Int[ndarray, "k"]) -> Int[ndarray, "k"]:
        """Step of each detection, a row of `objects`."""
        step = self.step.astype(np.int32)  # messages keep it for several steps
        return step[self.detections.message[detection]]


def for_trust(
    listed: Detections, message: Int[ndarray, "d"], n_messages: int
) -> tuple[tables.SentDetections, Int[ndarray, "m+1"]]:
    """Detections in the form that `trust` uses, and the row at which the detections of each message begin.

    Parameters
    ----------
    listed
        Detections as vehicles list them.
    message
        Row of `Senders` of each detection, ascending.
    n_messages
        Number of messages.
    """
    is_self = claims_to_be_own(listed)
    detections = tables.SentDetections(message, listed.detection_index, listed.label, listed.score, is_self)
    return detections, ptr_of(message, n_messages)
