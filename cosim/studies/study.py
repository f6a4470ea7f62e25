"""A study file: a base config, the swept keys, replicates, limits, and the tables and metrics to keep."""

import copy
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le

from cosim.base.bounds import Share
from cosim.config import config as configs
from cosim.config import data as config_data
from cosim.door.kinds import KINDS
from cosim.door.load import function
from cosim.door.permission import loading_code, loading_code_of, untrusted
from cosim.runs.manifest import toml_text
from cosim.traffic.params import TrafficParams
from results.metrics.registry import TOPICS
from results.tables import TABLES

Keys = Mapping[str, Any]
"""Swept keys of the config and their values at one point."""

SECTIONS = ("study", "base", "grid", "zip", "limits", "keep", "measure")


@dataclass(frozen=True, kw_only=True, slots=True)
class Head:
    """The section `[study]`."""

    name: str
    """Name of the study. The folder of a study belongs to one name."""
    question: str = ""
    """The question of the study, for its report."""
    config: str = ""
    """Config that all points start from; empty for the default city. `[base]` changes it."""
    replicates: Annotated[int, Ge(1), Le(1000)] = 1
    """Runs per combination. Replicate r adds r to `seed` and to `traffic.seed`."""
    baseline: dict[str, Any] = field(default_factory=dict)
    """Swept keys and values of the combinations with which the others are compared."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """Limits of a run: the section `[limits]`."""

    retries: Annotated[int, Ge(0)] = 1
    """Number of further attempts if a run fails."""
    timeout_s: Annotated[float, Gt(0)] = 86_400.0
    """Longest duration of one attempt [s]."""
    memory_gb: Annotated[float, Gt(0)] = 8.0
    """Largest resident memory of a run [GB]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Keep:
    """What is measured and kept of every run: the section `[keep]`."""

    topics: tuple[str, ...] = ()
    """Topics of the metrics to measure when a run ends; empty for all."""
    tables: tuple[str, ...] | None = None
    """Tables to keep on disk; if unset, all that `record.level` keeps."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Measuring:
    """Options of the metrics: the section `[measure]`."""

    threshold: Share | None = None
    """A subject with less trust than this is suspected; by default `trust.suspect_below`."""
    fresh_s: Annotated[float, Ge(0)] = 10.0
    """Trust is fresh up to this age [s]."""
    false_positives: Share = 0.05
    """False positive rate at which recall is reported."""
    own: str = ""
    """The user's own metrics, as path.py:name or package.module:name: a function of a `results.run.Run` that returns
    columns metric, group, value, unit and label, with one row for each metric and group; empty for none."""


@dataclass(frozen=True, slots=True)
class Study:
    """A study that has been read and checked."""

    head: Head
    limits: Limits
    keep: Keep
    measuring: Measuring
    base: dict[str, Any]
    """Plain data of the config that all points start from, with absolute paths."""
    axes: tuple[tuple[Keys, ...], ...]
    """For each axis, the keys and values that it sets. A point takes one item of every axis."""
    untrusted: str = ""
    """Where it was read, if code that it names may not be loaded."""

    @property
    def keys(self) -> tuple[str, ...]:
        """Swept keys, in the order of the file."""
        return tuple(key for axis in self.axes for key in axis[0])

    def combinations(self) -> list[dict[str, Any]]:
        """All combinations of the swept keys, without replicates, in the order of the file."""
        found = []
        for parts in itertools.product(*self.axes):
            keys: dict[str, Any] = {}
            for part in parts:
                keys |= part
            found.append(keys)
        return found

    def to_toml(self) -> str:
        """The study as TOML. Its base is complete and needs no other file."""
        head = asdict(self.head)
        del head["config"]
        grid: dict[str, Any] = {}
        zips = []
        for axis in self.axes:
            columns = {key: [row[key] for row in axis] for key in axis[0]}
            if len(columns) == 1:
                grid |= columns
            else:
                zips.append(columns)
        data = {
            "study": head,
            "limits": asdict(self.limits),
            "keep": asdict(self.keep),
            "measure": asdict(self.measuring),
            "base": self.base,
            "grid": grid,
            "zip": zips,
        }
        return toml_text(data)


SHIPPED = Path(__file__).parent / "shipped"


def load(path: Path, trust_code: bool = False) -> Study:
    """Read a study from its TOML file, or a shipped study by name.

    Code that the study, or the config that it starts from, names is loaded, unless the file is part of a run or a
    study. `trust_code` allows that too.

    Raises
    ------
    ValueError
        In one line, if the file has a mistake.
    """
    shipped = SHIPPED / f"{path.name}.toml"
    if path.parent == Path() and not path.is_file() and shipped.is_file():
        path = shipped
    if not path.exists():
        names = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
        raise ValueError(f"{path}: no such study. Give the path of a TOML file, or a study that ships: {names}.")
    data = config_data.read_toml(path, "study file")
    with loading_code_of(path, trust_code):
        return _study(data, path, trust_code)


def _study(data: dict[str, Any], path: Path, trust_code: bool) -> Study:
    """The study that plain data of the file `path` state."""
    where = path.name
    for name in data:
        if name not in SECTIONS:
            raise ValueError(
                f"{name}: unknown section in {where}. A study has {', '.join(f'[{s}]' for s in SECTIONS)}."
            )
    head = _section(Head, {"name": path.stem} | data.get("study", {}), "study", where)
    if not head.name.strip():
        raise ValueError(f"study.name in {where} is empty. Leave it out: the study then has the name of its file.")
    keep = _section(Keep, data.get("keep", {}), "keep", where)
    wanted = {"topics": (TOPICS, keep.topics), "tables": (TABLES, keep.tables or ())}
    for what, (known, given) in wanted.items():
        if unknown := [name for name in given if name not in known]:
            raise ValueError(f"keep.{what}: there is no {unknown[0]!r}. There are {', '.join(known)}. Change {where}.")
    measuring = _section(Measuring, data.get("measure", {}), "measure", where)
    if measuring.own:
        measuring = replace(measuring, own=_beside("measure.own", measuring.own, path.parent))
        function(f"measure.own in {where}", measuring.own)
    base = configs.with_defaults({})
    if head.config:
        beside = path.parent / head.config
        named = beside if beside.is_file() else Path(head.config)
        with loading_code_of(named, trust_code):
            base = _absolute(config_data.read_toml(named, "config file"), named.name, named.parent)
    merge(base, data.get("base", {}))
    base = _absolute(base, f"[base] of {where}", path.parent)
    if "trust_variant" in base:
        raise ValueError(
            f"trust_variant in {where}: a study makes its trust variants itself. Sweep keys of [trust] in [grid]."
        )

    def with_paths(row: Keys) -> Keys:
        return {key: _beside(key, value, path.parent) for key, value in row.items()}

    axes = tuple(tuple(map(with_paths, axis)) for axis in _axes(data, where))
    limits = _section(Limits, data.get("limits", {}), "limits", where)
    study = Study(head, limits, keep, measuring, base, axes, untrusted(path, trust_code))
    for key, value in head.baseline.items():
        if key not in study.keys:
            raise ValueError(
                f"study.baseline names {key}, which is not swept in {where}. Swept: {', '.join(study.keys)}."
            )
        if not any(part.get(key) == value for axis in axes for part in axis):
            raise ValueError(f"study.baseline: {key} = {value!r} is none of its values in {where}. Take one of them.")
    return replace(study, head=replace(head, baseline=_baseline(study, where)))


def _baseline(study: Study, where: str) -> dict[str, Any]:
    """The baseline with values as the swept keys have them, 10 in place of 10.0.

    Of keys that change together, those that it leaves out are added if one row alone is meant.
    """
    found: dict[str, Any] = {}
    for axis in study.axes:
        wanted = [key for key in study.head.baseline if key in axis[0]]
        stated = {key: study.head.baseline[key] for key in wanted}
        rows = [row for row in axis if {key: row[key] for key in wanted} == stated]
        if not rows:
            said = " and ".join(f"{key} = {value!r}" for key, value in stated.items())
            raise ValueError(f"study.baseline: no row of [[zip]] in {where} has {said}. Take the values of one row.")
        is_one = wanted and len(rows) == 1
        for key in axis[0] if is_one else wanted:
            found[key] = rows[0][key]
    return found


def changed(study: Study, overrides: Sequence[str]) -> Study:
    """A study with `key=value` changes of the config that all points start from.

    Raises
    ------
    ValueError
        In one line, if a text is no change, or if the study sweeps the key.
    """
    base = copy.deepcopy(study.base)
    for text in overrides:
        if (key := text.partition("=")[0].strip()) in study.keys:
            raise ValueError(f"--set {text}: the study sweeps {key}. Change its values in [grid].")
        config_data.override(base, text)
    if overrides:
        configs.resolve_data(copy.deepcopy(base), "the study", None)
    return replace(study, base=base)


def config_at(study: Study, keys: Keys, replicate: int, where: str) -> configs.Config:
    """The config of a point."""
    data = copy.deepcopy(study.base)
    for key, value in keys.items():
        config_data.assign(data, key, copy.deepcopy(value), f"{key} in {where}")
    traffic = data.setdefault("traffic", {})
    for section, seed in ((data, configs.Config().seed), (traffic, TrafficParams().seed)):
        stated = section.get("seed", seed)
        section["seed"] = stated + replicate if isinstance(stated, int) else stated
    said = ", ".join(f"{k} = {v}" for k, v in keys.items())
    with loading_code(study.untrusted, not study.untrusted):
        return configs.resolve_data(data, f"{where} (point {said})", None)


def _absolute(stated: dict[str, Any], where: str, folder: Path) -> dict[str, Any]:
    """The keys that a study states, checked, with absolute paths of the user's own files."""
    stated = configs.with_defaults(stated)
    complete = configs.resolve_data(copy.deepcopy(stated), where, folder.resolve()).to_dict()
    named = [("traffic", "scenario"), ("traffic", "trace"), ("meshes", "file"), ("vehicle_meshes", "file")]
    named += [(kind.section, kind.key) for kind in KINDS.values() if kind.section]
    for section, key in named:
        pairs = [(stated.get(section, {}), complete[section])]
        if isinstance(complete[section], tuple):
            pairs = list(zip(stated.get(section, []), complete[section], strict=True))
        for given, found in pairs:
            if key in given:
                given[key] = found[key]
    return stated


