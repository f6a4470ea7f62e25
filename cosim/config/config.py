"""One experiment as one typed model: all parameters, from TOML and `--set`.

`load` reads a file. `resolve_data` builds a `Config` from plain data, in this order: keys of the preset that the data
leave out; parameters of the user's own classes, which are set aside; unknown keys, which are errors; absolute paths;
the typed model, with its checks across sections; trust variants. Mistakes of the user are ValueErrors of one line.

Each section is a dataclass of the package that uses it. A section may name a class, such as the trust model. A class of
the user's own may have parameters that its section does not declare. They are keys of the section in a config file, and
are in `Config.own`.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

from cosim.attacks.params import PAPER, AttackParams, check_attacks
from cosim.config import preset
from cosim.config.data import check_finite, check_keys, is_plain, override, read_toml, unknown_key, validated
from cosim.config.preset import default_of, default_section
from cosim.door.blame import at_load, definition_line
from cosim.door.kinds import SECTIONS
from cosim.door.load import Choice, is_own, resolve
from cosim.door.permission import loading_code, loading_code_of
from cosim.messages.cloud_params import EarlyFusionParams
from cosim.messages.cpm_params import CpmParams
from cosim.messages.linkage import check_server
from cosim.messages.pseudonyms import PseudonymParams
from cosim.messages.trust_server import ServerParams
from cosim.radio.params import RadioParams
from cosim.radio.rsu import RsuParams
from cosim.traffic.driver import DriverParams
from cosim.traffic.fleet import FleetParams
from cosim.traffic.meshes import MeshParams, VehicleMeshParams, check_vehicle_meshes
from cosim.traffic.objects import ObjectParams
from cosim.traffic.params import SHORTEST_STEP_S, TrafficParams, resolved_input
from cosim.traffic.position_errors import GnssParams
from cosim.traffic.roadside import RoadsideParams
from cosim.traffic.schedule import Schedule, SensingGroup
from cosim.traffic.streetside import ParkedParams, TreeParams
from results.columns import Level
from results.encounters import EncounterParams, check_definitions
from sensors.evidence import AreaParams
from sensors.lidar import LidarParams
from sensors.statistical_detector import DetectorParams
from sensors.tracking.params import TrackingParams
from sensors.weather import WeatherParams, check_weather
from sumo_nets import catalogue, sumocfg
from trust.params import TrustParams, differing_evidence_key

PAPER_RULE: dict[str, Any] = {
    "name": "paper",
    "fused": True,
    "unseen": "zero",
    "unevaluated": "value",
    "least_score": 0.0,
}
"""Trust variant that a run without a config file computes in addition: every detection is evidence, and one that no
other vehicle could see counts as 0, as in Hurl et al., TruPercept, 2020."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ComputeParams:
    """Use of the processor. No key of this section changes a result."""

    threads: Annotated[int, Ge(0), Le(1024)] = 0
    """Number of threads that divide the work of a step, at most one per core. 0 uses one per hundred equipped vehicles.
    Unless this is 1, one more thread computes the sensing of the next step in advance, and another one fuses and
    records the step before. They do not do so if a driver commands the traffic."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordParams:
    """What a run writes to its folder."""

    level: Level = "standard"
    """Which tables are written: `summary`, `standard` or `full`. See results/TABLES.md."""
    block_steps: Annotated[int, Ge(1), Le(1_000_000)] = 150
    """Number of steps between two writes to disk. A crash loses at most this many steps."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrustVariant:
    """A `[[trust_variant]]` section: another trust model, window or host that uses the same evaluations."""

    name: str
    """Name of the variant in the column `variant` of the tables."""
    fused: bool = False
    """Whether the fused objects of this variant are written to the table `fused` as well."""
    changes: dict[str, Any] = field(default_factory=dict)
    """The keys of [trust] that this variant changes, as written in the config."""
    trust: TrustParams = field(default_factory=TrustParams)
    """The section [trust] with these changes."""
    own: dict[str, Any] = field(default_factory=dict)
    """Parameters that only the chosen trust model has."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Config:
    """One experiment."""

    preset: str = field(default_factory=lambda: preset.DEFAULT)
    """Set of keys that the config starts from: `modern` or `paper`. Keys of the config come before those of the preset.
    See `cosim/config/presets`."""
    seed: Annotated[int, Ge(0), Le(2**63 - 1)] = 4
    """Seed of all random numbers except SUMO's."""
    sensing_interval_s: Annotated[float, Ge(0.1), Le(3600)] = 1.0
    """Time between two LiDAR sweeps of a vehicle, and between two of its messages [s]. It must be a multiple of
    traffic.step_s."""
    sensing_phase: Literal["common", "random"] = field(default_factory=partial(default_of, "sensing_phase"))
    """When vehicles sense within their intervals. `common`: all at the same time. `random`: each at a time of its own,
    drawn from its name, which is one of the traffic steps in an interval. Messages are then up to one interval old when
    they are used. `random` needs a traffic.step_s below the interval."""
    extrapolate: bool = field(default_factory=partial(default_of, "extrapolate"))
    """Whether a vehicle moves the objects of earlier messages by their velocities to the time of its own sweep, before
    it matches and evaluates them. Self reports have a speed; other objects have a velocity with [tracking]. Without it,
    a box is taken to be where its message says."""
    sensing_groups: tuple[SensingGroup, ...] = ()
    """Vehicles that sense at other intervals than sensing_interval_s."""
    sensing: bool = True
    """Whether vehicles sense, exchange messages and compute trust. If false, only traffic and encounters are simulated,
    which is faster."""
    traffic: TrafficParams = field(default_factory=partial(default_section, TrafficParams, "traffic"))
    fleet: FleetParams = field(default_factory=FleetParams)
    lidar: LidarParams = field(default_factory=partial(default_section, LidarParams, "lidar"))
    weather: WeatherParams = field(default_factory=WeatherParams)
    gnss: GnssParams = field(default_factory=partial(default_section, GnssParams, "gnss"))
    objects: tuple[ObjectParams, ...] = ()
    parked: ParkedParams = field(default_factory=ParkedParams)
    trees: TreeParams = field(default_factory=TreeParams)
    meshes: tuple[MeshParams, ...] = ()
    vehicle_meshes: tuple[VehicleMeshParams, ...] = ()
    area: AreaParams = field(default_factory=partial(default_section, AreaParams, "area"))
    detector: DetectorParams = field(default_factory=partial(default_section, DetectorParams, "detector"))
    tracking: TrackingParams = field(default_factory=partial(default_section, TrackingParams, "tracking"))
    attacks: tuple[AttackParams, ...] = ()
    cpm: CpmParams = field(default_factory=partial(default_section, CpmParams, "cpm"))
    early_fusion: EarlyFusionParams = field(default_factory=EarlyFusionParams)
    radio: RadioParams = field(default_factory=RadioParams)
    rsu: RsuParams = field(default_factory=RsuParams)
    roadside: tuple[RoadsideParams, ...] = ()
    server: ServerParams = field(default_factory=ServerParams)
    pseudonyms: PseudonymParams = field(default_factory=PseudonymParams)
    trust: TrustParams = field(default_factory=partial(default_section, TrustParams, "trust"))
    trust_variant: tuple[TrustVariant, ...] = ()
    driver: DriverParams = field(default_factory=DriverParams)
    encounters: tuple[EncounterParams, ...] = (EncounterParams(),)
    record: RecordParams = field(default_factory=RecordParams)
    compute: ComputeParams = field(default_factory=ComputeParams)
    own: dict[str, dict[str, Any]] = field(default_factory=dict, metadata={"internal": True})
    """Parameters of the chosen classes that their sections do not declare, by section (`trust`, `attacks.0`). In a
    config file they are keys of the section."""

    def __post_init__(self) -> None:
        if self.traffic.duration_s < self.traffic.step_s - 1e-9:
            raise ValueError(
                f"traffic.duration_s = {self.traffic.duration_s:g} s is shorter than one step of "
                f"{self.traffic.step_s:g} s. Set it to traffic.step_s or more."
            )
        check_definitions(self.encounters)
        if self.sensing:
            self._check_sensing()

    def _check_sensing(self) -> None:
        """Raise ValueError if what vehicles sense, exchange and compute cannot be. Without sensing it has no effect."""
        schedule = self.schedule  # checks the intervals
        if self.radio.timeout_s is not None and 2 * self.radio.timeout_s > schedule.shortest_s:
            raise ValueError(
                f"radio.timeout_s = {self.radio.timeout_s:g} s: the two messages of a sweep do not fit between two "
                f"sweeps of a vehicle, {schedule.shortest_s:g} s apart. Set it to half of that, or less."
            )
        turn_hz = self.lidar.rotation_hz
        if isinstance(turn_hz, float) and turn_hz * schedule.shortest_s < 1.0 - 1e-9:
            raise ValueError(
                f"lidar.rotation_hz = {turn_hz:g}: a sweep takes {1.0 / turn_hz:g} s, and the next one begins after "
                f"{schedule.shortest_s:g} s. Set it to {1.0 / schedule.shortest_s:g} or more, or a longer interval."
            )
        longest_s = schedule.longest_steps * self.traffic.step_s
        if self.tracking.model != "none" and self.tracking.keep_s < longest_s - 1e-9:
            raise ValueError(
                f"tracking.keep_s = {self.tracking.keep_s:g} s is shorter than the longest sensing interval, "
                f"{longest_s:g} s: every track would end before its object can be detected again. Set "
                "tracking.keep_s to two intervals or more."
            )
        hosts = [self.trust.host, *(variant.trust.host for variant in self.trust_variant)]
        has_units = self.rsu.at or self.rsu.n_at_junctions
        if self.server.uplink == "rsu" and "central" in hosts and not has_units:
            raise ValueError(
                'server.uplink = "rsu", but there are no roadside units, so no evaluation could reach the server. '
                "Set rsu.at or rsu.n_at_junctions."
            )
        check_vehicle_meshes(self.vehicle_meshes)
        check_weather(self.weather, self.lidar.max_range_m)
        if (self.meshes or self.vehicle_meshes) and self.lidar.engine == "columnar":
            which = "meshes" if self.meshes else "vehicle_meshes"
            raise ValueError(
                f'lidar.engine = "columnar" cannot cast rays at meshes, and the config has [[{which}]]. Set '
                'lidar.engine to "embree" or "open3d".'
            )
        check_attacks(self.attacks, self.trust.freshness_s, self.sensing_interval_s)
        jammers = [number for number, attack in enumerate(self.attacks) if attack.attack == "jamming"]
        if jammers and self.radio.model == "unit_disk":
            raise ValueError(
                f'attacks.{jammers[0]}.attack = "jamming" has no effect with radio.model = "unit_disk", which does not '
                'model interference. Set radio.model = "csma", "nr_mode2" or "lte_mode4".'
            )
        relay = self.radio.relay
        if relay.min_trust and relay.max_hops > 1 and self.trust.host == "none":
            raise ValueError(
                f'radio.relay.min_trust = {relay.min_trust:g}, but trust.host = "none": nobody has trust in '
                'anyone. Set trust.host = "central" or "local", or radio.relay.min_trust = 0.'
            )
        check_evidence(self)
        check_early_fusion(self)
        check_server(self.pseudonyms, self.attacks, hosts)

    @property
    def schedule(self) -> Schedule:
        """When each equipped vehicle senses. Without sensing, the keys that say so have no effect."""
        if not self.sensing:
            return Schedule.of(self.traffic.step_s, "common", (), self.traffic.step_s, self.seed)
        return Schedule.of(
            self.sensing_interval_s, self.sensing_phase, self.sensing_groups, self.traffic.step_s, self.seed
        )

    @property
    def sense_every_steps(self) -> int:
        """Steps between two sweeps of the vehicles that belong to no group."""
        return round(self.sensing_interval_s / self.traffic.step_s)

    @property
    def n_steps(self) -> int:
        return max(1, math.floor(self.traffic.duration_s / self.traffic.step_s + 1e-9))

    @property
    def message_lifetime_s(self) -> float:
        """Longest time that the detection messages of a step may take [s]; evaluation messages have twice that."""
        return self.radio.lifetime_s(self.schedule.shortest_s)

    @property
    def round_s(self) -> float:
        """Length of one round of messages [s]: two rounds fit between two steps in which vehicles sense.

        It is the lifetime of messages where all vehicles sense together. Otherwise it is shorter, and messages go on in
        the rounds that follow.
        """
        between_s = self.schedule.exchange_interval_s
        return self.message_lifetime_s if 2 * self.message_lifetime_s <= between_s else 0.4 * between_s

    def to_dict(self) -> dict[str, Any]:
        """The resolved config as plain data, with the keys that a config file has."""
        data = asdict(self)
        data["trust_variant"] = [
            {"name": v.name, "fused": v.fused} | copy.deepcopy(v.changes) for v in self.trust_variant
        ]
        for place, values in data.pop("own").items():
            section, _, number = place.partition(".")
            keys = data[section][int(number)] if number else data[section]
            keys.update(values)
        return data


