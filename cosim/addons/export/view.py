"""A run as a recording for the Rerun viewer: a map, the city in 3D, and trust over time.

The faces of a vehicle have the colour of its role, as in all figures. Vehicles that are not equipped are pale grey.
The edges of a vehicle and its ring on the map have the colour of the trust in it: red is 0, yellow 0.5, blue 1, and
dark grey is not rated. Fabricated objects are red. For chosen vehicles there are the clouds, and what they detected,
received and believe, until they sense again.

The first view shows the first chosen vehicle. If there is none, it shows the first lie that was listed, or else the
middle of the traffic.

No server is started, and only the file is written. The viewer itself collects usage data unless you run
`rerun analytics disable`.
"""

import errno
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.addons.export.export import Progress, Sweeper, scenario_of
from cosim.addons.export.frames import normals_of
from cosim.addons.export.ros2 import turn
from cosim.base import durable
from cosim.base.durable import PARTIAL
from cosim.base.extras import needed
from cosim.base.plane import turned_by
from cosim.config.config import Config
from cosim.runs.replay_lidar import city_of, config_of
from cosim.traffic.scenario import Scenario
from results.archive import open_run
from results.figures import style
from results.metrics.trust import in_vehicles, server_values
from results.moments import BOX, at_steps
from results.run import Run
from results.sensing import interval_steps, senses
from sensors.boxes import Boxes
from sensors.raycast.mesh import city_triangles
from sensors.scene import Scene
from sumo_nets import network

ZERO, HALF, ONE, GREY = np.array(
    [
        [213, 50, 40],
        [255, 224, 130],
        [30, 90, 200],
        [70, 70, 70],
    ],
    np.uint8,
)
"""Colours of trust 0, 0.5 and 1, and of no trust."""

COLOURS = {
    "detected": (0, 158, 115),
    "received": (230, 159, 0),
    "believed": (86, 180, 233),
    "fabricated": (213, 0, 0),
}

BACKGROUND = (245, 245, 245)
"""Background of both views. It is light, because the colours of roles are made for paper."""

EYE_M = np.array([-35.0, -35.0, 35.0])
"""Vector from the point at which the camera looks first to the camera [m]."""
MAP_M = 120.0
"""Half of the width that the map shows first [m]."""
_EDGE_SHARE = 1.01
"""Size of the edges of a box relative to its faces. Faces of the same size would hide the edges."""

BLOCK_STEPS = 60
_LEAST_FREE_BYTES = 4_000_000
"""Free disk space that each block needs. On a full disk the SDK's writer ends, and a flush may never return."""
_PATIENCE_S = 600.0
"""Longest wait for the SDK's writer at the end."""
_HERE = "127.0.0.1"
_START_S = 60.0
"""Longest wait for the viewer to start."""


def view(
    run: Run,
    out: Path,
    vehicles: Sequence[int] = (),
    from_s: float = 0.0,
    to_s: float | None = None,
    clouds: bool = True,
    progress: Progress = lambda what, done, total: None,
) -> dict[str, Any]:
    """Write a recording of a run.

    Parameters
    ----------
    vehicles
        Vehicles whose clouds, detections and beliefs are shown. The default is none.

    Raises
    ------
    ValueError
        In one line: the file cannot be written, a vehicle has no LiDAR, no step is in the time span, or the viewer's
        package is not installed.
    """
    _check_name(out)
    run.require("actors", "vehicles", "detections", "trust", "encounters")
    end_s = int(run.manifest["steps"]) * run.dt_s if to_s is None else to_s
    steps = np.arange(int(run.manifest["steps"]))
    time_s = steps * run.dt_s
    steps = steps[(time_s >= from_s - 1e-9) & (time_s < end_s - 1e-9)]
    if not len(steps):
        raise ValueError(f"--from {from_s:g} --to {end_s:g}: {run.path} has no step in between.")
    roles = run.roles
    for vehicle in vehicles:
        if vehicle not in roles.index:
            some = ", ".join(map(str, roles.index[:8]))
            raise ValueError(f"--vehicle {vehicle} is none that carries a LiDAR. These do: {some}, ...")
    recording = _open(out, first_look(run, steps, vehicles))
    try:
        _write(recording, out, run, steps, vehicles, clouds, progress)
        recording.flush(timeout_sec=_PATIENCE_S)
        recording.disconnect()
        _partial(out).replace(out)
    except BaseException as error:
        _partial(out).unlink(missing_ok=True)
        if not isinstance(error, OSError | RuntimeError):  # the latter: the SDK's writer has stopped
            raise
        free = shutil.disk_usage(out.parent).free
        raise ValueError(
            f"--out {out} cannot be written to its end, with {free / 1e6:,.1f} MB free on its disk. Show less (--from, "
            "--to, --no-clouds), or choose another disk."
        ) from None
    return {"out": str(out), "steps": len(steps), "bytes": out.stat().st_size}


