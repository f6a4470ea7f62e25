"""The channel: packet delivery ratio, losses by cause, latency, packet inter-reception time, channel busy ratio.

Read them beside `conditions`, the assumptions that they rest on.
"""

from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from cosim.base.codes import DISTANCE_BIN_M, LATENCY_EDGES_S
from results.run import Run

MessageType = Literal["cpm", "evaluation"]

LOST = ("n_lost_propagation", "n_lost_collision", "n_lost_receiver_busy", "n_lost_expired", "n_lost_late")


def _traffic(run: Run) -> pd.DataFrame:
    frame = run.radio
    if not frame.n_in_range.sum():
        raise ValueError(f"{run.path} holds no radio traffic: no vehicle had another in range. Raise radio.range_m.")
    return frame


def overall(run: Run, message_type: MessageType | None = None) -> pd.DataFrame:
    """One row, of one message type or of all: n_sent, n_in_range, pdr, shares lost by cause, sent_bytes, mean cbr."""
    frame = _traffic(run)
    if message_type is not None:
        frame = frame[frame.message_type == message_type]
    total = frame[["n_sent", "n_in_range", "n_delivered", *LOST, "sent_bytes"]].astype(np.float64).sum()
    row = {
        "n_sent": int(total.n_sent), "n_in_range": int(total.n_in_range),
        "pdr": total.n_delivered / total.n_in_range if total.n_in_range else np.nan,
        **{name[2:]: total[name] / total.n_in_range if total.n_in_range else np.nan for name in LOST},
        "sent_bytes": total.sent_bytes, "cbr": frame.cbr.astype(np.float64).mean(),
    }  # fmt: skip
    return pd.DataFrame([row])


def over_time(run: Run, every_s: float = 10.0) -> pd.DataFrame:
    """Packet delivery ratio by time: time_s, n_in_range, pdr, cbr."""
    frame = _traffic(run)
    slots = frame.astype({"cbr": np.float64}).groupby(np.floor(frame.step * run.dt_s / every_s) * every_s)
    total = slots[["n_in_range", "n_delivered"]].sum()
    total = total[total.n_in_range > 0]
    return pd.DataFrame({
        "time_s": total.index, "n_in_range": total.n_in_range.to_numpy(),
        "pdr": (total.n_delivered / total.n_in_range).to_numpy(),
        "cbr": slots.cbr.mean().reindex(total.index).to_numpy(),
    })  # fmt: skip


def by_distance(run: Run, by_los: bool = False) -> pd.DataFrame:
    """Packet delivery ratio by distance: distance_bin_m (lower edge), distance_m (middle), n_in_range, pdr, losses.

    With `by_los` also by line of sight between the two ends: los_state is los, nlos, or unknown.
    """
    by = ["los_state", "distance_bin_m"] if by_los else ["distance_bin_m"]
    counts = ["n_in_range", "n_delivered", *LOST]
    total = run.pdr_by_distance.groupby(by, observed=True)[counts].sum()
    total = total[total.n_in_range > 0].reset_index()
    if total.empty:
        raise ValueError(f"{run.path} holds no radio traffic: no vehicle had another in range. Raise radio.range_m.")
    shares = {name[2:]: total[name] / total.n_in_range for name in LOST}
    return pd.DataFrame({
        **{name: total[name] for name in by}, "distance_m": total.distance_bin_m + DISTANCE_BIN_M / 2,
        "n_in_range": total.n_in_range,
        "pdr": total.n_delivered / total.n_in_range, **shares,
    })  # fmt: skip


def latency(run: Run) -> pd.DataFrame:
    """Latency from generation to reception: message_type, latency_s (upper bin edge), n_delivered, share up to it."""
    frame = run.latency_histogram.groupby(["message_type", "latency_s"], observed=True).n_delivered.sum().reset_index()
    if frame.empty:
        raise ValueError(f"{run.path} holds no radio traffic: no message was received. Raise radio.range_m.")
    messages = frame.groupby("message_type", observed=True).n_delivered
    frame["share"] = messages.cumsum() / messages.transform("sum")
    lower_s = frame.latency_s.to_numpy(np.float64) * (1 + 1e-6)  # stored in single precision
    frame["latency_s"] = LATENCY_EDGES_S[np.searchsorted(LATENCY_EDGES_S, lower_s).clip(max=len(LATENCY_EDGES_S) - 1)]
    return frame


