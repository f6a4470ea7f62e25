"""The points of a study. Each has a config, and its name is a hash of everything that determines the result."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from cosim.config.config import Config
from cosim.runs.inputs import mesh_checksums
from cosim.runs.source import code_digest
from cosim.step.parts import sources
from cosim.studies.density import scenario_of
from cosim.studies.study import Keys, Study, config_at

HOW = ("compute", "record")
"""Sections of a config that change no result."""


@dataclass(frozen=True, slots=True)
class Point:
    """One requested run: values of the swept keys and a replicate."""

    id: str
    keys: Keys
    replicate: int
    config: Config

    @property
    def said(self) -> str:
        """Swept keys and replicate in one line."""
        swept = [f"{key} = {value}" for key, value in self.keys.items()]
        return ", ".join([*swept, f"replicate {self.replicate}"])


def points_of(study: Study, where: str) -> list[Point]:
    """All points, replicate by replicate; ValueError if a config is invalid or two points are the same experiment."""
    found: dict[str, Point] = {}
    for replicate in range(study.head.replicates):
        for keys in study.combinations():
            config = config_at(study, keys, replicate, where)
            point = Point(identity(config), keys, replicate, config)
            if (same := found.get(point.id)) is not None:
                raise ValueError(
                    f"{where}: two points resolve to the same experiment: ({same.said}) and ({point.said}). "
                    "Take one of them out."
                )
            found[point.id] = point
    return list(found.values())


def identity(config: Config) -> str:
    """Name of the result of a config: a hash of the resolved config and of the content of all files that it names."""
    data = config.to_dict()
    for section in HOW:
        del data[section]
    content = {"config": data, "files": _files(config.traffic.scenario, config.traffic.trace), "own": _own(config)}
    if meshes := mesh_checksums(config):
        content["meshes"] = meshes
        for section in ("meshes", "vehicle_meshes"):
            data[section] = [mesh | {"file": ""} for mesh in data[section]]
    data["traffic"] |= {"scenario": "", "trace": ""}  # the content of these files is in the hash
    return digest(content)


def traffic_identity(config: Config) -> str:
    """Name of a config's traffic: a hash of `[traffic]`, its files, the version of SUMO, and all code."""
    from cosim.runs.manifest import versions

    data = config.to_dict()["traffic"] | {"scenario": "", "trace": ""}
    files = _files(config.traffic.scenario, config.traffic.trace)
    return digest({"traffic": data, "files": files, "sumo": versions("").get("libsumo"), "code": code_digest()})


def shared_identity(config: Config, level: str) -> str:
    """Name of what a config computes apart from trust."""
    own = {section: values for section, values in config.own.items() if section != "trust"}
    without_trust = replace(config, trust=type(config.trust)(), trust_variant=(), own=own)
    return identity(without_trust) + level


def digest(content: Any) -> str:
    """Sixteen hexadecimal digits of plain data."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _own(config: Config) -> Mapping[str, str]:
    """Checksums of the user's own classes, by key of the config."""
    return {key: source.sha256 for key, source in sources(config).items() if source.file}


@cache
def _files(scenario: str, trace: str | None) -> Mapping[str, str]:
    """Checksums of the files of a scenario, and its own warm-up."""
    found = scenario_of(scenario, trace)
    about = found.provenance() | {"warm-up": f"{found.warmup_s:g} s"}
    decisive = ("sha256", "origin", "warm-up")
    return {name: text for name, text in about.items() if name.startswith(decisive)}
