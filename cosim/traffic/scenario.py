"""Network, buildings and traffic: a city by name, the user's own SUMO scenario, or recorded traffic."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from cosim.base.durable import sha256
from cosim.base.earth import Projection
from cosim.base.file_names import name_of
from cosim.traffic import fcd
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.frame import Bounds, Frame, origin_of
from cosim.traffic.georeference import NetLocation
from cosim.traffic.limits import NO_LIMITS, SpeedLimits
from cosim.traffic.objects import ObjectParams, Placed, WithObjects
from cosim.traffic.params import TrafficParams
from cosim.traffic.replay import RunReplay, TraceReplay
from cosim.traffic.roadside import NO_UNITS, RoadsideUnits
from cosim.traffic.source import TrafficSource
from cosim.traffic.streetside import NO_TREES, ParkedParams, Streetside, TreeParams, check_streets, with_trees
from sensors.scene import Scene
from sumo_nets import catalogue, network, sumocfg
from sumo_nets.catalogue import Net
from sumo_nets.footprints import read_footprints
from sumo_nets.ground import standing_on
from sumo_nets.map_files import refuse_map
from sumo_nets.network import check_for_cars, lanes
from sumo_nets.xml import spelling


@dataclass(frozen=True, slots=True)
class Scenario:
    """Files of a network, its buildings and its traffic."""

    name: str
    sumocfg: Path | None
    net: Path | None
    buildings: tuple[Path, ...]
    types: tuple[Path, ...] = ()
    """Files that define vehicle types, in the order in which they are read."""
    warmup_s: float = 0.0
    licence: str = "the user's own"
    attribution: str = ""
    trace: Path | None = None
    """A trace or a run folder to replay. None means that SUMO runs."""
    origin_m: tuple[float, float] = (0.0, 0.0)
    """The world's origin in the network's coordinates [m]."""
    bounds_m: Bounds | None = None
    """Bounds of the network in its coordinates."""
    inputs: tuple[Path, ...] = ()
    """All files that SUMO reads."""
    switches: frozenset[str] = frozenset()
    """Options of SUMO that the configuration switches on."""

    def warmup_of(self, params: TrafficParams) -> float:
        """Duration of the traffic before the first recorded step [s]: that of the config, else that of the city."""
        return self.warmup_s if params.warmup_s is None else params.warmup_s

    def traffic(
        self,
        params: TrafficParams,
        registry: ActorRegistry,
        has_driver: bool = False,
        objects: Sequence[ObjectParams] = (),
        parked: Mapping[str, ObjectParams] | None = None,
        units: RoadsideUnits = NO_UNITS,
    ) -> TrafficSource:
        """Open the traffic source, and add the objects and the roadside units of the config, and parked cars.

        Parameters
        ----------
        has_driver
            Whether a driver commands vehicles. If so, and SUMO runs, worlds have lane paths.

        Raises
        ------
        ValueError
            The source cannot be read. The message is one line.
        """
        source = f"traffic.scenario = {params.scenario}" if self.trace is None else f"traffic.trace = {self.trace}"
        frame = Frame(source, self.origin_m, self.bounds_m)
        placed = Placed.of(objects, frame, params.step_s, parked, units)
        found = self._moving(params, registry, frame, has_driver)
        return WithObjects(found, placed, registry, frame) if placed.names else found

    def check_simulator(self) -> None:
        """Raise ValueError, in one line, if the traffic needs SUMO, and it is not installed."""
        if self.trace is None and find_spec("libsumo") is None:
            raise ValueError(
                f"{self.name}: its traffic needs SUMO, and libsumo is not installed. Install it: pip install "
                "libsumo==1.28.0. Or replay recorded traffic, which needs no SUMO: set traffic.trace."
            )

    def _moving(self, params: TrafficParams, registry: ActorRegistry, frame: Frame, has_driver: bool) -> TrafficSource:
        self.check_simulator()
        if self.trace is None:
            from cosim.traffic.sumo import SumoTraffic  # imported here, because loading SUMO is slow

            assert self.sumocfg is not None
            return SumoTraffic(params, self.sumocfg, registry, frame, has_driver)
        if self.trace.is_dir():
            from results.archive import open_run

            changed = self.changed_inputs(open_run(self.trace).manifest.get("net", {}))
            return RunReplay(params, self.trace, registry, frame, changed, self.location())
        return TraceReplay(params, self.trace, registry, self.types, frame, self.location())

    def location(self) -> NetLocation | None:
        """Where the network is, and its projection; None without a network."""
        if self.net is None or self.bounds_m is None:
            return None
        text, offset_m = network.location(self.net)
        try:
            projection = Projection.of(text, -offset_m[0], -offset_m[1])
        except ValueError:
            projection = None
        return NetLocation(self.bounds_m, projection, offset_m, self.net)

    def parked(self, params: ParkedParams, city: Scene, seed: int) -> dict[str, ObjectParams]:
        """Parked cars by name. A ValueError of one line is raised if there are no streets."""
        if not params.per_100_m:
            return {}
        return Streetside.of(self.net, self.origin_m, seed, "parked").parked(city, params)

    def city(self, trees: TreeParams = NO_TREES, seed: int = 0) -> Scene:
        """The buildings and trees, as a scene for ray casting. Trees need streets; see `parked`."""
        footprints = [f for path in self.buildings for f in read_footprints(path, self.net)]
        if self.net is not None:
            footprints = standing_on(footprints, lanes(self.net))
        origin = np.array(self.origin_m)
        rings = []
        for footprint in footprints:
            rings.append([ring - origin for ring in (footprint.outer, *footprint.holes)])
        city = Scene.from_footprints(rings, [f.base_z_m for f in footprints], [f.top_z_m for f in footprints])
        if not (trees.per_100_m or trees.from_map):
            return city
        net = check_streets(self.net, "trees")
        return with_trees(city, Streetside.of(net, self.origin_m, seed, "trees"), net, self.buildings, trees)

    def limits(self) -> SpeedLimits:
        """Speed limits of the roads; none without a network."""
        return NO_LIMITS if self.net is None else SpeedLimits.of(lanes(self.net), self.origin_m)

    def provenance(self) -> dict[str, str]:
        """Name, licence and attribution of the data, its warm-up, and the SHA-256 of every file that is read."""
        about = {"name": self.name, "licence": self.licence, "attribution": self.attribution}
        if any(self.origin_m):
            about["origin"] = "{:.0f} m east, {:.0f} m north of the network's own".format(*self.origin_m)
        if self.warmup_s:
            about["warm-up"] = f"{self.warmup_s:g} s, unless traffic.warmup_s is set"
        for name, path in self._named_inputs().items():
            about[f"sha256 {name}"] = sha256(path)
        return about

    def changed_inputs(self, provenance: dict[str, str]) -> list[str]:
        """Names of the files whose content has changed since an earlier run of this scenario, by its provenance."""
        changed = []
        for name, path in self._named_inputs().items():
            before = provenance.get(f"sha256 {name}")
            if before is not None and path != self._recorded and before != sha256(path):
                changed.append(name)
        return changed

    @property
    def _recorded(self) -> Path | None:
        """The manifest of the run that is replayed."""
        return (self.trace / "manifest.json").resolve() if self.trace is not None and self.trace.is_dir() else None

    def _named_inputs(self) -> dict[str, Path]:
        """The files that are read, by name. If two files have the same name, a number follows the second one's."""
        trace = self._recorded or self.trace
        given = (self.sumocfg, self.net, *self.buildings, *self.types, *self.inputs)
        named: dict[str, Path] = {}
        for path in dict.fromkeys(p.resolve() for p in (*given, trace) if p is not None):
            n, name = 1, path.name
            while name in named:
                n, name = n + 1, f"{path.name} ({n + 1})"
            named[name] = path
        return named


