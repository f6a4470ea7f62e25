"""The paper's scene of five actors, played step by step."""

from dataclasses import fields, is_dataclass, replace

import numpy as np

from cosim.addons.compare.scenarios import FOLDER, ScriptedScene
from cosim.base.deferred import Deferred
from cosim.config.config import load
from cosim.radio.rsu import NO_RSUS
from cosim.step.cycle import step
from cosim.step.parts import Parts, perception_of
from cosim.step.state import State

QUIET = (
    "server.cellular.delay_min_s=0.001", "server.cellular.delay_mean_s=0.002", "server.backhaul_s=0.005",
    "attacks.0.start_s=1000",
)  # fmt: skip
"""Short delays, and no attack within a test."""


def parts_of(scene: ScriptedScene, *overrides: str, rsus=NO_RSUS, **others) -> Parts:
    """Parts of the scene; `others` replace those that the config names."""
    config = load(FOLDER / "scenario-2.toml", [*QUIET, *overrides])
    parts = Parts.of(config, scene.city, rsus)
    perception = replace(perception_of(config, scene.city), detector=scene.detector)
    return replace(parts, perception=perception, **others)


def play(n: int, *overrides: str, rsus=NO_RSUS, **others):
    """What happened in steps 0 to n - 1 (`Sensed`), and the state at the end."""
    scene = ScriptedScene.load()
    parts = parts_of(scene, *overrides, rsus=rsus, **others)
    state, sensed = State.start(parts), []
    for number in range(n):
        state, result = step(scene.world(number), state, parts)
        sensed.append(result.sensed)
    return sensed, state


def assert_same(one, other, where="", leave_out=("sweeps",)):
    """Equal in every array and number, however deep."""
    assert type(one) is type(other), where
    if is_dataclass(one):
        for f in fields(one):
            if f.name not in leave_out:
                assert_same(getattr(one, f.name), getattr(other, f.name), f"{where}.{f.name}", leave_out)
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), where
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}[{i}]", leave_out)
    elif isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_same(one[key], other[key], f"{where}[{key}]", leave_out)
    elif isinstance(one, Deferred):
        assert_same(one(), other(), where, leave_out)
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other, where)
    elif isinstance(one, float):
        np.testing.assert_equal(one, other, where)
    else:
        assert one == other, where
