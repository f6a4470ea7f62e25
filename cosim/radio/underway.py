"""Messages that outlast a round: their segments wait for the channel when the round ends.

Congestion control spaces the frames of a station by 50 ms to 1 s, and vehicles that sense at phases of their own have
rounds of less than that. So a message goes on in the rounds that follow, until all its frames are sent, or until it is
too old. Rows of stations change from step to step.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int, UInt64
from numpy import ndarray

from cosim.base.ragged import rows_of
from cosim.base.rows import no_rows
from cosim.radio.dtypes import NONE
from cosim.radio.forwarding import COPY, UNIT

MESSAGE = np.dtype(
    [
        ("name", "i8"),
        ("step", "i8"),
        ("begin_ns", "i8"),
        ("end_ns", "i8"),
        ("n_segments", "i4"),
        ("station", "i4"),
        ("kind", "u1"),
        ("is_background", "?"),
    ]
)
"""A message: the caller's name for it, its round, the time from which on it is too old, and its sender."""

SENT_FRAME = np.dtype(
    [
        ("start_ns", "i8"),
        ("end_ns", "i8"),
        ("unit", "i4"),
        ("transmitter", "i4"),
        ("hop", "i4"),
        ("on_air", "?"),
        ("is_decided", "?"),
    ]
)
"""A frame of such a message. It is decided when it has been sent, or when it never will be."""


@dataclass(frozen=True, slots=True)
class Underway:
    """Messages that wait, with all that is known of their frames."""

    key: UInt64[ndarray, "n"] = no_rows(np.uint64)
    """The stations of the round, to whose rows the others refer."""
    messages: ndarray = no_rows(MESSAGE)
    """Records of `MESSAGE`."""
    units: ndarray = no_rows(UNIT)
    """Their segments."""
    frames: ndarray = no_rows(SENT_FRAME)
    """Their frames: that of each segment's sender in the order of the segments, then forwarded ones."""
    copies: ndarray = no_rows(COPY)
    """Segments at other stations, for forwarding."""
    got_frame: Int[ndarray, "g"] = no_rows(np.int64)
    """Frames that were received, ascending, one row for each receiver."""
    got_by: Int[ndarray, "g"] = no_rows(np.int64)
    """Station that received each."""
    refused_message: Int[ndarray, "p"] = no_rows(np.int64)
    """Messages that stations do not forward."""
    refused_by: Int[ndarray, "p"] = no_rows(np.int64)
    """Station that refuses each."""

    def __len__(self) -> int:
        return len(self.messages)

    def among(self, key: UInt64[ndarray, "n"]) -> tuple["Underway", Int[ndarray, "f"]]:
        """The messages whose senders are among these stations, with rows of these stations.

        Copies, receptions and refusals of stations that have left are dropped.

        Returns
        -------
        The messages, and the new number of each frame; NONE for frames of senders that have left.
        """
        if not len(self):
            return self, np.zeros(0, np.int64)
        row = np.append(rows_of_keys(key, self.key), NONE)  # NONE, the last row, stays NONE
        chosen, number = self.only(row[self.messages["station"]] != NONE)
        for records, name in ((chosen.messages, "station"), (chosen.units, "source"), (chosen.frames, "transmitter")):
            records[name] = row[records[name]]
        chosen.copies["station"] = row[chosen.copies["station"]]
        got_by, refused_by = row[chosen.got_by], row[chosen.refused_by]
        got, refuses = got_by != NONE, refused_by != NONE
        present = replace(
            chosen,
            key=key,
            copies=chosen.copies[chosen.copies["station"] != NONE],
            got_frame=chosen.got_frame[got],
            got_by=got_by[got],
            refused_message=chosen.refused_message[refuses],
            refused_by=refused_by[refuses],
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
            key=self.key,
            messages=self.messages[kept],
            units=units,
            frames=frames,
            copies=copies,
            got_frame=frame[self.got_frame[of_got]],
            got_by=self.got_by[of_got],
            refused_message=message[self.refused_message[of_refused]],
            refused_by=self.refused_by[of_refused],
        )
        return chosen, frame


def rows_of_keys(
    key: UInt64[ndarray, "n"],
    wanted: UInt64[ndarray, "k"],
) -> Int[ndarray, "k"]:
    """Row of each wanted station; NONE where it is not among these."""
    order = np.argsort(key)
    row, is_there = rows_of(wanted, key[order])
    return np.where(is_there, np.append(order, NONE)[row], NONE)


def _numbers(kept: Bool[ndarray, "m"]) -> Int[ndarray, "m"]:
    """New number of each row if only these are kept; NONE for the others."""
    return np.where(kept, np.cumsum(kept) - 1, NONE)
