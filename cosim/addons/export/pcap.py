"""Packets that Wireshark opens: detection messages as CPMs of release 2, self reports as CAMs of release 1.

Notes
-----
`sent.pcap` has every message of the chosen vehicles at the step's beginning. With `received`, `veh_<vehicle>.pcap` has
the messages that each chosen vehicle received, from all senders, at the time of reception. Frames are Ethernet (type
0x8947) with GeoNetworking (EN 302 636-4-1, single-hop broadcast) and BTP-B (EN 302 636-5-1; ports 2001 and 2009). There
is no security header, so there is no signature.

A message with a self report becomes a CAM, which repeats the report, and a CPM, whose reference position is the
reported one. Without a report the reference position is the true one. It is the middle of the front on the ground.
Objects lie east, north and up of it. The map's north is turned to true north. What the run does not know is
"unavailable" or absent; `cosim/messages/README.md` lists all fields.

Second 0 of the run is 2025-01-01 00:00 UTC; time stamps in messages count atomic time since 2004 in milliseconds.
Stations have the numbers of their pseudonyms, and objects those of `detection_index`. Where a run has tracks, an object
has its velocity, and a number that it keeps as long as its track and the pseudonym last; it says neither the number of
the track nor that an attack fabricated the object. A CPM that would be longer than 1,398 bytes, with BTP, is split into
segments. A CPM describes the LiDAR where the message did so in the simulation, in its first segment.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.addons.export import kitti
from cosim.addons.export.frames import compass_deg
from cosim.addons.export.messages import message_steps, receptions_of, units_of
from cosim.base.codes import ObjectClass
from cosim.base.earth import OnEarth, Projection
from cosim.base.plane import ahead_of, turned_by
from cosim.base.ragged import ptr_of
from cosim.messages import cam, cpm, etsi
from results.moments import BOX, Clouds, File, Plan, Selection, Unit, at_steps

START_S = 1_735_689_600
"""Second 0 of a run, in seconds since 1970 (UTC): 2025-01-01 00:00."""

LONGEST_BYTES = 1398
"""Longest BTP packet: itsGnMaxSduSize of EN 302 636-4-1."""

PORTS = {"cam": 2001, "cpm": 2009}
"""BTP ports: TS 103 248."""

TRAFFIC_CLASS = {"cam": 2, "cpm": 3}
"""Of GeoNetworking."""

PACKET_BYTES = 500
"""Of one packet, roughly."""

Frames = dict[tuple[int, int], list[bytes]]
"""Frames of the messages by step and pseudonym."""

KEY = ("step", "observer", "detection_index")

TRACKED = ("velocity_x_mps", "velocity_y_mps", "object_id")
"""Columns of the table `tracks`; a run without tracking has no rows there."""

POSITION = ["relative_x_std_m", "relative_y_std_m", "relative_xy_correlation"]
VELOCITY = ["velocity_x_std_mps", "velocity_y_std_mps", "velocity_xy_correlation"]
STATED = (*POSITION, *VELOCITY, "yaw_std_rad", "size_std")
"""Columns of the table `stated_accuracies`, which runs at level full have."""

TRACKS = 2**15
"""Tracks are counted modulo this."""

BLOCK_STEPS = 20
"""Steps whose detections are in memory together."""


@dataclass(frozen=True, kw_only=True)
class PcapPlace:
    """Where the world's origin is, if the network has no projection."""

    latitude: Annotated[float, Ge(-85), Le(85)] | None = None
    """Latitude of the world's origin [degrees]. If it is not set, the projection of the network is used."""
    longitude: Annotated[float, Ge(-180), Le(180)] | None = None
    """Longitude of the world's origin [degrees]. Set it together with `latitude`."""


@dataclass(frozen=True, kw_only=True)
class Params(PcapPlace):
    """Which messages are written, and where the world's origin is, if the network has no projection."""

    received: bool = False
    """Whether one file per receiver is written instead of one file of all that was sent."""


