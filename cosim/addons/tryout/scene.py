"""A tiny scene of eight seconds: sixteen actors at a crossing of two streets, with a building at each corner."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.base import rng
from cosim.world import LanePaths, World
from sensors.boxes import Boxes
from sensors.scene import Scene, Shape

STEP_S = 0.5
N_STEPS = 16
"""Number of steps. Vehicles sense in every second step."""
_HALF_M = 60.0
"""Length of each street from the crossing to its end [m]."""
_LANES = {
    "east": (0.0, -2.0),
    "west": (np.pi, 2.0),
    "north": (np.pi / 2, 2.0),
    "south": (-np.pi / 2, -2.0),
}
"""Heading of each lane, and its distance from the middle of the street (y, or x for north and south) [m]."""
_LWH_M = {
    Shape.CAR: (4.5, 1.8, 1.5),
    Shape.TRUCK: (8.0, 2.5, 3.2),
    Shape.PEDESTRIAN: (0.5, 0.6, 1.75),
}
FAR_AWAY_M = 9_000.0
"""Distance of a vehicle that no other vehicle can perceive or receive."""


@dataclass(frozen=True, slots=True)
class Actor:
    """An actor that drives or walks along a lane at a constant speed."""

    name: str
    lane: str
    begin_m: float
    """Position along the lane at the first step, measured from the crossing."""
    speed_mps: float
    shape: Shape = Shape.CAR
    equipped: bool = True
    attack: int = 0
    """As `World.attack`."""
    side_m: float = 0.0
    """Offset to the right of the lane's centre."""

    def xy_m(self, time_s: float) -> Float[ndarray, "2"]:
        """Position at a time since the first step."""
        yaw, across = _LANES[self.lane]
        along = self.begin_m + self.speed_mps * time_s
        c, s = np.cos(yaw), np.sin(yaw)
        ahead = np.array([c, s])
        right = np.array([s, -c])
        centre = np.array([0.0, across] if abs(c) > 0.5 else [across, 0.0])
        return centre + along * ahead + self.side_m * right


ACTORS = (
    Actor("A", "east", -45.0, 8.0),
    Actor("B", "east", -30.0, 8.0, attack=1),
    Actor("C", "east", -12.0, 8.0),
    Actor("D", "west", -45.0, 7.0),
    Actor("E", "west", -25.0, 7.0),
    Actor("F", "west", -9.0, 7.0, attack=1),
    Actor("G", "north", -17.0, 0.0),
    Actor("H", "north", -10.0, 0.0),
    Actor("I", "south", -18.0, 0.0),
    Actor("J", "south", -10.0, 0.0, attack=1),
    Actor("truck", "south", -28.0, 0.0, Shape.TRUCK, False, side_m=2.6),
    Actor("parked", "east", 15.0, 0.0, equipped=False, side_m=2.4),
    Actor("bus", "north", 20.0, 3.0, Shape.TRUCK, False),
    Actor("moped", "west", 6.0, 7.0, equipped=False),
    Actor("walker", "east", -6.0, 1.2, Shape.PEDESTRIAN, False, side_m=4.0),
    Actor("child", "north", 6.0, 1.0, Shape.PEDESTRIAN, False, side_m=4.0),
)
"""Ten equipped vehicles, three of which attack, and six other actors."""
STRANGER = Actor("stranger", "east", FAR_AWAY_M, 5.0)


@dataclass(frozen=True, slots=True)
class TinyScene:
    """The actors of the scene."""

    actors: tuple[Actor, ...] = ACTORS
    """In the order of their actor numbers."""

    def renumbered(self) -> "TinyScene":
        """The scene with other actor numbers, and therefore in another order of rows."""
        order = np.random.default_rng(7).permutation(len(self.actors))
        return TinyScene(tuple(self.actors[i] for i in order))

    def with_stranger(self) -> "TinyScene":
        """The scene with one more equipped vehicle, which is far away and has the lowest actor number."""
        return TinyScene((STRANGER, *self.actors))

    def with_other_attackers(self) -> "TinyScene":
        """The scene with other vehicles as attackers."""
        swapped = []
        for actor in self.actors:
            attacks = actor.equipped and not actor.attack
            swapped.append(replace(actor, attack=int(attacks)))
        return TinyScene(tuple(swapped))

    @property
    def names(self) -> list[str]:
        """Names by actor number."""
        return [actor.name for actor in self.actors]

    @property
    def city(self) -> Scene:
        """A building at each corner of the crossing."""
        square = np.array([[8.0, 8.0], [_HALF_M, 8.0], [_HALF_M, _HALF_M], [8.0, _HALF_M]])
        corners = ((-1, -1), (-1, 1), (1, -1), (1, 1))
        rings = [[square * corner] for corner in corners]
        return Scene.from_footprints(rings, [0.0] * 4, [12.0] * 4)

    def world(self, step: int) -> World:
        """All actors in one step."""
        actors, time_s = self.actors, step * STEP_S
        lwh_m = np.array([_LWH_M[a.shape] for a in actors]).reshape(-1, 3)
        xy_m = np.array([a.xy_m(time_s) for a in actors]).reshape(-1, 2)
        yaw_rad = np.array([_LANES[a.lane][0] for a in actors])
        return World(
            step=step,
            actor=np.arange(len(actors), dtype=np.int32),
            name_key=np.array([rng.name_key(f"vehicle/{a.name}") for a in actors], np.uint64),
            shape=np.array([a.shape for a in actors], np.uint8),
            boxes=Boxes(np.column_stack([xy_m, lwh_m[:, 2] / 2]), lwh_m, yaw_rad),
            speed_mps=np.array([a.speed_mps for a in actors]),
            equipped=np.array([a.equipped for a in actors], bool),
            attack=np.array([a.attack for a in actors], np.uint8),
            paths=self._paths(xy_m),
        )

    def _paths(self, xy_m: Float[ndarray, "n 2"]) -> LanePaths:
        """The lane paths of equipped vehicles: their own lanes, straight ahead."""
        rows = [row for row, actor in enumerate(self.actors) if actor.equipped]
        lines, front_m = [], []
        for row in rows:
            actor = self.actors[row]
            yaw = _LANES[actor.lane][0]
            heading = [np.cos(yaw), np.sin(yaw)]
            lines.append(xy_m[row] + np.outer([-20.0, 80.0, 180.0], heading))
            front_m.append(20.0 + _LWH_M[actor.shape][0] / 2)
        n = len(rows)
        return LanePaths(
            row=np.array(rows, np.int64),
            line=np.arange(n),
            front_m=np.array(front_m),
            ptr=3 * np.arange(n + 1),
            xy_m=np.concatenate([*lines, np.zeros((0, 2))]),
            along_m=np.tile([0.0, 100.0, 200.0], n),
        )
