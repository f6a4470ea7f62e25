"""Floating car data as SUMO's `--fcd-output` writes them: every actor of every step, in one XML file.

Notes
-----
`fcd.xml.gz`: a `<timestep>` per step, `time` in seconds of the run. `x` and `y` are the centre
of the front bumper in the coordinates of the network [m], `angle` is in degrees clockwise from north, `type` is the
class of the actor, and names are SUMO's. All of the traffic is written; parked cars and placed objects are no
traffic.   Deviations: `z` is the
underside of the box; lane, position on it and slope are left out, because the tables do not have them. SUMO's class and
the size of each actor are written as `vClass`, `length`, `width` and `height`, which SUMO's own files leave to its
types: a run that replays the file has the same boxes.
"""

import gzip
import io
from collections.abc import Hashable, Iterator
from functools import partial
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from cosim.base.codes import OBJECT, PARKED
from cosim.base.plane import ahead_of
from results.moments import Clouds, File, Moment, Plan, Selection, Unit

TABLES = ("actors", "vehicles")

SUMO_CLASS = {"car": "passenger", "van": "delivery"}
"""SUMO's class of each of ours that SUMO calls otherwise."""

ROW_BYTES = 40
"""Of an actor in a step, packed, roughly."""


class Fcd:
    """SUMO's floating car data."""

    TABLES = TABLES
    ALL_VEHICLES = True
    ALL_STEPS = True

    def plan(self, selection: Selection) -> Plan:
        """One file."""
        n = selection.run.n_rows("actors")
        return Plan((Unit("trace", partial(_files, selection)),), text_bytes=float(ROW_BYTES * n))


def _files(selection: Selection, clouds: Clouds) -> Iterator[File]:
    yield File("fcd.xml.gz", partial(_packed, selection))


def _packed(selection: Selection) -> bytes:
    columns = ["vehicle", "sumo_id", "vehicle_class", "length_m", "width_m", "height_m"]
    rows = selection.run.table("vehicles", columns).to_dict("records")
    n_objects = len(selection.run.config.get("objects", ()))
    placed = [f"{OBJECT}{i}" for i in range(n_objects)]
    fixed = {}
    for row in rows:
        name = str(row["sumo_id"])
        if name not in placed and not name.startswith(PARKED):
            fixed[int(row["vehicle"])] = _fixed(row)
    packed = io.BytesIO()
    with gzip.GzipFile(fileobj=packed, mode="wb", mtime=0) as file:
        file.write(b'<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n')
        for steps in selection.spans():
            for moment in selection.traffic(steps):
                file.write(_timestep(moment, fixed, selection.run.dt_s, selection.place.origin_m))
        file.write(b"</fcd-export>\n")
    return packed.getvalue()


def _fixed(actor: dict[Hashable, Any]) -> str:
    """Element, name, class and size of an actor."""
    kind = actor["vehicle_class"]
    element = "person" if kind == "pedestrian" else "vehicle"
    name = quoteattr(actor["sumo_id"])
    about = f'id={name} type="{kind}" vClass="{SUMO_CLASS.get(kind, kind)}"'
    length, width, height = actor["length_m"], actor["width_m"], actor["height_m"]
    return f'{element} {about} length="{length:.9g}" width="{width:.9g}" height="{height:.9g}"'


def _timestep(
    moment: Moment,
    fixed: dict[int, str],
    dt_s: float,
    origin_m: tuple[float, float],
) -> bytes:
    """A step; without actors it is an empty element, so that no reader takes it for a gap."""
    time = f'time="{moment.step * dt_s:.4f}"'
    if not len(moment.actor):
        return f"    <timestep {time}/>\n".encode()
    box = moment.box
    yaw = box[:, 6]
    half_length = 0.5 * box[:, 3:4]
    front = box[:, :2] + half_length * ahead_of(yaw) + origin_m
    underside = box[:, 2] - 0.5 * box[:, 5]
    angle = np.mod(90.0 - np.degrees(yaw), 360.0)
    columns = (moment.actor, *front.T, underside, angle, moment.speed_mps)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    lines = [f"    <timestep {time}>\n"]
    for actor, x, y, z, degrees, speed in rows:
        if actor not in fixed:
            continue
        place = f'x="{x:.5f}" y="{y:.5f}" z="{z:.5f}" angle="{degrees:.5f}"'
        lines.append(f'        <{fixed[actor]} {place} speed="{speed:.5f}"/>\n')
    lines.append("    </timestep>\n")
    return "".join(lines).encode()
