"""The scenarios of TruPercept, simulated frame by frame with the complete cycle. Only the detectors' scores are given.

References
----------
.. [1] Hurl, Cohen, Czarnecki, Waslander, "TruPercept", 2020, section "Qualitative Analysis".
"""

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base import rng
from cosim.config.config import Config, load
from cosim.messages.content import FABRICATED
from cosim.step.cycle import step
from cosim.step.parts import Parts, perception_of
from cosim.step.result import Sensed
from cosim.step.state import State
from cosim.world import LABELS, World
from sensors.boxes import Boxes
from sensors.evidence import Observability
from sensors.lidar import Sweeps
from sensors.reports import DetectorDraws, Reports
from sensors.scene import Scene, Shape
from trust.params import Method

FOLDER = Path(__file__).parent / "scenes"
EGO, ATTACKER, THIRD = range(3)
"""Equipped vehicles in the order of the scene. These are the rows of actors, observers and trust."""
PEDESTRIAN = LABELS.index("pedestrian")
MEASURES = ("scenario_1", "scenario_2")


@dataclass(frozen=True, slots=True)
class ScriptedDetector:
    """A detector that reports true boxes with given scores."""

    observer: Int[ndarray, "d"]
    """Row of the sweep; ascending."""
    actor: Int[ndarray, "d"]
    """Row of the actor that it detects."""
    score: Float[ndarray, "d"]

    def detect(
        self,
        sweeps: Sweeps,
        seen: Observability,
        boxes: Boxes,
        label: UInt8[ndarray, "n"],
        draws: DetectorDraws,
    ) -> Reports:
        """These reports, in every step."""
        is_false = np.zeros(len(self.actor), bool)
        actor = self.actor
        return Reports(self.observer, label[actor], boxes.take(actor), self.score, actor, is_false)


@dataclass(frozen=True, slots=True)
class ScriptedScene:
    """Actors that stand still, the detections of the equipped ones, and the walls."""

    names: list[str]
    shape: UInt8[ndarray, "n"]
    boxes: Boxes
    equipped: Bool[ndarray, "n"]
    attack: UInt8[ndarray, "n"]
    """Number of the attack that each actor carries out, as in `World.attack`."""
    detector: ScriptedDetector
    city: Scene

    @staticmethod
    def load(path: Path = FOLDER / "scene.toml") -> "ScriptedScene":
        """Read the scene from a TOML file."""
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        names, actors = list(data["actors"]), list(data["actors"].values())
        lwh_m = np.array([a["lwh_m"] for a in actors])
        xy_m = [a["xy_m"] for a in actors]
        xyz_m = np.column_stack([xy_m, lwh_m[:, 2] / 2])
        equipped = np.array(["scores" in a for a in actors])
        scores = []
        for observer, row in enumerate(np.flatnonzero(equipped)):
            for other, score in actors[row]["scores"].items():
                scores.append((observer, names.index(other), score))
        walls = data["walls"]
        rings = []
        for wall in walls:
            up_and_down_m = wall["y_m"] + wall["y_m"][::-1]
            rings.append([np.column_stack([np.repeat(wall["x_m"], 2), up_and_down_m])])
        return ScriptedScene(
            names=names,
            shape=np.array([Shape[a["shape"].upper()] for a in actors], np.uint8),
            boxes=Boxes(xyz_m, lwh_m, np.radians([a["heading_deg"] for a in actors])),
            equipped=equipped,
            attack=np.array([a.get("attack", 0) for a in actors], np.uint8),
            detector=ScriptedDetector(*(np.array(column) for column in zip(*scores, strict=True))),
            city=Scene.from_footprints(rings, [0.0] * len(walls), [w["top_m"] for w in walls]),
        )

    def parts(self, config: Config) -> Parts:
        """The components that a config names, with the scene's own detector."""
        perception = replace(perception_of(config, self.city), detector=self.detector)
        return replace(Parts.of(config, self.city), perception=perception)

    def play(self, config: Config, n_frames: int) -> Iterator[Sensed]:
        """Simulate the same frame repeatedly and yield the results. Sweeps are valid until the next frame."""
        parts = self.parts(config)
        state = State.start(parts)
        for number in range(n_frames):
            state, result = step(self.world(number), state, parts)
            assert result.sensed is not None
            yield result.sensed

    def world(self, number: int) -> World:
        """All actors in the step of this number."""
        n = len(self.names)
        return World(
            step=number,
            actor=np.arange(n, dtype=np.int32),
            name_key=np.array([rng.name_key("vehicle/" + name) for name in self.names], np.uint64),
            shape=self.shape,
            boxes=self.boxes,
            speed_mps=np.zeros(n),
            equipped=self.equipped,
            attack=self.attack,
        )


def scenario_1(*, thing: str, checked: Sequence[bool], method: Method) -> list[float]:
    """The ego's final score of something that others report to it; 0 if it is not among the fused objects.

    Parameters
    ----------
    thing
        A class, or `false car`.
    checked
        Whether the plausibility check is on, for each value.
    method
        Rule of fusion.
    """
    scene, config, found = ScriptedScene.load(), load(FOLDER / "scenario-1.toml"), []
    for check in checked:
        trust = replace(config.trust, method=method, plausibility_in_evaluation=check, plausibility_in_fusion=check)
        (sensed,) = scene.play(replace(config, trust=trust), 1)
        found.append(_fused_scores(sensed).get(thing, 0.0))
    return found


def _fused_scores(sensed: Sensed) -> dict[str, float]:
    """The ego's final scores for objects that it did not detect itself."""
    fused, listed = sensed.fused()[0], sensed.listed.objects
    assert fused is not None
    foreign = fused.take((fused.ego == EGO) & ~fused.ego_detected)
    found = {}
    for seed, score in zip(foreign.seed, foreign.score, strict=True):
        is_false = listed.origin[seed] == FABRICATED
        thing = "false car" if is_false else LABELS[listed.label[seed]]
        found[thing] = float(score)
    return found


def scenario_2(*, ghosts: str, at: Sequence[tuple[str, int]]) -> list[float]:
    """Trust in a vehicle after some frames.

    Parameters
    ----------
    ghosts
        What the attacker inserts, as in `attacks.0.ghosts`.
    at
        Name of the vehicle, and number of the frame from 1 on.
    """
    scene = ScriptedScene.load()
    config = load(FOLDER / "scenario-2.toml", [f"attacks.0.ghosts={ghosts}"])
    # the server computes trust at the start of a frame, from the frames before it
    trust = []
    for sensed in scene.play(config, max(frame for _, frame in at) + 1):
        published = sensed.published[0]
        if published and len(published.subject):
            trust.append(published.trust)
    found = []
    for name, frame in at:
        row = scene.names.index(name)
        found.append(float(trust[frame - 1][row]))
    return found
