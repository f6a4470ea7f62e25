"""Floating car data as SUMO's `--fcd-output` writes them: every actor of every step, in one XML file.

Notes
-----
`fcd.xml.gz`: a `<timestep>` per step in which vehicles sense, `time` in seconds of the run. `x` and `y` are the centre
of the front bumper in the coordinates of the network [m], `angle` is in degrees clockwise from north, `type` is the
class of the actor, and names are SUMO's. All actors are written.   Deviations: `z` is the
underside of the box; lane, position on it and slope are left out, because the tables do not have them.
"""

import gzip
import io
from collections.abc import Iterator
from functools import partial
from xml.sax.saxutils import quoteattr

import numpy as np

from results.export.moments import Clouds, File, Moment, Plan, Selection, Unit

TABLES = ("actors", "vehicles")

ROW_BYTES = 30
"""Of an actor in a step, packed, roughly."""


class Fcd:
    """SUMO's floating car data."""

    TABLES = TABLES
    ALL_VEHICLES = True

    def plan(self, selection: Selection) -> Plan:
        """One file."""
        n = selection.run.n_rows("actors")
        return Plan((Unit("trace", partial(_files, selection)),), text_bytes=float(ROW_BYTES * n))


def _files(selection: Selection, clouds: Clouds) -> Iterator[File]:
    yield File("fcd.xml.gz", partial(_packed, selection))


def _packed(selection: Selection) -> bytes:
    names = selection.run.table("vehicles", ["vehicle", "sumo_id"]).set_index("vehicle").sumo_id
    quoted = {int(number): quoteattr(name) for number, name in names.items()}  # type: ignore[call-overload]
    packed = io.BytesIO()
    with gzip.GzipFile(fileobj=packed, mode="wb", mtime=0) as file:
        file.write(b'<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n')
        for steps in selection.spans():
            for moment in selection.traffic(steps):
                file.write(_timestep(moment, quoted, selection.run.dt_s, selection.place.origin_m))
        file.write(b"</fcd-export>\n")
    return packed.getvalue()


def _timestep(moment: Moment, quoted: dict[int, str], dt_s: float, origin_m: tuple[float, float]) -> bytes:
    box = moment.box
    ahead = 0.5 * box[:, 3:4] * np.column_stack([np.cos(box[:, 6]), np.sin(box[:, 6])])
    front = box[:, :2] + ahead + origin_m
    angle = np.mod(90.0 - np.degrees(box[:, 6]), 360.0)
    rows = zip(
        moment.actor.tolist(), moment.vehicle_class.tolist(), front.tolist(), (box[:, 2] - 0.5 * box[:, 5]).tolist(),
        angle.tolist(), moment.speed_mps.tolist(), strict=True,
    )  # fmt: skip
    lines = [f'    <timestep time="{moment.step * dt_s:.4f}">\n']
    for actor, kind, (x, y), z, degrees, speed in rows:
        element = "person" if kind == "pedestrian" else "vehicle"
        lines.append(
            f'        <{element} id={quoted[actor]} x="{x:.5f}" y="{y:.5f}" z="{z:.5f}" angle="{degrees:.5f}" '
            f'type="{kind}" speed="{speed:.5f}"/>\n'
        )
    lines.append("    </timestep>\n")
    return "".join(lines).encode()
