"""Where roadside units keep trust young: a greedy choice of junctions from traffic alone, without sensing.

A unit at a junction sees a vehicle within the range in which it evaluates, if no building cuts the line. In the
element (vehicle, step), the age of the newest sight by the units S is a, at most the cap A. The objective is the sum of
w (A - a) over all elements. The weight w is the number of others within radio range that do not see the vehicle: they
look up trust in it, and have no evaluation of their own. For each element this is a maximum over S, so the objective is
monotone and submodular (a facility location), and the greedy choice reaches at least 1 - 1/e of the best [1]_.

References
----------
.. [1] Nemhauser, Wolsey, Fisher, "An analysis of approximations for maximizing submodular set functions I",
   Mathematical Programming 14, 1978.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int, UInt16
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.base.ragged import ptr_of
from cosim.config.config import Config
from cosim.runs import run as running
from cosim.runs.check import check
from cosim.runs.drive import Advance, warm_up
from cosim.traffic.source import TrafficEnded
from cosim.world import World
from sensors.line_of_sight import WallIndex
from sensors.scene import Shape
from sumo_nets.network import Junction, junctions


@dataclass(frozen=True, slots=True)
class SiteCoverage:
    """What units at C candidate sites would see of N elements (vehicle, step)."""

    ptr: Int[ndarray, "c+1"]
    """Rows of candidate c are ptr[c]:ptr[c + 1] of the next two."""
    element: Int[ndarray, "k"]
    """Each element once per candidate."""
    young: UInt16[ndarray, "k"]
    """Cap less the age of the candidate's newest sight of the vehicle [sensing steps]; above 0."""
    weight: Float[ndarray, "n"]
    cap: int
    """Largest age that counts [sensing steps]."""

    def gain(self, c: int, best: UInt16[ndarray, "n"]) -> float:
        """By how much candidate c raises the objective, if `best` is what the units so far reach."""
        rows = slice(self.ptr[c], self.ptr[c + 1])
        element, young = self.element[rows], self.young[rows]
        reached = best[element]
        more = young > reached
        younger = young[more] - reached[more]
        return float((younger * self.weight[element[more]]).sum())

    def reached(self, chosen: Sequence[int]) -> UInt16[ndarray, "n"]:
        """Cap less the age of each element's newest sight by these candidates."""
        best = np.zeros(len(self.weight), np.uint16)
        for c in chosen:
            rows = slice(self.ptr[c], self.ptr[c + 1])
            np.maximum.at(best, self.element[rows], self.young[rows])
        return best

    def value(self, chosen: Sequence[int]) -> float:
        """The objective."""
        return float((self.reached(chosen) * self.weight).sum())

    def ages(self, chosen: Sequence[int], shares: Sequence[float]) -> list[float]:
        """Weighted quantiles of the capped age of the newest sight [sensing steps]."""
        age = self.cap - self.reached(chosen).astype(int)
        total = np.cumsum(np.bincount(age, self.weight, self.cap + 1))
        return [float(np.searchsorted(total, share * total[-1])) for share in shares]


def greedy(coverage: SiteCoverage, count: int) -> list[int]:
    """The greedy choice: each candidate raises the objective by most; of equal ones, the first.

    Gains only fall as units are added, so a candidate is counted again only when it is next in line (Minoux 1978).
    """
    best = np.zeros(len(coverage.weight), np.uint16)
    line: list[tuple[float, int, int]] = []
    for c in range(len(coverage.ptr) - 1):
        heapq.heappush(line, (-coverage.gain(c, best), c, 0))
    chosen: list[int] = []
    while line and len(chosen) < count:
        _, c, at = heapq.heappop(line)
        if at == len(chosen):
            chosen.append(c)
            best = coverage.reached(chosen)
        else:
            heapq.heappush(line, (-coverage.gain(c, best), c, len(chosen)))
    return chosen


