"""VeReMi NextGen: one JSON array of messages per receiver, all values strings.

Notes
-----
`veh_<vehicle>.json`. `pos` is "x,y,z", the centre of the box in metres east, north, up; `spd` [m/s]; `acl` along the
heading [m/s2]; `hed` clockwise from north [degrees]; times in nanoseconds; `sender_alias` is the pseudonym;
`attacker` is 1 from the first attack of the sender on. `distance_to_road_edge` is positive on a lane and negative
beside all of them [m], of the position as reported. `pos_noise` and `hed_noise` of a sender are the standard deviations
of the errors of its position and heading (`gnss`); a receiver's own state is the true one, in the step of
the reception. There is one profile of drivers. Messages without a self report state nothing of their sender, so they
are left out, and the export says how many.
"""

import json
from collections.abc import Iterator
from functools import partial

import numpy as np
import pandas as pd

from cosim.addons.export import kitti, messages
from cosim.addons.export.frames import compass_deg
from cosim.addons.export.messages import ExportedMessages
from results.moments import Clouds, File, Plan, Selection
from results.run import Run

TABLES = messages.TABLES

MESSAGE_BYTES = 640
"""Of one message, roughly."""

State = dict[str, str]
"""What is said of a vehicle at one time, by name."""

EXACT: State = {"pos_noise": "0,0,0", "spd_noise": "0", "acl_noise": "0", "hed_noise": "0", "driversProfile": "NORMAL"}


class VeremiNextGen:
    """VeReMi NextGen."""

    TABLES = TABLES

    def plan(self, selection: Selection) -> Plan:
        """Receivers in blocks."""
        sent = ExportedMessages(selection)
        names = kitti.names(selection)
        units = [*sent.units(_receivers), names]
        n = selection.run.n_rows("receptions")
        return Plan(tuple(units), 0, 0, 0.5 * MESSAGE_BYTES * n, sent.remarks())


def _receivers(sent: ExportedMessages, receivers: list[int], clouds: Clouds) -> Iterator[File]:
    found = sent.received(receivers)
    edge_m = sent.selection.road_edge_m(found.messages[["x_m", "y_m"]].to_numpy(float))
    whole = found.messages.assign(edge_m=edge_m)
    for receiver in receivers:
        got = whole[whole.receiver == receiver]
        if len(got):
            own = found.own[found.own.vehicle == receiver]
            yield File(f"veh_{receiver}.json", partial(_array, sent, own, got))


def _array(sent: ExportedMessages, own: pd.DataFrame, got: pd.DataFrame) -> bytes:
    at = np.searchsorted(own.step.to_numpy(), got.received_step.to_numpy())
    receiver = _states(own.iloc[at], EXACT)
    sender = _states(got, _noise(sent.selection.run))
    for state, edge_m in zip(sender, got.edge_m, strict=True):
        state["distance_to_road_edge"] = f"{edge_m:.4f}"
    number = sent.number(got.step.to_numpy(), got.sender.to_numpy())
    receive_ns = _ns(got.receive_s)
    send_ns = _ns(got.send_s)
    array = []
    for k, row in enumerate(got.itertuples()):
        array.append(
            {
                "rcvTime": receive_ns[k],
                "sendTime": send_ns[k],
                "sender_id": f"veh_{row.vehicle}",
                "sender_alias": str(row.sender),
                "messageID": str(number[k]),
                "attacker": "1" if row.is_attack else "0",
                "receiver": receiver[k],
                "sender": sender[k],
            }
        )
    return json.dumps(array, indent=1).encode()


def _ns(time_s: pd.Series) -> list[str]:
    ns = np.round(time_s.to_numpy(float) * 1e9)
    return [str(x) for x in ns.astype(np.int64).tolist()]


def _noise(run: Run) -> State:
    """What the errors of reported states are."""
    gnss = run.config.get("gnss", {})
    std_m, heading_deg = (float(gnss.get(name, 0.0)) for name in ("std_m", "heading_std_deg"))
    return EXACT | {"pos_noise": f"{std_m:g},{std_m:g},0", "hed_noise": f"{heading_deg:g}"}


def _states(rows: pd.DataFrame, noise: State) -> list[State]:
    places = zip(rows.x_m, rows.y_m, rows.z_m, strict=True)
    heading_deg = compass_deg(rows.yaw_rad.to_numpy())
    states = zip(places, rows.speed_mps, rows.acceleration_mps2, heading_deg, strict=True)
    return [
        {
            "pos": ",".join(f"{metres:.4f}" for metres in place),
            "spd": f"{speed:.4f}",
            "acl": f"{acceleration:.4f}",
            "hed": f"{heading:.4f}",
            **noise,
        }
        for place, speed, acceleration, heading in states
    ]