def _beside(key: str, value: Any, folder: Path) -> Any:
    """The absolute path if a value names a file in the study's folder; otherwise the value itself."""
    if not isinstance(value, str):
        return value
    file, colon, name = value.rpartition(":") if ".py:" in value else (value, "", "")
    is_name = colon or key.endswith(("traffic.scenario", "traffic.trace", ".file"))
    if is_name and (folder / file).exists():
        return str((folder / file).resolve()) + colon + name
    return value


def merge(data: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Changes into plain data, section by section; dotted keys may be quoted or not."""
    for key, value in changes.items():
        if isinstance(value, Mapping):
            inner = data.setdefault(key, {})
            if isinstance(inner, dict):
                merge(inner, value)
                continue
        if "." in key:
            config_data.assign(data, key, copy.deepcopy(value), f"{key} in [base]")
        else:
            data[key] = copy.deepcopy(value)


def _section(model: type, given: Any, name: str, where: str) -> Any:
    if not isinstance(given, dict):
        raise ValueError(f"{name} should be a section [{name}] in {where}.")
    known = [f.name for f in fields(model)]
    if unknown := [key for key in given if key not in known]:
        raise config_data.unknown_key(unknown[0], known, f"{name}.", where)
    return config_data.validated(model, given, name, where)


def _axes(
    data: Mapping[str, Any],
    where: str,
) -> tuple[tuple[Keys, ...], ...]:
    """Axes of the grid and of the sections `[[zip]]`."""
    grid, zips = data.get("grid", {}), data.get("zip", [])
    if not isinstance(grid, dict):
        raise ValueError(f"grid should be a section [grid] in {where}.")
    if not isinstance(zips, list) or not all(isinstance(z, dict) for z in zips):
        raise ValueError(f"zip should be a list of sections [[zip]] in {where}.")
    axes: list[tuple[Keys, ...]] = []
    for key, values in config_data.leaves(grid):
        stated = _once(f"grid: {key}", _values(key, values, "grid", where), where)
        axes.append(tuple({key: value} for value in stated))
    for section in zips:
        columns = {key: _values(key, values, "zip", where) for key, values in config_data.leaves(section)}
        lengths = {key: len(values) for key, values in columns.items()}
        if len(set(lengths.values())) > 1:
            said = ", ".join(f"{key} has {n}" for key, n in lengths.items())
            raise ValueError(f"[[zip]] in {where}: values that change together must be as many of each key: {said}.")
        if columns:
            together = zip(*columns.values(), strict=True)
            rows = [dict(zip(columns, row, strict=True)) for row in together]
            axes.append(tuple(_once("[[zip]]", rows, where)))
    if not axes:
        raise ValueError(
            f"{where} sweeps nothing. Give [grid] at least one key with a list of values; one value is enough for "
            "replicates of one config."
        )
    names = [key for axis in axes for key in axis[0]]
    if twice := [key for key in names if names.count(key) > 1]:
        raise ValueError(f"{twice[0]} is swept twice in {where}. Leave it in one place.")
    if seeds := [key for key in names if key in ("seed", "traffic.seed")]:
        raise ValueError(f"{seeds[0]} is swept in {where}: chance is varied by study.replicates. Leave it out.")
    return tuple(axes)


def _values(key: str, values: Any, section: str, where: str) -> Sequence[Any]:
    if not isinstance(values, list) or not values:
        raise ValueError(f"{section}: {key} = {values!r} should be a list of at least one value in {where}.")
    return values


def _once(name: str, values: Sequence[Any], where: str) -> Sequence[Any]:
    """These values; ValueError if one occurs twice."""
    said = [json.dumps(value, sort_keys=True, default=str) for value in values]
    if twice := [text for text in said if said.count(text) > 1]:
        raise ValueError(f"{name} has the value {twice[0]} twice in {where}. Leave one out.")
    return values