def check_evidence(config: Config) -> None:
    """Raise ValueError, in one line, if the config lacks what `trust.evidence` needs."""
    evidence = config.trust.evidence
    if "speed" in evidence and config.tracking.model == "none":
        raise ValueError(
            'trust.evidence names "speed", but vehicles do not track objects, so they know no velocities. Set '
            'tracking.model = "constant_velocity", or remove "speed".'
        )
    if "missing" not in evidence:
        return
    if not config.trust.self_reports:
        raise ValueError(
            'trust.evidence names "missing", but trust.self_reports = false: where the sender of a message stands is '
            'not known. Set trust.self_reports = true, or remove "missing".'
        )
    if config.cpm.rules != "all" or config.cpm.redundancy != "none":
        key = "rules" if config.cpm.rules != "all" else "redundancy"
        raise ValueError(
            f'trust.evidence names "missing", but cpm.{key} = "{getattr(config.cpm, key)}" leaves objects out of '
            "messages, which cannot be told from withheld ones. Set "
            f'cpm.{key} = "{"all" if key == "rules" else "none"}", or remove "missing".'
        )


def check_early_fusion(config: Config) -> None:
    """Raise ValueError, in one line, if the clouds that vehicles share cannot be sent or merged."""
    early, model = config.early_fusion, config.detector.model
    if early.share == "none":
        return
    if model == "ideal" or is_own(model):
        raise ValueError(
            f'early_fusion.share = "{early.share}" needs a detector that can be asked about numbers of returns; '
            f'detector.model = "{model}" cannot. Set it to "avod", "pointpillars" or "pv_rcnn".'
        )
    if early.medium == "radio" and config.radio.relay.max_hops > 1:
        raise ValueError(
            f'early_fusion.share = "{early.share}" with radio.relay.max_hops = {config.radio.relay.max_hops}: point '
            'clouds are not forwarded. Set radio.relay.max_hops = 1, or early_fusion.medium = "unlimited".'
        )