def follow(
    folder: Path,
    out: Path | None = None,
    vehicles: Sequence[int] = (),
    every_s: float = 1.0,
    progress: Progress = lambda what, done, total: None,
) -> dict[str, Any]:
    """Show a run while another process computes it, block by block, until it ends.

    Parameters
    ----------
    folder
        The run folder. A run that has ended is shown to its end.
    out
        Recording to write; None opens the viewer.
    vehicles
        Vehicles whose detections and beliefs are shown.
    every_s
        Time between two looks into the folder [s].

    Raises
    ------
    ValueError
        In one line: the folder holds no run, the file cannot be written, or the viewer does not start.
    """
    if out is not None:
        _check_name(out)
    shown, recording = 0, None
    while True:
        run = open_run(folder, unfinished=True)
        n_steps, has_ended = int(run.manifest["steps"]), run.status != "running"
        if n_steps > shown:
            steps, config = np.arange(shown, n_steps), config_of(run)
            if recording is None:
                look_m = first_look(run, steps, vehicles)
                recording = _spawned(look_m) if out is None else _open(out, look_m)
                surroundings(recording, scenario_of(config), city_of(config))
            encounters, trust = _encounters(run), _trust(run)
            for at in range(0, len(steps), BLOCK_STEPS):
                block = steps[at : at + BLOCK_STEPS]
                _block(recording, run, config, block, encounters, vehicles, None)
            _over_time(recording, run, trust, steps, vehicles)
            shown = n_steps
            progress("view", shown, int(run.config["traffic"]["duration_s"] / run.dt_s))
        if has_ended:
            break
        time.sleep(every_s)
    if recording is None:
        raise ValueError(f"{folder}: the run ended before its first step was on disk, so there is nothing to show.")
    recording.flush(timeout_sec=_PATIENCE_S)
    recording.disconnect()
    if out is not None:
        _partial(out).replace(out)
    return {"out": None if out is None else str(out), "steps": shown, "status": run.status}


def _check_name(out: Path) -> None:
    if out.suffix != ".rrd":
        raise ValueError(f"--out {out}: a recording ends in .rrd.")


def _spawned(look_m: Float[ndarray, "3"]):  # type: ignore[no-untyped-def]
    """The viewer, with a blueprint that shows map, city and trust."""
    sdk()
    import rerun

    recording = rerun.RecordingStream("cosim")
    show(recording, "--live", "Write a file with --out")
    send_layout(recording, look_m)
    return recording