class Pcap:
    """CPMs and CAMs as packets."""

    Params = Params

    def __init__(self, params: Params | None = None) -> None:
        self._params = params or Params()

    @property
    def TABLES(self) -> tuple[str, ...]:
        """Tables that the run must hold; receptions if those are written."""
        return ("actors", "vehicles", "pseudonyms", "detections", *["receptions"] * self._params.received)

    def plan(self, selection: Selection) -> Plan:
        """One file of what was sent, or one per receiver in blocks; then the names.

        Raises
        ------
        ValueError
            In one line: it is not known where on Earth the run is.
        """
        packets = PcapPackets(selection, projection_of(self._params, selection))
        names = kitti.names(selection)
        if not self._params.received:
            sent = Unit("sent", lambda clouds: iter([File("sent.pcap", packets.sent)]))
            return Plan((sent, names), 0, 0, 2.0 * PACKET_BYTES * len(selection.presence))
        units = units_of(selection, packets.received)
        received = receptions_of(selection, list(selection.vehicles))
        n_of_units = int((~received.sender.isin(selection.run.subjects.index)).sum())
        why = f"{n_of_units:,} received messages of roadside units are left out: the table actors does not place them."
        n_bytes = 2.0 * PACKET_BYTES * selection.run.n_rows("receptions")
        return Plan((*units, names), text_bytes=n_bytes, remarks=(why,) if n_of_units else ())


def projection_of(at: PcapPlace, selection: Selection) -> Projection:
    """The projection with the origin that is given, or that of the network.

    Raises
    ------
    ValueError
        In one line: it is not known where on Earth the run is.
    """
    if at.latitude is not None and at.longitude is not None:
        return Projection(at.latitude, at.longitude)
    if (at.latitude, at.longitude) != (None, None):
        raise ValueError(
            "packets need the latitude and the longitude of the origin: --set latitude=60.17 --set longitude=24.94"
        )
    try:
        return selection.projection()
    except ValueError as error:
        raise ValueError(
            f"{str(error).rstrip('.')}. Say where the world's origin is, as in "
            "--set latitude=60.17 --set longitude=24.94"
        ) from None


