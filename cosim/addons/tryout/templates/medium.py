"""A radio medium: all stations within a distance receive a message, except for random losses."""

from dataclasses import dataclass

import numpy as np

from cosim.extend import MessageRound, draws


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [radio] that belong to this medium."""

    reach_m: float = 200.0  # distance within which a message can be received
    loss_p: float = 0.1  # probability that a receiver does not get it


class MyMedium:
    Params = Params

    def __init__(self, params, round_s, seed, los):  # seconds of a round; the run's seed; lines of sight
        self.params, self.seed = params, seed

    def start(self):
        return None  # the state before the first round; this medium needs no state

    def broadcast(self, state, kind, step, begin_s, stations, messages):
        xy_m = stations.xyz_m[:, :2]
        sender_m = xy_m[messages.station]
        apart_m = np.linalg.norm(xy_m[:, None] - sender_m, axis=2)  # station by message
        near = (apart_m <= self.params.reach_m) & (messages.length_bytes > 0)  # a message of length 0 is not sent
        near[messages.station, np.arange(len(messages))] = False  # no station receives its own message
        receiver, message = np.nonzero(near)
        # Random numbers depend on the seed, the step and names only, so that other stations do not change them.
        sent = messages.keys(stations)[message]
        names = stations.key[receiver], sent, np.full(len(message), kind)
        lost = draws(self.seed, step, names)[:, 0] < self.params.loss_p
        return state, MessageRound.of(
            stations,
            messages,
            receiver[~lost],
            message[~lost],
            latency_s=0.001,
            lost_receiver=receiver[lost],
            lost_message=message[lost],
        )
