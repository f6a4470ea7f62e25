"""A ROS 2 bag of MCAP files, which Foxglove opens too: the city, all actors, trust, clouds and detections over time.

Notes
-----
`metadata.yaml` and `bag_<k>.mcap` (one for each span of steps; Foxglove opens them together). Messages are ROS 2's
(CDR), and their definitions are in the files. Frame `map` is the world of the tables: x east, y north, z up.

| topic | message | content |
|---|---|---|
| `/buildings` | visualization_msgs/Marker | triangles of the buildings, once |
| `/actors` | visualization_msgs/MarkerArray | a box for each actor, in the colour of its role; `id` is its number |
| `/fabricated` | visualization_msgs/MarkerArray | boxes that attacks fabricated and that were sent |
| `/trust` | sensor_msgs/PointCloud2 | per pseudonym in use a point with `trust`, `newest_evaluation_age_s`, `subject` |
| `/tf` | tf2_msgs/TFMessage | the frame `vehicle_<n>/lidar` of each chosen vehicle |
| `/vehicle_<n>/points` | sensor_msgs/PointCloud2 | its sweep |
| `/vehicle_<n>/detections` | vision_msgs/Detection3DArray | its list as transmitted, in the frame `map` |

A box stays until the next step of the topic. Topics of vehicles are written for vehicles that `--vehicles` names,
because clouds are large; `--set clouds=false` leaves the clouds out. `/trust` has the values of the acting variant at
the steps in which the server computes them, at the true places of the vehicles. An age that is not there is NaN. Second
0 of a run is 2025-01-01 00:00 UTC.   Deviations: sweeps have no intensity and no time per point.
"""

import io
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import IO, cast

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Float, Float32, Int, UInt8
from numpy import ndarray

from cosim.addons.export.frames import normals_of
from cosim.addons.export.pcap import START_S
from cosim.addons.export.ros2_messages import definition
from cosim.base.extras import needed
from results.figures import style
from results.moments import BOX, Clouds, File, Moment, Plan, Selection, Unit, at_steps

TABLES = ("actors", "vehicles", "detections", "observability", "pseudonyms", "trust")

ACTOR_BYTES, DETECTION_BYTES = 60, 250
"""Of a box in a message, after compression, roughly."""

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
RATED = np.dtype([*POINT.descr, ("trust", "<f4"), ("newest_evaluation_age_s", "<f4"), ("subject", "<i4")])
_DATATYPES = {"<f4": 7, "<i4": 5}
"""Numbers of types in sensor_msgs/PointField."""

FABRICATED = (0.84, 0.0, 0.0, 1.0)
BUILDING = (0.80, 0.80, 0.77)
LIGHT = np.array([0.4, 0.25, 0.88])
"""Direction to the light by which walls are shaded."""


class Cdr:
    """A message in little-endian CDR: numbers are aligned to their size, counted from the end of the head."""

    def __init__(self) -> None:
        self._bytes = bytearray(b"\x00\x01\x00\x00")

    @property
    def place(self) -> int:
        """Number of bytes so far, the head included."""
        return len(self._bytes)

    def put(self, form: str, *values: float) -> "Cdr":
        """Numbers of one type, as in `struct`."""
        size = struct.calcsize(form[-1])
        self._bytes += b"\x00" * (-(len(self._bytes) - 4) % size)
        self._bytes += struct.pack("<" + form, *values)
        return self

    def text(self, value: str) -> "Cdr":
        """A string: length with the final zero, characters, zero."""
        raw = value.encode() + b"\x00"
        self.put("I", len(raw))
        self._bytes += raw
        return self

    def raw(self, content: bytes, align: int = 1) -> "Cdr":
        """Bytes as they are, aligned."""
        self._bytes += b"\x00" * (-(len(self._bytes) - 4) % align) + content
        return self

    def header(self, nanos: int, frame: str) -> "Cdr":
        """A std_msgs/Header."""
        seconds, rest = divmod(nanos, 10**9)
        return self.put("i", seconds).put("I", rest).text(frame)

    def done(self) -> bytes:
        return bytes(self._bytes)


def turn(yaw_rad: Float[ndarray, "n"]) -> Float[ndarray, "n 4"]:
    """Turns about the vertical axis as quaternions: x, y, z, w."""
    zero, half = np.zeros(len(yaw_rad)), 0.5 * yaw_rad
    return np.column_stack([zero, zero, np.sin(half), np.cos(half)])