@dataclass(slots=True)
class _Sights:
    """Sights of vehicles from candidate sites, step by step."""

    site_m: Float[ndarray, "c 3"]
    walls: WallIndex
    range_m: float
    """A unit or a vehicle sees vehicles up to here."""
    radio_m: float
    """Vehicles up to here receive a vehicle's messages, and look up trust in it."""
    cap: int
    last: Int[ndarray, "c v"] = field(init=False)
    """Step in which each site last saw each vehicle, by actor number."""
    rows: list[tuple[ndarray, ndarray, ndarray]] = field(default_factory=list)
    weight: list[ndarray] = field(default_factory=list)
    n: int = 0

    def __post_init__(self) -> None:
        shape = len(self.site_m), 1024
        self.last = np.full(shape, -self.cap - 1, np.int32)

    def add(self, step: int, actor: Int[ndarray, "v"], roof_m: Float[ndarray, "v 3"]) -> None:
        """Add the vehicles of one sensing step, each with the middle of its roof."""
        while actor.max(initial=-1) >= self.last.shape[1]:
            unseen = np.full_like(self.last, -self.cap - 1)
            self.last = np.concatenate([self.last, unseen], axis=1)
        tree = cKDTree(roof_m[:, :2])
        near = cKDTree(self.site_m[:, :2]).sparse_distance_matrix(tree, self.range_m, output_type="ndarray")
        site, vehicle = near["i"], near["j"]
        order = np.lexsort((vehicle, site))
        site, vehicle = site[order], vehicle[order]
        points, n_sites = np.concatenate([self.site_m, roof_m]), len(self.site_m)
        clear = self.walls.has_los(points, site, n_sites + vehicle)
        self.last[site[clear], actor[vehicle[clear]]] = step
        age = step - self.last[:, actor]
        c, v = np.nonzero(age < self.cap)
        young = self.cap - age[c, v]
        site_of_row = c.astype(np.int32)
        self.rows.append((site_of_row, self.n + v, young.astype(np.uint16)))
        self.weight.append(self._unseen_by(tree, roof_m))
        self.n += len(actor)

    def _unseen_by(self, tree: cKDTree, roof_m: Float[ndarray, "v 3"]) -> Float[ndarray, "v"]:
        """For each vehicle, how many others within radio range do not see it."""
        within = tree.query_ball_point(roof_m[:, :2], self.radio_m, return_length=True) - 1.0
        a, b = tree.query_pairs(min(self.range_m, self.radio_m), output_type="ndarray").T
        clear = self.walls.has_los(roof_m, a, b)
        seeing = np.concatenate([a[clear], b[clear]])
        return within - np.bincount(seeing, minlength=len(roof_m))

    def coverage(self) -> SiteCoverage:
        """All of it, by site."""
        c, element, young = map(np.concatenate, zip(*self.rows, strict=True))
        order = np.argsort(c, kind="stable")
        ptr = ptr_of(c[order], len(self.site_m))
        weight = np.concatenate(self.weight)
        return SiteCoverage(ptr, element[order], young[order], weight, self.cap)


def observe(config: Config, height_m: float, advance: Advance) -> tuple[list[Junction], SiteCoverage]:
    """The junctions of a config's network, and what units there would see of its traffic.

    Parameters
    ----------
    config
        The experiment. All vehicles that can be equipped count, whatever the penetration. The largest age that counts
        is its `trust.freshness_s`, or the whole run if evidence does not expire; lookups are made within
        `radio.range_m`.
    height_m
        Height of the sensors above the street.
    advance
        Called with progress.

    Raises
    ------
    ValueError
        In one line, if there is no network or no traffic.
    """
    config = replace(config, roadside=())
    scenario = check(config)
    if scenario.net is None:
        raise ValueError("cosim place needs the junctions of a network: name a city or a network in traffic.scenario.")
    found, every = list(junctions(scenario.net).junctions), config.sense_every_steps
    junctions_m = np.array([junction.xyz_m for junction in found]).reshape(-1, 3)
    site_m = junctions_m - [*scenario.origin_m, -height_m]
    steps = -(-config.n_steps // every)
    window_s = config.trust.freshness_s
    cap = steps
    if window_s != "off":
        cap = min(steps, max(1, round(window_s / config.sensing_interval_s)))
    kinds = {name.upper() for name in config.fleet.equipped_kinds}
    can = np.array([shape.name in kinds for shape in Shape])
    parts, _, traffic = running.load_parts(config, scenario)
    sights = _Sights(
        site_m,
        WallIndex.of(parts.city.buildings),
        min(config.area.range_m, config.lidar.max_range_m),
        config.radio.range_m,
        min(cap, 65_000),
    )
    try:
        warm_up(scenario.warmup_of(config.traffic), traffic, parts.watch, advance)
        for number in range(config.n_steps):
            try:
                world = traffic.advance()
            except TrafficEnded:
                break
            if number % every == 0:
                rows = np.flatnonzero(can[world.shape])
                sights.add(number // every, world.actor[rows], _roofs(world, rows))
            advance("place", number + 1, config.n_steps, f"steps, {len(world)} actors")
    finally:
        traffic.close()
    if not sights.n:
        raise ValueError(
            f"traffic.scenario = {config.traffic.scenario}: no vehicle that can be equipped was on the road."
        )
    return found, sights.coverage()


def _roofs(world: World, rows: Int[ndarray, "v"]) -> Float[ndarray, "v 3"]:
    """Middle of the roof of each actor."""
    xyz_m = world.boxes.xyz_m[rows].copy()
    xyz_m[:, 2] += world.boxes.lwh_m[rows, 2] / 2
    return xyz_m
