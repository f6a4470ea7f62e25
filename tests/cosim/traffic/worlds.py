"""Worlds of a live run."""

from typing import Any

import numpy as np

from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fleet import FleetParams
from cosim.traffic.params import TrafficParams
from cosim.traffic.scenario import find
from cosim.traffic.source import TrafficEnded, TrafficSource

COLUMNS = ("actor", "name_key", "shape", "speed_mps", "equipped", "attack")


def collect(traffic: TrafficSource, warmup_s: float, n_steps: int) -> list[dict[str, np.ndarray]]:
    """Everything that `n_steps` worlds say, or fewer if the traffic ends."""
    for _ in traffic.warm_up(warmup_s):
        pass
    worlds = []
    try:
        for _ in range(n_steps):
            world = traffic.advance()
            boxes = {"xyz_m": world.boxes.xyz_m, "lwh_m": world.boxes.lwh_m, "yaw_rad": world.boxes.yaw_rad}
            worlds.append({name: getattr(world, name) for name in COLUMNS} | boxes)
    except TrafficEnded:
        pass
    traffic.close()
    return worlds


def live(
    scenario: str, warmup_s: float, n_steps: int, params: TrafficParams | None = None
) -> tuple[list[dict[str, np.ndarray]], dict[str, Any]]:
    """Worlds of a live run, and its report."""
    traffic = find(scenario).traffic(params or TrafficParams(), registry())
    report: dict[str, Any] = {}
    close = traffic.close
    traffic.close = lambda: (report.update(traffic.report()), close())  # type: ignore[method-assign]
    return collect(traffic, warmup_s, n_steps), report


def registry() -> ActorRegistry:
    return ActorRegistry(FleetParams(), 4, (0.3, 0.3))


def same(one: list[dict[str, np.ndarray]], other: list[dict[str, np.ndarray]]) -> None:
    """All worlds are equal, to the bit."""
    assert len(one) == len(other)
    for step, (a, b) in enumerate(zip(one, other, strict=True)):
        for name in a:
            np.testing.assert_array_equal(a[name], b[name], err_msg=f"step {step}: {name}")
