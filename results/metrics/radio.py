"""What the channel does: how much of what could be heard is heard, where the rest goes, how far it carries.

No figure of a radio means much without `conditions`.
"""

from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from results.run import Run

LOST = ("n_lost_propagation", "n_lost_collision", "n_lost_receiver_busy", "n_lost_expired", "n_lost_late")


def _traffic(run: Run) -> pd.DataFrame:
    frame = run.radio
    if not frame.n_in_reach.sum():
        raise ValueError(f"{run.path} holds no radio traffic: nobody had anybody in reach. Widen radio.range_m.")
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


def by_distance(run: Run, by_view: bool = False) -> pd.DataFrame:
    """Delivery by distance: ring_m (lower edge), distance_m (middle), n_in_reach, delivery_ratio, shares lost.

    With `by_view` also by what stands between the two ends: view is open, wall, or unknown.
    """
    by = ["view", "ring_m"] if by_view else ["ring_m"]
    counts = ["n_in_reach", "n_delivered", *LOST]
    total = run.links.groupby(by, observed=True)[counts].sum()
    total = total[total.n_in_reach > 0].reset_index()
    if total.empty:
        raise ValueError(f"{run.path} holds no radio traffic: nobody had anybody in reach. Widen radio.range_m.")
    rings = np.unique(total.ring_m)
    width = int(np.diff(rings).min()) if len(rings) > 1 else 0
    shares = {name.replace("n_lost", "lost"): total[name] / total.n_in_reach for name in LOST}
    return pd.DataFrame({
        **{name: total[name] for name in by}, "distance_m": total.ring_m + width / 2, "n_in_reach": total.n_in_reach,
        "delivery_ratio": total.n_delivered / total.n_in_reach, **shares,
    })  # fmt: skip


def latency(run: Run) -> pd.DataFrame:
    """Latency from generation to reception: message, latency_s (upper edge of the bin), n_delivered, share up to it."""
    frame = run.latencies.groupby(["message", "latency_s"], observed=True).n_delivered.sum().reset_index()
    if frame.empty:
        raise ValueError(f"{run.path} holds no radio traffic: nobody heard anybody. Widen radio.range_m.")
    messages = frame.groupby("message", observed=True).n_delivered
    frame["share"] = messages.cumsum() / messages.transform("sum")
    frame["latency_s"] = frame.latency_s.astype(np.float64) * np.sqrt(2)
    return frame


