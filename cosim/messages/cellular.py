"""The cellular network at application level: delay, loss, retries, capacity of cells."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim.base import rng
from cosim.base.bounds import Share
from cosim.base.ragged import differs_from_last

HEADER_BYTES = 18 + 20 + 8
"""Cellular, IP and UDP headers of a message [B]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CellularParams:
    """Public cellular network. The defaults are those of Eclipse MOSAIC's LTE cell (Tiergarten)."""

    delay_min_s: Annotated[float, Ge(0), Le(1e6)] = 0.05
    """Shortest delay of one attempt, either way [s]."""
    delay_mean_s: Annotated[float, Ge(0), Le(1e6)] = 0.15
    """Mean delay of one attempt, either way [s]. The part above the shortest delay has a Gamma distribution with
    shape 2."""
    uplink_loss_p: Share = 0.01
    """Probability that one attempt of a vehicle's report fails."""
    downlink_loss_p: Share = 0.01
    """Probability that a vehicle does not receive a broadcast of trust values. There are no retries."""
    n_retries: Annotated[int, Ge(0), Le(10)] = 2
    """Number of retries of a failed report. Each has its own delay."""
    cell_m: Annotated[float, Ge(1), Le(1e6)] = 1000.0
    """Side length of a cell [m]. Cells are the squares of a grid that begins at the network's origin."""
    cell_up_bytes_per_s: Annotated[float, Gt(0), Le(1e12)] = 3.5e6
    """Capacity of one cell for reports [B/s]. Reports that exceed it are dropped."""
    cell_down_bytes_per_s: Annotated[float, Gt(0), Le(1e12)] = 5.275e6
    """Capacity of one cell for the broadcast of trust values [B/s]."""

    def __post_init__(self) -> None:
        if self.delay_mean_s < self.delay_min_s:
            raise ValueError(
                f"server.cellular.delay_mean_s = {self.delay_mean_s:g} s is below server.cellular.delay_min_s = "
                f"{self.delay_min_s:g} s. Set a mean that is at least the minimum."
            )


def delay_s(u: Float[ndarray, "..."], params: CellularParams) -> Float[ndarray, "..."]:
    """Delays from uniforms in [0, 1): delay_min plus a Gamma(shape 2) variable of mean delay_mean - delay_min [s]."""
    scale_s = (params.delay_mean_s - params.delay_min_s) / 2
    return params.delay_min_s + scipy.special.gammaincinv(2.0, u) * scale_s


def transfer_delay_s(
    rng_key: np.uint64, key: UInt64[ndarray, "n"], loss_p: float, n_retries: int, params: CellularParams
) -> Float[ndarray, "n"]:
    """Time from sending to arrival of each message, including failed attempts.

    Parameters
    ----------
    rng_key
        Key of the draws of this step and direction.
    key
        Key of each message for random draws. All are different.
    loss_p
        Probability that one attempt fails.
    n_retries
        Number of attempts after the first one.

    Returns
    -------
    Delays [s]; inf if all attempts fail.
    """
    n = 1 + n_retries
    draws = rng.uniforms(rng_key, key, n=2 * n)  # loss, delay, loss, delay, ...
    arrives = draws[:, 0::2] >= loss_p
    total = np.cumsum(delay_s(draws[:, 1::2], params), axis=1)
    first = np.argmax(arrives, axis=1)
    until_first = total[np.arange(len(draws)), first]
    return np.where(arrives.any(axis=1), until_first, np.inf)


def within_capacity(
    xy_m: Float[ndarray, "n 2"],
    length_bytes: Int[ndarray, "n"],
    key: UInt64[ndarray, "n"],
    budget_bytes: float,
    cell_m: float,
) -> Bool[ndarray, "n"]:
    """Whether each message fits into the capacity of its cell. Messages are accepted in random order.

    Parameters
    ----------
    xy_m
        Positions of the senders.
    length_bytes
        Lengths of the messages.
    key
        Random keys that decide the order.
    budget_bytes
        Capacity of a cell.
    cell_m
        Side length of a cell.

    Notes
    -----
    Once a message does not fit, no later message of its cell fits, even if it is shorter.   Deviations: retries use no
    capacity of their own; messages beyond the capacity are lost.
    """
    cell = np.floor(xy_m / cell_m).astype(np.int64)
    order = np.lexsort((key, cell[:, 1], cell[:, 0]))
    column, row = cell[order].T
    first = np.flatnonzero(differs_from_last(column) | differs_from_last(row))
    n_messages = np.diff(np.append(first, len(order)))
    length = length_bytes[order]
    total = np.cumsum(length)
    before_cell = total[first] - length[first]
    before = np.repeat(before_cell, n_messages)
    taken = np.empty(len(order), bool)
    taken[order] = total - before <= budget_bytes
    return taken
