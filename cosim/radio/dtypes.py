"""Records of the event loop (receivers, medium access, frames), and its parameters in linear units."""

from typing import NamedTuple

import numpy as np

N_ACCESS = 4
NEVER = np.iinfo(np.int64).max
NONE = -1
"""Row of no record."""
RECEIVED, RANGE, FADING, COLLISION, BUSY, HALF_DUPLEX, EXPIRED, QUEUE, WAITING = range(9)
FREE, DETECTING, LOCKED = range(3)

PHY = np.dtype(
    [
        ("key", "u8"),
        ("energy_mw", "f8"),  # all arrivals together
        # of the frame being received, by `phase`
        ("frame_mw", "f8"),
        ("frame_ns", "i8"),
        ("frame_from", "i4"),
        ("frame_edge", "i4"),
        ("chunk_ns", "i8"),  # up to when it is evaluated
        ("log_psr", "f8"),  # log of its success
        ("jam_mw", "f8"),  # noise of jammers
        ("idle_ns", "i8"),
        ("eifs_ns", "i8"),
        ("busy_since_ns", "i8"),
        ("busy_ns", "i8"),
        ("strong_since_ns", "i8"),
        ("strong_ns", "i8"),
        ("n_air", "i4"),
        ("n_strong", "i4"),
        ("packet", "i4"),  # own packet on the air
        ("phase", "u1"),
        ("busy", "u1"),
        ("hurt", "u1"),
        ("active", "u1"),  # whether a back-off runs or a packet waits
    ]
)
"""Receiver and carrier sense of a station: two cache lines."""

MAC = np.dtype(
    [
        ("rank", "i4"),
        ("n_draws", "u4"),
        ("armed_ns", "i8"),
        ("gate_ns", "i8"),
        ("gap_ns", "i8"),
        ("gated", "u1"),
        ("since_ns", "i8", N_ACCESS),
        ("slots", "i4", N_ACCESS),
        ("head", "i4", N_ACCESS),
        ("tail", "i4", N_ACCESS),
        ("count", "i4", N_ACCESS),
        ("n_queued", "i4"),
    ]
)
"""Medium access of a station: four queues with their back-offs."""

PACKET = np.dtype(
    [
        ("generated_ns", "i8"),
        ("expires_ns", "i8"),
        ("airtime_ns", "i8"),
        ("start_ns", "i8"),
        ("key", "u8"),
        ("seq", "u8"),
        ("tag", "i8"),
        ("edge", "i8"),  # the first one
        ("slot", "i8"),  # of the first outcome
        ("sender", "i4"),
        ("degree", "i4"),
        ("payload_bytes", "i4"),
        ("next", "i4"),
        ("access", "u1"),
        ("outcome", "u1"),
    ]
)
"""A frame: its place in the queue, its start, and where its outcomes are written."""


class Constants(NamedTuple):
    """Parameters in linear units."""

    noise_mw: float
    sinr_min: float
    detectable_mw: float
    cca_mw: float
    floor_mw: float
    curve_a: float  # ln of the error exponent is a - b ln(SINR)
    curve_b: float
    sinr_clean: float  # above this a chunk has no errors
    capture_ratio: float
    capture_ns: int
    slot_ns: int
    eifs_ns: int
    queue_max: int
    overhead_bytes: int
