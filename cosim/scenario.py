"""Network, buildings and traffic: a city by name, a SUMO scenario of the user's own, or recorded traffic."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.actors import ActorRegistry
from cosim.manifest import sha256
from cosim.mobility import fcd
from cosim.mobility.params import TrafficParams
from cosim.mobility.replay import RunReplay, TraceReplay
from cosim.mobility.source import TrafficSource
from cosim.mobility.sumo import SumoTraffic
from results.archive import open_run
from sensors.scene import Scene
from sumo_nets import catalogue, sumocfg
from sumo_nets.catalogue import Net
from sumo_nets.footprints import read_footprints
from sumo_nets.ground import standing_on
from sumo_nets.network import check_for_cars

FARTHEST_M = 32_000.0
"""Coordinates beyond this get an origin within the network, because tables keep them in single precision."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Files of a network, its buildings and its traffic."""

    name: str
    sumocfg: Path | None
    net: Path | None
    buildings: tuple[Path, ...]
    types: tuple[Path, ...] = ()
    """Files that define vehicle types, in the order of reading."""
    warmup_s: float = 0.0
    licence: str = "the user's own"
    attribution: str = ""
    trace: Path | None = None
    """A trace or a run folder to replay; None runs SUMO."""
    origin_m: tuple[float, float] = (0.0, 0.0)
    """Where the world's origin lies in the network's coordinates."""

    def traffic(self, params: TrafficParams, registry: ActorRegistry, has_driver: bool = False) -> TrafficSource:
        """The source of traffic; ValueError in one line where it cannot be read.

        With a driver, its worlds have lane paths where SUMO runs.
        """
        if self.trace is None:
            assert self.sumocfg is not None
            return SumoTraffic(params, self.sumocfg, registry, self.origin_m, has_driver)
        if self.trace.is_dir():
            return RunReplay(params, self.trace, registry)
        return TraceReplay(params, self.trace, registry, self.types, self.origin_m)

    def city(self) -> Scene:
        """The buildings, as the scene that rays are cast into."""
        footprints = [f for path in self.buildings for f in read_footprints(path, self.net)]
        if self.net is not None:
            footprints = standing_on(footprints, self.net)
        origin = np.array(self.origin_m)
        rings = [[ring - origin for ring in (f.outer, *f.holes)] for f in footprints]
        return Scene.from_footprints(rings, [f.base_z_m for f in footprints], [f.top_z_m for f in footprints])

    def certificate(self) -> dict[str, str]:
        """Where the network comes from, and checksums of its files."""
        trace = self.trace / "manifest.json" if self.trace is not None and self.trace.is_dir() else self.trace
        files = [p for p in (self.sumocfg, self.net, *self.buildings, trace) if p is not None]
        about = {"name": self.name, "licence": self.licence, "attribution": self.attribution}
        if any(self.origin_m):
            about["origin"] = "{:.0f} m east, {:.0f} m north of the network's own".format(*self.origin_m)
        return about | {f"sha256 {p.name}": sha256(p) for p in files}


def find(scenario: str, trace: str | None = None) -> Scenario:
    """What `traffic.scenario` and `traffic.trace` name; ValueError in one line for a mistake."""
    found = _find(scenario)
    if trace is None:
        return found
    path = Path(trace)
    if not path.exists():
        raise ValueError(f"traffic.trace = {trace}: no such file or folder. Give a trace of SUMO's or a run folder.")
    if not (_is_trace(path) or (path / "manifest.json").is_file()):
        raise ValueError(
            f"traffic.trace = {trace}: neither a run folder nor a trace. Give a folder that `cosim run` wrote, or what "
            f"SUMO wrote with --fcd-output ({', '.join(fcd.SUFFIXES)})."
        )
    return replace(found, trace=path, warmup_s=0.0 if path.is_dir() else found.warmup_s)


def _find(scenario: str) -> Scenario:
    if scenario in catalogue.names():
        return _of_net(catalogue.find(scenario))
    path = Path(scenario)
    if path.is_dir():
        return _in_folder(path)
    if path.name.endswith(".sumocfg") and not path.is_file():
        raise ValueError(f"traffic.scenario = {scenario}: no such file. Give the path of a .sumocfg.")
    if path.is_file() and path.name.endswith(".sumocfg"):
        return _of_sumocfg(path)
    if path.is_file() and _is_trace(path):
        name = path.name
        for suffix in sorted(fcd.SUFFIXES, key=len, reverse=True):
            name = name.removesuffix(suffix)
        return Scenario(name, None, None, (), trace=path)
    raise ValueError(
        f"traffic.scenario = {scenario}: no city of that name ships, and it is no .sumocfg, folder or trace. "
        f"Set it to one of {', '.join(catalogue.names())}, or to the path of a .sumocfg."
    )


def _is_trace(path: Path) -> bool:
    return path.is_file() and path.name.endswith(fcd.SUFFIXES)


def _in_folder(folder: Path) -> Scenario:
    """A city that `cosim nets build` made, a run to replay, or a folder with one .sumocfg."""
    if (folder / "recipe.toml").is_file():
        return _of_net(catalogue.open_folder(folder))
    if (folder / "manifest.json").is_file():
        traffic = open_run(folder).config["traffic"]
        try:
            streets = _find(traffic["scenario"])
        except ValueError as error:
            raise ValueError(
                f"traffic.scenario = {folder}: the city of that run is not to be found: {error} "
                f'Or set traffic.scenario to that city, and traffic.trace = "{folder}".'
            ) from None
        return replace(streets, trace=folder, warmup_s=0.0)
    found = sorted(folder.glob("*.sumocfg"))
    if len(found) == 1:
        return _of_sumocfg(found[0])
    raise ValueError(
        f"traffic.scenario = {folder}: a folder with {len(found) or 'no'} .sumocfg, and neither a run nor a city that "
        "`cosim nets build` made. Give the path of a .sumocfg."
    )


def _of_net(net: Net) -> Scenario:
    types = (net.folder / "vtypes.add.xml",)
    return Scenario(
        net.name, net.sumocfg_path, net.net_path, (net.buildings_path,), types, net.warm_up_s, net.licence,
        net.attribution, origin_m=_origin_m(net.bounds_m),
    )  # fmt: skip


def _of_sumocfg(path: Path) -> Scenario:
    config = sumocfg.read(path)
    check_for_cars(config.net)
    return Scenario(
        path.stem, path, config.net, config.buildings, (*config.additional, *config.routes),
        origin_m=_origin_m(catalogue.bounds_m(config.net)),
    )  # fmt: skip


def _origin_m(bounds_m: tuple[float, float, float, float]) -> tuple[float, float]:
    """The network's own origin, or where that is far away, its centre rounded to the kilometre."""
    if max(map(abs, bounds_m)) < FARTHEST_M:
        return 0.0, 0.0
    x0, y0, x1, y1 = bounds_m
    return round((x0 + x1) / 2, -3), round((y0 + y1) / 2, -3)
