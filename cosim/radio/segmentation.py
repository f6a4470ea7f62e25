"""Segments of messages longer than one frame."""

import numpy as np
from jaxtyping import Int
from numpy import ndarray

FRAME_BYTES = 1398
"""Longest payload of one frame: GeoNetworking's itsGnMaxSduSize [B]."""
ENVELOPE_BYTES = 44 + 96 + 37 + 9
"""GeoNetworking and BTP, signature and digest, header, sensor: repeated in each segment of a long message [B]."""


def segments(
    length_bytes: Int[ndarray, "n"], frame_bytes: int = FRAME_BYTES
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Number of frames of each message, and the length of each frame [B]. Every segment is signed on its own.

    A message of at most `frame_bytes` is one frame. All frames of a longer one have the same length, rounded up.
    """
    n = np.where(length_bytes <= frame_bytes, 1, -(-(length_bytes - ENVELOPE_BYTES) // (frame_bytes - ENVELOPE_BYTES)))
    each = ENVELOPE_BYTES - (ENVELOPE_BYTES - length_bytes) // n
    return n, np.where(n == 1, length_bytes, each)
