"""Messages that outlast a round: their segments wait for the channel when the round ends.

Congestion control spaces the frames of a station by 50 ms to 1 s, and vehicles that sense at phases of their own have
rounds of less than that. So a message goes on in the rounds that follow, until all its frames are sent, or until it is
too old. Stations are named by their keys here, because their rows change from step to step.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Int, UInt64
from numpy import ndarray

from cosim.radio.dtypes import NONE
from cosim.radio.forwarding import COPY, UNIT

MESSAGE = np.dtype([
    ("sender_key", "u8"), ("name", "i8"), ("step", "i8"), ("begin_ns", "i8"), ("end_ns", "i8"), ("n_segments", "i4"),
    ("station", "i4"), ("kind", "u1"), ("is_background", "?"),
])  # fmt: skip
"""A message: its sender, the caller's name for it, its round, and the time from which on it is too old."""

SENT_FRAME = np.dtype([
    ("transmitter_key", "u8"), ("start_ns", "i8"), ("end_ns", "i8"), ("unit", "i4"), ("transmitter", "i4"),
    ("hop", "i4"), ("on_air", "?"), ("is_decided", "?"),
])  # fmt: skip
"""A frame of such a message. It is decided when it has been sent, or when it never will be."""


@dataclass(frozen=True, slots=True)
class Underway:
    """Messages that wait, with all that is known of their frames."""

    messages: ndarray = field(default_factory=lambda: np.zeros(0, MESSAGE))
    """Records of `MESSAGE`."""
    units: ndarray = field(default_factory=lambda: np.zeros(0, UNIT))
    """Their segments."""
    frames: ndarray = field(default_factory=lambda: np.zeros(0, SENT_FRAME))
    """Their frames: that of each segment's sender in the order of the segments, then forwarded ones."""
    copies: ndarray = field(default_factory=lambda: np.zeros(0, COPY))
    """Segments at other stations, for forwarding."""
    copy_key: UInt64[ndarray, "c"] = field(default_factory=lambda: np.zeros(0, np.uint64))
    """Station of each copy."""
    got_frame: Int[ndarray, "g"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Frames that were received, ascending, one row for each receiver."""
    got_key: UInt64[ndarray, "g"] = field(default_factory=lambda: np.zeros(0, np.uint64))
    """Station that received each."""
    refused_message: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Messages that stations do not forward."""
    refused_key: UInt64[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.uint64))
    """Station that refuses each."""

    def __len__(self) -> int:
        return len(self.messages)

    def among(self, key: UInt64[ndarray, "n"]) -> tuple["Underway", Int[ndarray, "f"]]:
        """The messages whose senders are among these stations, with rows of stations filled in.

        Copies, receptions and refusals of stations that have left are dropped.

        Returns
        -------
        The messages, and the new number of each frame; NONE for frames of senders that have left.
        """
        if not len(self):
            return self, np.zeros(0, np.int64)
        row = _RowOf.of(key)
        sender, is_there = row(self.messages["sender_key"])
        chosen, number = self.only(is_there)
        chosen.messages["station"] = sender[is_there]
        chosen.units["source"] = chosen.messages["station"][chosen.units["message"]]
        chosen.frames["transmitter"] = row(chosen.frames["transmitter_key"])[0]
        station, has_copy = row(chosen.copy_key)
        chosen.copies["station"] = station
        got, refuses = row(chosen.got_key)[1], row(chosen.refused_key)[1]
        present = replace(
            chosen,
            copies=chosen.copies[has_copy],
            copy_key=chosen.copy_key[has_copy],
            got_frame=chosen.got_frame[got],
            got_key=chosen.got_key[got],
            refused_message=chosen.refused_message[refuses],
            refused_key=chosen.refused_key[refuses],
        )
        return present, number

    def only(self, kept: Bool[ndarray, "m"]) -> tuple["Underway", Int[ndarray, "f"]]:
        """Copies of these messages and of what belongs to them, and the new number of each frame; NONE without one."""
        message, unit = _numbers(kept), _numbers(kept[self.units["message"]])
        of_frame = unit[self.frames["unit"]] != NONE
        frame = _numbers(of_frame)
        units, frames = self.units[unit != NONE], self.frames[of_frame]
        units["message"] = message[units["message"]]
        frames["unit"] = unit[frames["unit"]]
        of_copy = unit[self.copies["unit"]] != NONE
        of_got = frame[self.got_frame] != NONE
        copies = self.copies[of_copy]
        copies["unit"] = unit[copies["unit"]]
        of_refused = message[self.refused_message] != NONE
        chosen = Underway(
            messages=self.messages[kept],
            units=units,
            frames=frames,
            copies=copies,
            copy_key=self.copy_key[of_copy],
            got_frame=frame[self.got_frame[of_got]],
            got_key=self.got_key[of_got],
            refused_message=message[self.refused_message[of_refused]],
            refused_key=self.refused_key[of_refused],
        )
        return chosen, frame


@dataclass(frozen=True, slots=True)
class _RowOf:
    """Rows of stations by their keys."""

    key: UInt64[ndarray, "n"]
    order: Int[ndarray, "n"]

    @staticmethod
    def of(key: UInt64[ndarray, "n"]) -> "_RowOf":
        order = np.argsort(key)
        return _RowOf(key[order], order)

    def __call__(self, key: UInt64[ndarray, "k"]) -> tuple[Int[ndarray, "k"], Bool[ndarray, "k"]]:
        """The row of each key, NONE where it is not there, and whether it is there."""
        if not len(self.key):
            return np.full(len(key), NONE), np.zeros(len(key), bool)
        at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
        is_there = self.key[at] == key
        return np.where(is_there, self.order[at], NONE), is_there


def rows_of_keys(key: UInt64[ndarray, "n"], wanted: UInt64[ndarray, "k"]) -> Int[ndarray, "k"]:
    """Row of each wanted station; NONE where it is not among these."""
    return _RowOf.of(key)(wanted)[0]


def _numbers(kept: Bool[ndarray, "m"]) -> Int[ndarray, "m"]:
    """New number of each row if only these are kept; NONE for the others."""
    return np.where(kept, np.cumsum(kept) - 1, NONE)
