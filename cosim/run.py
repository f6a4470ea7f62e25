"""A run, from config to folder."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import tomli_w

from cosim import recording
from cosim.actors import ActorRegistry
from cosim.adversary.params import named, roles_of, shares
from cosim.config import Config, chosen
from cosim.cycle import State, step
from cosim.driver.driver import largest_step_s
from cosim.manifest import Manifest
from cosim.meshes import with_meshes
from cosim.mobility.remarks import traffic_remarks
from cosim.mobility.source import TrafficEnded, TrafficError, TrafficSource
from cosim.parts import Parts, check_choices, sources
from cosim.radio.rsu import NO_RSUS, RsuAntennas, place_rsus
from cosim.scenario import Scenario, find
from cosim.stopwatch import Stopwatch
from results.recorder import Recorder
from sensors import lidar
from sensors.boxes import Boxes
from sensors.scene import Scene, Shape
from sumo_nets.network import junctions
from trust.models.interface import ModelError

Advance = Callable[[str, int, int, str], None]
"""Told of progress: phase, done, total, a note."""

_CORES = numba.get_num_threads()
_EQUIPPED_PER_THREAD = 100
"""Below it a step takes some 20 ms, and threads lose more than they gain wherever the cores have other work."""


def check(config: Config) -> Scenario:
    """The scenario that a config asks for; ValueError where it could not run."""
    scenario = find(config.traffic.scenario, config.traffic.trace)
    roadside_units(config, scenario)
    check_choices(config)
    _check_driver(config, scenario)
    lidar.beams(config.lidar)
    with_meshes(Scene.empty(), config.meshes)
    if config.lidar.engine != "columnar":  # the others are libraries that may not be there
        one = Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1))
        car, first = np.array([Shape.CAR], np.uint8), np.zeros(1, np.int64)
        lidar.scan(one, car, first, Scene.empty(), config.lidar, np.zeros(1, np.uint64))
    return scenario


def _check_driver(config: Config, scenario: Scenario) -> None:
    """ValueError where the traffic cannot do what the driver commands."""
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


def roadside_units(config: Config, scenario: Scenario) -> RsuAntennas:
    """Where the config's roadside units stand in the scenario's network; ValueError where they cannot."""
    if not config.rsu.at and not config.rsu.n_at_junctions:
        return NO_RSUS
    if scenario.net is None:
        raise ValueError(
            "rsu.at, rsu.n_at_junctions: a trace without streets has no network to stand in. "
            "Leave the roadside units out, or name the streets in traffic.scenario and the trace in traffic.trace."
        )
    sites = place_rsus(config.rsu, *junctions(scenario.net))
    return replace(sites, xyz_m=sites.xyz_m - np.array([*scenario.origin_m, 0.0]))


def without_nulls(data: Any) -> Any:
    """Plain data without what is not set, as TOML needs it."""
    if isinstance(data, dict):
        return {k: without_nulls(v) for k, v in data.items() if v is not None}
    return [without_nulls(v) for v in data] if isinstance(data, list | tuple) else data


def run(config: Config, out: Path | None, advance: Advance, traffic_from: Path | None = None) -> Path:
    """Drive, sense, talk, trust and record; the folder that it wrote.

    `traffic_from` is a folder that `record_traffic` wrote for the same `[traffic]`: it is replayed instead of driving
    SUMO, with the same tables.

    Nothing is written before the config has been checked and SUMO has accepted the scenario.
    """
    scenario = check(config)
    folder = _folder(out, scenario.name)
    watch = Stopwatch()
    with watch("city"):
        city = with_meshes(scenario.city(), config.meshes)
    parts = Parts.of(config, city, roadside_units(config, scenario), watch)
    registry = ActorRegistry(config.fleet, config.seed, shares(config.attacks), named(config.attacks))
    recorded = scenario if traffic_from is None else replace(scenario, trace=traffic_from, warmup_s=0.0)
    params = config.traffic if traffic_from is None else replace(config.traffic, begin_s=None, warmup_s=0.0)
    traffic = recorded.traffic(params, registry, has_driver=config.driver.model != "none")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        manifest = Manifest(folder, config, scenario.provenance(), sources(config))
        (folder / "config.toml").write_text(tomli_w.dumps(without_nulls(config.to_dict())), encoding="utf-8")
        manifest.write("running")
        try:
            _warm_up(0.0 if traffic_from is not None else _warmup_s(config, scenario), traffic, watch, advance)
            _drive(parts, scenario, traffic, registry, manifest, advance)
        except KeyboardInterrupt:
            manifest.write("interrupted")
            raise
        except (TrafficError, ModelError):
            manifest.write("failed")
            raise
        except Exception as error:
            manifest.write("failed")
            raise RuntimeError(f"{folder}: the run failed at step {manifest.steps}") from error
    finally:
        traffic.close()
    manifest.write("finished")
    return folder


def record_traffic(config: Config, folder: Path, advance: Advance) -> Path:
    """Drive and record the traffic of a config, nobody equipped; a folder for `run(..., traffic_from=folder)`."""
    own = {section: values for section, values in config.own.items() if not section.startswith("attacks.")}
    config = replace(config, attacks=(), trust_variant=(), own=own)
    scenario, watch = check(config), Stopwatch()
    registry = ActorRegistry(replace(config.fleet, penetration_p=0.0), config.seed)
    traffic = scenario.traffic(config.traffic, registry)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        manifest = Manifest(folder, config, scenario.provenance(), sources(config))
        manifest.write("running")
        _warm_up(_warmup_s(config, scenario), traffic, watch, advance)
        with Recorder(folder, "standard", config.record.block_steps) as recorder:
            for number in range(config.n_steps):
                try:
                    world = traffic.advance()
                except TrafficEnded:
                    break
                recording.actors(recorder, world)
                manifest.steps = number + 1
                advance("traffic", number + 1, config.n_steps, f"steps, {len(world)} actors")
            nobody = np.zeros(len(registry), np.int32), np.zeros(len(registry), bool)
            recording.vehicles(recorder, registry, roles_of(()), *nobody, max(0, manifest.steps - 1))
        manifest.timings_s, manifest.summary = watch.seconds, traffic.report()
    finally:
        traffic.close()
    manifest.write("finished")
    return folder


def remarks(folder: Path) -> list[str]:
    """What a user should know of a finished run before they trust its figures; mostly nothing."""
    summary = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["summary"]
    return traffic_remarks(summary)


def _threads(config: Config, n_equipped: int) -> int:
    """Threads for one step: what the config says, or as many as are worth it."""
    return min(config.compute.threads or max(1, n_equipped // _EQUIPPED_PER_THREAD), _CORES)


def _drive(
    parts: Parts, scenario: Scenario, traffic: TrafficSource, registry: ActorRegistry, manifest: Manifest,
    advance: Advance,
) -> None:  # fmt: skip
    config, watch = parts.config, parts.watch
    state = State.start(parts)
    variants = [variant.name for variant in parts.trust.variants]
    n_on_road, ended = 0, ""
    with Recorder(manifest.folder, config.record.level, config.record.block_steps, variants=variants) as recorder:
        for number in range(config.n_steps):
            with watch("traffic"):
                try:
                    world = traffic.advance()
                except TrafficEnded as over:
                    asked_s = config.n_steps * config.traffic.step_s
                    ended = f"the traffic ended before the {asked_s:g} s asked for: {over}"
                    break
            numba.set_num_threads(_threads(config, int(world.equipped.sum())))
            state, happened = step(world, state, parts)
            with watch("record"):
                recording.step(recorder, happened, config.traffic.step_s)
            traffic.command(happened.commands.actor, happened.commands.speed_mps)
            n_on_road += int((world.shape != Shape.PEDESTRIAN).sum())
            manifest.steps = number + 1
            advance("run", number + 1, config.n_steps, f"steps, {len(world)} actors")
        if not manifest.steps:
            raise TrafficError(f"traffic.scenario = {scenario.name}: there is nothing to record: {ended}.")
        last = manifest.steps - 1
        recording.encounters(recorder, last, state.encounters.close(manifest.steps))
        recording.pseudonyms(recorder, last, parts.pseudonyms.in_use(state.pseudonyms))
        recording.vehicles(
            recorder, registry, roles_of(config.attacks), *state.attack_start.first_steps(len(registry)), last
        )
    manifest.timings_s = watch.seconds
    manifest.summary = {
        "vehicles_on_road_mean": round(n_on_road / manifest.steps, 2),
        **traffic.report(),
        "detections_malformed": state.n_malformed,
        "evaluations_rejected": parts.trust.rejected(state.trust),
        **_pseudonym_summary(config, state),
        **({"ended_early": ended} if ended else {}),
    }


def _pseudonym_summary(config: Config, state: State) -> dict[str, Any]:
    """What became of pseudonyms, where anything can."""
    found: dict[str, Any] = {}
    if config.pseudonyms.revocation != "none":
        found["revoked"] = len(state.pseudonyms.revoked)
    if config.pseudonyms.linkage == "on_demand":
        found["linked_on_demand"] = int((state.pseudonyms.linked >= 0).sum())
    if config.pseudonyms.linkage == "own":
        heard = state.heard
        found["relinked"] = {"changes": heard.n_changes, "linked": heard.n_linked, "right": heard.n_right}
    return found


def _warmup_s(config: Config, scenario: Scenario) -> float:
    return scenario.warmup_s if config.traffic.warmup_s is None else config.traffic.warmup_s


def _warm_up(warmup_s: float, traffic: TrafficSource, watch: Stopwatch, advance: Advance) -> None:
    with watch("warm-up"):
        try:
            for done_s in traffic.warm_up(warmup_s):
                advance("warm-up", int(done_s), int(warmup_s), "s")
        except TrafficEnded as over:
            raise TrafficError(f"traffic.warmup_s = {warmup_s:g} s outlasts the traffic: {over}. Shorten it.") from None
        advance("warm-up", int(warmup_s), int(warmup_s), "s")


def _folder(out: Path | None, name: str) -> Path:
    if out is None:
        n = 1
        while (folder := Path("runs") / f"{name}-{n}").exists():
            n += 1
        return folder
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file. Give a folder that is empty or does not exist.")
    if out.is_dir() and any(out.iterdir()):
        what = "already holds a run" if (out / "manifest.json").exists() else "is not empty"
        raise ValueError(f"--out {out} {what}. Give a folder that is empty or does not exist.")
    return out
