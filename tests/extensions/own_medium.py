"""A radio medium of one's own: every message reaches every station within a distance, at once."""

from dataclasses import dataclass

import numpy as np

from cosim.extend import MessageRound


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [radio] that belong to this medium."""

    ideal_range_m: float = 200.0
    """Distance within which everything is received [m]."""


class Ideal:
    """No losses, no delay, no channel."""

    Params = Params

    def __init__(self, params):
        self.params = params

    def start(self):
        return None

    def broadcast(self, state, kind, step, begin_s, stations, messages):
        xy, sent = stations.xyz_m[:, :2], np.flatnonzero(messages.length_bytes > 0)
        away_m = np.hypot(*(xy[:, None] - xy[messages.station[sent]][None]).T).T  # station, message
        near = away_m <= self.params.ideal_range_m
        near[messages.station[sent], np.arange(len(sent))] = False  # not one's own
        receiver, column = np.nonzero(near)
        return state, MessageRound.of(stations, messages, receiver, sent[column])