def inter_reception(run: Run, message_type: MessageType = "cpm") -> pd.DataFrame:
    """Packet inter-reception time: between successive messages of one vehicle at another, while within range.

    Returns
    -------
    pir_s, n_lost (messages in between), n_received and n_censored (intervals so long that a reception ended, or
    that were cut off when the two got out of range), longer: share of intervals that last longer, by Kaplan-Meier.
    """
    frame = (
        run.packet_inter_reception[run.packet_inter_reception.message_type == message_type]
        .groupby("pir_steps")[["n_received", "n_censored"]]
        .sum()
    )
    if not frame.n_received.sum():
        raise ValueError(f"{run.path} holds no two messages of type {message_type} in a row of any pair. Run longer.")
    ended, censored = frame.n_received.astype(np.float64), frame.n_censored
    at_risk = (ended + censored)[::-1].cumsum()[::-1]
    every = max(1, run.manifest.get("sense_every_steps", 1))
    n_lost = (frame.index // every - 1).to_numpy().clip(min=0)
    return pd.DataFrame({
        "pir_s": frame.index * run.dt_s, "n_lost": n_lost, "n_received": frame.n_received,
        "n_censored": censored, "longer": (1 - ended / at_risk).cumprod(),
    }).reset_index(drop=True)  # fmt: skip


LEFT_OUT = ("n_waiting", "n_not_due", "n_redundant", "n_over_limit")


def cpm(run: Run) -> pd.DataFrame:
    """One row: n_sent (detection messages), rate_hz, objects and length_bytes per message, shares of objects left out.

    The rate is that of one equipped vehicle while it is on the road, under all its pseudonyms together. The shares are
    of all objects that vehicles would report, in columns named as in the table `cpm_content`.
    """
    columns = ["length_bytes", "n_objects", "n_included", *LEFT_OUT]
    total, of_sent, n_sent = np.zeros(len(columns)), np.zeros(len(columns)), 0
    for part in run.parts("cpm_content", columns):
        rows = part[columns].to_numpy(np.float64)
        sent = rows[rows[:, 0] > 0]
        total, of_sent, n_sent = total + rows.sum(axis=0), of_sent + sent.sum(axis=0), n_sent + len(sent)
    if not n_sent:
        raise ValueError(f"{run.path} holds no detection messages: no vehicle sent one. Raise fleet.penetration_p.")
    vehicles = run.vehicles[run.vehicles.equipped]
    n_steps = (vehicles.last_step - vehicles.first_step + 1).sum()
    return pd.DataFrame([{
        "n_sent": n_sent, "rate_hz": n_sent / (n_steps * run.dt_s), "objects": of_sent[2] / n_sent,
        "length_bytes": of_sent[0] / n_sent,
        **{name: total[3 + i] / total[1] if total[1] else np.nan for i, name in enumerate(LEFT_OUT)},
    }])  # fmt: skip


def clouds(run: Run) -> pd.DataFrame:
    """One row: what `[early_fusion]` asks of the channel, and what arrives.

    Returns
    -------
    offered_mbps and delivered_mbps (sent by, and received in whole sweeps by, one equipped vehicle on the road, mean),
    and complete (share of the sweeps that a vehicle within range receives whole).
    """
    run.require("clouds")
    if not run.n_rows("clouds"):
        raise ValueError(f'{run.path} holds no point clouds. Set early_fusion.share to "objects" or "sweep".')
    sent = run.table("clouds", ["length_bytes", "n_in_range", "n_received"]).astype(np.float64)
    vehicles = run.vehicles[run.vehicles.equipped]
    road_s = (vehicles.last_step - vehicles.first_step + 1).sum() * run.dt_s
    return pd.DataFrame([{
        "offered_mbps": 8e-6 * sent.length_bytes.sum() / road_s,
        "delivered_mbps": 8e-6 * (sent.length_bytes * sent.n_received).sum() / road_s,
        "complete": sent.n_received.sum() / sent.n_in_range.sum() if sent.n_in_range.any() else np.nan,
    }])  # fmt: skip


def by_place(run: Run, cell_m: float = 50.0) -> pd.DataFrame:
    """The channel by place of the receiver: x_m, y_m (middle of the cell), n, cbr, pdr."""
    sums: list[pd.DataFrame] = []
    for channel in run.parts("vehicle_channel"):
        during = (pc.field("step") >= int(channel.step.min())) & (pc.field("step") <= int(channel.step.max()))
        actors = run.table("actors", ["step", "actor", "x_m", "y_m"], during)
        channel = channel.astype({"cbr": np.float64})
        here = channel.merge(actors, left_on=["step", "vehicle"], right_on=["step", "actor"])
        for axis in ("x_m", "y_m"):
            here[axis] = (np.floor(here[axis].astype(np.float64) / cell_m) + 0.5) * cell_m
        cells = here.assign(n=1).groupby(["x_m", "y_m"])
        sums.append(cells[["n", "cbr", "n_in_range", "n_received"]].sum(min_count=1))
    if not sums:
        raise ValueError(f"{run.path} holds no radio traffic: no vehicle was equipped. Raise fleet.penetration_p.")
    total = pd.concat(sums).groupby(["x_m", "y_m"]).sum(min_count=1).reset_index()
    return pd.DataFrame({
        "x_m": total.x_m, "y_m": total.y_m, "n": total.n, "cbr": total.cbr / total.n,
        "pdr": (total.n_received / total.n_in_range.where(total.n_in_range > 0)).astype(np.float64),
    })  # fmt: skip


def to_server(run: Run) -> pd.DataFrame:
    """One row: n_reports, shares reached, lost, over_capacity and outage of them, n_addressed, share informed."""
    total = run.variant_table("server").drop(columns=["step", "variant"]).sum()
    if not total.get("n_reports", 0):
        raise ValueError(f'{run.path} holds no reports to a trust server. Set trust.host = "central".')
    late = total.get("n_late", 0)
    total["n_reached"], total["n_lost"] = total.n_reached + late, total.n_lost - late
    shares = {name: total["n_" + name] / total.n_reports for name in ("reached", "lost", "over_capacity", "outage")}
    informed = total.n_informed / total.n_addressed if total.n_addressed else np.nan
    return pd.DataFrame([{
        "n_reports": int(total.n_reports), **shares, "n_addressed": int(total.n_addressed), "informed": informed,
    }])  # fmt: skip


def conditions(run: Run) -> pd.DataFrame:
    """Assumptions that the metrics of the radio rest on: condition, is (in words), value.

    Conditions are named as the metrics `radio.condition.<name>`; of a user's own medium there are the few that every
    medium has.
    """
    radio: dict[str, Any] = run.config.get("radio", {})
    if "model" not in radio:
        raise ValueError(f"{run.path}/manifest.json holds no section radio in its config.")
    rows: list[tuple[str, str, float]] = [
        ("model", radio["model"], np.nan), ("range", "", radio.get("range_m", radio.get("reach_m", np.nan))),
        ("max_hops", "", radio["relay"]["max_hops"]),
        ("penetration", ", ".join(run.config["fleet"]["equipped_kinds"]), run.config["fleet"]["penetration_p"]),
    ]  # fmt: skip
    if radio["model"] in ("disk", "unit_disk"):
        loss_p = radio[radio["model"]]["loss_p"]
        rows += [("loss_per_hop", "", loss_p)]
        rows += [(name, "not modelled", np.nan) for name in ("receiver_threshold", "nlos", "fading", "dcc")]
    elif radio["model"] == "csma":
        receiver, dcc = radio["receiver"], radio["dcc"]
        threshold = (f"SINR at least {receiver['sinr_min_db']:g} dB", receiver["p_min_dbm"])
        rows += _of_channel(
            radio["propagation"], threshold, dcc.get("algorithm", "reactive") if dcc["enabled"] else "off"
        )
    elif radio["model"] in ("nr_mode2", "lte_mode4"):
        sidelink = radio["sidelink"]
        threshold = (f"SINR of the control part at least {sidelink['control_sinr_db']:g} dB", np.nan)
        rows += _of_channel(
            radio["propagation"], threshold, "limits of occupancy" if sidelink["limits_occupancy"] else "off"
        )
    return pd.DataFrame(rows, columns=["condition", "is", "value"])


def _of_channel(propagation: dict[str, Any], threshold: tuple[str, float], dcc: str) -> list[tuple[str, str, float]]:
    tr_37885 = propagation["model"] in ("urban", "highway")
    nlos = {
        "3gpp": "TR 37.885 NLOS" if tr_37885 else "none",
        "sommer": f"{propagation['wall_db']:g} dB per wall, {propagation['indoors_db_per_m']:g} dB/m inside (Sommer)",
    }[propagation["walls"]]
    fading = {
        "none": "none", "nakagami": "Nakagami m = 1.5 to 80 m, 0.75 beyond", "rayleigh": "Rayleigh",
        "cheng": "Nakagami, m by Cheng",
    }[propagation["fading"]]  # fmt: skip
    path_loss = propagation["model"].replace("_", " ")
    return [
        ("path_loss", f"TR 37.885 {path_loss}" if tr_37885 else path_loss, np.nan),
        ("receiver_threshold", *threshold),
        ("nlos", nlos, np.nan),
        ("fading", fading, np.nan),
        ("dcc", dcc, np.nan),
    ]
