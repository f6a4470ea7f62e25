"""State of the channel between two windows."""

from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray

from cosim.base.ragged import ranges
from cosim.radio import dtypes
from cosim.radio.csma_events import Air, Log


@dataclass(frozen=True, slots=True)
class ChannelState:
    """All that lasts from one window to the next. Callers only pass it on."""

    now_ns: int
    phy: ndarray
    mac: ndarray
    packets: ndarray
    """Waiting or on the air."""
    receiver: ndarray
    """Receivers of the frames on the air. `arrival_mw` and `reception` (`PhyOutcome` so far) have the same order."""
    arrival_mw: ndarray
    reception: ndarray

    @staticmethod
    def start(now_ns: int = 0) -> "ChannelState":
        """An idle channel without stations."""
        return ChannelState(
            now_ns=now_ns,
            phy=np.zeros(0, dtypes.PHY),
            mac=np.zeros(0, dtypes.MAC),
            packets=np.zeros(0, dtypes.PACKET),
            receiver=np.zeros(0, np.int32),
            arrival_mw=np.zeros(0, np.float32),
            reception=np.zeros(0, np.uint8),
        )


def remap_stations(state: ChannelState, key: ndarray) -> ChannelState:
    """A copy of the state for the stations `key`, in this order.

    Stations that left while they had a frame on the air come last. Packets that wait at a station that left expire.
    A station that left does not receive the frames that are on the air. New stations are idle.
    """
    old = state.phy["key"]
    if np.array_equal(old, key):
        return replace(state, phy=state.phy.copy(), mac=state.mac.copy(), packets=state.packets.copy())
    assert len(np.unique(key)) == len(key), "every station has a key of its own"
    _, was, now = np.intersect1d(old, key, assume_unique=True, return_indices=True)
    stays = np.zeros(len(old), bool)
    stays[was] = True
    leaving = np.flatnonzero(~stays & (state.phy["packet"] != dtypes.NONE))
    row = np.full(len(old) + 1, dtypes.NONE)  # one more: NONE maps to NONE
    row[was] = now
    row[leaving] = len(key) + np.arange(len(leaving))

    phy = np.zeros(len(key) + len(leaving), dtypes.PHY)
    mac = np.zeros(len(phy), dtypes.MAC)
    phy["key"][: len(key)] = key
    phy["packet"] = dtypes.NONE
    mac["armed_ns"] = dtypes.NEVER
    kept = np.flatnonzero(row[:-1] >= 0)
    phy[row[kept]] = state.phy[kept]
    mac[row[kept]] = state.mac[kept]
    frame_from = row[phy["frame_from"]]
    phy["frame_from"] = np.where(phy["phase"] == dtypes.FREE, 0, frame_from)
    mac["rank"][np.argsort(phy["key"])] = np.arange(len(phy))

    packets = state.packets.copy()
    dropped = ~stays[packets["sender"]] & (packets["outcome"] == dtypes.WAITING)
    packets["outcome"][dropped] = dtypes.EXPIRED
    packets["sender"] = row[packets["sender"]]
    left_phy, left_mac = phy[len(key) :], mac[len(key) :]  # only their frame on the air remains
    left_phy["energy_mw"] = left_phy["n_air"] = left_phy["n_strong"] = 0
    left_phy["phase"] = dtypes.FREE
    left_mac["count"] = left_mac["n_queued"] = left_mac["gated"] = 0
    left_mac["armed_ns"] = dtypes.NEVER

    receiver = row[state.receiver]
    receiver[receiver >= len(key)] = dtypes.NONE
    arrival_mw = np.where(receiver == dtypes.NONE, np.float32(0), state.arrival_mw)
    return ChannelState(state.now_ns, phy, mac, packets, receiver.astype(np.int32), arrival_mw, state.reception)


def next_state(air: Air, log: Log, alive: ndarray, on_air: ndarray, now_ns: int) -> ChannelState:
    """The state after a window.

    Parameters
    ----------
    air, log
        Stations and packets at the end of the window. Their arrays are reused and changed.
    alive
        Packets (bool) that wait or are on the air: they are kept and renumbered.
    on_air
        Packets (bool) that are on the air: their receivers are kept.
    now_ns
        End of the window [ns].
    """
    phy, mac, table = air.phys, air.macs, log.packets
    if not alive.any():
        phy["packet"] = mac["head"] = mac["tail"] = dtypes.NONE
        return replace(ChannelState.start(now_ns), phy=phy, mac=mac)
    number = np.full(len(table) + 1, dtypes.NONE, np.int32)  # one more: NONE maps to NONE
    number[:-1][alive] = np.arange(np.count_nonzero(alive))
    phy["packet"] = number[phy["packet"]]
    is_empty = mac["count"] == 0
    for name in ("head", "tail"):
        packet = np.where(is_empty, dtypes.NONE, mac[name])
        mac[name] = number[packet]
    frames = table[on_air]
    edge = ranges(frames["edge"], frames["degree"])
    slot = ranges(frames["slot"], frames["degree"])
    table["edge"][on_air] = np.cumsum(frames["degree"]) - frames["degree"]
    table["next"] = number[table["next"]]
    return ChannelState(
        now_ns=now_ns,
        phy=phy,
        mac=mac,
        packets=table[alive],
        receiver=air.receiver[edge],
        arrival_mw=air.arrival_mw[edge],
        reception=log.outcome[slot],
    )
