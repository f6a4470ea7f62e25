"""omega-prime: ground truth of the Open Simulation Interface (OSI) and the map as OpenDRIVE, in one MCAP file.

Notes
-----
`omega-prime.mcap`: topic `ground_truth` has an `osi3.GroundTruth` per step in which vehicles sense, with every actor as
a moving object; topic `ground_truth_map` has the network as `osi3.MapAsamOpenDrive`, if the traffic has one. Positions
are the centres of boxes in the coordinates of the network [m], which are those of the map; its projection is stated.
Headings are counter-clockwise from east. Speeds point along the heading. Accelerations are the difference of an actor's
velocity from the one in its step before, and 0 in its first. If one vehicle is chosen, it is the host vehicle. All
actors are written, whatever vehicles are chosen.   Deviations: roles of vehicles are civil, colours and lights are
absent, and roads are flat: roll and pitch are 0.
"""

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from results.export.moments import Clouds, File, Moment, Plan, Selection, Unit
from results.extras import needed

TABLES = ("actors", "vehicles")

ROW_BYTES = 110
"""Of an actor in a step, roughly."""

TYPES = {
    "car": "CAR", "van": "DELIVERY_VAN", "truck": "HEAVY_TRUCK", "bus": "BUS",
    "motorcycle": "MOTORBIKE", "bicycle": "BICYCLE",
}  # fmt: skip
"""OSI's types of vehicles."""


class Osi:
    """omega-prime."""

    TABLES = TABLES

    def plan(self, selection: Selection) -> Plan:
        """One file."""
        with needed("betterosi", "writes recordings of OSI", "formats"):
            import betterosi  # noqa: F401  (a missing library is told before anything is written)
        n = selection.run.n_rows("actors")
        return Plan((Unit("recording", partial(_files, selection)),), text_bytes=float(ROW_BYTES * n))


def _files(selection: Selection, clouds: Clouds) -> Iterator[File]:
    yield File("omega-prime.mcap", partial(_recording, selection))


def _recording(selection: Selection) -> bytes:
    import betterosi as osi

    created = str(selection.run.manifest.get("created") or "1970-01-01T00:00:00Z")
    about = {"description": f"cosim run {selection.run.name}", "creation_time": created}
    before: dict[int, Any] = {}
    with tempfile.TemporaryDirectory(prefix="cosim-osi-") as folder:
        path = Path(folder) / "omega-prime.mcap"
        with osi.Writer(path, metadata=about, library="cosim") as writer:
            for steps in selection.spans():
                for moment in selection.traffic(steps):
                    writer.add(_ground_truth(osi, selection, moment, before))
            if (road := selection.place.open_drive()) is not None:
                osi_map = osi.MapAsamOpenDrive(map_reference="network", open_drive_xml_content=road.decode())
                writer.add(osi_map, topic="ground_truth_map", log_time=0)
        return path.read_bytes()


def _ground_truth(osi: Any, selection: Selection, moment: Moment, before: dict[int, Any]) -> Any:
    """A step. `before` has the velocity and time of each actor when it was last seen; the function updates it."""
    now_s = moment.step * selection.run.dt_s
    box = moment.box
    velocity = moment.speed_mps[:, None] * np.column_stack([np.cos(box[:, 6]), np.sin(box[:, 6])])
    east_m, north_m = selection.place.origin_m
    vehicle, objects = osi.MovingObject.VehicleClassification, []
    rows = zip(moment.actor.tolist(), moment.vehicle_class.tolist(), box.tolist(), velocity.tolist(), strict=True)
    for actor, kind, (x, y, z, length, width, height, yaw), (east, north) in rows:
        (was_east, was_north), was_s = before.get(actor, ((east, north), now_s - 1.0))
        before[actor] = (east, north), now_s
        base = osi.BaseMoving(
            dimension=osi.Dimension3d(length=length, width=width, height=height),
            position=osi.Vector3d(x=x + east_m, y=y + north_m, z=z),
            orientation=osi.Orientation3d(roll=0.0, pitch=0.0, yaw=yaw),
            velocity=osi.Vector3d(x=east, y=north, z=0.0),
            acceleration=osi.Vector3d(
                x=(east - was_east) / (now_s - was_s), y=(north - was_north) / (now_s - was_s), z=0.0
            ),
        )  # fmt: skip
        one = osi.MovingObject(id=osi.Identifier(value=actor), base=base)
        if kind == "pedestrian":
            one.type = osi.MovingObject.Type.PEDESTRIAN
        else:
            one.type = osi.MovingObject.Type.VEHICLE
            one.vehicle_classification = vehicle(type=getattr(vehicle.Type, TYPES[kind]), role=vehicle.Role.CIVIL)
        objects.append(one)
    nanos = round(now_s * 1e9)
    time = osi.Timestamp(seconds=nanos // 10**9, nanos=nanos % 10**9)
    made = osi.GroundTruth(timestamp=time, moving_object=objects)
    if (on_map := selection.place.map_projection()) is not None:
        made.proj_string, (x_m, y_m) = on_map
        made.proj_frame_offset = osi.GroundTruth.ProjFrameOffset(position=osi.Vector3d(x=x_m, y=y_m, z=0.0), yaw=0.0)
    if len(selection.vehicles) == 1:
        made.host_vehicle_id = osi.Identifier(value=selection.vehicles[0])
    return made
