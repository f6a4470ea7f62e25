"""Checks of a config before anything is loaded or written, and changes of its inputs since an earlier run."""

import math
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

from cosim.attacks.params import PAPER, AttackParams
from cosim.config.config import Config, chosen
from cosim.config.effect import without_effect
from cosim.config.preset import default_of, farewell
from cosim.radio.rsu import NO_RSUS, RsuAntennas, place_rsus
from cosim.runs.inputs import changed_inputs
from cosim.step import mixed_perception
from cosim.step.parts import check_choices
from cosim.traffic.driver import largest_step_s
from cosim.traffic.georeference import refuse_degrees
from cosim.traffic.meshes import with_meshes
from cosim.traffic.roadside import NO_UNITS, RoadsideUnits, place
from cosim.traffic.scenario import Scenario, find
from cosim.traffic.scene_summary import scene_summary
from cosim.traffic.streetside import check_streets
from results.manifest import read_manifest
from sensors import lidar
from sensors.boxes import Boxes
from sensors.line_of_sight import WallIndex
from sensors.scene import Scene, Shape
from sumo_nets import sumocfg
from sumo_nets.ground import StreetHeights
from sumo_nets.network import junctions, lanes
from sumo_nets.streetside import read_trees

_SUNK_M = 1.0
"""An object farther from the height of the street beside it is not on the ground [m]."""

_LOWEST_RAD = -0.05
"""Whoever is 20 m away or more is not farther below the sensor than this."""
_TESTED_M = 0.25
"""Height of the part of a pedestrian that the test of free space looks at, half their width."""
_NEAREST_GAP_M = 30.0
"""If this part is lower than a gap between two beams at this distance, there is a note."""


def check(config: Config) -> Scenario:
    """Check a config and find its scenario.

    Raises
    ------
    ValueError
        In one line, if the config cannot run.
    """
    _check_compiler()
    scenario = find(config.traffic.scenario, config.traffic.trace)
    scenario.check_simulator()
    _check_degrees(config, scenario)
    rsu_antennas(config, scenario)
    roadside_units(config, scenario)
    _check_streetside(config, scenario)
    check_choices(config)
    _check_driver(config, scenario)
    _check_hosts(config)
    lidar.beams(config.lidar)
    mixed_perception.check_lidars(config.lidar, [unit.sensor for unit in config.roadside])
    with_meshes(Scene.empty(), config.meshes, config.vehicle_meshes)
    if config.lidar.engine != "columnar":  # the other engines are libraries that may not be installed
        one = Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1))
        car = np.array([Shape.CAR], np.uint8)
        first = np.zeros(1, np.int64)
        key = np.zeros(1, np.uint64)
        lidar.scan(one, car, first, Scene.empty(), config.lidar, key)
    return scenario