def chosen(config: Config, section: str, number: int | None = None) -> tuple[Choice, Any]:
    """The class that a section names, and an object with its parameters (None if it has no parameters)."""
    params, place = getattr(config, section), section
    if number is not None:
        params, place = params[number], f"{section}.{number}"
    return _chosen(section, params, config.own.get(place, {}))


def chosen_model(variant: TrustVariant) -> tuple[Choice, Any]:
    """The trust model of a variant, and an object with its parameters (None if it has no parameters)."""
    return _chosen("trust", variant.trust, variant.own)


def _chosen(section: str, params: Any, own: dict[str, Any]) -> tuple[Choice, Any]:
    """The class that a section names, and its parameters: those that the section declares, and its own ones."""
    kind = SECTIONS[section]
    choice = resolve(kind, getattr(params, kind.key))
    if choice.params is None:
        return choice, None
    if isinstance(params, choice.params):
        return choice, params
    shared = {f.name: getattr(params, f.name, None) for f in fields(choice.params)}
    shared = {name: value for name, value in shared.items() if value is not None}  # own defaults for unset keys
    return choice, _params(choice, shared | own, section, "the config")


def _params(choice: Choice, data: dict[str, Any], prefix: str, where: str) -> Any:
    """Build the parameters of a chosen class from plain data. A mistake raises a ValueError of one line."""
    if not choice.is_own or choice.params is None:
        return validated(choice.params, data, prefix, where)
    file = choice.source.file
    line = definition_line(choice.params, "", file)
    with at_load(file, choice.title, "Params cannot be read", line, passes=ValueError):
        return validated(choice.params, data, prefix, where)


