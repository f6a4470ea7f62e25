"""A radio medium of one's own: every message reaches every station within a distance, at once."""

from dataclasses import dataclass

import numpy as np

from cosim.radio.message_round import FrameOutcomes, LosState, MessageRound, Outcome, receptions_of


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [radio] that belong to this medium."""

    ideal_range_m: float = 200.0
    """Distance within which everything is received [m]."""


class Ideal:
    """No losses, no delay, no channel."""

    Params = Params

    def __init__(self, params, round_s, seed, sight):
        self.params = params

    def start(self):
        return None

    def broadcast(self, state, kind, step, begin_s, stations, messages):
        xy, sent = stations.xyz_m[:, :2], np.flatnonzero(messages.length_bytes > 0)
        away_m = np.hypot(*(xy[:, None] - xy[messages.station[sent]][None]).T).T  # station, message
        near = away_m <= self.params.ideal_range_m
        near[messages.station[sent], np.arange(len(sent))] = False  # not one's own
        receiver, column = np.nonzero(near)
        message, n, zero = sent[column], len(column), np.zeros(len(column))
        ones = np.ones(n, int)
        frames = FrameOutcomes(
            message, receiver, ones, away_m[near], np.full(n, LosState.UNKNOWN, np.uint8),
            np.full(n, Outcome.RECEIVED), (messages.length_bytes > 0).astype(int), 0, 0,
            float(messages.length_bytes.sum()), None,
        )  # fmt: skip
        got = receptions_of(receiver, message, ones, zero, zero, zero, messages.station, xy)
        return state, MessageRound(messages.station, got, frames)