def _check_compiler() -> None:
    """Raise ValueError if Numba compiles nothing: a step calls functions that only compiled code has."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        raise ValueError("NUMBA_DISABLE_JIT is set, and a run needs compiled code: unset NUMBA_DISABLE_JIT")


def _check_degrees(config: Config, scenario: Scenario) -> None:
    """Raise ValueError if a position is in degrees."""
    net = scenario.location()
    if net is None:
        return
    for i, thing in enumerate(config.objects):
        if thing.at_m is not None:
            refuse_degrees(f"objects.{i}.at_m", thing.at_m, net, scenario.origin_m)
    for i, unit in enumerate(config.roadside):
        if unit.at is not None:
            refuse_degrees(f"roadside.{i}.at", unit.at, net)
    for i, (east_m, north_m, _) in enumerate(config.rsu.at):
        refuse_degrees(f"rsu.at[{i}]", (east_m, north_m), net)


def _check_streetside(config: Config, scenario: Scenario) -> None:
    """Raise ValueError if parked cars or trees have no streets or no map to stand along."""
    if config.parked.per_100_m > 0:
        check_streets(scenario.net, "parked")
    if config.trees.per_100_m > 0 or config.trees.from_map:
        check_streets(scenario.net, "trees")
    if not config.trees.per_100_m and _lacks_trees(config, scenario):
        raise ValueError(
            f"trees.from_map = true: the polygon files of {scenario.name} contain no trees. Set trees.per_100_m, or "
            "build the city from a map with trees."
        )


def _lacks_trees(config: Config, scenario: Scenario) -> bool:
    """Whether the trees of the map are wanted, and there are none."""
    return config.trees.from_map and not any(len(read_trees(path)) for path in scenario.buildings)


def _check_hosts(config: Config) -> None:
    """Raise ValueError if a trust model needs what its host does not have."""
    named = [("trust", config.trust)]
    named += [(f'trust_variant "{variant.name}"', variant.trust) for variant in config.trust_variant]
    for where, trust in named:
        if trust.model == "self_first" and trust.host == "central":
            raise ValueError(
                f'{where}: model = "self_first" puts the holder\'s own sweep first, and with host = "central" the '
                'holder is a server, which has none. Set host = "local", or model = "evaluator_trust".'
            )


def _check_driver(config: Config, scenario: Scenario) -> None:
    """Raise ValueError if the traffic cannot obey the driver's commands."""
    limit_s = largest_step_s(chosen(config, "driver")[0].of)
    if limit_s is None:
        return
    name = f'driver.model = "{config.driver.model}"'
    if scenario.trace is not None:
        raise ValueError(
            f"{name}: {scenario.trace} is replayed: nothing can brake in it. Run SUMO (no traffic.trace), or set "
            'driver.model = "none".'
        )
    if config.traffic.step_s > limit_s + 1e-9:
        raise ValueError(
            f"traffic.step_s = {config.traffic.step_s:g} s is too long for {name}: drivers behind would brake too late "
            f"and too hard. Set traffic.step_s to {limit_s:g} or less."
        )


def rsu_antennas(config: Config, scenario: Scenario) -> RsuAntennas:
    """The trust server's antennas in the scenario's network.

    Raises
    ------
    ValueError
        If the scenario has no street network, or a position does not fit.
    """
    if not config.rsu.at and not config.rsu.n_at_junctions:
        return NO_RSUS
    if scenario.net is None:
        raise ValueError(
            "rsu.at, rsu.n_at_junctions: a trace without streets has no network to stand in. "
            "Leave the roadside units out, or name the city in traffic.scenario and the trace in traffic.trace."
        )
    sites = place_rsus(config.rsu, junctions(scenario.net))
    return replace(sites, xyz_m=sites.xyz_m - np.array([*scenario.origin_m, 0.0]))


def roadside_units(config: Config, scenario: Scenario) -> RoadsideUnits:
    """The config's roadside units with a LiDAR, in the scenario's network.

    Raises
    ------
    ValueError
        If the scenario has no street network, or a position does not fit.
    """
    if not config.roadside:
        return NO_UNITS
    if scenario.net is None:
        raise ValueError(
            "[[roadside]]: a trace without streets has no network to stand in. Leave the units out, or name the city "
            "in traffic.scenario and the trace in traffic.trace."
        )
    return place(config.roadside, junctions(scenario.net), scenario.origin_m, config.seed)


def remarks_on(config: Config, scenario: Scenario, path: Path | None) -> list[str]:
    """Notes on a config that was read from `path`: keys without effect, and inputs that have changed."""
    return notes_on(config, scenario) + changed_since(path, config)