def show(recording, option: str, instead: str) -> subprocess.Popen[bytes]:  # type: ignore[no-untyped-def]
    """Open the viewer for a recording.

    It is the viewer of this installation, and it listens to this machine alone. The SDK would start the first `rerun`
    in PATH, which listens to all of the network.

    Returns
    -------
    Its process, which goes on when this one ends.

    Raises
    ------
    ValueError
        In one line, if it does not start; `instead` says what to do.
    """
    with socket.create_server((_HERE, 0)) as free:
        port = int(free.getsockname()[1])
    viewer = subprocess.Popen(
        [sys.executable, "-P", "-m", "rerun_cli", "--bind", _HERE, "--port", str(port), "--hide-welcome-screen"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    end_s = time.monotonic() + _START_S
    while time.monotonic() < end_s and viewer.poll() is None:
        with suppress(OSError), socket.create_connection((_HERE, port), timeout=1.0):
            recording.connect_grpc(f"rerun+http://{_HERE}:{port}/proxy")
            return viewer
        time.sleep(0.1)
    with suppress(OSError):
        os.killpg(viewer.pid, signal.SIGKILL)
    viewer.wait()
    raise ValueError(f"{option}: the Rerun viewer does not start; it needs a screen. {instead}.")


def _encounters(run: Run) -> pd.DataFrame:
    found = run.table("encounters", ["a", "b", "start_step", "end_step", "pairs"])
    return found[found.pairs != "all"]


def _write(  # type: ignore[no-untyped-def]
    recording,
    out: Path,
    run: Run,
    steps: Int[ndarray, "s"],
    vehicles: Sequence[int],
    clouds: bool,
    progress: Progress,
) -> None:
    """Write the whole recording. An OSError is raised if the disk is nearly full, because the SDK might then hang."""
    _require_space(out)
    config = config_of(run)
    city = city_of(config)
    surroundings(recording, scenario_of(config), city)
    sweeper = Sweeper(run, config, city, steps)
    encounters, trust = _encounters(run), _trust(run)
    for at in range(0, len(steps), BLOCK_STEPS):
        block = steps[at : at + BLOCK_STEPS]
        _require_space(out)
        _block(recording, run, config, block, encounters, vehicles, sweeper if clouds else None)
        progress("view", min(len(steps), at + BLOCK_STEPS), len(steps))
    _over_time(recording, run, trust, steps, vehicles)


def _require_space(out: Path) -> None:
    if shutil.disk_usage(out.parent).free < _LEAST_FREE_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _partial(out: Path) -> Path:
    """Name of the file until it is complete."""
    return out.with_name(out.name + PARTIAL)


def first_look(
    run: Run,
    steps: Int[ndarray, "s"],
    vehicles: Sequence[int],
) -> Float[ndarray, "3"]:
    """Point at which the camera looks first [m], world frame.

    It is the first position of the first of `vehicles` in these steps. If there is none, it is the position of the
    first lie, otherwise the median position of all actors in the first step, otherwise the origin.
    """
    where = at_steps(steps)
    is_first = pc.field("actor").isin(list(vehicles[:1]))
    look = run.table("actors", ["step", *BOX[:3]], where & is_first)
    if look.empty:
        lies = run.table("detections", ["step", *BOX[:3], "lied"], where)
        look = lies[lies.lied]
    if look.empty:
        look = run.table("actors", ["step", *BOX[:3]], where)
        look = look[look.step == look.step.min()].median().to_frame().T
    if look.empty or look[BOX[:3]].isna().any(axis=None):
        return np.zeros(3)
    return look.sort_values("step", kind="stable")[BOX[:3]].to_numpy(float)[0]


def _open(out: Path, look_m: Float[ndarray, "3"]):  # type: ignore[no-untyped-def]
    """The recording, with a blueprint that shows map, city and trust."""
    sdk()
    import rerun

    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        os.close(durable.new_file(_partial(out)))
    except OSError as error:
        raise ValueError(f"--out {out} cannot be written: {error.strerror or error}.") from None
    recording = rerun.RecordingStream("cosim")
    recording.save(_partial(out))
    send_layout(recording, look_m)
    return recording


def sdk() -> None:
    """Import Rerun's SDK. Raises ValueError, with one line, if it is not installed."""
    os.environ.setdefault("RUST_LOG", "off")  # of the SDK, which has nothing to say that is not said here
    with needed("rerun-sdk", "writes recordings", "view"):
        import rerun  # noqa: F401


def send_layout(recording, look_m: Float[ndarray, "3"], ages: bool = False) -> None:  # type: ignore[no-untyped-def]
    """Arrange the views: map, city, trust over time, and ages if asked for. The first view is around `look_m`."""
    from rerun import blueprint as b

    x, y = look_m[0], -look_m[1]
    bounds = b.VisualBounds2D(
        x_range=[x - MAP_M, x + MAP_M],
        y_range=[y - MAP_M, y + MAP_M],
    )
    eye = b.EyeControls3D(position=look_m + EYE_M, look_target=look_m, eye_up=[0, 0, 1])
    series = [b.TimeSeriesView(origin="trust", name="Trust")]
    series += [b.TimeSeriesView(origin="ages", name="Age of evaluations [s]")] if ages else []
    views = b.Horizontal(
        b.Spatial2DView(origin="map", name="Map (north is up)", visual_bounds=bounds, background=BACKGROUND),
        b.Vertical(
            b.Spatial3DView(origin="city", name="City", eye_controls=eye, background=BACKGROUND),
            *series,
            row_shares=[2, *[1] * len(series)],
        ),
    )
    recording.send_blueprint(b.Blueprint(views, collapse_panels=True))


def surroundings(recording, scenario: Scenario, city: Scene) -> None:  # type: ignore[no-untyped-def]
    """Buildings and streets."""
    import rerun

    recording.log("city", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    triangles = city_triangles(city)
    if len(triangles):
        normals = normals_of(triangles.reshape(-1, 3, 3))
        mesh = rerun.Mesh3D(
            vertex_positions=triangles.reshape(-1, 3),
            albedo_factor=[205, 203, 196, 255],
            vertex_normals=np.repeat(normals, 3, axis=0),  # without them there is no shading
        )
        recording.log("city/buildings", mesh, static=True)
        xy, ring = shapely.get_coordinates(shapely.get_rings(city.footprints), return_index=True)
        outlines = strips(on_map(xy), np.bincount(ring))
        recording.log("map/buildings", rerun.LineStrips2D(outlines, colors=[170, 170, 165], radii=0.4), static=True)
    if scenario.net is not None:
        lanes = [lane.line_m[:, :2] for lane in network.lanes(scenario.net)]
        xy = np.concatenate([np.zeros((0, 2)), *lanes]) - scenario.origin_m
        n_points = list(map(len, lanes))
        flat = strips(on_map(xy), n_points)
        recording.log("map/streets", rerun.LineStrips2D(flat, colors=[150, 150, 156], radii=0.6), static=True)
        high = strips(np.column_stack([xy, np.full(len(xy), 0.02)]), n_points)
        recording.log("city/streets", rerun.LineStrips3D(high, colors=[150, 150, 156], radii=0.15), static=True)


def on_map(xyz_m: Float[ndarray, "n _"]) -> Float[ndarray, "n 2"]:
    """Places on the map, whose second axis points downwards."""
    return xyz_m[:, :2] * [1.0, -1.0]


def strips(
    points_m: Float[ndarray, "p d"],
    n_points: Sequence[int] | Int[ndarray, "s"],
) -> Any:
    """Strips of these numbers of points, in 2 or 3 dimensions, as an Arrow array of lists.

    Rerun's SDK takes it as it is. It would convert a list of arrays one by one, in a second for a city.
    """
    points = pa.array(np.ascontiguousarray(points_m, np.float32).ravel())
    item = pa.field("item", pa.float32(), nullable=False)
    vector = pa.FixedSizeListArray.from_arrays(points, type=pa.list_(item, points_m.shape[1]))
    kind = pa.list_(pa.field("item", vector.type, nullable=False))
    begins = pa.array(np.cumsum([0, *n_points]), pa.int32())
    return pa.ListArray.from_arrays(begins, vector, type=kind)


def _trust(run: Run) -> pd.DataFrame:
    """Trust of the acting variant in pseudonyms in use, by step and vehicle; only of those that somebody evaluated."""
    found = server_values(run)
    found = found.join(run.subjects[["vehicle", "identity", "to_step"]], on="subject")
    is_known = (found.n_evaluations > 0) & (found.step <= found.to_step)
    return found[is_known].sort_values(["step", "vehicle"])[["step", "vehicle", "identity", "trust"]]


def colours(trust: Float[ndarray, "n"]) -> UInt8[ndarray, "n 3"]:
    """Colours (red, green, blue) of trust values in [0, 1]; grey for NaN, which means that there is no value."""
    low = np.clip(np.nan_to_num(trust) * 2, 0, 1)[:, None]
    high = np.clip(np.nan_to_num(trust) * 2 - 1, 0, 1)[:, None]
    upper = (1 - high) * HALF + high * ONE
    mixed = (1 - low) * ZERO + low * upper
    return np.where(np.isnan(trust)[:, None], GREY, mixed).astype(np.uint8)


def role_colours(run: Run, actor: Int[ndarray, "n"]) -> UInt8[ndarray, "n 3"]:
    """Colours (red, green, blue) of actors by their roles, as in all figures; pale if an actor is not equipped.

    `actor` contains actor numbers.
    """
    of_role = {role: style.role_look(role, run.role_labels)["color"] for role in run.role_labels}
    of_actor = run.roles.astype(object).map(of_role)
    inks = [of_actor.get(number, style.PALE) for number in actor.tolist()]
    rgb = [tuple(bytes.fromhex(ink[1:])) for ink in inks]
    return np.array(rgb, np.uint8).reshape(-1, 3)


def _block(  # type: ignore[no-untyped-def]
    recording,
    run: Run,
    config: Config,
    steps: Int[ndarray, "b"],
    encounters: pd.DataFrame,
    vehicles: Sequence[int],
    sweeper: Sweeper | None,
) -> None:
    """Write a block of steps."""
    import rerun

    columns = ["vehicle", "length_m", "width_m", "height_m"]
    bodies = run.table("vehicles", columns).set_index("vehicle")
    actors = run.table("actors", where=at_steps(steps)).sort_values(["step", "actor"]).join(bodies, on="actor")
    shown = _last_sensed(run, steps, vehicles)
    here = dict(iter(actors.groupby("step")))
    for step in steps.tolist():
        recording.set_time("time", duration=step * run.dt_s)
        now = here.get(step, actors[:0])
        number = now.actor.to_numpy(np.int64)
        value = in_vehicles(run, step).reindex(number).to_numpy()
        boxes = _boxes(now)
        roles, rated = role_colours(run, number), colours(value)
        flat = log_actors(recording, boxes, roles, rated)
        met = encounters[(encounters.start_step <= step) & (encounters.end_step > step)]
        met = met[met.a.isin(number) & met.b.isin(number)]
        ends = [np.searchsorted(number, met[end].to_numpy()) for end in ("a", "b")]
        lines = np.stack([flat[e] for e in ends], axis=1)
        recording.log("map/encounters", rerun.LineStrips2D(lines, colors=[120, 60, 160], radii=0.3))
        high = np.stack([boxes.xyz_m[e] for e in ends], axis=1)
        recording.log("city/encounters", rerun.LineStrips3D(high, colors=[120, 60, 160], radii=0.08))
        for name, every in shown.items():
            if not ((every.step == step) | (every.end_step == step)).any():
                continue
            is_shown = (every.step <= step) & (step < every.end_step)
            rows, colour = every[is_shown], COLOURS[name]
            if rows.empty:
                recording.log(f"city/{name}", rerun.Clear(recursive=False))
                recording.log(f"map/{name}", rerun.Clear(recursive=False))
                continue
            boxes = _boxes(rows)
            recording.log(f"city/{name}", drawn_boxes(boxes, np.array(colour, np.uint8)))
            if name == "fabricated":
                flat = on_map(boxes.xyz_m)
                recording.log(f"map/{name}", rerun.Points2D(flat, colors=colour, radii=4.0))
        if sweeper is None:
            continue
        for vehicle in set(vehicles) - set(number.tolist()):
            recording.log(f"city/clouds/{vehicle}", rerun.Clear(recursive=False))
        there = now[now.actor.isin(list(vehicles))].actor.to_numpy(np.int64)
        there = there[senses(run, np.full(len(there), step), there)].tolist()
        for vehicle, cloud in zip(there, sweeper(step, there), strict=True):
            row = now[now.actor == vehicle].iloc[0]
            points = cloud()
            xy_m = turned_by(row.yaw_rad, points) + [row.x_m, row.y_m]
            height = row.z_m + 0.5 * row.height_m + config.lidar.mount_above_roof_m
            world = np.column_stack([xy_m, points[:, 2] + height])
            recording.log(f"city/clouds/{vehicle}", rerun.Points3D(world.astype(np.float32), radii=0.04))


def _boxes(rows: pd.DataFrame) -> Boxes:
    xyz_m, lwh_m = rows[BOX[:3]], rows[BOX[3:6]]
    return Boxes(xyz_m.to_numpy(float), lwh_m.to_numpy(float), rows.yaw_rad.to_numpy(float))


def _last_sensed(
    run: Run,
    steps: Int[ndarray, "b"],
    vehicles: Sequence[int],
) -> dict[str, pd.DataFrame]:
    """Boxes that are shown in some of these steps.

    Parameters
    ----------
    steps
        Steps, ascending.
    vehicles
        Vehicles of which is shown what they detected, received and believe. What any vehicle fabricated is shown, too.

    Returns
    -------
    By name: boxes with `step`, in which a vehicle sensed or received them, and `end_step`, an interval of its sensing
    later. They are shown from `step` until before `end_step`.
    """
    equipped = run.vehicles.vehicle[run.vehicles.equipped]
    longest = int(interval_steps(run, equipped.to_numpy(np.int64)).max(initial=1))
    step = pc.field("step")
    first, last = int(steps[0]), int(steps[-1])
    where = (step > first - longest) & (step <= last)
    of = run.subjects.vehicle
    own = of.index[of.isin(vehicles)].tolist()
    columns = ["step", "observer", *BOX]
    fabricated = run.table("detections", columns, where & (pc.field("origin") == "fabricated"))
    found = {"fabricated": fabricated.assign(by=fabricated.observer.map(of))}
    if vehicles:
        sensed = where & pc.field("observer").isin(own) & (pc.field("origin") == "sensed")
        detected, received = run.table("detections", columns, sensed), _received(run, where, vehicles)
        found["detected"] = detected.assign(by=detected.observer.map(of))
        found["received"] = received.assign(by=received.receiver)
        if "fused" in run.tables:
            believed = run.variant_table("fused", columns, where & pc.field("observer").isin(list(vehicles)))
            found["believed"] = believed.assign(by=believed.observer)
    for name, rows in found.items():
        interval = interval_steps(run, rows.by.to_numpy(np.int64))
        found[name] = rows.assign(end_step=rows.step + interval)
    return found


def _received(run: Run, where: pc.Expression, vehicles: Sequence[int]) -> pd.DataFrame:
    """Boxes in the messages that the chosen vehicles received, by step of reception. Empty without `receptions`."""
    if not vehicles or "receptions" not in run.tables:
        return pd.DataFrame(columns=["step", "receiver", *BOX])
    is_cpm = pc.field("message_type") == "cpm"
    mine = where & is_cpm & pc.field("receiver").isin(list(vehicles))
    got = run.table("receptions", ["step", "message_step", "sender", "receiver"], mine).drop_duplicates()
    when = at_steps(got.message_step.unique())
    sent = run.table("detections", ["step", "observer", *BOX, "transmitted"], when)
    sent = sent[sent.transmitted].rename(columns={"step": "message_step", "observer": "sender"})
    return sent.merge(got, on=["message_step", "sender"])


def log_actors(  # type: ignore[no-untyped-def]
    recording,
    boxes: Boxes,
    inks: UInt8[ndarray, "n _"],
    rated: UInt8[ndarray, "n _"],
) -> Float[ndarray, "n 2"]:
    """Log actors in the city, with edges in the colours of trust, and on the map; return their places on the map."""
    import rerun

    recording.log("city/actors", drawn_boxes(boxes, inks, solid=True))
    edges = Boxes(boxes.xyz_m, boxes.lwh_m * _EDGE_SHARE, boxes.yaw_rad)
    recording.log("city/edges", drawn_boxes(edges, rated))
    flat = on_map(boxes.xyz_m)
    recording.log("map/rings", rerun.Points2D(flat, colors=rated, radii=3.0, draw_order=30.0))
    recording.log("map/actors", rerun.Points2D(flat, colors=inks, radii=2.0, draw_order=31.0))
    return flat


def drawn_boxes(boxes: Boxes, colour: UInt8[ndarray, "..."], solid: bool = False):  # type: ignore[no-untyped-def]
    import rerun

    fill = rerun.components.FillMode.Solid if solid else rerun.components.FillMode.MajorWireframe
    return rerun.Boxes3D(
        centers=boxes.xyz_m.astype(np.float32),
        half_sizes=0.5 * boxes.lwh_m.astype(np.float32),
        quaternions=turn(boxes.yaw_rad).astype(np.float32),
        colors=colour,
        fill_mode=fill,
    )


def _over_time(  # type: ignore[no-untyped-def]
    recording, run: Run, trust: pd.DataFrame, steps: Int[ndarray, "s"], vehicles: Sequence[int]
) -> None:
    """Plot the median trust of each role, and the trust in the chosen vehicles, over time."""
    import rerun

    part = trust[trust.step.isin(steps.tolist())]
    role = part.vehicle.map(run.roles).astype(object)
    series = {}
    for name, rows in part.groupby(role):
        series[str(name)] = rows.groupby("step").trust.median()
    for vehicle in vehicles:
        own = part[(part.vehicle == vehicle) & (part.identity == 0)]
        series[f"vehicle_{vehicle}"] = own.set_index("step").trust
    for name, values in series.items():
        for step, value in values.items():
            recording.set_time("time", duration=float(cast(int, step)) * run.dt_s)
            recording.log(f"trust/{name}", rerun.Scalars(float(value)))