@dataclass(frozen=True)
class PcapPackets:
    """The packets of a run."""

    selection: Selection
    projection: Projection

    def sent(self) -> bytes:
        """All packets of the chosen vehicles, as a file."""
        of = self.selection.run.subjects.vehicle
        mine = of[of.isin(list(self.selection.vehicles))].index.tolist()
        records = [pcap_header()]
        for at in range(0, len(self.selection.steps), BLOCK_STEPS):
            block = self.selection.steps[at : at + BLOCK_STEPS]
            for (step, _), frames in self.frames(block, mine).items():
                time_s = START_S + step * self.selection.run.dt_s
                records += [record(time_s, frame) for frame in frames]
        return b"".join(records)

    def received(self, receivers: list[int], clouds: Clouds) -> Iterator[File]:
        """One file for each of these receivers."""
        got = receptions_of(self.selection, receivers).sort_values(["receiver", "receive_s", "sender"])
        for receiver, mine in got.groupby("receiver"):
            yield File(f"veh_{receiver}.pcap", partial(_capture, mine, self._all))

    @cached_property
    def _all(self) -> Frames:
        """Frames of all senders in the steps in which received messages were sent."""
        steps = message_steps(self.selection)
        found: Frames = {}
        for at in range(0, len(steps), BLOCK_STEPS):
            found |= self.frames(steps[at : at + BLOCK_STEPS], None)
        return found

    def frames(self, steps: Int[ndarray, "b"], observers: list[int] | None) -> Frames:
        """Frames of the messages of these pseudonyms (None: all) in these steps, by step and pseudonym."""
        where = at_steps(steps)
        mine = where if observers is None else where & pc.field("observer").isin(observers)
        columns, key = [*BOX, "class", "score", "transmitted", "speed_mps", "acceleration_mps2"], list(KEY)
        listed = self.selection.run.table("detections", [*key, *columns], mine)
        listed = listed[listed.transmitted & listed.observer.isin(self.selection.run.subjects.index)]
        listed = listed.sort_values(key, ignore_index=True)
        if listed.empty:
            return {}
        for name, more in (("tracks", TRACKED), ("stated_accuracies", STATED)):
            if name in self.selection.run.tables:
                stated = self.selection.run.table(name, [*key, *more], mine)
                listed = listed.merge(stated, on=key, how="left") if len(stated) else listed
        senders = self._senders(listed, where)
        numbered = senders[["step", "observer"]].assign(sender=range(len(senders)))
        of_sender = listed[["step", "observer"]].merge(numbered, how="left").sender.to_numpy()
        is_object = (listed.detection_index != 0).to_numpy()
        perceived, sender = listed[is_object], of_sender[is_object]
        senders["has_sensors"] = self._describe_sensors(senders, where)
        return self._assembled(senders, perceived, ptr_of(sender, len(senders)), sender)

    def _senders(self, listed: pd.DataFrame, where: pc.Expression) -> pd.DataFrame:
        """One row per message: the self report, or the true state where there is none."""
        own = listed[listed.detection_index == 0]
        key = listed[["step", "observer"]].drop_duplicates()
        senders = key.merge(own.assign(is_cam=True), on=["step", "observer"], how="left")
        senders["is_cam"] = senders.is_cam.notna()
        if not senders.is_cam.all():
            actors = self.selection.run.table("actors", ["step", "actor", "x_m", "y_m", "z_m", "yaw_rad"], where)
            bodies = self.selection.bodies
            true = actors.join(bodies[["vehicle_class", "length_m", "width_m", "height_m"]], on="actor")
            true = true.astype({"step": np.int64, "actor": np.int64})
            vehicle = senders.observer.map(self.selection.run.subjects.vehicle).astype(np.int64)
            at = senders[["step"]].assign(actor=vehicle).merge(true, how="left")
            for name in BOX:
                senders[name] = senders[name].where(senders.is_cam, at[name])
            kind = np.where(at.vehicle_class.isin(["truck", "bus"]), "truck", "car")
            senders["class"] = senders["class"].astype(object).where(senders.is_cam, kind)
        return senders

    def _describe_sensors(self, senders: pd.DataFrame, where: pc.Expression) -> Bool[ndarray, "m"]:
        """Whether each message describes the sensors; all do in runs that do not say."""
        if "cpm_content" not in self.selection.run.tables:
            return np.ones(len(senders), bool)
        stated = self.selection.run.table("cpm_content", ["step", "sender", "sensors"], where)
        stated = stated.astype({"step": np.int64, "sender": np.int64}).rename(columns={"sender": "observer"})
        found = senders[["step", "observer"]].astype(np.int64).merge(stated, on=["step", "observer"], how="left")
        return found.sensors.ne(False).to_numpy(bool, na_value=True)

    def _assembled(
        self,
        senders: pd.DataFrame,
        perceived: pd.DataFrame,
        ptr: Int[ndarray, "m"],
        sender: Int[ndarray, "d"],
    ) -> Frames:
        box = senders[BOX].to_numpy(float)
        size, yaw = box[:, 3:6], box[:, 6]
        front = box[:, :3].copy()
        half_m = 0.5 * box[:, 3:4]
        front[:, :2] += half_m * ahead_of(yaw)
        front[:, 2] -= 0.5 * box[:, 5]
        place = self.projection.of_world(front[:, :2])
        since_ms = np.round(senders.step.to_numpy() * self.selection.run.dt_s * 1000)
        vectors = etsi.PositionVectors(
            station=senders.observer.to_numpy(np.int64),
            label=_labels(senders["class"]),
            time_ms=etsi.its_ms(START_S) + since_ms.astype(np.int64),
            latitude=np.round(place.latitude_deg * 1e7).astype(np.int64),
            longitude=np.round(place.longitude_deg * 1e7).astype(np.int64),
            heading=etsi.heading(compass_deg(yaw) + np.degrees(place.turn_rad)),
            speed_mps=senders.speed_mps.to_numpy(float),
        )
        cams = cam.cams(vectors, senders.acceleration_mps2.to_numpy(float), size)
        objects = objects_of(perceived, front[sender], place, sender)
        bits = objects.is_used.sum(axis=1)
        range_m = float(self.selection.run.config["lidar"].get("max_range_m", 0.0))
        heads = geonetworking(vectors)
        where = vectors.latitude, vectors.longitude, vectors.heading
        columns = (senders.step, vectors.station, vectors.time_ms, *where, senders.is_cam, senders.has_sensors)
        rows = zip(*(np.asarray(column).tolist() for column in columns), strict=True)
        found = {}
        for i, (step, number, time, latitude, longitude, angle, is_cam, has_sensors) in enumerate(rows):
            begin, end = int(ptr[i]), int(ptr[i + 1])
            frames = []
            if is_cam:
                frames.append(frame(heads[i], number, "cam", cams[i].tobytes()))
            inner = [begin + cut for cut in cuts_of(bits[begin:end])]
            cuts = [begin, *inner, end]
            for k, (first, last) in enumerate(pairwise(cuts)):
                segment = (len(cuts) - 1, k + 1) if len(cuts) > 2 else None
                describes = has_sensors and k == 0
                head = cpm.CpmHead(number, time, latitude, longitude, angle, range_m, segment, describes)
                message = cpm.cpm(head, end - begin, objects.between(first, last))
                frames.append(frame(heads[i], number, "cpm", message))
            found[step, number] = frames
        return found