def notes_on(config: Config, scenario: Scenario) -> list[str]:
    """Notes on keys that change nothing, and on streets, buildings and what stands beside streets."""
    notes = farewell(config.preset) + keys_in_vain(config, scenario)
    notes += scene_summary(scenario).notes
    if config.parked.per_100_m or config.trees.per_100_m:
        city = scenario.city(config.trees, config.seed)
        if config.parked.per_100_m and not scenario.parked(config.parked, city, config.seed):
            notes.append("note: [parked] places no car: no place along the streets is free, or tags say so.")
        if config.trees.per_100_m and not len(city.trees.shape):
            notes.append("note: [trees] places no tree: no place along the streets is free.")
    notes += _late_objects(config) + _buried_objects(config, scenario) + _indoors(config, scenario)
    notes += _sparse_beams(config) + _few_clouds(config) + _short_window(config)
    notes += _no_links(config) + _one_evaluator(config)
    return notes + _out_of_reach(config)


def _late_objects(config: Config) -> list[str]:
    """Notes on objects that the run ends before."""
    notes = []
    for i, thing in enumerate(config.objects):
        if thing.from_s >= config.traffic.duration_s:
            notes.append(
                f"note: objects.{i}.from_s = {thing.from_s:g} s: the object never appears, because "
                f"traffic.duration_s = {config.traffic.duration_s:g} s."
            )
    return notes


def _buried_objects(config: Config, scenario: Scenario) -> list[str]:
    """Notes on objects at height 0 where the ground is elsewhere."""
    if not config.objects or scenario.net is None:
        return []
    at_m = np.array([thing.at_m for thing in config.objects]) + scenario.origin_m
    ground_m = StreetHeights(lanes(scenario.net)).ground_m(shapely.points(at_m))
    notes = []
    for i, (thing, height_m) in enumerate(zip(config.objects, ground_m.tolist(), strict=True)):
        if thing.ground_m == 0.0 and abs(height_m) > _SUNK_M:
            notes.append(
                f"note: objects.{i}.ground_m = 0 m, and the street beside it is at {height_m:.1f} m: nobody sees it "
                f"there. Set objects.{i}.ground_m = {height_m:.1f}."
            )
    return notes


def _sparse_beams(config: Config) -> list[str]:
    """A note where people stand between two beams, and vehicles take such places for free."""
    if not config.sensing or config.area.gaps == "unknown":
        return []
    beam_rad = lidar.beams(config.lidar).elevation_rad
    is_ahead = (beam_rad[1:] > _LOWEST_RAD) & (beam_rad[:-1] < 0.0)
    apart_rad = np.diff(beam_rad)[is_ahead].max(initial=0.0)
    if apart_rad <= _TESTED_M / _NEAREST_GAP_M:
        return []
    return [
        f"note: beams of the LiDAR are {math.degrees(apart_rad):.2g} degrees apart. People more than "
        f"{_TESTED_M / apart_rad:.0f} m away can stand between two of them, and vehicles that do not see them take the "
        'place for free. Set area.gaps = "unknown".'
    ]


def _indoors(config: Config, scenario: Scenario) -> list[str]:
    """Notes on objects, and on sensors of roadside units, inside buildings."""
    units = roadside_units(config, scenario)
    names = [f"objects.{i}" for i in range(len(config.objects))]
    names += units.names
    if not names:
        return []
    middles = []
    for thing in config.objects:
        middle_m = thing.ground_m + 0.5 * thing.lwh_m[2]
        middles.append((*(thing.at_m or ()), middle_m))
    sensors_m = units.ground_m + units.height_m[:, None] * [0.0, 0.0, 1.0]
    walls = WallIndex.of(scenario.city().buildings)
    is_in = walls.indoors(np.concatenate([np.reshape(middles, (-1, 3)), sensors_m]))
    said = "note: {} is inside a building: no ray goes in or out. Move it."
    return [said.format(names[row]) for row in np.flatnonzero(is_in).tolist()]


def empty_streets(config: Config, scenario: Scenario) -> list[str]:
    """A note before a run that has no warm-up, neither set nor of its city: recording begins on empty streets."""
    if scenario.trace is not None or scenario.sumocfg is None or config.traffic.warmup_s is not None:
        return []
    if scenario.warmup_s > 0 or sumocfg.read(scenario.sumocfg).files.get("load-state"):
        return []
    return [
        f"note: traffic.warmup_s is not set, and {scenario.name} has none of its own. Recording begins on empty "
        "streets. Set traffic.warmup_s to the time that traffic needs to fill them, such as 600."
    ]