def load(path: str | Path | None = None, overrides: Sequence[str] | None = None, trust_code: bool = False) -> Config:
    """Read a config from a TOML file and apply `key=value` overrides.

    Parameters
    ----------
    path
        The TOML file. None uses the defaults.
    overrides
        Texts such as `radio.range_m=150`, applied in order.
    trust_code
        Whether Python files that the config of a run folder names may be loaded.

    Raises
    ------
    ValueError
        The config has a mistake; the message is one line.
    """
    path = None if path is None else Path(path)
    data = with_defaults({} if path is None else read_toml(path, "config file"))
    for text in [overrides] if isinstance(overrides, str) else overrides or []:
        override(data, text)
    if path is not None:
        with loading_code_of(path, trust_code):
            return resolve_data(data, path.name, path.parent)
    if data.get("server", {}).get("uplink") != "rsu":  # with it, every variant would load the channel
        data.setdefault("trust_variant", [copy.deepcopy(PAPER_RULE)])
    return resolve_data(data, "the config", None)


def with_defaults(data: dict[str, Any]) -> dict[str, Any]:
    """Plain data, completed with the default lists of sections that it leaves out."""
    return {"attacks": copy.deepcopy(list(PAPER)), "encounters": [{}]} | data


def resolve_data(data: dict[str, Any], where: str, folder: Path | None) -> Config:
    """Build a config from plain data. The function modifies `data`.

    Parameters
    ----------
    where
        Name of the file or of the source of `data`, for error messages.
    folder
        Folder to which relative paths in `data` are relative; None for the present one.
    """
    variants = data.pop("trust_variant", [])
    traffic = data.get("traffic")
    has_step = isinstance(traffic, dict) and bool({"step_s", "trace"} & traffic.keys())  # without that of the preset
    _begin_together(data.get("attacks"))
    preset.under(data, where)
    own = _take_own_of_all(data, where, folder)
    check_keys(data, Config, "", where)
    _make_paths_absolute(data, folder or Path())
    if not has_step:
        _take_step_of_sumocfg(data.get("traffic", {}))
    config = validated(Config, data, "", where)
    config = replace(config, own={section: values for section, values in own.items() if values})
    trust = data["trust"] | own.get("trust", {})
    return replace(config, trust_variant=_variants(variants, trust, config, where, folder))