def _marker(
    cdr: Cdr,
    nanos: int,
    name: str,
    kind: int,
    triangles: bytes = b"",
    inks: bytes = b"",
) -> dict[str, int]:
    """Append a visualization_msgs/Marker; returns the places of the fields that differ between boxes."""
    place = {}
    cdr.header(nanos, "map").text(name)
    place["id"] = cdr.put("i", 0).place - 4
    cdr.put("2i", kind, 0)
    place["pose"] = cdr.put("7d", 0, 0, 0, 0, 0, 0, 1).place - 56
    place["size"] = cdr.put("3d", 1, 1, 1).place - 24
    place["ink"] = cdr.put("4f", 1, 1, 1, 1).place - 16
    cdr.put("i", 0).put("I", 0).put("?", False)  # lifetime, frame_locked
    cdr.put("I", len(triangles) // 24).raw(triangles, 8 if triangles else 1)
    cdr.put("I", len(inks) // 16).raw(inks)
    cdr.text("").header(0, "").text("").put("I", 0)  # texture_resource, texture
    cdr.put("I", 0).text("").text("").text("").put("I", 0).put("?", False)  # uv, text, mesh_resource, mesh_file
    return place


_DELETE_ALL = 3


@cache
def _box_template(
    name: str,
) -> tuple[UInt8[ndarray, "s"], dict[str, int], int]:
    """The bytes of a box's marker in an array, the places of its fields, and how many bytes only align the next one.

    A marker begins 4 bytes after a multiple of 8. Its name is made longer until the next one does so too; then all
    markers of an array have the same bytes, and an array is a few assignments of columns.
    """
    begin = Cdr().put("I", 0).place
    for padding in range(8):
        cdr = Cdr().put("I", 0)
        place = _marker(cdr, 0, name + " " * padding, kind=1)
        end, after = cdr.place, cdr.put("i", 0).place - 4
        if (after - begin) % 8 == 0:
            template = np.frombuffer(cdr.done()[begin:after], np.uint8)
            place_of = {field: at - begin for field, at in place.items()}
            return template, place_of, after - end
    raise AssertionError("one of eight lengths is a multiple of eight")


def boxes(
    nanos: int,
    name: str,
    number: Int[ndarray, "n"],
    box: Float[ndarray, "n 7"],
    ink: Float32[ndarray, "n 4"],
) -> bytes:
    """A visualization_msgs/MarkerArray: everything of before is deleted, then a cube for each box.

    Parameters
    ----------
    number
        Values of `id`.
    box
        Boxes, world frame: x, y, z, length, width, height, yaw.
    ink
        Red, green, blue and opacity, in [0, 1].
    """
    template, place, slack = _box_template(name)
    rows = np.tile(template, (len(box) + 1, 1))

    def fill(at: int, values: ndarray) -> None:
        if not len(values):
            return
        n = len(values)
        raw = np.ascontiguousarray(values).view(np.uint8).reshape(n, -1)
        end = at + raw.shape[1]
        rows[-n:, at:end] = raw

    stamp = np.array([divmod(nanos, 10**9)], "<u4")
    fill(0, stamp.repeat(len(rows), axis=0))
    fill(place["id"], number.astype("<i4")[:, None])
    pose = np.column_stack([box[:, :3], turn(box[:, 6])])
    fill(place["pose"], pose.astype("<f8"))
    fill(place["size"], box[:, 3:6].astype("<f8"))
    fill(place["ink"], ink.astype("<f4"))
    action = place["id"] + 8
    delete_all = np.array([_DELETE_ALL], "<i4")
    rows[0, action : action + 4] = delete_all.view(np.uint8)
    markers = rows.tobytes()[: rows.size - slack]
    return Cdr().put("I", len(rows)).raw(markers).done()


def buildings(nanos: int, triangles: Float[ndarray, "t 3 3"]) -> bytes:
    """A visualization_msgs/Marker of triangles, shaded by the direction of their faces."""
    to_light = LIGHT / np.linalg.norm(LIGHT)
    light = 0.65 + 0.35 * np.abs(normals_of(triangles) @ to_light)
    inks = np.ones((len(triangles), 3, 4), "<f4")
    inks[:, :, :3] = (light[:, None] * BUILDING)[:, None, :]
    cdr = Cdr()
    _marker(cdr, nanos, "buildings", 11, triangles.astype("<f8").tobytes(), inks.tobytes())
    return cdr.done()


def points(nanos: int, frame: str, rows: ndarray) -> bytes:
    """A sensor_msgs/PointCloud2 of the rows of a structured array."""
    cdr = Cdr().header(nanos, frame).put("2I", 1, len(rows))
    cdr.put("I", len(rows.dtype.names or ()))
    for name, (kind, offset, *_) in (rows.dtype.fields or {}).items():
        cdr.text(name).put("I", offset)
        cdr.put("B", _DATATYPES[kind.str]).put("I", 1)
    cdr.put("?", False).put("2I", rows.itemsize, rows.nbytes)
    cdr.put("I", rows.nbytes).raw(rows.tobytes())
    return cdr.put("?", True).done()


def transforms(nanos: int, pose: Mapping[str, Float[ndarray, "4"]]) -> bytes:
    """A tf2_msgs/TFMessage: poses (x, y, z, yaw) of frames in the frame `map`."""
    cdr = Cdr().put("I", len(pose))
    for frame, (x, y, z, yaw) in pose.items():
        quaternion = turn(np.array([yaw]))[0].tolist()
        cdr.header(nanos, "map").text(frame).put("7d", x, y, z, *quaternion)
    return cdr.done()


def detections(nanos: int, rows: pd.DataFrame) -> bytes:
    """A vision_msgs/Detection3DArray, frame `map`; `id` is `detection_index`."""
    cdr = Cdr().header(nanos, "map").put("I", len(rows))
    turns = turn(rows.yaw_rad.to_numpy(float)).tolist()
    boxes = rows[BOX].to_numpy(float).tolist()
    scores, indices = rows.score.tolist(), rows.detection_index.tolist()
    found = zip(rows["class"], scores, indices, boxes, turns, strict=True)
    for kind, score, index, (x, y, z, *size, _), quaternion in found:
        pose = x, y, z, *quaternion
        cdr.header(nanos, "map").put("I", 1).text(kind).put("d", score)
        cdr.put("7d", *pose).put("36d", *[0.0] * 36)
        cdr.put("7d", *pose).put("3d", *size).text(str(index))
    return cdr.done()


def _rgb(ink: str) -> Float[ndarray, "3"]:
    """Red, green and blue of a colour such as `#0072b2`, in [0, 1]."""
    return np.array(tuple(bytes.fromhex(ink[1:]))) / 255


class Writing:
    """An MCAP file with messages of ROS 2 that is being written.

    Raises
    ------
    ValueError
        In one line: the package `mcap` is not installed.
    """

    def __init__(self, file: IO[bytes]) -> None:
        with needed("mcap", "writes MCAP files", "formats"):
            from mcap.writer import CompressionType, Writer
        self._writer = Writer(file, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="cosim")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def register(self, topic: str, kind: str) -> None:
        """Announce a topic and the type of its messages."""
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition(kind).encode())
        about = {"offered_qos_profiles": _qos(topic)}
        self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], about)

    def add(self, nanos: int, topic: str, message: bytes) -> None:
        """Add a message at a time in nanoseconds since 1970."""
        self._writer.add_message(self._channels[topic], nanos, message, nanos)

    def finish(self) -> None:
        """Write the summary at the end of the file."""
        self._writer.finish()


