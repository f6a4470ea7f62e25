"""Encounters by all definitions in the config, from pairs near each other and their lines of sight."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim.base.rows import no_rows
from cosim.traffic.actors import actor_key
from cosim.world import World
from results.encounters import EncounterParams, EncounterTracker, Rows
from sensors.line_of_sight import WallIndex, los_between_actors
from sensors.scene import Scene, Shape


@dataclass(frozen=True, slots=True)
class NearPairs:
    """P pairs of actors of one step, each once, sorted; `a` and `b` are actor numbers, a < b."""

    a: Int[ndarray, "p"]
    b: Int[ndarray, "p"]
    distance_m: Float[ndarray, "p"]
    los: Mapping[str, Bool[ndarray, "p"]]
    """Whether there is line of sight, by the kind of blockers that `EncounterParams.los` names."""
    equipped: Bool[ndarray, "p"]
    """Whether both are equipped."""
    on_foot: Bool[ndarray, "p"]
    """Whether one of them is a pedestrian."""
    present: Int[ndarray, "v"]
    """Actor numbers of all actors that were searched."""


@dataclass(frozen=True, slots=True)
class PairSearch:
    """Finds the pairs of actors in a step that can have encounters by a config's definitions."""

    walls: WallIndex
    radius_m: float
    """Largest distance between the centres of two boxes."""
    equipped_only: bool
    blockers: tuple[str, ...]
    """Kinds of blockers for which lines of sight are computed, as `EncounterParams.los`."""
    pedestrians: bool
    mount_above_roof_m: float
    city: Scene | None = None
    """The scene whose trees block lines of sight."""
    parked_key: UInt64[ndarray, "p"] = no_rows(np.uint64)
    """Keys of the names of parked cars, which have no encounters."""

    @staticmethod
    def of(
        params: Sequence[EncounterParams], walls: WallIndex, mount_above_roof_m: float, city: Scene | None = None
    ) -> "PairSearch":
        """The search that all these definitions need."""
        return PairSearch(
            walls,
            max((p.radius_m for p in params), default=0.0),
            all(p.pairs in ("equipped", "los") for p in params),
            tuple(sorted({p.los for p in params})),
            any(p.pedestrians for p in params),
            mount_above_roof_m,
            city,
        )

    def without(self, parked: Collection[str]) -> "PairSearch":
        """The search among all but the parked cars of these names."""
        keys = [actor_key(name, is_person=False) for name in parked]
        return replace(self, parked_key=np.array(keys, np.uint64))

    def __call__(self, world: World) -> NearPairs:
        """Pairs of actors within the radius; pedestrians only if a definition includes them."""
        searched = np.full(len(world), self.pedestrians) | (world.shape != Shape.PEDESTRIAN)
        searched &= ~world.is_roadside
        if self.equipped_only:
            searched &= world.equipped
        elif len(self.parked_key):
            searched &= ~np.isin(world.name_key, self.parked_key)
        rows = np.flatnonzero(searched)
        xy = world.boxes.xyz_m[rows, :2]
        pairs = (
            scipy.spatial.cKDTree(xy).query_pairs(self.radius_m, output_type="ndarray")
            if len(rows)
            else np.zeros((0, 2), int)
        )
        pair = np.sort((pairs[:, 0] << 32) | pairs[:, 1])
        a, b = rows[pair >> 32], rows[pair & 0xFFFFFFFF]
        apart_m = world.boxes.xyz_m[a] - world.boxes.xyz_m[b]
        east_m, north_m, _ = apart_m.T
        is_on_foot = world.shape == Shape.PEDESTRIAN
        return NearPairs(
            a=world.actor[a],
            b=world.actor[b],
            distance_m=np.sqrt(east_m * east_m + north_m * north_m),
            los={
                what: los_between_actors(
                    self.walls,
                    world.boxes,
                    world.shape,
                    a,
                    b,
                    self.mount_above_roof_m,
                    bodies=what == "buildings_and_vehicles",
                    city=self.city,
                )
                for what in self.blockers
            },
            equipped=world.equipped[a] & world.equipped[b],
            on_foot=is_on_foot[a] | is_on_foot[b],
            present=world.actor[rows],
        )


Encounters = tuple[EncounterTracker, ...]
"""One tracker per definition in the config. They are updated in every step, with or without sensing."""


def update_encounters(
    trackers: Encounters, step: int, near: NearPairs
) -> tuple[list[Rows], Int[ndarray, "k"], Int[ndarray, "k"]]:
    """Add one step to the trackers.

    Parameters
    ----------
    trackers
        One tracker per definition. They are changed.
    step
        Number of the step.
    near
        What `PairSearch` finds for these definitions.

    Returns
    -------
    Rows of the table `encounters` for encounters that have ended, per definition; and holders and others of the
    equipped pairs whose encounter begins, in both directions. The caller then calls `first_contact` for these.
    """
    closed, begins = [], np.zeros(len(near.a), bool)
    for tracker in trackers:
        kept = np.flatnonzero(~near.on_foot | tracker.params.pedestrians)
        rows, opened = tracker.update(
            step,
            near.a[kept],
            near.b[kept],
            near.distance_m[kept],
            near.los[tracker.params.los][kept],
            near.present,
            near.equipped[kept],
        )
        closed.append(rows)
        begins[kept[opened]] = True
    begins &= near.equipped
    a, b = near.a[begins], near.b[begins]
    return closed, np.concatenate([a, b]), np.concatenate([b, a])