def _capture(got: pd.DataFrame, frames: Frames) -> bytes:
    content = [pcap_header()]
    row: Any
    for row in got.itertuples():
        sent = frames.get((row.step, row.sender), ())
        content += [record(START_S + row.receive_s, one) for one in sent]
    return b"".join(content)


_HEAD_BYTES = int(cpm.cpm_bytes(np.zeros((1, 4), int), is_segment=True)[0])
"""Length of a segment without objects."""
_ROOM_BITS = 8 * (LONGEST_BYTES - 4 - _HEAD_BYTES - 1)
"""Bits of objects that fit into one segment, whose length may then take a second byte."""


def cuts_of(bits: Int[ndarray, "n"]) -> list[int]:
    """Where segments of a message begin, without the first one, if each takes as many objects as fit.

    `bits` are the lengths of the objects in the message.
    """
    cuts, before = [], 0
    ends = np.cumsum(bits)
    while len(ends) and ends[-1] - before > _ROOM_BITS:
        cuts.append(int(np.searchsorted(ends, before + _ROOM_BITS, side="right")))
        before = int(ends[cuts[-1] - 1])
    return cuts


def _labels(classes: pd.Series) -> Int[ndarray, "n"]:
    code_of = {kind.name.lower(): int(kind) for kind in ObjectClass}
    return classes.astype(object).map(code_of).to_numpy(np.int64)


def objects_of(
    perceived: pd.DataFrame, front_m: Float[ndarray, "d 3"], place: OnEarth, sender: Int[ndarray, "d"]
) -> cpm.CpmObjects:
    """Objects seen from the front of their senders, turned to true north, with the velocities that are known.

    Parameters
    ----------
    perceived
        Rows of the table `detections`.
    front_m
        Front of the sender of each object, on the ground.
    place
        Directions and scale of the map at the senders.
    sender
        Row of `place` of each object.
    """
    box = perceived[BOX].to_numpy(float)
    away = box[:, :3] - front_m
    turn, scale = place.turn_rad[sender], place.scale[sender]
    away[:, :2] = turned_by(-turn, away) / scale[:, None]
    number = perceived.detection_index.to_numpy(np.int64)
    velocity = confidences = None
    if set(TRACKED) <= set(perceived.columns):
        number = _object_numbers(perceived, sender)
        velocity = perceived[["velocity_x_mps", "velocity_y_mps"]].to_numpy(float, na_value=np.nan)
        velocity = turned_by(-turn, velocity)
    if set(STATED) <= set(perceived.columns):
        confidences = confidences_of(perceived, turn)
    label = _labels(perceived["class"])
    score = perceived.score.to_numpy(float)
    size = box[:, 3:6]
    yaw = box[:, 6] - turn
    return cpm.CpmObjects.of(number, label, away, size, yaw, score, velocity, confidences)