def find(scenario: str, trace: str | None = None) -> Scenario:
    """Find what `traffic.scenario` and `traffic.trace` name. A mistake raises a ValueError of one line."""
    found = _find(scenario)
    if trace is None:
        return found
    path = Path(trace)
    if not path.exists():
        cure = spelling(path) or " Give a trace of SUMO's or a run folder."
        raise ValueError(f"traffic.trace = {trace}: no such file or folder.{cure}")
    if not (_is_trace(path) or (path / "manifest.json").is_file()):
        raise ValueError(
            f"traffic.trace = {trace}: neither a run folder nor a trace. Give a folder that `cosim run` wrote, or what "
            f"SUMO wrote with --fcd-output ({', '.join(fcd.SUFFIXES)})."
        )
    return replace(found, trace=path, warmup_s=0.0)


def _find(scenario: str) -> Scenario:
    if scenario in catalogue.names():
        return _of_net(catalogue.find(scenario))
    path = Path(scenario)
    if path.is_dir():
        return _in_folder(path)
    if path.name.endswith(sumocfg.SUFFIXES) and not path.is_file():
        cure = spelling(path) or " Give the path of a .sumocfg."
        raise ValueError(f"traffic.scenario = {scenario}: no such file.{cure}")
    if sumocfg.is_sumocfg(path):
        return _of_sumocfg(path)
    if path.is_file() and _is_trace(path):
        name = path.name
        for suffix in sorted(fcd.SUFFIXES, key=len, reverse=True):
            name = name.removesuffix(suffix)
        named = name_of(path.resolve().with_name(name + ".xml"))
        return Scenario(named, None, None, (), trace=path)
    refuse_map(path, "traffic.scenario = ")
    raise ValueError(
        f"traffic.scenario = {scenario}: there is no city of that name, and it is no .sumocfg, folder or trace. "
        f"Set it to one of {', '.join(catalogue.names())}, or to the path of a .sumocfg."
        + (spelling(path) if not path.exists() and {"/", "\\"} & set(scenario) else "")
    )