def _short_window(config: Config) -> list[str]:
    """A note if rounds of a sidelink leave less than half of its selection window."""
    window_s = config.radio.sidelink.window_s
    has_sidelink = config.sensing and config.radio.model in ("nr_mode2", "lte_mode4")
    if not has_sidelink or config.round_s >= window_s / 2:
        return []
    return [
        f"note: radio.sidelink.window_s = {window_s:g} s, but all messages of a step are sent within a round of "
        f"{config.round_s:g} s. Stations choose among fewer slots, and more messages collide than if they were spread. "
        'A longer sensing_interval_s makes longer rounds, and so does sensing_phase = "common".'
    ]


def _few_clouds(config: Config) -> list[str]:
    """A note if clouds are merged with early fusion that are too old after one step, where vehicles sense in turns."""
    oldest_s, step_s, interval_s = config.early_fusion.max_age_s, config.traffic.step_s, config.sensing_interval_s
    in_turns = config.sensing_phase == "random" and interval_s > step_s
    if config.early_fusion.share == "none" or oldest_s >= step_s or not in_turns:
        return []
    n_phases = round(interval_s / step_s)
    return [
        f"note: early_fusion.max_age_s = {oldest_s:g} is shorter than a step of {step_s:g} s. Only clouds of vehicles "
        f"that sense in the same step are merged: those of one in {n_phases}. early_fusion.max_age_s = "
        f"{interval_s - step_s:g} merges those of all, and blurs what moves."
    ]


def _no_links(config: Config) -> list[str]:
    """A note if receivers forget some senders before they could link their next pseudonyms."""
    gap_s = config.pseudonyms.own_gap_s
    longest_s = config.cpm.longest_gap_s(config.schedule.longest_steps * config.traffic.step_s)
    if config.pseudonyms.linkage != "own" or not config.sensing or gap_s >= longest_s - 1e-9:
        return []
    return [
        f"note: pseudonyms.own_gap_s = {gap_s:g} is shorter than the {longest_s:g} s that may lie between two messages "
        "of a vehicle. Receivers forget such a vehicle before they could link its next pseudonym. Set it higher."
    ]


def _one_evaluator(config: Config) -> list[str]:
    """A note for each attack with identities that a linking server takes for one evaluator."""
    if config.pseudonyms.linkage != "server" or not config.sensing:
        return []
    params = [chosen(config, "attacks", k)[1] for k in range(len(config.attacks))]
    wanted = [getattr(one, "n_identities", 1) for one in params]
    return [
        f'note: attacks.{k}.n_identities = {n}: with pseudonyms.linkage = "server" the identities of a vehicle are one '
        'evaluator, whose evaluation of a detection counts once. Set pseudonyms.linkage = "none" for votes of each.'
        for k, n in enumerate(wanted)
        if n > 1
    ]


def _out_of_reach(config: Config) -> list[str]:
    """Notes on messages that no station can receive: from too far away, or because they take longer than a round."""
    radio, notes = config.radio, []
    farthest_m = radio.propagation.interference_range_m
    if radio.model != "unit_disk" and ":" not in radio.model and radio.range_m > farthest_m:
        notes.append(
            f"note: radio.range_m = {radio.range_m:g} m, but no frame arrives from farther than "
            f"radio.propagation.interference_range_m = {farthest_m:g} m. Set it to more than the range."
        )
    longest_s = radio.unit_disk.latency_max_s
    if radio.model == "unit_disk" and longest_s > config.round_s:
        notes.append(
            f"note: radio.unit_disk.latency_max_s = {longest_s:g} s is longer than a round of {config.round_s:g} s, "
            "and unit_disk loses what takes longer than its round, whatever radio.timeout_s is. Set it lower, or "
            'sensing_phase = "common", whose rounds last two fifths of the sensing interval.'
        )
    return notes