def _object_numbers(perceived: pd.DataFrame, sender: Int[ndarray, "d"]) -> Int[ndarray, "d"]:
    """Numbers of objects, each once in a message, that are mixed anew for each pseudonym.

    The k-th object of a message that has no track, which an attack fabricated, has the same number in all messages.
    """
    is_fabricated = perceived.object_id.isna()
    rank = is_fabricated.groupby(sender).cumsum()
    track = perceived.object_id.fillna(0).astype(np.int64) % TRACKS
    known = np.where(is_fabricated, TRACKS + rank, track)
    of_pseudonym = perceived.observer.to_numpy(np.int64) * 2_654_435_761 >> 16
    return (40_503 * known + of_pseudonym) % 2**16  # an odd factor keeps different numbers apart


def confidences_of(perceived: pd.DataFrame, turn_rad: Float[ndarray, "d"]) -> etsi.Confidences:
    """What the senders state of the accuracy of objects, with axes turned to true north."""
    position_m, velocity_mps = (_turned_std(perceived[columns], turn_rad) for columns in (POSITION, VELOCITY))
    yaw, size = perceived[["yaw_std_rad", "size_std"]].to_numpy(float).T
    lwh_m = perceived[BOX].to_numpy(float)[:, 3:6]
    return etsi.Confidences.of(position_m, yaw, lwh_m * size[:, None], velocity_mps)


def _turned_std(stated: pd.DataFrame, turn_rad: Float[ndarray, "d"]) -> Float[ndarray, "d 2"]:
    """Standard deviations along turned axes, from two standard deviations and their correlation."""
    x, y, correlation = stated.to_numpy(float).T
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    shared = 2 * cos * sin * correlation * x * y
    east = (cos * x) ** 2 + shared + (sin * y) ** 2
    north = (sin * x) ** 2 - shared + (cos * y) ** 2
    return np.sqrt(np.column_stack([east, north]))


def geonetworking(senders: etsi.PositionVectors) -> list[bytes]:
    """Extended headers of single-hop broadcasts: the sender's long position vector, and 4 bytes of the medium.

    An unknown speed is 0, because this header has no value for "unavailable". The position is declared inaccurate,
    because no accuracy is known.
    """
    speed_cm_s = np.round(np.nan_to_num(senders.speed_mps) * 100)
    in_range = np.clip(speed_cm_s, -(2**14), 2**14 - 1)
    speed = in_range.astype(np.int64) & 0x7FFF
    encoded = senders._replace(label=senders.station_type(), speed_mps=speed)
    rows = zip(*(column.tolist() for column in encoded), strict=True)
    headers = []
    for number, kind, time, lat, lon, angle, v in rows:
        flags = 1 << 15 | kind << 10
        low_time = time & 0xFFFFFFFF
        headers.append(struct.pack(">H6sIiiHH4x", flags, mac(number), low_time, lat, lon, v, angle))
    return headers


def mac(station: int) -> bytes:
    """A locally administered address that ends in the station's number."""
    return b"\x02\x00" + station.to_bytes(4)


def frame(position: bytes, station: int, kind: str, message: bytes) -> bytes:
    """An Ethernet frame with a single-hop broadcast of a message, `cam` or `cpm`."""
    basic = struct.pack(">BBBB", 1 << 4 | 1, 0, 1 << 2 | 1, 1)  # version 1, common header next, 1 s, one hop
    length = 4 + len(message)  # with the header of BTP
    common = struct.pack(">BBBBHBB", 0x20, 0x50, TRAFFIC_CLASS[kind], 0x80, length, 1, 0)
    btp = struct.pack(">HH", PORTS[kind], 0)
    ethernet = b"\xff" * 6 + mac(station) + b"\x89\x47"
    return ethernet + basic + common + position + btp + message


def pcap_header() -> bytes:
    """Of a capture of Ethernet frames with times in microseconds."""
    return struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)


def record(time_s: float, content: bytes) -> bytes:
    """A frame in a capture, at a time in seconds since 1970."""
    second, micro = divmod(round(time_s * 1e6), 10**6)
    return struct.pack("<IIII", second, micro, len(content), len(content)) + content
