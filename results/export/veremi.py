"""VeReMi Extension: what every receiver knows, as one JSON object per line, and the truth in a file of its own.

Notes
-----
`traceJSON-<vehicle>-<vehicle>-A<attack>-<first time>-0.json`: objects of type 2 are the receiver's own state, those of
type 3 are messages, as reported, in the order of reception. `traceGroundTruthJSON-0.json`: objects of type 4, every
message as its sender's true state would have it. Attack 0 is honest; the others are the codes of roles
(`attacks.csv`). Vectors are x east, y north, z up: `pos` is the centre of the box [m], `spd` and `acl` point along the
heading [m/s, m/s2], `hed` is its unit vector. There is no noise of positioning: `*_noise` is 0.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np
import pandas as pd

from results.export import kitti, messages
from results.export.messages import Messages
from results.export.moments import Clouds, File, Plan, Selection, Unit
from results.spreadsheet import csv_of

TABLES = messages.TABLES

LINE_BYTES = 460
"""Of one object, roughly."""

NOISE = [f'"{name}_noise":[0.0,0.0,0.0]' for name in ("pos", "spd", "acl", "hed")]


class Veremi:
    """VeReMi Extension."""

    TABLES = TABLES

    def plan(self, selection: Selection) -> Plan:
        """Receivers in blocks, then the ground truth."""
        sent = Messages(selection)
        units = [*sent.units(_receivers), Unit("ground truth", partial(_ground_truth, sent))]
        n = selection.run.n_rows("receptions")
        return Plan(tuple(units), 0, 0, float(LINE_BYTES) * (0.5 * n + len(sent.sent)))


def _receivers(sent: Messages, receivers: list[int], clouds: Clouds) -> Iterator[File]:
    found = sent.received(receivers)
    code = {label: i for i, label in enumerate(sent.selection.run.role_labels)}
    roles = sent.selection.run.roles
    for receiver in receivers:
        own = found.own[found.own.vehicle == receiver]
        if own.empty:
            continue
        first_s = own.step.iloc[0] * sent.selection.run.dt_s
        name = f"traceJSON-{receiver}-{receiver}-A{code[roles[receiver]]}-{first_s:g}-0.json"
        yield File(name, partial(_trace, sent, own, found.messages[found.messages.receiver == receiver]))


def _trace(sent: Messages, own: pd.DataFrame, got: pd.DataFrame) -> bytes:
    times_s = own.step.to_numpy() * sent.selection.run.dt_s
    lines = [f'{{"type":2,"rcvTime":{t:.9f},{m}}}' for t, m in zip(times_s.tolist(), _state(own), strict=True)]
    number = sent.number(got.step.to_numpy(), got.sender.to_numpy())
    rows = zip(got.receive_s, got.send_s, got.vehicle, got.sender, number, _state(got), strict=True)
    lines += [
        f'{{"type":3,"rcvTime":{r:.9f},"sendTime":{s:.9f},"sender":{v},"senderPseudo":{p},"messageID":{n},{m}}}'
        for r, s, v, p, n, m in rows
    ]
    order = np.argsort(np.concatenate([times_s, got.receive_s.to_numpy(float)]), kind="stable")
    return "".join(lines[i] + "\n" for i in order.tolist()).encode()


def _ground_truth(sent: Messages, clouds: Clouds) -> Iterator[File]:
    run = sent.selection.run
    senders = sorted(sent.sent.vehicle.unique().tolist())
    key = sent.sent[["step", "observer", "vehicle"]]
    whole = key.merge(sent.own(senders), on=["step", "vehicle"]).sort_values(["step", "observer"])
    yield File("traceGroundTruthJSON-0.json", partial(_truth, sent, whole))
    roles = pd.DataFrame({"attack": range(len(run.role_labels)), "role": run.role_labels})
    yield File("attacks.csv", partial(csv_of, roles))
    yield File("vehicles.csv", partial(kitti.names_csv, sent.selection))


def _truth(sent: Messages, whole: pd.DataFrame) -> bytes:
    number = sent.number(whole.step.to_numpy(), whole.observer.to_numpy())
    rows = zip(whole.step * sent.selection.run.dt_s, whole.vehicle, whole.observer, number, _state(whole), strict=True)
    return "".join(
        f'{{"type":4,"sendTime":{s:.9f},"sender":{v},"senderPseudo":{p},"messageID":{n},{m}}}\n'
        for s, v, p, n, m in rows
    ).encode()


def _state(rows: pd.DataFrame) -> list[str]:
    """Position, speed, acceleration and heading of each row, as members of an object."""
    cos, sin = np.cos(rows.yaw_rad.to_numpy(float)), np.sin(rows.yaw_rad.to_numpy(float))
    speed, change = rows.speed_mps.to_numpy(float), rows.acceleration_mps2.to_numpy(float)
    columns = (rows.x_m, rows.y_m, rows.z_m, speed * cos, speed * sin, change * cos, change * sin, cos, sin)
    return [
        f'"pos":[{x:.4f},{y:.4f},{z:.4f}],{NOISE[0]},"spd":[{vx:.4f},{vy:.4f},0.0],{NOISE[1]},'
        f'"acl":[{ax:.4f},{ay:.4f},0.0],{NOISE[2]},"hed":[{hx:.6f},{hy:.6f},0.0],{NOISE[3]}'
        for x, y, z, vx, vy, ax, ay, hx, hy in zip(*map(np.asarray, columns), strict=True)
    ]