def _begin_together(attacks: Any) -> None:
    """Let sections of attackers of an earlier section begin with it, unless they say when. Wrong values stay."""
    listed = attacks if isinstance(attacks, list) else []
    for number, section in enumerate(listed):
        earlier = section.get("together_with") if isinstance(section, dict) else None
        if type(earlier) is not int or not 0 <= earlier < number:
            continue
        if isinstance(first := listed[earlier], dict) and "start_s" in first:
            section.setdefault("start_s", first["start_s"])


def _take_own_of_all(
    data: dict[str, Any],
    where: str,
    folder: Path | None,
) -> dict[str, dict[str, Any]]:
    """Remove the parameters of chosen classes that their sections do not declare; returns them as `Config.own`.

    Values of a wrong type are left for the checks that follow.
    """
    own: dict[str, dict[str, Any]] = {}
    types = {f.name: f.type for f in fields(Config)}
    for section in SECTIONS:
        if section == "attacks":
            listed = data.get(section)
            for number, item in enumerate(listed if isinstance(listed, list) else ()):
                if isinstance(item, dict):
                    if item.get("attack") == "unreliable":
                        item.setdefault("role", "unreliable")
                    place = f"{section}.{number}"
                    own[place] = _take_own(item, section, place, AttackParams, where, folder)
            continue
        given = data.setdefault(section, {})
        if isinstance(given, dict):
            own[section] = _take_own(given, section, section, types[section], where, folder)
    return own


