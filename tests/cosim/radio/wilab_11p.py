"""IEEE 802.11p in the setting of the WiLabV2Xsim reference run: 80 vehicles, 350 B at 10 Hz and 6 Mb/s."""

import numpy as np
from numpy import ndarray

from cosim.base import rng
from cosim.radio.channel import AccessParams, ChannelRules, ChannelState, Links, Packets, run_window
from cosim.radio.link_budget import from_db
from cosim.radio.phy import MAC_OVERHEAD_BYTES, ReceiverParams
from tests.cosim.radio.wilab import BIN_M, loss_db, positions

THRESHOLD_DB = 6.5
"""SINR that a frame needs there, at any time and on average."""
SHIFT_DB = 0.45
"""Our error curve `nist` at 350 B has its middle at 6.05 dB: all powers and thresholds are lower by this."""
PERIOD_NS = 100_000_000


def simulate(seed: int, n_bins: int) -> tuple[ndarray, ndarray, ndarray]:
    """One run of 15 s: received by our receiver, received by theirs, all packets, in bins of 10 m.

    Their receiver turns to each new frame that has 6.5 dB, also if it is receiving another one: its time since the
    last change, which must be below 4 us for this, is set to zero just before. A frame is received if its mean SINR,
    with the interference averaged over the frame, is 6.5 dB.
    """
    xy_m, n, g = positions(80), 80, np.random.default_rng(seed)
    key = rng.keys(np.uint64(seed), np.arange(n))
    receiver = np.array([[j for j in range(n) if j != i] for i in range(n)]).ravel()
    off, upper = ~np.eye(n, dtype=bool), np.triu_indices(n, 1)
    apart = np.linalg.norm(xy_m[:, :, None] - xy_m[:, None], axis=3)
    access = AccessParams(aifsn=(6, 6, 6, 6), cw=(15, 15, 15, 15))
    params = ReceiverParams(
        error_model="nist", noise_figure_db=6.0, p_min_dbm=-115.0, sinr_min_db=THRESHOLD_DB - SHIFT_DB,
        cca_dbm=-65.0 - SHIFT_DB, floor_dbm=-119.0, capture=True, capture_margin_db=THRESHOLD_DB - SHIFT_DB,
        capture_window_s=0.01,
    )  # fmt: skip
    rules, state = ChannelRules(np.uint64(seed), params, access), ChannelState.start()
    phase, shadow = g.integers(0, PERIOD_NS, n), np.zeros((n, n))
    values, ones = g.normal(0, 3.0, len(upper[0])), np.ones(n, np.int64)
    out = np.zeros((3, n_bins + 1))
    for k in range(len(xy_m)):
        if k:
            keeps = np.exp(-np.abs(apart[k] - apart[k - 1])[upper] / 25)
            values = keeps * values + np.sqrt(1 - keeps**2) * g.normal(0, 3.0, len(values))
        shadow[upper] = values
        power_mw = from_db(29.0 - SHIFT_DB - np.maximum(loss_db(apart[k]) - shadow - shadow.T, 0.0))
        links = Links(key, (n - 1) * np.arange(n + 1), receiver, power_mw[off], np.zeros(len(receiver), np.uint8))
        packets = Packets(
            np.arange(n), np.full(n, k, np.uint64), k * PERIOD_NS + phase, (350 - MAC_OVERHEAD_BYTES) * ones,
            np.full(n, 2, np.uint8), PERIOD_NS * ones, np.arange(n),
        )  # fmt: skip
        state, found = run_window(state, links, packets, (k + 1) * PERIOD_NS, rules)
        sender = np.repeat(found.tag, np.diff(found.ptr))
        d = apart[k][sender, found.receiver]
        bins = np.minimum((d / BIN_M).astype(int), n_bins)
        noise_mw = float(from_db(params.noise_dbm))
        theirs = by_their_receiver(found.tag, found.start_ns, found.end_ns, power_mw, noise_mw)
        for row, weight in enumerate((found.reception == 0, theirs[sender_row(found), found.receiver], None)):
            out[row] += np.bincount(bins, weight, n_bins + 1)
    return tuple(out[:, :n_bins])


def sender_row(found) -> ndarray:
    """Row of the frame of each reception."""
    return np.repeat(np.arange(len(found.tag)), np.diff(found.ptr))


def by_their_receiver(sender, start_ns, end_ns, power_mw, noise_mw: float) -> ndarray:
    """Whether each of F frames is received at each of N stations [F, N]."""
    least = float(from_db(THRESHOLD_DB - SHIFT_DB))
    order = np.argsort(start_ns, kind="stable")
    sender, start_ns, end_ns = sender[order], start_ns[order], end_ns[order]
    turned = np.full(power_mw.shape[0], -1)  # frame that each station receives
    got, average = np.zeros((len(order), len(turned)), bool), np.zeros((len(order), len(turned)))
    for f in range(len(order)):
        other = np.flatnonzero((start_ns < end_ns[f]) & (end_ns > start_ns[f]) & (np.arange(len(order)) != f))
        share = (np.minimum(end_ns[other], end_ns[f]) - np.maximum(start_ns[other], start_ns[f])) / (
            end_ns[f] - start_ns[f]
        )
        average[f] = power_mw[sender[f]] / (noise_mw + share @ power_mw[sender[other]])
        earlier = other[start_ns[other] <= start_ns[f]]
        at_once = power_mw[sender[f]] / (noise_mw + power_mw[sender[earlier]].sum(0))
        got[f] = (at_once > least) & (average[f] >= least)
        got[f, sender[other]] = got[f, sender[f]] = False  # half duplex
        got[np.ix_(earlier, np.flatnonzero(at_once > least))] = False  # the station turns to this frame
    back = np.empty_like(got)
    back[order] = got
    return back
