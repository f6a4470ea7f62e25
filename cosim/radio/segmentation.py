"""Segments of messages longer than one frame."""

import numpy as np
from jaxtyping import Int
from numpy import ndarray

FRAME_BYTES = 1398
"""Longest payload of one frame: GeoNetworking's itsGnMaxSduSize [B]."""
ENVELOPE_BYTES = 44 + 96 + 37 + 9
"""GeoNetworking and BTP, signature and digest, header, sensor: repeated in each segment of a long message [B]."""


def segments(
    length_bytes: Int[ndarray, "n"],
    envelope_bytes: Int[ndarray, "n"] | int = ENVELOPE_BYTES,
    frame_bytes: int = FRAME_BYTES,
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Number of frames of each message, and the length of each frame [B]. Every segment is signed on its own.

    A message of at most `frame_bytes` is one frame. All frames of a longer one have the same length, rounded up.

    Parameters
    ----------
    length_bytes
        Length of each message.
    envelope_bytes
        What each segment of a message repeats, less than `frame_bytes`.
    frame_bytes
        Largest length of a frame.
    """
    content, room = length_bytes - envelope_bytes, frame_bytes - envelope_bytes
    n = np.where(length_bytes <= frame_bytes, 1, -(-content // room))
    each = envelope_bytes - (-content) // n
    return n, np.where(n == 1, length_bytes, each)
