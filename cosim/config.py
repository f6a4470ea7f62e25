"""The board where every room nails its knobs: one typed experiment, from TOML and `--set`."""

import difflib
import json
import math
import tomllib
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from annotated_types import Ge
from pydantic import TypeAdapter, ValidationError

from cosim.fleet import FleetParams
from cosim.mobility.params import TrafficParams, resolved_input
from cosim.v2x.adversary import AdversaryParams
from cosim.v2x.radio import RadioParams
from cosim.v2x.roadside import RoadsideParams
from cosim.v2x.server import ServerParams
from results.encounters import EncounterParams
from results.tables import Level
from sensors.detector import DetectorParams
from sensors.evidence import AreaParams
from sensors.lidar import LidarParams
from sumo_nets import catalogue, sumocfg
from trust.params import TrustParams


@dataclass(frozen=True, kw_only=True, slots=True)
class ComputeParams:
    """How the work is done; nothing here changes a result."""

    threads: Annotated[int, Ge(0)] = 0
    """Threads of the compiled kernels, at most one per core; 0 takes one for every hundred equipped vehicles."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordParams:
    """What is kept of a run."""

    level: Level = "standard"
    """Which tables: summary, standard or full; see results/TABLES.md."""
    block_steps: Annotated[int, Ge(1)] = 60
    """Steps between two writes to disk; a crash loses at most one block."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Config:
    """One experiment."""

    seed: Annotated[int, Ge(0)] = 4
    """Seed of everything but SUMO."""
    sensing_interval_s: Annotated[float, Ge(0.1)] = 1.0
    """Time between two sweeps of every LiDAR, and two rounds of messages [s]; a multiple of traffic.step_s."""
    traffic: TrafficParams = field(default_factory=TrafficParams)
    fleet: FleetParams = field(default_factory=FleetParams)
    lidar: LidarParams = field(default_factory=LidarParams)
    area: AreaParams = field(default_factory=AreaParams)
    detector: DetectorParams = field(default_factory=DetectorParams)
    adversary: AdversaryParams = field(default_factory=AdversaryParams)
    radio: RadioParams = field(default_factory=RadioParams)
    rsu: RoadsideParams = field(default_factory=RoadsideParams)
    server: ServerParams = field(default_factory=ServerParams)
    trust: TrustParams = field(default_factory=TrustParams)
    encounters: tuple[EncounterParams, ...] = (EncounterParams(),)
    record: RecordParams = field(default_factory=RecordParams)
    compute: ComputeParams = field(default_factory=ComputeParams)

    def __post_init__(self) -> None:
        steps = self.sensing_interval_s / self.traffic.step_s
        if abs(steps - round(steps)) > 1e-9 or steps < 1:
            raise ValueError(
                f"sensing_interval_s = {self.sensing_interval_s:g} s is no multiple of traffic.step_s = "
                f"{self.traffic.step_s:g} s: a sweep needs a step to happen in. Change one of them."
            )
        if self.radio.timeout_s is not None and 2 * self.radio.timeout_s > self.sensing_interval_s:
            raise ValueError(
                f"radio.timeout_s = {self.radio.timeout_s:g} s: two rounds of messages do not fit between two sweeps, "
                f"sensing_interval_s = {self.sensing_interval_s:g} s apart. Set it to half of that, or less."
            )

        if self.server.uplink == "rsu" and not (self.rsu.at or self.rsu.n_at_junctions):
            raise ValueError(
                'server.uplink = "rsu", but there are no roadside units: nothing would ever reach the server. '
                "Set rsu.at or rsu.n_at_junctions."
            )

    @property
    def sense_every_steps(self) -> int:
        return round(self.sensing_interval_s / self.traffic.step_s)

    @property
    def n_steps(self) -> int:
        return max(1, math.floor(self.traffic.duration_s / self.traffic.step_s + 1e-9))

    def to_dict(self) -> dict[str, Any]:
        """The resolved experiment, as plain data."""
        return asdict(self)


def load(path: Path | None = None, overrides: list[str] | None = None) -> Config:
    """Experiment from a TOML file, then from `key=value` overrides; ValueError in one line for a mistake."""
    data: dict[str, Any] = {}
    where = "the config"
    if path is not None:
        where = path.name
        try:
            data = tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ValueError(f"{path}: no such config file. Give the path of a TOML file, or none.") from None
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: cannot be read as a config file: {error}.") from None
        except tomllib.TOMLDecodeError as error:
            raise ValueError(f"{path}: not valid TOML: {error}.") from None
    for text in overrides or []:
        _override(data, text)
    _check_keys(data, Config, "", where)
    for name in ("scenario", "trace"):
        given = data.get("traffic", {}).get(name)
        if isinstance(given, str):
            folder = path.parent if path is not None else Path("/nonexistent")
            data["traffic"][name] = resolved_input(given, folder, catalogue.names() if name == "scenario" else ())
    traffic = data.get("traffic", {})
    if isinstance(traffic.get("scenario"), str) and not {"step_s", "trace"} & traffic.keys():
        if (own_s := _own_step_s(traffic["scenario"])) is not None:
            traffic["step_s"] = own_s
    try:
        return TypeAdapter(Config).validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(p) for p in first["loc"])
        if first["type"] == "value_error":
            raise ValueError(first["msg"].removeprefix("Value error, ")) from None
        if first["type"] == "missing":
            raise ValueError(f"{name}: missing. Set {name} in {where}.") from None
        reason = first["msg"].removeprefix("Input should be ")
        raise ValueError(f"{name} = {first['input']!r} should be {reason}. Set {name} in {where}.") from None


def _own_step_s(scenario: str) -> float | None:
    """How long a step of the user's own .sumocfg is."""
    path = Path(scenario)
    found = [path] if path.name.endswith(".sumocfg") else sorted(path.glob("*.sumocfg"))
    if len(found) != 1 or not found[0].is_file() or scenario in catalogue.names():
        return None
    if (own_s := sumocfg.step_s(found[0])) < 0.1:
        raise ValueError(
            f"{found[0]}: its step-length of {own_s:g} s is shorter than the 0.1 s that a step takes here at least. "
            "Set traffic.step_s to 0.1 or more to drive it otherwise."
        )
    return own_s


def _override(data: dict[str, Any], text: str) -> None:
    name, sign, value = text.partition("=")
    if not sign or not name.strip():
        raise ValueError(f"--set {text}: no key=value. Write for example --set radio.reach_m=150.")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value
    *sections, last = name.strip().split(".")
    for section in sections:
        data = data.setdefault(section, {})
        if not isinstance(data, dict):
            raise ValueError(f"--set {text}: {section} is a value, not a section.")
    data[last] = parsed


def _check_keys(data: dict[str, Any], model: Any, prefix: str, where: str) -> None:
    known = {f.name: f for f in fields(model)}
    for name, value in data.items():
        full = prefix + name
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"Did you mean {prefix}{near[0]}?" if near else f"Known: {', '.join(known)}."
            raise ValueError(f"{full}: unknown key in {where}. {hint}")
        if get_origin(known[name].type) is tuple and is_dataclass(model_of := get_args(known[name].type)[0]):
            if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
                raise ValueError(f"{full} should be a list of sections [[{full}]] in {where}.")
            for item in value:
                _check_keys(item, model_of, full + ".", where)
        elif is_dataclass(known[name].type):
            if not isinstance(value, dict):
                raise ValueError(f"{full} = {value!r} should be a section [{full}] in {where}.")
            _check_keys(value, known[name].type, full + ".", where)
        elif isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{full} = {value}: not a finite number. Set {full} in {where}.")
