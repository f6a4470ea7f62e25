"""The channel: packet delivery ratio, losses by cause, latency, packet inter-reception time, channel busy ratio.

They rest on the assumptions of the section [radio] of the config.
"""

from typing import Any, Literal

import numpy as np
import pandas as pd

from cosim.base.codes import DISTANCE_BIN_M, LATENCY_EDGES_S
from results.run import WINDOW_S, Run

MessageType = Literal["cpm", "evaluation"]

LOST = ("n_lost_propagation", "n_lost_collision", "n_lost_receiver_busy", "n_lost_expired", "n_lost_late")
LEFT_OUT = ("n_waiting", "n_not_due", "n_redundant", "n_over_limit")

_PDR = "sum(n_in_range)::BIGINT AS n_in_range, sum(n_delivered) / nullif(sum(n_in_range), 0) AS pdr"
_LOSSES = ", ".join(f"sum({name}) / nullif(sum(n_in_range), 0) AS {name[2:]}" for name in LOST)
_ROAD_S = "(SELECT sum(n_steps) * $dt_s FROM vehicles WHERE equipped)"
"""Time that equipped vehicles are on the road."""


def _asked(run: Run, what: str, why: str, query: str, **values: Any) -> pd.DataFrame:
    """What SQL answers. ValueError where it answers nothing: `what` there is none of, and why (if empty, it is that no
    message was received)."""
    found = run.sql(query, **values)
    if found.empty:
        raise run.lacks(what, why or why_none_received(run))
    return found


_TRAFFIC = "radio traffic"
_NOBODY = "no vehicle had another in range. Raise fleet.penetration_p or radio.range_m."


def overall(run: Run, message_type: MessageType | None = None) -> pd.DataFrame:
    """One row, of one message type or of all: n_sent, n_in_range, pdr, shares lost by cause, sent_bytes, mean cbr."""
    return _asked(
        run,
        _TRAFFIC,
        _NOBODY,
        f"""
        SELECT sum(n_sent)::BIGINT AS n_sent, {_PDR}, {_LOSSES}, sum(sent_bytes::DOUBLE) AS sent_bytes,
            avg(cbr::DOUBLE) AS cbr
        FROM radio WHERE $message_type IS NULL OR message_type = $message_type
        HAVING (SELECT sum(n_in_range) FROM radio) > 0
    """,
        message_type=message_type,
    )


def over_time(run: Run, every_s: float = 10.0) -> pd.DataFrame:
    """Packet delivery ratio by time: time_s, n_in_range, pdr, cbr."""
    return _asked(
        run,
        _TRAFFIC,
        _NOBODY,
        f"""
        SELECT {WINDOW_S} AS time_s, {_PDR}, avg(cbr::DOUBLE) AS cbr
        FROM radio GROUP BY time_s HAVING sum(n_in_range) > 0 ORDER BY time_s
    """,
        every_s=every_s,
    )


def by_distance(run: Run, by_los: bool = False) -> pd.DataFrame:
    """Packet delivery ratio by distance: distance_bin_m (lower edge), distance_m (middle), n_in_range, pdr, losses.

    With `by_los` also by line of sight between the two ends: los_state is los, nlos, or unknown.
    """
    by = "los_state, distance_bin_m" if by_los else "distance_bin_m"
    return _asked(
        run,
        _TRAFFIC,
        _NOBODY,
        f"""
        SELECT {by}, distance_bin_m + {DISTANCE_BIN_M / 2}::DOUBLE AS distance_m, {_PDR}, {_LOSSES}
        FROM pdr_by_distance GROUP BY {by} HAVING sum(n_in_range) > 0 ORDER BY {by}
    """,
    )


def by_los(run: Run) -> pd.DataFrame:
    """Packet delivery ratio by line of sight: los_state, n_in_range, pdr."""
    query = f"SELECT los_state, {_PDR} FROM pdr_by_distance GROUP BY los_state HAVING sum(n_in_range) > 0 ORDER BY ALL"
    return _asked(run, _TRAFFIC, _NOBODY, query)


def why_none_received(run: Run) -> str:
    """Why no message was received or used: nobody was within range, or all frames were lost, and what to change."""
    found = run.sql("SELECT coalesce(sum(n_in_range), 0) AS n, sum(n_delivered) AS n_delivered FROM radio").iloc[0]
    if not found.n:
        return _NOBODY
    if found.n_delivered:
        return "no message arrived in time to be used. Run longer."
    is_disk = run.config.get("radio", {}).get("model") == "unit_disk"
    cure = "Lower radio.unit_disk.loss_p." if is_disk else "The metrics radio.lost say why; change the section [radio]."
    return f"all {found.n:,.0f} frames within range were lost. {cure}"


