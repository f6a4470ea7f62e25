"""What the channel does: how much of what could be heard is heard, where the rest goes, how far it carries."""

import numpy as np
import pandas as pd

from results.archive import Run

LOST = ("n_lost_propagation", "n_lost_collision", "n_lost_receiver_busy", "n_lost_expired", "n_lost_late")


def _traffic(run: Run) -> pd.DataFrame:
    frame = run.radio
    if not frame.n_in_reach.sum():
        raise ValueError(f"{run.path} holds no radio traffic: nobody had anybody in reach. Widen radio.reach_m.")
    return frame


def overall(run: Run) -> pd.DataFrame:
    """One row: n_sent, n_in_reach, delivery_ratio, the share lost to each cause, bytes, mean busy_ratio."""
    frame = _traffic(run)
    total = frame[["n_sent", "n_in_reach", "n_delivered", *LOST, "bytes"]].astype(np.float64).sum()
    row = {
        "n_sent": int(total.n_sent), "n_in_reach": int(total.n_in_reach),
        "delivery_ratio": total.n_delivered / total.n_in_reach,
        **{name.replace("n_lost", "lost"): total[name] / total.n_in_reach for name in LOST},
        "bytes": total.bytes, "busy_ratio": frame.busy_ratio.mean(),
    }  # fmt: skip
    return pd.DataFrame([row])


def over_time(run: Run, every_s: float = 10.0) -> pd.DataFrame:
    """Delivery by time: time_s, n_in_reach, delivery_ratio, busy_ratio."""
    frame = _traffic(run)
    slots = frame.groupby(np.floor(frame.step * run.dt_s / every_s) * every_s)
    total = slots[["n_in_reach", "n_delivered"]].sum()
    total = total[total.n_in_reach > 0]
    return pd.DataFrame({
        "time_s": total.index, "n_in_reach": total.n_in_reach.to_numpy(),
        "delivery_ratio": (total.n_delivered / total.n_in_reach).to_numpy(),
        "busy_ratio": slots.busy_ratio.mean().reindex(total.index).to_numpy(),
    })  # fmt: skip


def by_distance(run: Run) -> pd.DataFrame:
    """Delivery by distance: ring_m (lower edge), distance_m (middle), n_in_reach, delivery_ratio, shares lost."""
    total = run.links.drop(columns=["step", "message"]).groupby("ring_m").sum()
    total = total[total.n_in_reach > 0].reset_index()
    if total.empty:
        raise ValueError(f"{run.path} holds no radio traffic: nobody had anybody in reach. Widen radio.reach_m.")
    width = int(np.diff(total.ring_m).min()) if len(total) > 1 else 0
    shares = {name.replace("n_lost", "lost"): total[name] / total.n_in_reach for name in LOST}
    return pd.DataFrame({
        "ring_m": total.ring_m, "distance_m": total.ring_m + width / 2, "n_in_reach": total.n_in_reach,
        "delivery_ratio": total.n_delivered / total.n_in_reach, **shares,
    })  # fmt: skip
