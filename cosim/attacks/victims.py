"""The victim of each attacker."""

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim.attacks.params import AttackParams
from cosim.base import rng
from cosim.world import World

Pairs = tuple[Int[ndarray, "b"], Int[ndarray, "b"]]


def victims(
    world: World, attackers: Int[ndarray, "a"], params: AttackParams, draw: Float[ndarray, "a"], seed: int
) -> Pairs:
    """Attackers that have a victim within range, in the given order, and the victim of each; both as rows of the world.

    Parameters
    ----------
    attackers
        Rows of the world.
    draw
        A uniform in [0, 1) for each attacker, used only with `victim = "random"`.
    seed
        Seed of the run, used only with `victim = "designated"`.
    """
    aims = _eligible(world, params, seed)
    if not len(aims) or not len(attackers):
        return np.zeros(0, int), np.zeros(0, int)
    xy = world.boxes.xyz_m[:, :2]
    if params.victim == "random":
        return _random(xy, attackers, aims, params.victim_range_m, draw)
    k = min(2, len(aims))
    tree = scipy.spatial.cKDTree(xy[aims])
    distance, near = tree.query(xy[attackers], k=k)
    nearest = aims[near].reshape(-1, k)
    distance = distance.reshape(-1, k)
    other = np.where(nearest[:, 0] == attackers, 1, 0)  # the attacker itself is at distance 0 and usually first
    there = other < k
    pick = np.arange(len(attackers)), np.minimum(other, k - 1)
    within = there & (distance[pick] <= params.victim_range_m)
    return attackers[within], nearest[pick][within]


def designated(seed: int, name_key: UInt64[ndarray, "n"], victim_p: float) -> Bool[ndarray, "n"]:
    """Which actors are drawn with `victim = "designated"`. Of these, the equipped ones that do not attack are victims.

    Parameters
    ----------
    seed
        Seed of the run.
    name_key
        Keys of the actors' names. With the seed they decide the draw, which is therefore the same in every step.
    victim_p
        Share that is drawn.
    """
    key = rng.key(seed, rng.Stream.VICTIM)
    return rng.uniforms(key, name_key)[:, 0] < victim_p


def _eligible(world: World, params: AttackParams, seed: int) -> Int[ndarray, "v"]:
    """Equipped vehicles that may be victims, as ascending rows of the world."""
    equipped = np.flatnonzero(world.equipped & ~world.is_roadside)
    if params.victim == "one":
        return equipped[world.name_key[equipped] == rng.name_key("vehicle/" + params.victim_id)]
    if params.victim == "designated":
        chosen = designated(seed, world.name_key[equipped], params.victim_p)
        return equipped[chosen & (world.attack[equipped] == 0)]
    if params.victim == "region":
        x, y, radius = params.region_m
        from_centre_m = world.boxes.xyz_m[equipped, :2] - [x, y]
        return equipped[np.hypot(*from_centre_m.T) <= radius]
    return equipped


def _random(
    xy: Float[ndarray, "n 2"],
    attackers: Int[ndarray, "a"],
    aims: Int[ndarray, "v"],
    range_m: float,
    draw: Float[ndarray, "a"],
) -> Pairs:
    """A random victim within range of each attacker. All are equally likely."""
    near = scipy.spatial.cKDTree(xy[attackers]).sparse_distance_matrix(
        scipy.spatial.cKDTree(xy[aims]), range_m, output_type="ndarray"
    )
    a, v = near["i"], near["j"]
    order = np.lexsort((v, a))
    a, v = a[order], aims[v[order]]
    others = v != attackers[a]
    a, v = a[others], v[others]
    first = np.searchsorted(a, np.arange(len(attackers)))
    counts = np.bincount(a, minlength=len(attackers))
    has = counts > 0
    n = counts[has]
    drawn = (draw[has] * n).astype(int)
    pick = first[has] + np.minimum(drawn, n - 1)
    return attackers[has], v[pick]
