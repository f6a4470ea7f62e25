"""Pictures that need a sweep cast again or the map of the city: one sweep, the city at a moment, a movie.

`sweep`, `scene` and `movie` are hooks of `cosim plot`: they take the runs, vehicles and step of its command line.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import shapely

from cosim.addons.pictures import clouds, movie_figure, scene_figure, sweep_figure
from cosim.base import durable
from cosim.config.config import Config
from cosim.runs.replay_lidar import city_of, config_of, worlds
from cosim.runs.replay_lidar import sweep as replayed
from cosim.traffic.scenario import find
from results.figures import style
from results.metrics.trust import in_vehicles
from results.run import Run
from sensors.boxes import Boxes
from sensors.lidar import Sweeps
from sumo_nets import network

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ReplayedScan:
    """The sweep of one vehicle in one step, with actors and detections; sensor frame."""

    sweeps: Sweeps
    """Of this vehicle only."""
    actors: Boxes
    """All other actors within range."""
    reported: Boxes
    """Detections that its detector reported, where the LiDAR measured them."""


def replay_scan(run: Run, vehicle: int, step: int) -> ReplayedScan:
    """The sweep of a vehicle. A ValueError is raised if the vehicle did not sense in that step."""
    config = config_of(run)
    n_steps = int(run.manifest["steps"])
    every = config.schedule.exchange_every_steps
    if not 0 <= step < n_steps or step % every:
        raise ValueError(
            f"--step {step}: no vehicle sensed then. {run.path} has the steps 0 to {n_steps - 1}"
            + (f", and senses in every {every}th." if every > 1 else ".")
        )
    run.require("actors", "vehicles", "detections")
    world = next(worlds(run, np.array([step])), None)
    if world is None:
        raise ValueError(f"--step {step}: no actor is on the road then.")
    equipped = world.actor[world.equipped]
    if vehicle not in equipped:
        some = ", ".join(map(str, equipped[:8]))
        raise ValueError(f"--vehicle {vehicle} has no sensor on the road in step {step}. These have: {some}, ...")
    row = np.flatnonzero(world.actor == vehicle)
    if not config.schedule.senses(step, world.name_key[row]).all():
        interval, phase = config.schedule.of_vehicles(world.name_key[row])
        raise ValueError(
            f"--step {step}: vehicle {vehicle} does not sense then. It senses in step {phase[0]} and every "
            f"{interval[0]} steps after it."
        )
    sweeps = replayed(config, city_of(config), world, row)
    away_m = np.linalg.norm(world.boxes.xyz_m - sweeps.poses.origin_m, axis=1)
    rows = np.flatnonzero(away_m < config.lidar.max_range_m)
    rows = rows[rows != row]
    own = run.subjects.index[run.subjects.vehicle == vehicle].tolist()
    is_now = pc.field("step") == step
    detected = run.table("detections", where=is_now & pc.field("observer").isin(own))
    detected = detected[detected.origin == "sensed"]
    boxes = Boxes(
        xyz_m=detected[["x_m", "y_m", "z_m"]].to_numpy(float),
        lwh_m=detected[["length_m", "width_m", "height_m"]].to_numpy(float),
        yaw_rad=detected.yaw_rad.to_numpy(float),
    )
    errors = run.table("position_errors", where=is_now & (pc.field("vehicle") == vehicle))
    believed = sweeps.poses
    if len(errors):  # the pose that displaced the boxes
        believed = believed.displaced(errors[["error_x_m", "error_y_m", "error_yaw_rad"]].to_numpy(float))
    others = world.boxes.take(rows)
    actors = sweeps.poses.to_sensor(np.zeros(len(others), int), others)
    reported = believed.to_sensor(np.zeros(len(boxes), int), boxes)
    return ReplayedScan(sweeps, actors, reported)


def sweep(runs: Sequence[Run], vehicles: Sequence[int], step: int | None, out: Path | None) -> Path:
    """Write a sweep as a picture seen from above or as a point cloud. The ending of the file name decides which."""
    if len(runs) != 1 or step is None or len(vehicles) != 1:
        raise ValueError("cosim plot sweep shows one sweep: cosim plot sweep RUN --vehicle V --step S")
    (run,), (vehicle,) = runs, vehicles
    scan_of_step = replay_scan(run, vehicle, step)
    points = clouds.cloud_of(scan_of_step.sweeps, 0)
    out = out or run.path / f"sweep-{vehicle}-{step}.png"
    longest_first = sorted(clouds.FORMATS, key=len, reverse=True)
    form = next((end for end in longest_first if out.name.endswith(end)), None)
    if form is not None:
        durable.write_output(out, clouds.FORMATS[form](points))
        return out
    if out.suffix not in style.FORMATS:
        raise ValueError(
            f"--out {out}: {out.suffix or 'no ending'} is neither a picture ({', '.join(style.FORMATS)}) "
            f"nor a point cloud ({', '.join(clouds.FORMATS)}). Give one of these endings."
        )
    boxes = {
        "true boxes": _from_above(scan_of_step.actors),
        "reported by the detector": _from_above(scan_of_step.reported),
    }
    when = f"{step * run.dt_s:g} s"
    title = f"LiDAR sweep of vehicle {vehicle} at {when}: {len(points[0]):,} returns"
    return style.save(sweep_figure.draw(*points, boxes, title), out)


def _from_above(boxes: Boxes) -> np.ndarray:
    """Centre, length, width and yaw of boxes [n 5]."""
    xy_m = boxes.xyz_m[:, :2]
    return np.column_stack([xy_m, boxes.lwh_m[:, :2], boxes.yaw_rad])


def scene(runs: Sequence[Run], vehicles: Sequence[int], step: int | None, out: Path | None) -> Path:
    """Draw the city in one step, with trust and the point clouds of some vehicles.

    If `vehicles` is empty, the clouds are those of the vehicle with most other equipped ones within 80 m, and of the
    two equipped vehicles nearest to it.
    """
    if len(runs) != 1 or step is None:
        raise ValueError("cosim plot scene shows one moment: cosim plot scene RUN --step S [--vehicle V]")
    (run,) = runs
    out = out or run.path / f"scene-{step}.png"
    config = config_of(run)
    world = next(worlds(run, np.array([step])), None)
    if world is None or step % config.schedule.exchange_every_steps:
        raise ValueError(f"--step {step}: no vehicle senses then in {run.path}.")
    equipped = np.flatnonzero(world.equipped)
    senses = equipped[config.schedule.senses(step, world.name_key[equipped])]
    for vehicle in vehicles:
        if vehicle not in world.actor[equipped]:
            raise ValueError(f"--vehicle {vehicle} has no sensor on the road in step {step}.")
        if vehicle not in world.actor[senses]:
            raise ValueError(f"--vehicle {vehicle} does not sense in step {step}.")
    if not len(senses):
        raise ValueError(f"--step {step}: no vehicle with a LiDAR is on the road then.")
    xy_m = world.boxes.xyz_m[:, :2]
    chosen = np.searchsorted(world.actor, np.asarray(vehicles, int))
    if not vehicles:
        away = np.linalg.norm(xy_m[senses, None] - xy_m[senses], axis=2)
        middle = int(np.argmax((away < 80.0).sum(axis=1)))
        chosen = senses[np.argsort(away[middle], kind="stable")[:3]]
    city = city_of(config)
    sweeps = replayed(config, city, world, chosen)
    observers = world.actor[chosen].tolist()
    seen_m = {}
    for n, observer in enumerate(observers):
        seen_m[observer] = sweeps.poses.to_world(n, sweeps.xyz(n))
    lies = run.table("detections", where=(pc.field("step") == step))
    lies = lies[(lies.origin == "fabricated") & lies.transmitted]
    columns = ["x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad"]
    b = world.boxes
    moment = scene_figure.SceneMoment(
        centre_m=xy_m[chosen[0]],
        streets=[line_m for line_m, lane in _lanes(config) if lane.for_cars],
        buildings=[
            (shapely.get_coordinates(shapely.get_exterior_ring(polygon))[:-1], base, top)
            for polygon, base, top in zip(city.footprints, city.buildings.base_m, city.buildings.top_m, strict=True)
        ],
        clouds=seen_m,
        boxes=np.column_stack([b.xyz_m, b.lwh_m, b.yaw_rad]),
        equipped=world.equipped,
        trust=in_vehicles(run, step).reindex(world.actor).to_numpy(float),
        attacks=movie_figure.attack_starts(run).reindex(world.actor).to_numpy() <= step,
        ghosts=lies[columns].to_numpy(float),
    )
    title = f"{step * run.dt_s:g} s: point clouds and trust"
    if np.isnan(moment.trust).all():
        title = f"{step * run.dt_s:g} s: point clouds, no trust yet"
        _LOG.warning("--step %d: %s", step, _first_trust(run))
    return style.save(scene_figure.draw(moment, title), out)


def _first_trust(run: Run) -> str:
    """When a run has its first trust values that rest on an evaluation, in words."""
    known = run.variant_table("trust", ["step"], pc.field("n_evaluations") > 0)
    if known.empty:
        return "the run has no trust values of a server that rest on an evaluation, so none are drawn."
    return f"no vehicle on the road has a trust value yet; the first of the run are of step {known.step.min()}."


def _lanes(config: Config) -> list[tuple[np.ndarray, network.Lane]]:
    """The lanes of a run's network, with their lines in the world frame."""
    scenario = find(config.traffic.scenario, config.traffic.trace)
    lanes = () if scenario.net is None else network.lanes(scenario.net)
    return [(lane.line_m[:, :2] - scenario.origin_m, lane) for lane in lanes]


def movie(runs: Sequence[Run], vehicles: Sequence[int], step: int | None, out: Path | None) -> Path:
    """A movie of a run on the map of its city."""
    if len(runs) != 1 or len(vehicles) > 1 or step is not None:
        raise ValueError("cosim plot movie films one run: cosim plot movie RUN [--vehicle V]")
    return film(runs[0], vehicles[0] if vehicles else None, out)


def film(
    run: Run,
    vehicle: int | None,
    out: Path | None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """A movie of a run on the map of its city."""
    config = config_of(run)
    streets = [line_m for line_m, _ in _lanes(config)]
    buildings = [shapely.get_coordinates(shapely.get_exterior_ring(polygon)) for polygon in city_of(config).footprints]
    return movie_figure.write(run, out or run.path / "movie.gif", vehicle, streets, buildings, progress)
