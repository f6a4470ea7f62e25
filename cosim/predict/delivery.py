"""Delivery of broadcast messages between equipped vehicles, from their positions and the parameters of the radio."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.special import gammainc

from cosim import rng
from cosim.config.config import Config
from cosim.radio import link_budget
from cosim.radio.message_round import Stations
from cosim.radio.params import RadioParams
from cosim.radio.phy import CURVES, MAC_OVERHEAD_BYTES, ReceiverParams
from cosim.radio.propagation import fading_quantiles
from cosim.radio.rsu import NO_RSUS
from cosim.radio.segmentation import segments
from cosim.step.exchange import stations_of
from cosim.v2x.cellular import CellularParams
from cosim.world import World
from sensors.line_of_sight import LosOfPlaces

_DB_STEP = 0.25
"""Step of the table of success over mean power [dB]."""


class Links(NamedTuple):
    """Pairs of a sender and a receiver with a link; rows of the equipped vehicles."""

    sender: Int[ndarray, "p"]
    receiver: Int[ndarray, "p"]
    delivered_p: Callable[[Float[ndarray, "e"]], Float[ndarray, "p"]]
    """From the length of each vehicle's message [B]: the probability that each link delivers it."""


@dataclass(frozen=True, slots=True)
class Delivery:
    """Links of the radio that a config names."""

    params: RadioParams
    seed: int
    los: LosOfPlaces

    @staticmethod
    def of(config: Config, los: LosOfPlaces) -> "Delivery":
        """The radio of a config.

        Raises
        ------
        ValueError
            If the law does not cover it.
        """
        if config.radio.model not in ("csma", "unit_disk"):
            raise ValueError(
                f'radio.model = "{config.radio.model}": the law knows the delivery of "csma" and "unit_disk" only. '
                "Set radio.model to one of them."
            )
        return Delivery(config.radio, config.seed, los)

    def links(self, world: World, row: Int[ndarray, "e"]) -> Links:
        """Links between the vehicles in these rows of the world."""
        stations = stations_of(world, row, NO_RSUS, self.params.antenna_above_roof_m)
        if self.params.model == "unit_disk":
            sender, receiver, _ = link_budget.neighbours(stations.xyz_m[:, :2], self.params.range_m)
            p = np.full(len(sender), 1.0 - self.params.unit_disk.loss_p)
            return Links(sender, receiver, lambda length: p)
        return self._csma(stations)

    def _csma(self, stations: Stations) -> Links:
        """Links of the medium `csma`: path loss, shadowing and blockage are those of the run, fading is averaged.

        Other frames on the channel are neglected (assumption 8).
        """
        p, xyz_m = self.params.propagation, stations.xyz_m
        shadowing = rng.key(self.seed, rng.Stream.SHADOWING)
        links, _, _ = link_budget.links_between(
            xyz_m, stations.key, p, shadowing, self.los, above_street_m=stations.above_street_m
        )
        sender = np.repeat(np.arange(len(stations)), np.diff(links.ptr))
        apart_m = np.hypot(*(xyz_m[sender, :2] - xyz_m[links.receiver, :2]).T)
        power_dbm = 10 * np.log10(links.power_mw)
        strongest_dbm = power_dbm + 10 * np.log10(fading_quantiles()[links.fading, -1])
        near = np.flatnonzero(
            (apart_m <= self.params.range_m) & (strongest_dbm >= self.params.receiver.detectable_dbm)
        )
        sender, receiver = sender[near], links.receiver[near].astype(np.int64)
        power_dbm, fading = power_dbm[near], links.fading[near]

        def delivered_p(length_bytes: Float[ndarray, "e"]) -> Float[ndarray, "p"]:
            n, each = segments(np.maximum(np.rint(length_bytes), 1).astype(np.int64))
            frame = received_p(power_dbm, fading, each[sender] + MAC_OVERHEAD_BYTES, self.params.receiver)
            return frame ** n[sender]

        return Links(sender, receiver, delivered_p)


def received_p(
    power_dbm: Float[ndarray, "p"], fading: Int[ndarray, "p"], length_bytes: Int[ndarray, "p"], params: ReceiverParams
) -> Float[ndarray, "p"]:
    """Probability that a frame is received on an idle channel, over fading.

    Parameters
    ----------
    power_dbm
        Mean received power of each link.
    fading
        Class of fading, as a row of `fading_quantiles`.
    length_bytes
        Length of the frame with its MAC overhead.
    params
        The receiver.

    Notes
    -----
    The preamble needs `params.detectable_dbm`, and the payload succeeds with the probability of `phy.CURVES`.
    Success is tabulated over the mean power in steps of 0.25 dB and over lengths in steps of 64 B.
    """
    low, table = _success(params)
    level = np.clip((power_dbm - low) / _DB_STEP, 0, table.shape[2] - 1.001)
    size = np.clip(length_bytes / 64, 0, table.shape[1] - 1).astype(np.int64)
    i = level.astype(np.int64)
    t = level - i
    return (1 - t) * table[fading, size, i] + t * table[fading, size, i + 1]


@cache
def _success(params: ReceiverParams) -> tuple[float, Float[ndarray, "classes lengths levels"]]:
    """Lowest mean power of the table [dBm], and success by fading class, length and mean power."""
    gains_db = 10 * np.log10(np.maximum(fading_quantiles().astype(float), 1e-30))
    low = params.detectable_dbm - 15.0
    mean_dbm = low + _DB_STEP * np.arange(int(75 / _DB_STEP))
    lengths = 64.0 * np.arange(1, 38)
    x0, w = CURVES[params.error_model][params.rate_mbps]
    table = np.empty((len(gains_db), len(lengths), len(mean_dbm)))
    for fading, gain_db in enumerate(gains_db):
        dbm = mean_dbm[:, None] + gain_db[None, ::8]
        errors = np.exp(np.minimum((x0 - (dbm - params.noise_dbm)) / w, 50.0)) / 336.0
        detected = dbm >= params.detectable_dbm
        for k, length in enumerate(lengths):
            table[fading, k] = np.mean(detected * np.exp(-length * errors), axis=1)
    return low, table


def arrival_p(within_s: Float[ndarray, "n"], loss_p: float, n_retries: int, params: CellularParams) -> ndarray:
    """Probability that a message over the cellular network arrives within a time.

    Parameters
    ----------
    within_s
        Times since sending [s].
    loss_p
        Probability that one attempt fails.
    n_retries
        Number of attempts after the first one.
    params
        Delays of the network.

    Notes
    -----
    Attempt a + 1 succeeds with probability (1 - l) l^a. Its delay is the sum of a + 1 delays: (a + 1) delay_min plus a
    Gamma variable of shape 2 (a + 1) and scale (delay_mean - delay_min) / 2.   Deviations: none.
    """
    within_s = np.asarray(within_s, float)
    scale_s = (params.delay_mean_s - params.delay_min_s) / 2
    total = np.zeros(within_s.shape)
    for a in range(n_retries + 1):
        left_s = within_s - (a + 1) * params.delay_min_s
        if scale_s > 0:
            arrived = gammainc(2 * (a + 1), np.maximum(left_s, 0.0) / scale_s)
        else:
            arrived = (left_s >= 0).astype(float)
        total += (1 - loss_p) * loss_p**a * arrived
    return total
