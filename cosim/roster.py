"""Everyone who was ever on the road: who they are, and what part they play."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.rng import Stream, key, name_key, uniforms
from cosim.world import MALICIOUS, UNRELIABLE
from sensors.scene import Shape

Probability = Annotated[float, Ge(0), Le(1)]
Kind = Literal["car", "van", "truck", "bus", "motorcycle", "bicycle"]
_COLUMNS = ("_name_key", "_shape", "_lwh_m", "_equipped", "_behaviour", "_first_step", "_last_step")


@dataclass(frozen=True, kw_only=True, slots=True)
class FleetParams:
    """Which vehicles sense and talk, and how many of them lie.

    Each share is decided vehicle by vehicle from its name: raising a share adds vehicles and changes none.
    """

    penetration_p: Probability = 0.35
    """Share of the vehicles of `equipped_kinds` that carry a LiDAR and a radio."""
    equipped_kinds: tuple[Kind, ...] = ("car", "van")
    """Kinds of vehicle that can be equipped."""
    malicious_p: Probability = 0.10
    """Share of the equipped that insert objects in front of a victim."""
    unreliable_p: Probability = 0.10
    """Share of the equipped that lose own detections and add random ones."""

    def __post_init__(self) -> None:
        if self.malicious_p + self.unreliable_p > 1:
            raise ValueError(
                f"fleet.malicious_p + fleet.unreliable_p = {self.malicious_p + self.unreliable_p:g} is more "
                "than everybody. Lower one of them so that the two sum to at most 1."
            )


@dataclass(slots=True)
class Roster:
    """Actors by number, in order of first appearance; columns grow as actors appear."""

    params: FleetParams
    seed: int
    names: list[str] = field(default_factory=list)
    _n: int = 0
    _name_key: UInt64[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.uint64))
    _shape: UInt8[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.uint8))
    _lwh_m: Float[ndarray, "capacity 3"] = field(default_factory=lambda: np.zeros((1024, 3)))
    _equipped: Bool[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, bool))
    _behaviour: UInt8[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.uint8))
    _first_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.int32))
    _last_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.int32))
    _can_be_equipped: Bool[ndarray, "shape"] = field(init=False)
    _chosen: np.uint64 = field(init=False)
    _part: np.uint64 = field(init=False)

    def __post_init__(self) -> None:
        kinds = {kind.upper() for kind in self.params.equipped_kinds}
        self._can_be_equipped = np.array([shape.name in kinds for shape in Shape])
        self._chosen, self._part = key(self.seed, Stream.EQUIPPED), key(self.seed, Stream.BEHAVIOUR)

    def __len__(self) -> int:
        return self._n

    def enrol(
        self, names: list[str], shape: UInt8[ndarray, "n"], lwh_m: Float[ndarray, "n 3"], step: int
    ) -> Int[ndarray, "n"]:
        """Numbers for newcomers, in the order given, and the part that each of them plays.

        Numbers follow names, vehicles first, whatever order the newcomers come in. A person and a vehicle of
        one name are two. Sizes are kept in single precision, as tables keep them.
        """
        first, n = self._n, len(names)
        on_foot = shape == Shape.PEDESTRIAN
        order = sorted(range(n), key=lambda i: (on_foot[i], names[i]))
        names, shape, lwh_m, on_foot = [names[i] for i in order], shape[order], lwh_m[order], on_foot[order]
        while first + n > len(self._shape):
            for column in _COLUMNS:
                old = getattr(self, column)
                setattr(self, column, np.concatenate([old, np.zeros_like(old)]))
        rows = slice(first, first + n)
        who = np.array(
            [name_key(("person/" if walks else "vehicle/") + name) for name, walks in zip(names, on_foot, strict=True)],
            np.uint64,
        )
        equipped = self._can_be_equipped[shape] & (uniforms(self._chosen, who)[:, 0] < self.params.penetration_p)
        self._equipped[rows] = equipped
        if equipped.any():  # who is not, is honest: 0, as all rows are made
            part, behaviour = uniforms(self._part, who)[:, 0], self._behaviour[rows]
            behaviour[equipped & (part < self.params.malicious_p + self.params.unreliable_p)] = UNRELIABLE
            behaviour[equipped & (part < self.params.malicious_p)] = MALICIOUS

        self.names.extend(names)
        self._name_key[rows], self._shape[rows], self._lwh_m[rows] = who, shape, lwh_m.astype(np.float32)
        self._first_step[rows] = self._last_step[rows] = step
        self._n += n
        numbers = np.empty(n, np.int32)
        numbers[order] = np.arange(first, self._n, dtype=np.int32)
        return numbers

    def seen(self, actor: Int[ndarray, "n"], step: int) -> None:
        """Note that these actors are on the road in this step."""
        self._last_step[actor] = step

    name_key = property(lambda self: self._name_key[: self._n])
    shape = property(lambda self: self._shape[: self._n])
    lwh_m = property(lambda self: self._lwh_m[: self._n])
    equipped = property(lambda self: self._equipped[: self._n])
    behaviour = property(lambda self: self._behaviour[: self._n])
    first_step = property(lambda self: self._first_step[: self._n])
    last_step = property(lambda self: self._last_step[: self._n])
