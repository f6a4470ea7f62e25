"""Counts of the frames and messages of one round, by distance, latency and receiver."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.codes import DISTANCE_BIN_M, LATENCY_EDGES_S, LosState

Rows = dict[str, ndarray]


def pdr_by_distance(
    distance_m: Float[ndarray, "f"],
    los_state: UInt8[ndarray, "f"],
    outcome: Int[ndarray, "f"],
    columns: Mapping[str, int],
) -> tuple[Rows, Rows]:
    """Frames of one round at receivers within range, by distance bin, line of sight and outcome.

    Parameters
    ----------
    distance_m
        Distance between sender and receiver, per frame.
    los_state
        Line of sight per frame, as `LosState`.
    outcome
        Outcome per frame, as a code.
    columns
        The code that each column counts.

    Returns
    -------
    Columns of the table `pdr_by_distance` (distance_bin_m, los_state, n_in_range and `columns`), and the totals
    n_in_range and `columns`, one row.
    """
    bins, n_outcomes = _bins(distance_m), 1 + max(columns.values())
    cell = (bins * len(LosState) + los_state) * n_outcomes + outcome
    n_cells = (int(bins.max(initial=-1)) + 1) * len(LosState)
    counts = np.bincount(cell, minlength=n_cells * n_outcomes).reshape(n_cells, n_outcomes)
    cells = np.flatnonzero(counts.any(axis=1))
    total = counts.sum(axis=0)
    totals = {"n_in_range": np.array([len(outcome)])}
    totals |= {name: total[[code]] for name, code in columns.items()}
    return (
        {
            "distance_bin_m": cells // len(LosState) * DISTANCE_BIN_M,
            "los_state": cells % len(LosState),
            "n_in_range": counts[cells].sum(axis=1),
            **{name: counts[cells, code] for name, code in columns.items()},
        },
        totals,
    )


def _bins(distance_m: Float[ndarray, "f"]) -> Int[ndarray, "f"]:
    """Number of complete bins in each distance, without rounding errors."""
    n = (distance_m / DISTANCE_BIN_M).astype(np.int64)
    return n - (n * DISTANCE_BIN_M > distance_m)


def latency_histogram(latency_s: Float[ndarray, "m"]) -> Rows:
    """Columns latency_s and n_delivered of the table `latency_histogram`: messages by bin of latency."""
    counts = np.bincount(np.searchsorted(LATENCY_EDGES_S, latency_s, "right"))
    bins = np.flatnonzero(counts)
    return {"latency_s": np.append(0, LATENCY_EDGES_S)[bins], "n_delivered": counts[bins]}


def vehicle_channel(
    n: int,
    in_range: Sequence[Int[ndarray, "n"]],
    received: Sequence[Int[ndarray, "m"]],
    cbr: Float[ndarray, "n"] | None,
) -> Rows:
    """Columns cbr, n_in_range and n_received of the table `vehicle_channel`, over all rounds of a step.

    Parameters
    ----------
    n
        Number of receivers.
    in_range
        Per round and receiver, the number of messages of vehicles within communication range.
    received
        Per round, the receiver (0 to n - 1) of every message that was received.
    cbr
        As `channel_busy_ratio`.
    """
    n_in_range = np.zeros(n, int)
    n_received = np.zeros(n, int)
    for counts in in_range:
        n_in_range += counts
    for rows in received:
        n_received += np.bincount(rows, minlength=n)
    modelled = np.full(n, cbr is not None)
    cbr = np.zeros(n) if cbr is None else cbr
    return {"cbr": cbr, "cbr__valid": modelled, "n_in_range": n_in_range, "n_received": n_received}


def channel_busy_ratio(n: int, busy: Sequence[ndarray | None]) -> Float[ndarray, "n"] | None:
    """Share of the time in which each of the first n stations sensed the channel busy, over all rounds of a step.

    None if the medium does not model it. `busy` has that of each round, as `cosim.step.broadcast.Broadcast.cbr`.
    """
    shares = [share for share in busy if share is not None]
    if not shares or len(shares) < len(busy):
        return None
    return np.mean([share[:n] for share in shares], axis=0)