def _is_trace(path: Path) -> bool:
    return path.is_file() and path.name.endswith(fcd.SUFFIXES)


def _in_folder(folder: Path) -> Scenario:
    """A city that `cosim nets build` made, a run to replay, or a folder with one .sumocfg."""
    if (folder / "recipe.toml").is_file():
        return _of_net(catalogue.open_folder(folder))
    if (folder / "manifest.json").is_file():
        from results.archive import open_run

        traffic = open_run(folder).config["traffic"]
        try:
            streets = _find(traffic["scenario"])
        except ValueError as error:
            raise ValueError(
                f"traffic.scenario = {folder}: the city of that run cannot be found: {error} "
                f'Or set traffic.scenario to that city, and traffic.trace = "{folder}".'
            ) from None
        return replace(streets, trace=folder, warmup_s=0.0)
    found = sumocfg.in_folder(folder)
    if len(found) == 1:
        return _of_sumocfg(found[0])
    raise ValueError(
        f"traffic.scenario = {folder}: a folder with {len(found) or 'no'} .sumocfg, and neither a run nor a city that "
        "`cosim nets build` made. Give the path of a .sumocfg."
    )


def _of_net(net: Net) -> Scenario:
    types, config = (net.folder / "vtypes.add.xml",), sumocfg.read(net.sumocfg_path)
    return Scenario(
        net.name,
        net.sumocfg_path,
        net.net_path,
        (net.buildings_path,),
        types,
        net.warm_up_s,
        net.licence,
        net.attribution,
        origin_m=origin_of(net.bounds_m),
        bounds_m=net.bounds_m,
        inputs=config.inputs,
        switches=config.switches,
    )


def _of_sumocfg(path: Path) -> Scenario:
    config = sumocfg.read(path)
    check_for_cars(config.net)
    bounds_m = catalogue.bounds_m(config.net)
    return Scenario(
        name_of(path.resolve()),
        path,
        config.net,
        config.buildings,
        (*config.additional, *config.routes, *config.included),
        origin_m=origin_of(bounds_m),
        bounds_m=bounds_m,
        inputs=config.inputs,
        switches=config.switches,
    )