def _make_paths_absolute(data: dict[str, Any], folder: Path) -> None:
    """Make the paths of the traffic and of meshes absolute. Names of cities stay as they are."""
    for name in ("scenario", "trace"):
        given = data.get("traffic", {}).get(name)
        if isinstance(given, str):
            cities = catalogue.names() if name == "scenario" else ()
            data["traffic"][name] = resolved_input(given, folder, cities)
    for mesh in [*data.get("meshes", []), *data.get("vehicle_meshes", [])]:
        if isinstance(mesh.get("file"), str):
            mesh["file"] = str((folder / mesh["file"]).resolve())


def of_run(recorded: Mapping[str, Any], folder: Path, trust_code: bool = False) -> Config:
    """The config in the manifest of a run folder. Python files that it names are loaded only with `trust_code`."""
    if "preset" not in recorded:
        raise ValueError(f"{folder}/manifest.json names no preset: an earlier cosim wrote the run. Run again.")
    with loading_code(folder, trust_code):
        return resolve_data(copy.deepcopy(dict(recorded)), f"{folder}/manifest.json", None)


def of_run_without_code(recorded: Mapping[str, Any], folder: Path) -> Config:
    """The config of a run, with the default choice in place of each class of the user's own. No user code is loaded.

    This is sufficient for casting sweeps again, because sweeps depend on none of these classes.
    """
    data = copy.deepcopy(dict(recorded))
    for section, kind in SECTIONS.items():
        listed = data.get(section)
        if isinstance(listed, list):
            data[section] = [item for item in listed if not _names_own_class(item, kind.key)]
        elif _names_own_class(listed, kind.key):
            del data[section]
    variants = data.get("trust_variant") or ()
    if "trust" not in data or any(_names_own_class(variant, "model") for variant in variants):
        data["trust_variant"] = []
    return of_run(data, folder)


def _names_own_class(section: Any, key: str) -> bool:
    """Whether a section names a class of the user's own."""
    return isinstance(section, dict) and isinstance(name := section.get(key), str) and is_own(name)


def _variants(
    sections: Any, trust: dict[str, Any], config: Config, where: str, folder: Path | None
) -> tuple[TrustVariant, ...]:
    """Build the trust variants from their sections.

    Each variant inherits the keys of [trust], which are `trust`. One of another model inherits none of the parameters
    of the model of [trust], also where its own has one of the same name.
    """
    if not isinstance(sections, list) or not all(isinstance(section, dict) for section in sections):
        raise ValueError(f"trust_variant should be a list of sections [[trust_variant]] in {where}.")
    made: list[TrustVariant] = []
    declared = {f.name for f in fields(TrustParams)}
    for number, section in enumerate(sections):
        place = f"trust_variant.{number}"
        model, inherited = section.get("model", config.trust.model), trust
        if isinstance(model, str):
            named = resolve(SECTIONS["trust"], model, folder).source.name
            if named != config.trust.model:
                inherited = {key: trust[key] for key in trust.keys() & declared}
        variant = _variant(section, inherited, place, where, folder)
        if variant.name == "base" or variant.name in {other.name for other in made}:
            by = " by [trust] itself" if variant.name == "base" else ""
            raise ValueError(
                f'{place}.name = "{variant.name}" is taken{by}. Give every variant a name of its own in {where}.'
            )
        if key := differing_evidence_key(config.trust, variant.trust):
            raise ValueError(
                f'{place} ("{variant.name}"): {key} changes the evaluations, so this variant cannot share the evidence '
                "of the run. Remove the key here, or make the variant a separate run."
            )
        made.append(variant)
    return tuple(made)