def latency(run: Run) -> pd.DataFrame:
    """Latency from generation to reception: message_type, latency_s (upper bin edge), n_delivered, share up to it."""
    frame = _asked(
        run,
        _TRAFFIC,
        "",
        """
        SELECT message_type, latency_s, sum(n_delivered)::BIGINT AS n_delivered,
            sum(sum(n_delivered)) OVER (PARTITION BY message_type ORDER BY latency_s)
                / sum(sum(n_delivered)) OVER (PARTITION BY message_type) AS share
        FROM latency_histogram GROUP BY message_type, latency_s ORDER BY message_type, latency_s
    """,
    )
    lower_s = frame.latency_s.to_numpy(np.float64) * (1 + 1e-6)  # stored in single precision
    bin_ = np.searchsorted(LATENCY_EDGES_S, lower_s)
    frame["latency_s"] = LATENCY_EDGES_S[bin_.clip(max=len(LATENCY_EDGES_S) - 1)]
    return frame


def latency_quantiles(run: Run) -> pd.DataFrame:
    """One row, of all messages together: median_s and p95_s of the latency, upper edges of bins."""
    late = latency(run).groupby("latency_s").n_delivered.sum().cumsum()
    row = {}
    for name, share in (("median_s", 0.5), ("p95_s", 0.95)):
        n = share * late.iloc[-1]
        row[name] = late.index[late >= n][0]
    return pd.DataFrame([row])


def inter_reception(run: Run, message_type: MessageType = "cpm") -> pd.DataFrame:
    """Packet inter-reception time: between successive messages of one vehicle at another, while within range.

    Returns
    -------
    pir_s, n_lost (messages in between), n_received and n_censored (intervals so long that a reception ended, or
    that were cut off when the two got out of range), longer: share of intervals that last longer, by Kaplan-Meier.
    n_lost is NaN where vehicles do not all send in every sensing interval: a long interval is no loss then.
    """
    what = f"two messages of type {message_type} in a row of any pair"
    is_too_short = run.sql("SELECT sum(n_delivered) > 0 AS some FROM radio").some.fillna(False)[0]
    found = _asked(
        run,
        what,
        "it is too short. Run longer." if is_too_short else "",
        """
        WITH counts AS (
            SELECT pir_steps, sum(n_received)::BIGINT AS n_received, sum(n_censored)::BIGINT AS n_censored
            FROM packet_inter_reception WHERE message_type = $message_type GROUP BY pir_steps
        ), at_risk AS (
            SELECT *, sum(n_received + n_censored) OVER (ORDER BY pir_steps DESC) AS n FROM counts
        )
        SELECT pir_steps * $dt_s AS pir_s, greatest(pir_steps // $every - 1, 0) AS n_lost, n_received, n_censored,
            product(1 - n_received / n) OVER (ORDER BY pir_steps) AS longer
        FROM at_risk WHERE (SELECT sum(n_received) FROM counts) > 0 ORDER BY pir_steps
    """,
        message_type=message_type,
        every=max(1, run.manifest.get("sense_every_steps", 1)),
    )
    return found if _sends_in_every_interval(run, message_type) else found.assign(n_lost=np.nan)


def _sends_in_every_interval(run: Run, message_type: MessageType) -> bool:
    """Whether every vehicle sends a message of this type in every `sensing_interval_s`."""
    has_rules = message_type == "cpm" and run.config.get("cpm", {}).get("rules", "all") != "all"
    return not run.config.get("sensing_groups") and not has_rules


def inter_reception_means(run: Run) -> pd.DataFrame:
    """One row, of detection messages: mean_s, after_loss (share of intervals with a loss), n_lost (mean of them).

    The last two are NaN where `inter_reception` does not know what was lost.
    """
    pir = inter_reception(run)
    n, mean_s = pir.n_received, np.average(pir.pir_s, weights=pir.n_received)
    if pir.n_lost.isna().any():
        return pd.DataFrame([{"mean_s": mean_s, "after_loss": np.nan, "n_lost": np.nan}])
    lost = n[pir.n_lost > 0].sum()
    n_lost = (pir.n_lost * n).sum() / lost if lost else np.nan
    return pd.DataFrame([{"mean_s": mean_s, "after_loss": lost / n.sum(), "n_lost": n_lost}])