@dataclass(frozen=True, kw_only=True, slots=True)
class Ros2Params:
    """What a bag has of the chosen vehicles."""

    clouds: bool = True
    """Whether the sweeps of the vehicles that `--vehicles` names are in the bag."""


class Ros2Bag:
    """A ROS 2 bag in MCAP."""

    TABLES = TABLES
    Params = Ros2Params

    def __init__(self, params: Ros2Params | None = None) -> None:
        self._params = params or Ros2Params()

    def plan(self, selection: Selection) -> Plan:
        """A file for each span of steps, then the metadata."""
        with needed("mcap", "writes MCAP files", "formats"):
            import mcap.writer  # noqa: F401  (a missing library is told before anything is written)
        bag = Bag(selection, self._params.clouds)
        spans = selection.spans()
        units = []
        for k, steps in enumerate(spans):
            units.append(Unit(f"bag_{k}", partial(_file, bag, k, steps)))
        units.append(Unit("metadata", partial(_metadata, bag, len(spans))))
        n_actors, n_lists = selection.run.n_rows("actors"), len(bag.mine)
        n_clouds = n_lists if bag.clouds else 0
        n_bytes = ACTOR_BYTES * n_actors + DETECTION_BYTES * 20 * n_lists
        return Plan(tuple(units), n_clouds, 12, float(n_bytes))


