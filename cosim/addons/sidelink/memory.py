"""What lasts from slot to slot and from round to round of the sidelink, and room for the results of a round."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int, UInt64
from numpy import ndarray

from cosim.addons.sidelink.records import (
    ENTRY,
    MAX_SENT,
    PROCESS,
    RESERVATION,
    STATION,
    Memory,
    Room,
    SlotLog,
    SlotRules,
)
from cosim.addons.sidelink.slots import count_entries, load_entries
from cosim.base.ragged import differs_from_last, offsets
from cosim.base.rows import no_rows
from cosim.radio.channel import Links
from cosim.radio.dtypes import NEVER, NONE
from cosim.radio.link_cache import LinkCache
from cosim.radio.message_round import Stations


@dataclass(frozen=True, slots=True)
class SidelinkState:
    """All that lasts from one round to the next. Callers only pass it on."""

    process: ndarray = no_rows(PROCESS)
    """Processes of the stations, sorted by key."""
    station: ndarray = no_rows(STATION)
    entry: ndarray = no_rows(ENTRY)
    """Which stations have decoded which reservations, by station, with gaps."""
    ptr: ndarray = field(default_factory=lambda: np.zeros(1, np.int64))
    """Where each station's entries begin."""
    n_entries: ndarray = no_rows(np.int64)
    """Of each station."""
    reservation: ndarray = no_rows(RESERVATION)
    """All that were announced in the latest round, and earlier ones that lasted until then."""
    until: int = 0
    """First slot that has not been carried out."""
    cache: LinkCache | None = None


def stations_of(state: SidelinkState, stations: Stations) -> tuple[ndarray, Int[ndarray, "n"]]:
    """Records of these stations, in this order, and their rows in the state; new stations have sensed nothing."""
    old = state.station["key"]
    station = np.zeros(len(stations), STATION)
    was = np.full(len(stations), NONE, np.int64)
    if np.array_equal(old, stations.key):
        was = np.arange(len(stations))
    else:
        _, rows, now = np.intersect1d(old, stations.key, assume_unique=True, return_indices=True)
        was[now] = rows
    station[was != NONE] = state.station[was[was != NONE]]
    station["key"] = stations.key
    station["ignores"] = 0 if stations.abuse is None else stations.abuse.ignores_dcc
    return station, was


def processes_of(process: ndarray, unit: ndarray, key: UInt64[ndarray, "u"], stations: Stations) -> ndarray:
    """Processes of the stations that are there, sorted by key, with those of the units; names them in the units."""
    present = np.sort(stations.key)
    at = np.minimum(np.searchsorted(present, process["station"]), len(present) - 1)
    process = process[np.flatnonzero(present[at] == process["station"])]
    at = np.searchsorted(process["key"], key)
    known = at < len(process)
    known[known] = process["key"][at[known]] == key[known]
    new = np.flatnonzero(~known)
    if len(new):
        more = np.zeros(len(new), PROCESS)
        more["key"] = key[new]
        more["station"] = stations.key[unit["station"][new]]
        more["next_slot"], more["generated"] = NEVER, NONE
        process = np.concatenate([process, more])
        process = process[np.argsort(process["key"])]
        at = np.searchsorted(process["key"], key)
    unit["process"] = at
    return process


def memory_of(
    process: ndarray,
    station: ndarray,
    was: Int[ndarray, "n"],
    state: SidelinkState,
    unit: ndarray,
    links: Links,
    rules: SlotRules,
    begin: int,
) -> Memory:
    """Linked lists of each station's processes; its entries and the reservations, with room for those of the round.

    Reservations that end before the slot `begin` are left out.
    """
    order = np.argsort(station["key"])
    of = order[np.searchsorted(station["key"][order], process["station"])]
    own, next_own = _lists(of, len(station))
    n_announced = unit["n_sent"].astype(np.int64)
    if rules.with_repeats:
        n_announced = np.array([0, 1, 4, 9])[n_announced]
    room = np.zeros(len(station), np.int64)
    room[was != NONE] = state.n_entries[was[was != NONE]]
    count_entries(links.ptr, links.receiver, unit, n_announced, room)
    ptr, n_entries = offsets(room), np.zeros(len(station), np.int64)
    entry = np.zeros(ptr[-1], ENTRY)
    lasting = np.flatnonzero(state.reservation["last"] >= begin)
    number = np.full(len(state.reservation), NONE, np.int64)
    number[lasting] = np.arange(len(lasting))
    load_entries((state.entry, state.ptr, state.n_entries), was, number, entry, ptr, n_entries)
    reservation = np.zeros(len(lasting) + int(n_announced.sum()), RESERVATION)
    reservation[: len(lasting)] = state.reservation[lasting]
    n_reserved = np.array([len(lasting)])
    return Memory(process, own, next_own, station, entry, ptr, n_entries, reservation, n_reserved)


def _lists(of: Int[ndarray, "p"], n: int) -> tuple[ndarray, ndarray]:
    """The rows of each owner as linked lists: the first row of each owner, and the row after each row."""
    first = np.full(n, NONE, np.int64)
    after = np.full(len(of), NONE, np.int64)
    order = np.argsort(of, kind="stable")
    begins = differs_from_last(of[order])
    same = ~begins[1:]
    after[order[:-1][same]] = order[1:][same]
    first[of[order][begins]] = order[begins]
    return first, after


def log_of(unit: ndarray, links: Links, n_slots: int) -> SlotLog:
    """Room for the outcomes of these units at their receivers."""
    degree = np.diff(links.ptr)[unit["station"]]
    begins = offsets(degree)
    unit["rows"] = MAX_SENT * begins[:-1]
    return SlotLog(
        unit=unit,
        reception=np.zeros(MAX_SENT * begins[-1], np.uint8),
        sinr=np.zeros(begins[-1]),
        head_sent=np.full(n_slots, NONE, np.int64),
        next_sent=np.full(MAX_SENT * len(unit), NONE, np.int64),
        head_check=np.full(n_slots, NONE, np.int64),
        next_check=np.full(len(unit), NONE, np.int64),
    )


def room_of(rules: SlotRules) -> Room:
    """Room for one choice of resources."""
    n = (rules.last + 1) * rules.n_subchannels
    return Room(
        np.zeros(n),
        np.zeros(n),
        np.zeros(n, np.int64),
        np.zeros(n, np.uint64),
    )
