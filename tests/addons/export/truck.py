"""A car that waits, heading north, and a truck that turns left before it; by hand in every layout.

The car stands at (100, 50), 1.5 m high, so its LiDAR is at z = 1.5 + 0.23 = 1.73. The truck's middle is at (97, 70),
3.5 m high, and it heads north-west, 135 degrees from east. From the car: 20 m ahead, 3 m to the left, turned
by 135 - 90 = 45 degrees; its middle is 1.75 - 1.73 = 0.02 m above the LiDAR.
"""

import numpy as np

from results.moments import Selection
from results.tables import TABLES
from tests.results import tiny

TRUCK_WORLD = np.array([97, 70, 1.75, 10, 2.5, 3.5, np.radians(135)])
TRUCK_SENSOR = np.array([20, 3, 0.02, 10, 2.5, 3.5, np.radians(45)])
CAR_LIDAR = [100, 50, 1.73, np.radians(90)]
CONFIG = {
    "sensing_interval_s": 1.0, "lidar": {"mount_above_roof_m": 0.23}, "gnss": {"std_m": 0.2, "heading_std_deg": 0.5},
}  # fmt: skip


def body(number, kind, lwh, name, last=3, first=0, **more):
    size = dict(zip(("length_m", "width_m", "height_m"), lwh, strict=True))
    about = {"vehicle": number, "sumo_id": name, "vehicle_class": kind, "equipped": True, "role": "honest"}
    return about | size | {"first_step": first, "last_step": last} | more


def box(xyz, lwh, yaw):
    return dict(
        zip(("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad"), (*xyz, *lwh, yaw), strict=True)
    )


def make(folder, keep=lambda table, row: True, units=(), late=0, detected=(), **more):
    """Four steps: the car 0 and the truck 1 in all of them, the pedestrian 2 in the last two; 3 is a car behind.

    `keep` says of which rows of `observability`, `detections` and `receptions` the run has; `units` are numbers of
    roadside units, which send in step 0; messages arrive `late` steps after theirs; `detected` are further detections;
    `more` are rows of further tables.
    """
    car, truck, walker = (4.5, 1.8, 1.5), (10, 2.5, 3.5), (0.5, 0.5, 1.75)
    vehicles = [
        body(0, "car", car, "a/../../b"), body(1, "truck", truck, "<script>alert(1)</script>", role="malicious",
        attack_start_step=2), body(2, "pedestrian", walker, '"quoted", name', first=2, equipped=False, role=None),
        body(3, "car", car, "late", first=1),
    ]  # fmt: skip
    vehicles += [body(unit, "car", car, f"unit {unit}", role=None) for unit in units]
    pose = {0: ((100, 50, 0.75), car, np.pi / 2, 0.0), 1: ((97, 70, 1.75), truck, 3 * np.pi / 4, 5.0),
            2: ((101, 60, 0.875), walker, 0.0, 1.5), 3: ((100, 40, 0.75), car, np.pi / 2, 8.0)}  # fmt: skip
    there = [(s, a) for s in range(4) for a in pose if vehicles[a]["first_step"] <= s]
    actors = [
        {"step": s, "actor": a, "speed_mps": pose[a][3] + (s if a == 1 else 0)}
        | {name: value for name, value in box(*pose[a][:3]).items() if name in TABLES["actors"].columns}
        for s, a in there
    ]  # fmt: skip
    seen = [(0, 1, 90, 100), (0, 2, 0, 12), (1, 0, 40, 100), (3, 0, 60, 100)]
    observability = [
        {"step": s, "observer": o, "actor": a, "n_points": n, "n_unoccluded": m}
        for s in range(4) for o, a, n, m in seen if (s, o) in there and (s, a) in there
    ]  # fmt: skip
    equipped = [(s, a) for s, a in there if a != 2]
    detections = [
        {"step": s, "observer": a, "detection_index": 0, "class": "truck" if a == 1 else "car", "score": 1.0,
         "origin": "self", "transmitted": True, "speed_mps": pose[a][3] + (s if a == 1 else 0),
         "acceleration_mps2": 1.0 if a == 1 and s else 0.0, **box(*pose[a][:3])}
        for s, a in equipped
    ] + [
        {"step": s, "observer": 0, "detection_index": 1, "class": "truck", "score": 0.75, "origin": "sensed",
         "transmitted": s != 3, "n_points": 90, **box((97, 70, 1.75), truck, 3 * np.pi / 4)} for s in range(4)
    ] + list(detected)  # fmt: skip
    receptions = [
        {"step": s + late, "message_step": s, "message_type": "cpm", "sender": a, "receiver": b, "hops": 1,
         "generation_offset_s": 0.25, "latency_s": 0.5, "distance_m": 20.0}
        for s, a in equipped + [(0, unit) for unit in units]
        for b in (0, 1, 3) if a != b and (s, b) in there and s + late < 4
    ]  # fmt: skip
    observability, detections, receptions = (
        [row for row in rows if keep(name, row)] for name, rows in (
            ("observability", observability), ("detections", detections), ("receptions", receptions),
        )
    )  # fmt: skip
    trust = [{"step": 2, "variant": "base", "subject": a, "trust": 0.25 * a, "state": "evaluated"} for a in (0, 1)]
    folder.mkdir(parents=True)
    return tiny.make(
        folder, 4, CONFIG, vehicles=vehicles, actors=actors, observability=observability, detections=detections,
        receptions=receptions, trust=trust, **more,
    )  # fmt: skip


def selection(run, vehicles=(0, 1, 3)):
    return Selection(run, vehicles, np.arange(4), lambda xy: np.full(len(xy), 1.25))


def clouds(step, vehicles):
    """Three points, different for each vehicle and step."""
    return [lambda v=v: np.array([[1, 2, 3], [4, 5, 6], [step, v, 0]], np.float32) for v in vehicles]


def written(plan, folder):
    """All files of a plan, by path, as bytes, and on disk."""
    made = {}
    for unit in plan.units:
        for file in unit.files(clouds):
            content = made[file.same_as] if file.same_as else file.content()
            assert file.path not in made
            made[file.path] = content
            path = folder / file.path
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    return made
