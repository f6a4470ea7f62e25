"""The components of a step: perception, adversary, medium, trust, pseudonyms, driver. They are built once per run."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.attacks.adversary import Adversary
from cosim.base.codes import BASE_VARIANT
from cosim.config import config
from cosim.config.config import Config
from cosim.door.guard import Guarded, construct, make
from cosim.door.kinds import SECTIONS
from cosim.door.load import Choice, Source
from cosim.messages.linkage import Linkage, Revocation
from cosim.messages.pseudonyms import Pseudonyms
from cosim.messages.trust_hosts import TrustHosts, Variant
from cosim.radio.medium import Medium
from cosim.radio.params import RadioParams
from cosim.radio.rsu import NO_RSUS, RsuAntennas
from cosim.step.accuracy import DetectorAccuracy
from cosim.step.early_fusion import EarlyFusion
from cosim.step.mixed_perception import MixedPerception
from cosim.step.perception import Perceives, Perception
from cosim.step.stopwatch import Stopwatch
from cosim.step.trackers.encounters import PairSearch
from cosim.traffic.driver import Driver
from cosim.traffic.limits import NO_LIMITS, SpeedLimits
from cosim.traffic.roadside import NO_UNITS, RoadsideUnits
from cosim.traffic.schedule import Schedule
from cosim.world import World
from sensors.coverage import Coverage
from sensors.evidence import AreaParams
from sensors.lidar import LidarParams
from sensors.line_of_sight import LosOfPlaces, WallIndex
from sensors.scene import Scene
from sensors.weather import road_range_m
from trust.params import TrustParams

Recall = Callable[[ndarray, ndarray, ndarray], ndarray]
"""Recall of a detector, from number of returns, class and distance."""


@dataclass(frozen=True, slots=True)
class Parts:
    """The components of a step. The config chooses detector, attacks, medium, trust model, policy and driver."""

    config: Config
    schedule: Schedule
    city: Scene
    near_pairs: PairSearch
    """Finds the pairs of actors that can have encounters."""
    rsus: RsuAntennas
    perception: Perceives
    adversary: Adversary
    medium: Medium
    pseudonyms: Pseudonyms
    linkage: Linkage
    revocation: Revocation
    trust: TrustHosts
    driver: Driver
    early: EarlyFusion | None = None
    """Shares and merges point clouds; None if none are shared."""
    accuracy: DetectorAccuracy = field(default_factory=DetectorAccuracy)
    """What the detector knows of its own accuracy."""
    recall: Recall | None = None
    """Recall of the detector (`sensors.detector.KnowsRecall`); None unless denials are weighted by it."""
    area: AreaParams = field(default_factory=AreaParams)
    """The area in which detections are evaluated: that of the config, as far as the LiDARs see in this weather."""
    coverage: Coverage | None = None
    """What a detector should find from another place; None unless evaluations are about missing objects."""
    units: RoadsideUnits = NO_UNITS
    """Roadside units that sense."""
    limits: SpeedLimits = NO_LIMITS
    """Speed limits of the roads, by the map that vehicles have."""
    watch: Stopwatch = field(default_factory=Stopwatch)
    """Measures how long each stage takes."""

    @staticmethod
    def of(
        experiment: Config,
        city: Scene,
        rsus: RsuAntennas = NO_RSUS,
        watch: Stopwatch | None = None,
        units: RoadsideUnits = NO_UNITS,
        limits: SpeedLimits = NO_LIMITS,
    ) -> "Parts":
        """Build the components that a config names.

        Raises
        ------
        ValueError
            In one line, if a component cannot be built.
        """
        c = experiment
        dt_s = c.traffic.step_s
        walls = WallIndex.of(city.buildings)
        pseudonyms = Pseudonyms(_make(c, "pseudonyms"), c.seed, dt_s)
        linkage, perception = Linkage(c.pseudonyms, pseudonyms), perception_of(c, city)
        area, seeing = seen_in_weather(c)
        return Parts(
            config=c,
            schedule=c.schedule,
            city=city,
            near_pairs=PairSearch.of(c.encounters, walls, c.lidar.mount_above_roof_m, city),
            rsus=rsus,
            perception=MixedPerception.of(perception, units) if len(units) else perception,
            adversary=Adversary.of(
                c.attacks,
                [_make(c, "attacks", n) for n in range(len(c.attacks))],
                c.seed,
                dt_s,
                c.trust.freshness_s,
                walls,
            ),
            medium=_make_medium(c, LosOfPlaces(walls)),
            pseudonyms=pseudonyms,
            linkage=linkage,
            revocation=Revocation(c.pseudonyms, linkage),
            trust=TrustHosts.of(
                variants(c), c.server, c.seed, c.schedule.exchange_interval_s, dt_s, 2.0 * c.message_lifetime_s
            ),
            driver=_make(c, "driver"),
            early=EarlyFusion.of(c),
            accuracy=DetectorAccuracy.of(_make(c, "detector")),
            recall=recall_of(c) if c.trust.denials == "recall" else None,
            area=area,
            coverage=Coverage.of(seeing, walls, recall_of(c)) if "missing" in c.trust.evidence else None,
            units=units,
            limits=limits,
            watch=Stopwatch() if watch is None else watch,
        )

    def under(self, experiment: Config) -> "Parts":
        """The components that another config names, in the same place: its city, antennas, units and speed limits."""
        return Parts.of(experiment, self.city, self.rsus, None, self.units, self.limits)

    @property
    def certified(self) -> UInt64[ndarray, "c"]:
        """Keys of the names of roadside units that are trusted by the class of their certificate."""
        return self.units.name_key[self.units.trusted]

    def senses(self, step: int) -> bool:
        """Whether vehicles can sense and exchange messages in this step."""
        return self.config.sensing and step % self.schedule.exchange_every_steps == 0

    def sensing(self, world: World) -> Int[ndarray, "s"]:
        """Rows of the world of the equipped vehicles that sense in this step."""
        rows = np.flatnonzero(world.equipped)
        if not self.senses(world.step):
            return rows[:0]
        return rows[self.schedule.senses(world.step, world.name_key[rows])]


def perception_of(experiment: Config, city: Scene) -> Perception:
    """The LiDAR and the detector that a config names."""
    c = experiment
    return Perception(
        city=city,
        lidar=c.lidar,
        detector=_make(c, "detector"),
        self_reports=c.trust.self_reports,
        seed=c.seed,
        dt_s=c.traffic.step_s,
        weather=c.weather,
    )


def seen_in_weather(experiment: Config) -> tuple[AreaParams, LidarParams]:
    """The area that vehicles evaluate, and the LiDAR as they know it: both end where the road returns nothing.

    If vehicles do not know how far they see in this weather (`weather.known`), both end where the LiDAR does.
    """
    area, lidar = experiment.area, experiment.lidar
    range_m = lidar.max_range_m
    if experiment.weather.known:
        range_m = road_range_m(experiment.weather, range_m)
    return replace(area, range_m=min(area.range_m, range_m)), replace(lidar, max_range_m=range_m)


def recall_of(experiment: Config) -> Recall:
    """The detector's recall function.

    A detector without the method `recall` is taken to miss nothing. With "missing" in `trust.evidence` it must have the
    method: ValueError.
    """
    detector = _make(experiment, "detector")
    if hasattr(detector, "recall"):
        return detector.recall
    if "missing" in experiment.trust.evidence:
        raise ValueError(
            f'trust.evidence names "missing", but the detector {type(detector).__name__} has no method '
            "recall(n_points, label, range_m): how often it misses an object is not known. Add it, or remove "
            '"missing" from trust.evidence.'
        )
    return _misses_nothing


def _misses_nothing(
    n_points: Int[ndarray, "n"], label: UInt8[ndarray, "n"], range_m: Float[ndarray, "n"]
) -> Float[ndarray, "n"]:
    """As `sensors.detector.KnowsRecall`: 1 for all."""
    return np.ones(len(n_points))


def check_choices(experiment: Config) -> None:
    """Raise ValueError, in one line, if a component that the config names cannot be built."""
    recall_of(experiment)
    for section in ("detector", "pseudonyms", "driver"):
        _make(experiment, section)
    for number in range(len(experiment.attacks)):
        _make(experiment, "attacks", number)
    _make_medium(experiment, None)
    c = experiment
    interval_s = c.schedule.exchange_interval_s
    TrustHosts.of(variants(c), c.server, c.seed, interval_s, c.traffic.step_s).start()


def variants(experiment: Config) -> list[Variant]:
    """The acting trust of the config, then its trust variants."""
    found = [_variant(BASE_VARIANT, experiment.trust, *config.chosen(experiment, "trust"), fused=True)]
    for v in experiment.trust_variant:
        found.append(_variant(v.name, v.trust, *config.chosen_model(v), v.fused))
    return found


def _variant(name: str, trust: TrustParams, choice: Choice, own: Any, fused: bool) -> Variant:
    """A trust variant. A user's own model keeps its evidence in the state, and every call of it is checked."""
    if not choice.is_own:
        return Variant(name, trust, choice.of, own, fused)
    make_model, guard = partial(construct, choice), partial(Guarded, choice)
    return Variant(name, trust, choice.of, own, fused, make=make_model, guard=guard)


