"""Line of sight of encounters, for every pair and second of a run, against Shapely and Embree."""

import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree

from cosim.traffic.scenario import find
from results.archive import open_run
from sensors.boxes import Boxes
from sensors.raycast.embree import tracer_of
from sensors.raycast.mesh import body_triangles
from sensors.scene import prisms
from tests.drive import drive

RADIUS_M, ABOVE_ROOF_M = 60.0, 0.23
ENCOUNTERS = [
    f'encounters.{i}.{key}'
    for i, (los, on_foot) in enumerate((("buildings", "true"), ("buildings_and_vehicles", "false")))
    for key in (
        'pairs="all_los"', f'los="{los}"', f"pedestrians={on_foot}", f"radius_m={RADIUS_M}", "hysteresis_s=0.0",
    )
]  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Without sensing or radio, by one key."""
    return open_run(drive(tmp_path_factory.mktemp("run") / "los", "sensing=false", "traffic.duration_s=6", *ENCOUNTERS))


@pytest.fixture(scope="module")
def steps(run):
    """By step: actors, whether on foot, their boxes, shapes, points above their roofs, and pairs within the radius."""
    who = run.vehicles.set_index("vehicle")
    found = {}
    for step, now in run.actors.groupby("step"):
        size = who.loc[now.actor]
        boxes = Boxes(
            now[["x_m", "y_m", "z_m"]].to_numpy(float), size[["length_m", "width_m", "height_m"]].to_numpy(float),
            now.yaw_rad.to_numpy(float),
        )  # fmt: skip
        top = boxes.xyz_m.copy()
        top[:, 2] += boxes.lwh_m[:, 2] / 2 + ABOVE_ROOF_M
        pairs = np.sort(cKDTree(top[:, :2]).query_pairs(RADIUS_M, output_type="ndarray"), axis=1)
        on_foot = (size.vehicle_class == "pedestrian").to_numpy()
        found[step] = now.actor.to_numpy(), on_foot, boxes, size.vehicle_class.cat.codes.to_numpy(np.uint8), top, pairs
    return found


def recorded(run, los):
    """(step, a, b) of every second in contact; breaks are not bridged."""
    frame = run.encounters[run.encounters.los == los]
    return {
        (step, a, b) for a, b, start, end in frame[["a", "b", "start_step", "end_step"]].itertuples(index=False)
        for step in range(start, end)
    }  # fmt: skip


@pytest.fixture(scope="module")
def clear_of_buildings(steps):
    """(step, a, b) of the pairs whose line meets no building between its base and its top, by Shapely."""
    city = find("helsinki").city()
    base_m, top_m, tree = city.buildings.base_m, city.buildings.top_m, shapely.STRtree(city.footprints)
    clear = set()
    for step, (actor, _, _, _, top, pairs) in steps.items():
        a, b = top[pairs[:, 0]], top[pairs[:, 1]]
        lines = shapely.linestrings(np.stack([a[:, :2], b[:, :2]], axis=1))
        line, building = tree.query(lines, "intersects")
        blocked = np.zeros(len(pairs), bool)
        inside = shapely.intersection(lines[line], tree.geometries[building])
        part, owner = shapely.get_parts(inside, return_index=True)
        part, owner = part[shapely.length(part) > 0], owner[shapely.length(part) > 0]
        of = line[owner]
        ends = np.stack([shapely.get_coordinates(shapely.get_point(part, i)) for i in (0, -1)])
        length_m = np.linalg.norm(b[of, :2] - a[of, :2], axis=1)
        share = np.linalg.norm(ends - a[of, :2], axis=2) / length_m
        z_m = a[of, 2] + share * (b[of, 2] - a[of, 2])
        cut = (z_m.min(axis=0) < top_m[building[owner]]) & (z_m.max(axis=0) > base_m[building[owner]])
        blocked[of[cut]] = True
        clear |= {(step, *sorted(actor[pair].tolist())) for pair in pairs[~blocked]}
    return clear


def test_buildings_equal_shapely_on_every_pair_second(run, clear_of_buildings):
    assert recorded(run, "buildings") == clear_of_buildings and len(clear_of_buildings) > 500


def test_vehicles_equal_embree_on_every_pair_second(run, steps, clear_of_buildings):
    """Rays between roofs through the bodies of all actors; what they hit of their own two ends does not count."""
    expected, n_cut = set(), 0
    for step, (actor, on_foot, boxes, shape, top, pairs) in steps.items():
        pairs = pairs[~on_foot[pairs].any(axis=1)]
        pairs = pairs[[(step, *sorted(actor[pair].tolist())) in clear_of_buildings for pair in pairs]]
        bodies = prisms(shape, boxes)
        owner = np.repeat(np.repeat(np.arange(len(boxes)), np.diff(bodies.ptr)), 12)
        centre = top.mean(axis=0)
        trace = tracer_of((body_triangles(bodies) - centre).astype(np.float32))
        start, end = top[pairs[:, 0]] - centre, top[pairs[:, 1]] - centre
        length_m = np.linalg.norm(end - start, axis=1)
        way = (end - start) / length_m[:, None]
        gone_m, blocked, going = np.zeros(len(pairs)), np.zeros(len(pairs), bool), np.ones(len(pairs), bool)
        while going.any():
            at = np.flatnonzero(going)
            far_m, triangle = trace(
                (start[at] + gone_m[at, None] * way[at]).astype(np.float32), way[at].astype(np.float32)
            )
            gone_m[at] += far_m + 1e-3
            met = (triangle >= 0) & (gone_m[at] < length_m[at])
            own = met & (owner[triangle][:, None] == pairs[at]).any(axis=1)
            blocked[at] |= met & ~own
            going[at] = own
        n_cut += int(blocked.sum())
        expected |= {(step, *sorted(actor[pair].tolist())) for pair in pairs[~blocked]}
    assert recorded(run, "buildings_and_vehicles") == expected and n_cut > 5


def test_without_sensing_nothing_is_sensed_or_sent(run):
    assert not len(run.detections) and not len(run.radio) and len(run.encounters)
    assert not run.vehicles.attack_start_step.notna().any()
