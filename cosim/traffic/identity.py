"""Who the actors of a trace are: their types, and when a name that comes back is another actor."""

from collections.abc import Sequence
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.traffic.source import SHAPE_OF_CLASS
from sensors.scene import Shape
from sumo_nets import vtypes
from sumo_nets.vtypes import VehicleType

UNKNOWN, LEFT_OUT = -2, -1
Key = tuple[str, bool]
"""Name of an actor, and whether it is a person: a vehicle and a person may have one name."""
_FASTEST_MPS = 70.0
"""No vehicle in traffic is faster."""
_TELEPORT_M = 1000.0
"""Farthest that SUMO puts a vehicle ahead when its street is jammed; it stays the same vehicle."""


class TypeTable:
    """Vehicle types by name: those of files, and guesses for others.

    The next file is read only if a type is not known yet.
    """

    def __init__(self, files: Sequence[Path] = ()) -> None:
        self._left = list(files)
        self._defined: dict[str, VehicleType] = {}
        self._known: dict[tuple[str, bool, str], VehicleType] = {}
        self._shape: dict[tuple[str, bool, str], int] = {}
        self.guessed: dict[str, str] = {}
        """Types that no file defines and whose name is not that of a class, and the class that was guessed."""

    def __call__(self, name: str, is_person: bool = False, vclass: str = "") -> VehicleType:
        """The class and size of a type.

        Parameters
        ----------
        is_person
            Whether the actor is a person, which is on foot unless its type is known to be something else.
        vclass
            SUMO's class, if the trace states it.
        """
        key = name, is_person, vclass
        if key not in self._known:
            self._known[key] = self._found(*key)
        return self._known[key]

    def shapes(
        self,
        names: list[str],
        is_person: Bool[ndarray, "n"],
        vclasses: list[str] | None,
    ) -> Int[ndarray, "n"]:
        """Shape code of each actor, or `LEFT_OUT` if it is not on the road."""
        keys = list(zip(names, is_person.tolist(), vclasses or repeat(""), strict=False))
        for key in set(keys) - self._shape.keys():
            shape = SHAPE_OF_CLASS.get(self(*key).vclass)
            self._shape[key] = LEFT_OUT if shape is None else int(shape)
        return np.fromiter(map(self._shape.__getitem__, keys), np.int16, len(keys))

    def _found(self, name: str, is_person: bool, vclass: str) -> VehicleType:
        defined = self._of_files(name)
        if vclass in vtypes.SIZES_M:
            if defined is not None and defined.vclass == vclass:
                return defined
            return VehicleType(vclass, vtypes.SIZES_M[vclass])
        guess = vtypes.guess(name)
        if is_person:  # on foot, even if its type is that of a vehicle
            if defined is not None and SHAPE_OF_CLASS.get(defined.vclass) in (None, Shape.PEDESTRIAN):
                return defined
            if guess.vclass not in ("container", "wheelchair"):
                return VehicleType("pedestrian", vtypes.SIZES_M["pedestrian"])
        elif defined is not None:
            return defined
        if name and not vtypes.is_plain(name):
            self.guessed[name] = guess.vclass
        return guess

    def _of_files(self, name: str) -> VehicleType | None:
        """The type of this name, or the one that SUMO copied for one vehicle, as TYPE@VEHICLE."""
        parts = name.split("@")
        for n in range(len(parts), 0, -1):
            origin = "@".join(parts[:n])
            while origin not in self._defined and self._left:
                self._defined.update(vtypes.read([self._left.pop(0)]))
            if origin in self._defined:
                return self._defined[origin]
        return None


class Identities:
    """Actor numbers by name.

    A name is one actor until it comes back as another type after an absence, or farther away than it can have driven.
    From then on it is another actor, called `name/2`.
    """

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        self._number: dict[Key, int] = {}
        self._used: set[Key] = set()
        self._type: list[str] = []
        self._turn = 0
        self._last_turn = np.zeros(0, np.int64)
        self._last_step = np.zeros(0, np.int64)
        self._last_m = np.zeros((0, 2))
        self._again: list[str] = []

    def numbers(
        self,
        keys: list[Key],
        types: list[str],
        xy_m: Float[ndarray, "n 2"],
        step: int,
    ) -> Int[ndarray, "n"]:
        """The number of each actor, or `UNKNOWN` for a new one, which `add` then numbers.

        It is asked whenever the actors on the road can have changed. One that is missing in between was absent.

        Parameters
        ----------
        types
            Names of types; what follows `@` does not count.
        """
        known = map(self._number.get, keys, repeat(UNKNOWN))
        number = np.fromiter(known, np.int32, len(keys))
        seen = np.flatnonzero(number != UNKNOWN)
        who = number[seen]
        steps_gone = step - self._last_step[who]
        way_m = np.hypot(*(xy_m[seen] - self._last_m[who]).T)
        is_other = way_m > _FASTEST_MPS * steps_gone * self._step_s + _TELEPORT_M
        self._turn += 1
        was_absent = self._turn - self._last_turn[who] > 1
        for i in np.flatnonzero(was_absent & ~is_other).tolist():  # few come back
            type_now, _, _ = types[seen[i]].partition("@")
            is_other[i] = self._type[who[i]] != type_now
        self._last_turn[who] = self._turn
        self._last_step[who] = step
        self._last_m[who] = xy_m[seen]
        number[seen[is_other]] = UNKNOWN
        return number

    def names(self, keys: list[Key]) -> list[str]:
        """Names under which new actors are registered."""
        shown = []
        for name, is_person in keys:
            new, n = name, 1
            while (new, is_person) in self._used:
                n += 1
                new = f"{name}/{n}"
            self._used.add((new, is_person))
            if n > 1:
                self._again.append(new)
            shown.append(new)
        return shown

    def add(
        self,
        keys: list[Key],
        types: list[str],
        xy_m: Float[ndarray, "k 2"],
        number: Int[ndarray, "k"],
        step: int,
    ) -> None:
        """Note the numbers of new actors, which are larger than those before. Objects have numbers in between."""
        self._number.update(zip(keys, number.tolist(), strict=True))
        n = int(number.max(initial=-1)) + 1
        if n > len(self._last_step):
            room = np.zeros(n, np.int64)
            self._last_turn = np.concatenate([self._last_turn, room])
            self._last_step = np.concatenate([self._last_step, room])
            self._last_m = np.concatenate([self._last_m, np.zeros((n, 2))])
        self._type += [""] * (n - len(self._type))
        for row, of in zip(number.tolist(), types, strict=True):
            self._type[row] = of.partition("@")[0]
        self._last_turn[number] = self._turn
        self._last_step[number] = step
        self._last_m[number] = xy_m

    def report(self) -> dict[str, Any]:
        """How many names came back as another actor, and the first of these actors."""
        return {"names_again": {"n": len(self._again), "first": self._again[0]}} if self._again else {}