def chosen(experiment: Config) -> dict[str, Choice]:
    """The class behind every choice of a config, by key."""
    found: dict[str, Choice] = {}
    for section, kind in SECTIONS.items():
        if section != "attacks":
            found[kind.place] = config.chosen(experiment, section)[0]
    for number in range(len(experiment.attacks)):
        found[f"attacks.{number}.attack"] = config.chosen(experiment, "attacks", number)[0]
    for number, variant in enumerate(experiment.trust_variant):
        found[f"trust_variant.{number}.model"] = config.chosen_model(variant)[0]
    return found


def sources(experiment: Config) -> dict[str, Source]:
    """The source of the class behind every choice of a config, by key."""
    return {key: choice.source for key, choice in chosen(experiment).items()}


def _make(experiment: Config, section: str, number: int | None = None) -> Any:
    """An instance of the class that a section names."""
    choice, own = config.chosen(experiment, section, number)
    return make(choice, *(() if choice.params is None else (own,)))


def _make_medium(experiment: Config, los: LosOfPlaces | None) -> Medium:
    choice, own = config.chosen(experiment, "radio")
    params = experiment.radio if own is None else own
    if isinstance(params, RadioParams) and experiment.sensing:  # else no station transmits
        params = replace(params, timeout_s=experiment.message_lifetime_s)
    return make(choice, params, experiment.round_s, experiment.seed, los)