def inter_reception(run: Run, message: Literal["detections", "verdicts"] = "detections") -> pd.DataFrame:
    """Time between successive messages of one vehicle at another, while the two are within reach.

    Returns
    -------
    gap_s, n_lost (messages in between), n_received and n_parted (silences so long that ended in a reception, or in
    the two parting), longer: share of silences that last longer than this, by Kaplan-Meier, parting being no end.
    """
    frame = run.silences[run.silences.message == message].groupby("gap_steps")[["n_received", "n_parted"]].sum()
    if not frame.n_received.sum():
        raise ValueError(f"{run.path} holds no two {message} in a row: nobody heard anybody twice. Run longer.")
    ended, out_of_reach = frame.n_received.astype(np.float64), frame.n_parted
    at_risk = (ended + out_of_reach)[::-1].cumsum()[::-1]
    every = max(1, run.manifest.get("sense_every_steps", 1))
    n_lost = (frame.index // every - 1).to_numpy().clip(min=0)
    return pd.DataFrame({
        "gap_s": frame.index * run.dt_s, "n_lost": n_lost, "n_received": frame.n_received,
        "n_parted": out_of_reach, "longer": (1 - ended / at_risk).cumprod(),
    }).reset_index(drop=True)  # fmt: skip


def by_place(run: Run, cell_m: float = 50.0) -> pd.DataFrame:
    """What radios met with by where they were: x_m, y_m (middle of the cell), n, busy_ratio, delivery_ratio."""
    sums: list[pd.DataFrame] = []
    for ears in run.parts("ears"):
        during = (pc.field("step") >= int(ears.step.min())) & (pc.field("step") <= int(ears.step.max()))
        actors = run.table("actors", ["step", "actor", "x_m", "y_m"], during)
        here = ears.merge(actors, left_on=["step", "vehicle"], right_on=["step", "actor"])
        for axis in ("x_m", "y_m"):
            here[axis] = (np.floor(here[axis].astype(np.float64) / cell_m) + 0.5) * cell_m
        cells = here.assign(n=1).groupby(["x_m", "y_m"])
        sums.append(cells[["n", "busy_ratio", "n_in_reach", "n_heard"]].sum(min_count=1))
    if not sums:
        raise ValueError(f"{run.path} holds no radio traffic: no vehicle was equipped. Raise fleet.penetration_p.")
    total = pd.concat(sums).groupby(["x_m", "y_m"]).sum(min_count=1).reset_index()
    return pd.DataFrame({
        "x_m": total.x_m, "y_m": total.y_m, "n": total.n, "busy_ratio": total.busy_ratio / total.n,
        "delivery_ratio": (total.n_heard / total.n_in_reach.where(total.n_in_reach > 0)).astype(np.float64),
    })  # fmt: skip


def to_server(run: Run) -> pd.DataFrame:
    """One row: n_reports, shares reached, lost, over_capacity and outage of them, n_addressed, share informed."""
    total = run.server.drop(columns="step").sum()
    if not total.get("n_reports", 0):
        raise ValueError(f'{run.path} holds no reports to a trust server. Set trust.where = "central".')
    shares = {name: total["n_" + name] / total.n_reports for name in ("reached", "lost", "over_capacity", "outage")}
    informed = total.n_informed / total.n_addressed if total.n_addressed else np.nan
    return pd.DataFrame([{
        "n_reports": int(total.n_reports), **shares, "n_addressed": int(total.n_addressed), "informed": informed,
    }])  # fmt: skip


def conditions(run: Run) -> pd.DataFrame:
    """Under what assumptions the figures of the radio hold: condition, is (in words), value, unit."""
    radio: dict[str, Any] = run.config.get("radio", {})
    if "model" not in radio:
        raise ValueError(f"{run.path}/manifest.json does not say what the radio was like.")
    rows: list[tuple[str, str, float, str]] = [("model", radio["model"], np.nan, "")]
    if radio["model"] == "unit_disk":
        rows += [
            ("reach", "", radio["range_m"], "m"), ("flat loss per hop", "", radio["unit_disk"]["loss_p"], "1"),
            *((name, "none: disk", np.nan, "") for name in ("receiver threshold", "non-line-of-sight model", "fading",
              "congestion control")),
        ]  # fmt: skip
    else:
        air, p = radio["propagation"], radio["receiver"]
        urban = air["model"] in ("urban", "highway")
        wall = {"3gpp": "TR 37.885 NLOS" if urban else "none", "sommer": f"{air['wall_db']:g} dB per wall, "
                f"{air['indoors_db_per_m']:g} dB/m inside (Sommer)"}[air["walls"]]  # fmt: skip
        shape = {"none": "none", "nakagami": "Nakagami m = 1.5 to 80 m, 0.75 beyond", "rayleigh": "Rayleigh",
                 "cheng": "Nakagami, m by Cheng"}[air["fading"]]  # fmt: skip
        rows += [
            ("path loss", f"TR 37.885 {air['model']}" if urban else air["model"].replace("_", " "), np.nan, ""),
            ("receiver threshold", f"SINR at least {p['sinr_min_db']:g} dB", p["p_min_dbm"], "dBm"),
            ("non-line-of-sight model", wall, np.nan, ""), ("fading", shape, np.nan, ""),
            ("congestion control", "reactive" if radio["dcc"]["enabled"] else "off", np.nan, ""),
            ("reach", "", radio["range_m"], "m"),
        ]  # fmt: skip
    rows += [
        ("hops at most", "", radio["relay"]["max_hops"], ""),
        ("penetration", ", ".join(run.config["fleet"]["equipped_kinds"]), run.config["fleet"]["penetration_p"], "1"),
    ]
    return pd.DataFrame(rows, columns=["condition", "is", "value", "unit"])
