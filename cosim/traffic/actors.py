"""Registry of all actors that have been on the road: names, sizes, equipment and attacks, by actor number."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.base.rng import Stream, key, name_key, uniforms
from cosim.traffic.fleet import FleetParams
from sensors.scene import Shape

_COLUMNS = ("_name_key", "_shape", "_lwh_m", "_equipped", "_attack", "_first_step", "_last_step", "_n_steps")


@dataclass(slots=True)
class ActorRegistry:
    """Actors by number, in order of first appearance; columns grow as actors appear."""

    params: FleetParams
    seed: int
    attack_shares: tuple[float, ...] = ()
    """For each attack of the config, the share of the equipped vehicles that carry it out."""
    attack_of: Mapping[str, int] = field(default_factory=dict)
    """Names of vehicles that the config names as attackers, and the position of their attack in the config."""
    names: list[str] = field(default_factory=list)
    _n: int = 0
    _name_key: UInt64[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.uint64))
    _shape: UInt8[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.uint8))
    _lwh_m: Float[ndarray, "capacity 3"] = field(default_factory=lambda: np.zeros((1024, 3)))
    _equipped: Bool[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, bool))
    _attack: UInt8[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.uint8))
    _first_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.int32))
    _last_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.int32))
    _n_steps: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(1024, np.int32))
    _can_be_equipped: Bool[ndarray, "shape"] = field(init=False)
    _equipped_key: np.uint64 = field(init=False)
    _attack_key: np.uint64 = field(init=False)

    def __post_init__(self) -> None:
        classes = {name.upper() for name in self.params.equipped_kinds}
        self._can_be_equipped = np.array([shape.name in classes for shape in Shape])
        self._equipped_key = key(self.seed, Stream.EQUIPPED)
        self._attack_key = key(self.seed, Stream.ROLE)

    def __len__(self) -> int:
        return self._n

    def register(
        self,
        names: list[str],
        shape: UInt8[ndarray, "n"],
        lwh_m: Float[ndarray, "n 3"],
        step: int,
        equipped: bool | None = None,
    ) -> Int[ndarray, "n"]:
        """Give numbers to new actors, and decide their equipment and attacks.

        Numbers are assigned in the order of names, vehicles before persons, whatever the order of the input. A person
        and a vehicle of the same name are two actors. Sizes are rounded to single precision, as in the tables.

        Parameters
        ----------
        names
            Names of the new actors.
        shape
            Codes of `sensors.scene.Shape`.
        lwh_m
            Length, width and height [m].
        equipped
            Whether these actors are equipped. If it is given, nothing is drawn, and none of them attacks.

        Returns
        -------
        The number of each actor, in the order of `names`.
        """
        first, n = self._n, len(names)
        is_person = shape == Shape.PEDESTRIAN
        order = sorted(range(n), key=lambda i: (is_person[i], names[i]))
        names = [names[i] for i in order]
        shape = shape[order]
        lwh_m = lwh_m[order]
        is_person = is_person[order]
        while first + n > len(self._shape):
            for column in _COLUMNS:
                old = getattr(self, column)
                setattr(self, column, np.concatenate([old, np.zeros_like(old)]))
        rows = slice(first, first + n)
        keys = np.array(
            [actor_key(name, person) for name, person in zip(names, is_person, strict=True)],
            np.uint64,
        )
        if equipped is not None:
            self._equipped[rows] = equipped
        else:
            drawn = uniforms(self._equipped_key, keys)[:, 0] < self.params.penetration_p
            self._equipped[rows] = self._can_be_equipped[shape] & drawn
            self._assign_attacks(names, keys, first)

        self.names.extend(names)
        self._name_key[rows] = keys
        self._shape[rows] = shape
        self._lwh_m[rows] = lwh_m.astype(np.float32)
        self._first_step[rows] = self._last_step[rows] = step
        self._n += n
        numbers = np.empty(n, np.int32)
        numbers[order] = np.arange(first, self._n, dtype=np.int32)
        return numbers

    def _assign_attacks(self, names: list[str], keys: UInt64[ndarray, "n"], first: int) -> None:
        """Decide which of these new actors attack. Their numbers begin at `first`."""
        rows = slice(first, first + len(names))
        equipped = self._equipped[rows]
        if equipped.any() and self.attack_shares:
            draw = uniforms(self._attack_key, keys)[:, 0]
            number = 1 + np.searchsorted(np.cumsum(self.attack_shares), draw, "right")
            attacks = equipped & (number <= len(self.attack_shares))
            self._attack[rows] = np.where(attacks, number, 0)
        for row in np.flatnonzero(equipped).tolist() if self.attack_of else ():
            if names[row] in self.attack_of:
                self._attack[first + row] = 1 + self.attack_of[names[row]]

    def mark_present(self, actor: Int[ndarray, "n"], step: int) -> None:
        """Record that these actors are on the road in this step."""
        self._last_step[actor] = step
        self._n_steps[actor] += 1

    name_key = property(lambda self: self._name_key[: self._n])
    shape = property(lambda self: self._shape[: self._n])
    lwh_m = property(lambda self: self._lwh_m[: self._n])
    equipped = property(lambda self: self._equipped[: self._n])
    attack = property(lambda self: self._attack[: self._n])
    first_step = property(lambda self: self._first_step[: self._n])
    last_step = property(lambda self: self._last_step[: self._n])
    n_steps = property(lambda self: self._n_steps[: self._n])


def actor_key(name: str, is_person: bool) -> int:
    """The key of an actor in random draws. A person and a vehicle of the same name have different keys."""
    return name_key(("person/" if is_person else "vehicle/") + name)
