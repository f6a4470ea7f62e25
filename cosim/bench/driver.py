"""Speed of the drivers that react, on made-up streets with everybody equipped."""

from time import process_time

import numpy as np

from cosim.driver.cautious import Cautious, CautiousParams
from cosim.driver.driver import Beliefs
from cosim.world import LanePaths, World
from sensors.boxes import Boxes
from sensors.scene import Shape

N_BELIEFS, N_VERTICES, LENGTH_M = 60, 24, 300.0
"""Fused objects per vehicle; vertices and length of its lane path."""


def street(n: int, step: int) -> tuple[World, Beliefs]:
    """Vehicles on parallel streets 40 m apart, ten on each; each believes in objects around it, a third of them its
    own, and one in fifteen in its path."""
    rng = np.random.default_rng(step)
    line, at = np.divmod(np.arange(n), 10)
    xy = np.column_stack([25.0 * at + 8.0 * 0.5 * step, 40.0 * line])
    sizes = np.tile([4.5, 1.8, 1.5], (n, 1))
    boxes = Boxes(np.column_stack([xy, np.full(n, 0.75)]), sizes, np.zeros(n))
    n_lines = int(line[-1]) + 1 if n else 0
    along = np.tile(np.linspace(0, LENGTH_M, N_VERTICES), n_lines)
    vertices = np.column_stack([along, np.repeat(40.0 * np.arange(n_lines), N_VERTICES)])
    paths = LanePaths(
        np.arange(n), line, xy[:, 0] + 2.25, np.arange(n_lines + 1) * N_VERTICES, vertices, along
    )  # fmt: skip
    world = World(
        step, np.arange(n, dtype=np.int32), np.arange(n, dtype=np.uint64) * 2654435761, np.full(n, Shape.CAR, np.uint8),
        boxes, np.full(n, 8.0), np.ones(n, bool), np.zeros(n, np.uint8), paths,
    )  # fmt: skip
    ego = np.repeat(np.arange(n), N_BELIEFS)
    m = len(ego)
    near = xy[ego] + rng.uniform(-60, 60, (m, 2))
    in_path = rng.random(m) < 1 / 15
    near[in_path, 1] = xy[ego[in_path], 1] + rng.uniform(-1, 1, in_path.sum())
    own = rng.random(m) < 1 / 3
    objects = Boxes(np.column_stack([near, np.full(m, 0.75)]), np.tile([4.5, 1.8, 1.5], (m, 1)), rng.uniform(-3, 3, m))
    index = np.tile(np.arange(N_BELIEFS), n)
    beliefs = Beliefs(
        0.5 * step, ego, np.zeros(m, np.uint8), objects, rng.random(m), own, rng.integers(0, n, m), index
    )  # fmt: skip
    return world, beliefs


def bench(n_vehicles: int = 1000, n_sweeps: int = 12) -> list[tuple[str, float, str]]:
    """What is measured, figure, unit; processor time on one thread."""
    driver, state = Cautious(CautiousParams()), None
    spent: dict[str, list[float]] = {"a sweep": [], "a step between two sweeps": []}
    for step in range(n_sweeps):
        world, beliefs = street(n_vehicles, step)
        for name, given in (("a sweep", beliefs), ("a step between two sweeps", None)):
            begin = process_time()
            state, _ = driver.commands(state, world, given, 0.5)
            spent[name].append(process_time() - begin)
    return [
        (f"{n_vehicles} vehicles, {name}", 1e3 * min(times[len(times) // 2 :]), "ms") for name, times in spent.items()
    ]