def _file(bag: "Bag", k: int, steps: Int[ndarray, "b"], clouds: Clouds) -> Iterator[File]:
    yield File(f"bag_{k}.mcap", partial(bag.content, k, steps, clouds))


def _metadata(bag: "Bag", n_files: int, clouds: Clouds) -> Iterator[File]:
    yield File("metadata.yaml", partial(bag.metadata, n_files))


@dataclass(frozen=True)
class Bag:
    """What goes into a bag."""

    selection: Selection
    clouds: bool

    @property
    def mine(self) -> pd.DataFrame:
        """(step, vehicle) of the vehicles with topics of their own: those that were named, not all."""
        return self.selection.presence if self.selection.named else self.selection.presence[:0]

    @cached_property
    def inks(self) -> Float32[ndarray, "n 4"]:
        """Colours of all actors by number."""
        run = self.selection.run
        of_role = {role: style.role_look(role, run.role_labels)["color"] for role in run.role_labels}
        of_actor = run.roles.astype(object).map(of_role)
        most = int(run.table("vehicles", ["vehicle"]).vehicle.max())
        inks = np.ones((most + 1, 4), np.float32)
        inks[:, :3] = _rgb(style.PALE)
        for actor, ink in of_actor.items():
            inks[int(cast(int, actor)), :3] = _rgb(ink)
        return inks

    def nanos(self, step: int) -> int:
        """Time of a step, in nanoseconds since 1970."""
        return START_S * 10**9 + round(step * self.selection.run.dt_s * 1e9)

    @cached_property
    def rated(self) -> dict[int, ndarray]:
        """By step: points with trust."""
        run = self.selection.run
        where = at_steps(self.selection.steps)
        columns = ["step", "subject", "trust", "newest_evaluation_age_s"]
        rows = run.variant_table("trust", columns, where)
        rows = rows.join(run.subjects[["vehicle", "to_step"]], on="subject")
        rows = rows[rows.step <= rows.to_step]
        at = run.table("actors", ["step", "actor", *BOX[:3]], where).rename(columns={"actor": "vehicle"})
        rows = rows.merge(at, on=["step", "vehicle"]).sort_values(["step", "subject"])
        made = np.zeros(len(rows), RATED)
        made["subject"] = rows.subject
        columns = [*BOX[:3], "trust", "newest_evaluation_age_s"]
        for name, column in zip(RATED.names or (), columns, strict=False):
            made[name] = rows[column].to_numpy(RATED[name], na_value=np.nan)
        steps, first = np.unique(rows.step.to_numpy(), return_index=True)
        return dict(zip(steps.tolist(), np.split(made, first)[1:], strict=True))

    @cached_property
    def topics(self) -> dict[str, tuple[str, int]]:
        """Message type of each topic, and the number of its messages."""
        found = {"/buildings": ("visualization_msgs/msg/Marker", 1)}
        n = len(self.selection.steps)
        found |= {name: ("visualization_msgs/msg/MarkerArray", n) for name in ("/actors", "/fabricated")}
        found["/trust"] = ("sensor_msgs/msg/PointCloud2", len(self.rated))
        found["/tf"] = ("tf2_msgs/msg/TFMessage", self.mine.step.nunique())
        for vehicle, rows in self.mine.groupby("vehicle"):
            if self.clouds:
                found[f"/vehicle_{vehicle}/points"] = ("sensor_msgs/msg/PointCloud2", len(rows))
            found[f"/vehicle_{vehicle}/detections"] = ("vision_msgs/msg/Detection3DArray", len(rows))
        return {name: about for name, about in found.items() if about[1]}

    def content(self, k: int, steps: Int[ndarray, "b"], clouds: Clouds) -> bytes:
        """A file of the bag."""
        made = io.BytesIO()
        writing = Writing(made)
        for topic, (kind, _) in self.topics.items():
            writing.register(topic, kind)
        for nanos, topic, message in self._messages(k, steps, clouds):
            writing.add(nanos, topic, message)
        writing.finish()
        return made.getvalue()

    def _messages(
        self,
        k: int,
        steps: Int[ndarray, "b"],
        clouds: Clouds,
    ) -> Iterator[tuple[int, str, bytes]]:
        """Time, topic and content of each message of a span of steps."""
        if k == 0:
            nanos = self.nanos(int(steps[0]))
            yield nanos, "/buildings", buildings(nanos, self.selection.place.buildings())
        where = at_steps(steps) & (pc.field("origin") == "fabricated")
        lies = self.selection.run.table("detections", ["step", *BOX, "transmitted"], where)
        lies = lies[lies.transmitted]
        vehicles = {}
        for step, of_step in self.mine.groupby("step").vehicle:
            vehicles[int(cast(int, step))] = of_step.tolist()
        for moment in self.selection.moments(steps) if vehicles else self.selection.traffic(steps):
            nanos = self.nanos(moment.step)
            inks = self.inks[moment.actor]
            yield nanos, "/actors", boxes(nanos, "actors", moment.actor, moment.box, inks)
            false = lies.loc[lies.step == moment.step, BOX].to_numpy(float)
            ink = np.full((len(false), 4), FABRICATED, np.float32)
            yield nanos, "/fabricated", boxes(nanos, "fabricated", np.arange(len(false)), false, ink)
            if moment.step in self.rated:
                yield nanos, "/trust", points(nanos, "map", self.rated[moment.step])
            if moment.step in vehicles:
                yield from self._of_vehicles(nanos, moment, vehicles[moment.step], clouds)

    def _of_vehicles(
        self, nanos: int, moment: Moment, vehicles: list[int], clouds: Clouds
    ) -> Iterator[tuple[int, str, bytes]]:
        pose = {f"vehicle_{v}/lidar": self.selection.pose(moment, v) for v in vehicles}
        yield nanos, "/tf", transforms(nanos, pose)
        nothing = Cdr().header(nanos, "map").put("I", 0).done()
        for v in vehicles:
            rows = moment.detections.get(v)
            listed = nothing if rows is None else detections(nanos, rows)
            yield nanos, f"/vehicle_{v}/detections", listed
        if self.clouds:
            for v, cloud in zip(vehicles, clouds(moment.step, vehicles), strict=True):
                xyz = np.ascontiguousarray(cloud(), "<f4").view(POINT)[:, 0]
                yield nanos, f"/vehicle_{v}/points", points(nanos, f"vehicle_{v}/lidar", xyz)

    def metadata(self, n_files: int) -> bytes:
        """`metadata.yaml` of the bag, version 5."""
        ends = self.selection.steps[[0, -1]].tolist()
        first, last = (self.nanos(step) for step in ends)
        topics = self.topics
        lines = [
            "rosbag2_bagfile_information:",
            "  version: 5",
            "  storage_identifier: mcap",
            f"  duration:\n    nanoseconds: {last - first}",
            f"  starting_time:\n    nanoseconds_since_epoch: {first}",
            f"  message_count: {sum(n for _, n in topics.values())}",
            "  topics_with_message_count:",
        ]
        for topic, (kind, n) in topics.items():
            qos = _qos(topic).replace("\n", "\\n")
            lines += [
                "    - topic_metadata:",
                f"        name: {topic}",
                f"        type: {kind}",
                "        serialization_format: cdr",
                f'        offered_qos_profiles: "{qos}"',
                f"      message_count: {n}",
            ]
        lines += ['  compression_format: ""', '  compression_mode: ""', "  relative_file_paths:"]
        lines += [f"    - bag_{k}.mcap" for k in range(n_files)]
        return ("\n".join(lines) + "\n").encode()


def _qos(topic: str) -> str:
    """Quality of service: what is sent once is kept for those who come later."""
    durability = 1 if topic == "/buildings" else 2
    span = "{sec: 2147483647, nsec: 4294967295}"
    names = f"deadline: {span}, lifespan: {span}, liveliness: 1, liveliness_lease_duration: {span}"
    return (
        f"- {{history: 1, depth: 10, reliability: 1, durability: {durability}, {names}, "
        "avoid_ros_namespace_conventions: false}\n"
    )
