"""Records of the sidelink's slots: processes, stations, reservations, messages, and the parameters.

A resource is a slot and some consecutive subchannels. A process sends one kind of message of one station. It reserves
the same subchannels again after its period, and announces this in the control part of its transmission. Each receiver
that decodes the announcement remembers it.

References
----------
.. [2] 3GPP TS 36.213 V14.16, clause 14.1.1.6: resources of mode 4.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

MAX_SENT = 3
"""Largest number of transmissions of a message."""
N_HISTORY = 24
"""Latest transmissions of a process that are remembered."""
N_USED = 10
"""Periods of the channel busy ratio over which a station's occupancy is counted."""

PROCESS = np.dtype(
    [
        ("key", "u8"),
        ("station", "u8"),
        ("next_slot", "i8"),  # of the first transmission that is reserved; NEVER without a reservation
        ("generated", "i8"),  # slot of the latest message; NONE before the first one
        ("gap", "i4", MAX_SENT),  # slots after the first transmission
        ("sub", "i2", MAX_SENT),  # first subchannels
        ("width", "i2"),
        ("n_sent", "i2"),
        ("period", "i4"),
        ("counter", "i4"),
        ("n_missed", "i4"),
        ("n_draws", "u4"),
        ("slots", "i8", N_HISTORY),
        ("subs", "i2", N_HISTORY),
        ("widths", "i2", N_HISTORY),
        ("n_past", "u4"),
    ]
)
"""A process: its reservation, and its latest transmissions."""

STATION = np.dtype(
    [
        ("key", "u8"),
        ("busy", "i8"),
        ("cbr", "f8"),
        ("used", "i4", N_USED),
        ("used_now", "i4"),
        ("ignores", "u1"),
    ]
)
"""A station: busy subchannels of the present period, busy ratio of the period before, subchannels it has used."""

RESERVATION = np.dtype([("slot", "i8"), ("last", "i8"), ("period", "i4"), ("sub", "i2"), ("width", "i2")])
"""A reservation that a transmission announces: the reserved slot, and its repetitions up to `last`."""

ENTRY = np.dtype([("reservation", "i4"), ("rsrp_mw", "f4")])
"""A reservation that a station has decoded: the row of the reservation, and the received power."""

UNIT = np.dtype(
    [
        ("key", "u8"),
        ("generated", "i8"),
        ("deadline", "i8"),
        ("process", "i4"),
        ("station", "i4"),
        ("width", "i2"),
        ("n_sent", "i2"),
        ("outcome", "u1"),
        ("announces", "u1"),
        ("threshold_mw", "f8"),
        ("sinr_db", "f8"),
        ("spread_db", "f8"),
        ("clear_sinr", "f8"),
        ("dead_sinr", "f8"),
        ("slot", "i8", MAX_SENT),
        ("sub", "i2", MAX_SENT),
        ("rows", "i8"),
    ]
)
"""A transport block of the round: what is sent, by which process, and where."""


class SlotRules(NamedTuple):
    """Parameters of the slots, in linear units; times are in slots."""

    rng_key: np.uint64
    n_subchannels: int
    rbs: int  # of a subchannel
    noise_mw: float  # of a resource block
    control_sinr: float  # least SINR at which the control part is decoded
    rsrp_mw: float  # threshold of a resource element, before it is raised
    share: float  # of the candidates that must remain
    first: int  # of the selection window, after generation
    last: int
    lead: int  # of the re-evaluation before the first transmission; 0: none
    max_gap: int  # between transmissions of one message
    aligned: bool  # whether candidates begin at multiples of their width only
    ranked: bool  # whether the candidates of least received power are chosen [2]_
    power_slots: int
    forced_period: int  # 0: the interval of the messages
    keep_p: float
    counter_low: int
    counter_high: int
    short_period: int  # below this period counters are multiplied
    long_slots: int  # by this over the period, rounded up
    reselect_after: int  # unused reservations
    busy_mw: float  # of a subchannel
    busy_slots: int
    limited: bool  # whether occupancy is limited
    with_repeats: bool  # whether one announcement names all transmissions of a message


class SlotAir(NamedTuple):
    """Stations and links of a round, and room for the sums of a slot."""

    ptr: ndarray
    receiver: ndarray
    mean_mw: ndarray
    fading: ndarray
    key: ndarray
    quantiles: ndarray
    leak: ndarray  # power per resource block on each subchannel, by width and first subchannel of the transmission
    allowed: ndarray  # whether each period [slots] may be reserved
    jam_mw: ndarray  # per resource block
    react_mw: ndarray
    is_jammed: ndarray
    density_mw: ndarray  # per station and subchannel: power of a resource block in this slot
    arrival_mw: ndarray  # per link, in this slot
    stamp: ndarray  # slot of the station's sums
    sends: ndarray  # slot in which the station sends
    touched: ndarray
    busy_round: ndarray


class Memory(NamedTuple):
    """What lasts from slot to slot: processes, stations, and what they have decoded."""

    process: ndarray
    own: ndarray  # first process of each station
    next_own: ndarray  # next process of the same station
    station: ndarray
    entry: ndarray  # by station, with room for those of the round
    ptr: ndarray  # where each station's entries begin
    n_entries: ndarray  # of each station
    reservation: ndarray
    n_reservations: ndarray  # one number


class SlotLog(NamedTuple):
    """Units of the round and the outcome at each receiver."""

    unit: ndarray
    reception: ndarray  # per transmission and link of the unit, from unit.rows on
    sinr: ndarray  # sum over the transmissions so far, per link of the unit
    head_sent: ndarray  # transmissions of each slot
    next_sent: ndarray
    head_check: ndarray
    next_check: ndarray


class Room(NamedTuple):
    """Room for one choice: candidates by slot and position."""

    block_mw: ndarray
    power_mw: ndarray
    order: ndarray
    rank: ndarray