def cpm(run: Run) -> pd.DataFrame:
    """One row: n_sent (detection messages), rate_hz, objects and length_bytes per message, shares of objects left out.

    The rate is that of one equipped vehicle while it is on the road, under all its pseudonyms together. The shares are
    of all objects that vehicles would report, in columns named as in the table `cpm_content`.
    """
    left_out = ", ".join(f"sum({name}) / nullif(sum(n_objects), 0) AS {name}" for name in LEFT_OUT)
    return _asked(
        run,
        "detection messages",
        "no vehicle sent one. Raise fleet.penetration_p.",
        f"""
        WITH rows AS (SELECT *, length_bytes > 0 AS sent FROM cpm_content)
        SELECT count_if(sent) AS n_sent, count_if(sent) / {_ROAD_S} AS rate_hz,
            avg(n_included) FILTER (sent) AS objects, avg(length_bytes) FILTER (sent) AS length_bytes, {left_out}
        FROM rows HAVING count_if(sent) > 0
    """,
    )


def cpm_left_out(run: Run) -> pd.DataFrame:
    """reason, share: objects left out of detection messages."""
    found = cpm(run).iloc[0]
    rows = [{"reason": name[2:].replace("_", " "), "share": found[name]} for name in LEFT_OUT]
    return pd.DataFrame(rows)


def clouds(run: Run) -> pd.DataFrame:
    """One row: what `[early_fusion]` asks of the channel, and what arrives.

    Returns
    -------
    offered_mbps and delivered_mbps (sent by, and received in whole sweeps by, one equipped vehicle on the road, mean),
    and complete (share of the sweeps that a vehicle within range receives whole).
    """
    return _asked(
        run,
        "point clouds",
        'none is sent. Set early_fusion.share to "objects" or "sweep".',
        f"""
        SELECT 8e-6 * sum(length_bytes) FILTER (sender IN (FROM vehicles SELECT vehicle WHERE equipped)) / {_ROAD_S}
                AS offered_mbps,
            8e-6 * sum(length_bytes::DOUBLE * (n_received + n_received_late)) / {_ROAD_S} AS delivered_mbps,
            sum(n_received + n_received_late) / nullif(sum(n_in_range), 0) AS complete
        FROM clouds HAVING count(*) > 0
    """,
    )


def by_place(run: Run, cell_m: float = 50.0) -> pd.DataFrame:
    """The channel by place of the receiver: x_m, y_m (middle of the cell), n, cbr, pdr (of messages).

    With relays pdr is NaN: vehicles receive messages from beyond range, which are not among those sent within range.
    """
    found = _asked(
        run,
        _TRAFFIC,
        "no vehicle was equipped. Raise fleet.penetration_p.",
        """
        SELECT (floor(a.x_m::DOUBLE / $cell_m) + 0.5::DOUBLE) * $cell_m AS x_m,
            (floor(a.y_m::DOUBLE / $cell_m) + 0.5::DOUBLE) * $cell_m AS y_m,
            count(*) AS n, sum(cbr::DOUBLE) / count(*) AS cbr, sum(n_received) / nullif(sum(n_in_range), 0) AS pdr
        FROM vehicle_channel c JOIN actors a ON a.step = c.step AND a.actor = c.vehicle
        GROUP BY ALL ORDER BY ALL
    """,
        cell_m=float(cell_m),
    )
    forwards = run.config.get("radio", {}).get("relay", {}).get("max_hops", 1) > 1
    return found.assign(pdr=np.nan) if forwards else found


def to_server(run: Run) -> pd.DataFrame:
    """One row: n_reports, shares reached, lost, over_capacity and outage of them, n_addressed, share informed.

    No row if the run's variant has no server.
    """
    found = run.sql("""
        SELECT sum(n_reports)::BIGINT AS n_reports, sum(n_reached + n_late) / nullif(sum(n_reports), 0) AS reached,
            sum(n_lost - n_late) / nullif(sum(n_reports), 0) AS lost,
            sum(n_over_capacity) / nullif(sum(n_reports), 0) AS over_capacity,
            sum(n_outage) / nullif(sum(n_reports), 0) AS outage, sum(n_addressed)::BIGINT AS n_addressed,
            sum(n_informed) / nullif(sum(n_addressed), 0) AS informed
        FROM server WHERE variant = $variant HAVING count(*) > 0
    """)
    if len(found) and not found.n_reports[0]:
        raise run.lacks("reports to a trust server", 'nobody sent one. Set trust.host = "central".')
    return found