def keys_in_vain(config: Config, scenario: Scenario) -> list[str]:
    """Notes on keys that the config sets and that change nothing, and on times in which nothing can happen."""
    lines = without_effect(config, scenario.trace is not None)
    if _lacks_trees(config, scenario):
        lines.append(f"trees.from_map has no effect: the polygon files of {scenario.name} contain no trees.")
    lines += _without_city(scenario) + _shorter_step(config, scenario)
    lines += _longer_periods(config) + _late_attacks(config)
    return [f"note: {line}" for line in lines]


def _without_city(scenario: Scenario) -> list[str]:
    """A line if a .sumocfg is that of a city that `nets build` made: the city's buildings are not among its files."""
    folder = None if scenario.sumocfg is None or scenario.buildings else scenario.sumocfg.parent
    if folder is None or not (folder / "recipe.toml").is_file():
        return []
    return [
        f"{scenario.name} is driven without the buildings and the warm-up of its city. Set traffic.scenario = {folder}."
    ]


def _shorter_step(config: Config, scenario: Scenario) -> list[str]:
    """A line if the user's own .sumocfg states a step, and that of the preset, which is shorter, is used instead."""
    path, step_s = scenario.sumocfg, config.traffic.step_s
    is_own = scenario.trace is None and scenario.warmup_s == 0  # a city has a warm-up
    if path is None or not is_own or step_s != default_of("traffic.step_s", config.preset):
        return []
    stated_s = sumocfg.step_s(path)
    if "step-length" not in sumocfg.read(path).options or stated_s <= step_s:
        return []
    return [
        f"{path.name} has steps of {stated_s:g} s, and those of the preset are used: traffic.step_s = {step_s:g}. "
        f"Set traffic.step_s = {stated_s:g} to drive it as it is."
    ]


def _late_attacks(config: Config) -> list[str]:
    """A line for each attack of the user's that the run ends before. The two of the default run are not the user's."""
    last_step_s = (config.n_steps - 1) * config.traffic.step_s
    if not config.sensing or config.attacks == tuple(AttackParams(**keys) for keys in PAPER):
        return []
    return [
        f"attacks.{number}.start_s = {attack.start_s:g} s: the attack never begins, because traffic.duration_s = "
        f"{config.traffic.duration_s:g} s. Set start_s lower, or run longer."
        for number, attack in enumerate(config.attacks)
        if attack.is_meant_to_begin and attack.start_s > last_step_s + 1e-9
    ]


def _longer_periods(config: Config) -> list[str]:
    """A line for each period of a trust server that is rounded up, because it broadcasts when vehicles exchange."""
    every_s = config.schedule.exchange_interval_s
    hosts = [config.trust, *(variant.trust for variant in config.trust_variant)]
    periods_s = [host.server_period_s for host in hosts if host.host == "central" and config.sensing]
    lines = []
    for period_s in dict.fromkeys(periods_s):
        real_s = every_s * math.ceil(period_s / every_s - 1e-6)
        if not math.isclose(real_s, period_s, rel_tol=1e-6):
            lines.append(
                f"trust.server_period_s = {period_s:g}: the server broadcasts every {real_s:g} s, because messages are "
                f"exchanged every {every_s:g} s."
            )
    return lines


def changed_since(path: Path | None, config: Config) -> list[str]:
    """A note if the config is that of a recorded run and input files have changed since; otherwise an empty list."""
    if path is None or not (path.parent / "manifest.json").is_file():
        return []
    with suppress(ValueError):
        before = read_manifest(path.parent)["net"]
        if changed := changed_inputs(config, find(config.traffic.scenario, config.traffic.trace), before):
            return [f"note: changed since {path.parent} was recorded: {', '.join(changed)}. The tables will differ."]
    return []
