"""Forty vehicles on an open plane, driven without SUMO: what happens to them stands in tables, as in a run."""

from collections import defaultdict
from itertools import groupby

import numpy as np
import pandas as pd

from cosim.attacks.params import named, shares
from cosim.config.config import resolve_data
from cosim.runs import recording
from cosim.step.cycle import step
from cosim.step.parts import Parts
from cosim.step.state import State
from cosim.traffic.actors import ActorRegistry
from cosim.world import World
from results.tables import TABLES
from sensors.scene import Scene, Shape
from tests.sensors.town import boxes_at

N, SPACING_M, SPEED_MPS = 40, 17.0, 10.0
NAMES = [f"v{i:02}" for i in range(N)]
"""In the order of their actor numbers: four lanes of ten, 17 m apart, heading east at 10 m/s."""


class Tables(dict):
    """Takes what a recorder takes; a table is a frame, codes are numbers, what is absent is NaN."""

    def __init__(self, tables=tuple(TABLES)):
        super().__init__()
        self._rows, self.tables = defaultdict(list), tables

    def append(self, table, at, columns):
        """Rows of one step."""
        if table in self.tables:
            columns = {name: values for name, values in columns.items() if values is not None}
            n = next(len(values) for values in columns.values() if np.ndim(values))
            self._rows[table].append({name: np.broadcast_to(v, n) for name, v in ({"at": at} | columns).items()})

    def close(self):
        """All tables whole."""
        for table, rows in self._rows.items():
            self[table] = pd.concat([_frame(list(alike)) for _, alike in groupby(rows, tuple)], ignore_index=True)
        if "pseudonyms" in self:
            self["pseudonyms"] = self["pseudonyms"].drop(columns="at")
        return self


def _frame(rows):
    """One frame of rows that have the same columns."""
    columns = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    frame = pd.DataFrame({name: values for name, values in columns.items() if not name.endswith("__valid")})
    for name in frame:
        if f"{name}__valid" in columns:
            frame[name] = frame[name].where(columns[f"{name}__valid"])
    return frame


def play(attacks=(), n_steps=6, penetration_p=1.0, speeds=None, tables=tuple(TABLES), **sections):
    """Tables of some steps on the plane.

    Parameters
    ----------
    attacks
        Sections [[attacks]]; `start_s` is 0 unless they say otherwise.
    speeds
        Speed of all vehicles in each step [m/s].
    tables
        Names of those that are kept.
    """
    sections.setdefault("radio", {"model": "unit_disk", "unit_disk": {"loss_p": 0.0}})
    sections.setdefault("server", {"cellular": {"delay_min_s": 0.001, "delay_mean_s": 0.002, "uplink_loss_p": 0.0,
                                                "downlink_loss_p": 0.0}})  # fmt: skip
    sections["trust"] = {"server_period_s": 1.0} | sections.get("trust", {})
    sections.setdefault("lidar", {"n_azimuths": 256})
    sections.setdefault("fleet", {"penetration_p": penetration_p})
    attacks = [{"start_s": 0.0} | a for a in attacks]
    config = resolve_data({"attacks": attacks, "encounters": [{}], **sections}, "a test", None)
    parts = Parts.of(config, Scene.empty())
    registry = ActorRegistry(config.fleet, config.seed, shares(config.attacks), named(config.attacks))
    numbers = registry.register(NAMES, np.full(N, Shape.CAR, np.uint8), np.tile([4.4, 1.8, 1.5], (N, 1)), 0)
    state, tables, x_m = State.start(parts), Tables(tables), 0.0
    results = []
    for number in range(n_steps):
        speed = SPEED_MPS if speeds is None else speeds[number]
        xy = np.column_stack([SPACING_M * (np.arange(N) % 10) + x_m, 4.0 * (np.arange(N) // 10)])
        world = World(
            step=number, actor=numbers, name_key=registry.name_key, shape=registry.shape,
            boxes=boxes_at(np.column_stack([xy, np.full(N, 0.75)]), (4.4, 1.8, 1.5)),
            speed_mps=np.full(N, speed), equipped=registry.equipped, attack=registry.attack,
        )  # fmt: skip
        state, result = step(world, state, parts)
        recording.step(tables, result, 1.0)
        results.append(result)
        x_m += speed * config.traffic.step_s
    recording.pseudonyms(tables, n_steps - 1, parts.pseudonyms.in_use(state.pseudonyms))
    tables.close()
    tables.state, tables.parts, tables.results, tables.registry = state, parts, results, registry
    return tables