def _variant(
    section: dict[str, Any],
    trust: dict[str, Any],
    place: str,
    where: str,
    folder: Path | None,
) -> TrustVariant:
    """Build a trust variant, `place` in the config, which inherits the keys `trust`."""
    changes = dict(section)
    name, fused = changes.pop("name", None), changes.pop("fused", False)
    if not isinstance(name, str) or not name or not name.isprintable():
        raise ValueError(f"{place}.name = {name!r}: a variant must have a name. Set {place}.name in {where}.")
    if not isinstance(fused, bool):
        raise ValueError(f"{place}.fused = {fused!r} should be true or false. Set it in {where}.")
    merged = trust | changes
    own = _take_own(merged, "trust", place, TrustParams, where, folder)
    if "model" in changes:
        changes["model"] = merged["model"]
    check_keys(merged, TrustParams, f"{place}.", where)
    params = validated(TrustParams, merged, place, where)
    return TrustVariant(name=name, fused=fused, changes=changes, trust=params, own=own)


def _take_own(
    section: dict[str, Any],
    name: str,
    place: str,
    declared: Any,
    where: str,
    folder: Path | None,
) -> dict[str, Any]:
    """Remove the chosen class's own parameters from a section, check them and return them.

    `name` is that of the section, `place` where the user wrote it (`attacks.0`), `declared` its dataclass. The name of
    the class in the section becomes absolute.
    """
    kind = SECTIONS[name]
    default = next(f.default for f in fields(declared) if f.name == kind.key)
    given = section.get(kind.key, default)
    if not isinstance(given, str):
        return {}  # validation of the section reports the wrong type
    choice = resolve(kind, given, folder)
    if kind.key in section:
        section[kind.key] = choice.source.name
    if choice.params is None or issubclass(declared, choice.params):
        return {}
    of_section = {f.name for f in fields(declared)}
    of_class = {f.name for f in fields(choice.params)} - of_section
    taken = {key: section.pop(key) for key in list(section) if key in of_class}
    if unknown := [key for key in section if key not in of_section]:
        raise unknown_key(unknown[0], sorted(of_section | of_class), f"{place}.", where)
    check_finite(taken, place, where)
    values = asdict(_params(choice, taken, place, where))
    own = {key: value for key, value in values.items() if key in of_class}
    _check_plain(own, choice)
    check_finite(own, place, choice.source.file or where)
    return own


def _check_plain(own: dict[str, Any], choice: Choice) -> None:
    """Raise ValueError for a parameter of a chosen class whose value a config file cannot contain."""
    for key, value in own.items():
        if not is_plain(value):
            assert choice.params is not None
            file = choice.source.file
            line = definition_line(choice.params, "", file)
            raise ValueError(
                f"{file}:{line}: {choice.title}: Params.{key} is a {type(value).__name__}, which a "
                "config file cannot contain. Use text, a number, true or false, or a list of these."
            )


def _take_step_of_sumocfg(traffic: dict[str, Any]) -> None:
    """Set traffic.step_s to the step length of the user's own .sumocfg, unless the preset's is shorter."""
    scenario = traffic.get("scenario")
    if not isinstance(scenario, str) or scenario in catalogue.names():
        return
    path = Path(scenario)
    found = [path] if sumocfg.is_sumocfg(path) else sumocfg.in_folder(path)
    if len(found) != 1:
        return
    step_s = sumocfg.step_s(found[0])
    if step_s < SHORTEST_STEP_S:
        raise ValueError(
            f"{found[0]}: its step-length of {step_s:g} s is shorter than {SHORTEST_STEP_S:g} s, the shortest that is "
            f"supported. Set traffic.step_s to {SHORTEST_STEP_S:g} or more to simulate it with a longer step."
        )
    traffic["step_s"] = min(step_s, traffic.get("step_s", step_s))
