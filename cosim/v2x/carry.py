"""What one window of the channel hands to the next."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.v2x import records


@dataclass(frozen=True, slots=True)
class State:
    """What lasts from one window to the next; opaque."""

    now_ns: int
    phy: ndarray
    mac: ndarray
    packets: ndarray
    """Waiting or on the air."""
    receiver: ndarray
    """Far ends of the links of the frames on the air, the power that arrives there, and how it stands."""
    arrival_mw: ndarray
    reception: ndarray

    @staticmethod
    def start(now_ns: int = 0) -> "State":
        """A silent channel without radios."""
        return State(
            now_ns, np.zeros(0, records.PHY), np.zeros(0, records.MAC), np.zeros(0, records.PACKET),
            np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros(0, np.uint8),
        )  # fmt: skip


def spans(start: Int[ndarray, "r"], count: Int[ndarray, "r"]) -> Int[ndarray, "m"]:
    """All integers of the ranges [start, start + count), range after range."""
    before = np.cumsum(count) - count
    return np.arange(int(count.sum())) + np.repeat(start - before, count)


def starts(count: Int[ndarray, "r"]) -> Int[ndarray, "r+1"]:
    """Where the rows of each of these counts begin, and where all end."""
    return np.concatenate([[0], np.cumsum(count, dtype=np.int64)])


def renamed(state: State, key: ndarray) -> State:
    """A copy of the state with rows as in `key`, behind them radios that left with a frame on the air.

    What waits at a radio that left is dropped as expired; what is on its way to one is received by nobody.
    """
    old = state.phy["key"]
    if np.array_equal(old, key):
        return replace(state, phy=state.phy.copy(), mac=state.mac.copy(), packets=state.packets.copy())
    if len(np.unique(key)) < len(key):
        raise ValueError("links.key names one radio twice. Give every radio a key of its own.")
    order = np.argsort(key)
    at = order[np.minimum(np.searchsorted(key, old, sorter=order), len(key) - 1)] if len(key) else np.zeros_like(old)
    stays = key[at] == old if len(key) else np.zeros(len(old), bool)
    ghost = np.flatnonzero(~stays & (state.phy["packet"] != records.NOBODY))
    row = np.full(len(old) + 1, records.NOBODY)  # one more, so that nobody stays nobody
    row[:-1][stays] = at[stays]
    row[ghost] = len(key) + np.arange(len(ghost))

    phy = np.zeros(len(key) + len(ghost), records.PHY)
    mac = np.zeros(len(phy), records.MAC)
    phy["key"][: len(key)] = key
    phy["packet"] = records.NOBODY
    mac["armed_ns"] = records.NEVER
    kept = np.flatnonzero(row[:-1] >= 0)
    phy[row[kept]], mac[row[kept]] = state.phy[kept], state.mac[kept]
    phy["frame_from"] = np.where(phy["phase"] == records.FREE, 0, row[phy["frame_from"]])
    mac["rank"][np.argsort(phy["key"])] = np.arange(len(phy))

    packets = state.packets.copy()
    dropped = ~stays[packets["sender"]] & (packets["fate"] == records.WAITING)
    packets["fate"][dropped] = records.EXPIRED
    packets["sender"] = row[packets["sender"]]
    deaf, mute = phy[len(key) :], mac[len(key) :]  # all that is left of them is the frame on the air
    deaf["energy_mw"] = deaf["n_air"] = deaf["n_strong"] = 0
    deaf["phase"] = records.FREE
    mute["count"] = mute["n_queued"] = mute["gated"] = 0
    mute["armed_ns"] = records.NEVER

    receiver = row[state.receiver]
    receiver[receiver >= len(key)] = records.NOBODY
    arrival_mw = np.where(receiver == records.NOBODY, np.float32(0), state.arrival_mw)
    return State(state.now_ns, phy, mac, packets, receiver.astype(np.int32), arrival_mw, state.reception)


def carried(
    phy: ndarray, mac: ndarray, table: ndarray, alive: ndarray, on_air: ndarray,
    hearer: ndarray, arrival_mw: ndarray, reception: ndarray, now_ns: int,
) -> State:  # fmt: skip
    """The state after a window: only live packets, renumbered, and the links of the frames on the air."""
    number = np.full(len(table) + 1, records.NOBODY, np.int32)  # one more, so that nobody stays nobody
    number[:-1][alive] = np.arange(np.count_nonzero(alive))
    phy["packet"] = number[phy["packet"]]
    for name in ("head", "tail"):
        mac[name] = number[np.where(mac["count"] > 0, mac[name], records.NOBODY)]
    air = table[on_air]
    edge, slot = spans(air["edge"], air["degree"]), spans(air["slot"], air["degree"])
    table["edge"][on_air] = np.cumsum(air["degree"]) - air["degree"]
    table["next"] = number[table["next"]]
    return State(now_ns, phy, mac, table[alive], hearer[edge], arrival_mw[edge], reception[slot])
