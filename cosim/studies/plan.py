"""Plans the runs for the points of a study, so that nothing is computed twice.

Points that differ only in trust become trust variants of one run. Runs with the same traffic replay it. A point that
cannot share gets a separate run, and the plan says why.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from cosim.base.codes import BASE_VARIANT
from cosim.config.config import Config, resolve_data
from cosim.messages.trust_hosts import host_key
from cosim.step.parts import variants
from cosim.studies.points import Point, identity, scenario_of, shared_identity, traffic_identity
from trust.params import EVIDENCE_KEYS, eta_of

TRAFFIC_VERSION = 1
"""Increase it when the same `[traffic]` gives other traffic. `tests/cosim/studies/test_stages.py` checks this."""

MOST_VARIANTS = 60
"""Largest number of points in one run."""


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One run, and the points that it answers."""

    id: str
    config: Config
    members: tuple[tuple[str, str], ...]
    """Each point and its trust variant in this run."""
    traffic: str
    """Name of the traffic that it replays; empty if it simulates its own."""


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """Runs to make, and the traffic that several of them replay."""

    runs: tuple[PlannedRun, ...]
    traffic: Mapping[str, Config]
    """By name, a config whose traffic is simulated once."""
    remarks: tuple[str, ...]
    """Reasons why points cannot share."""


def plan(points: Sequence[Point], fused: bool, stored: Collection[str] = ()) -> StudyPlan:
    """Plan the runs for these points.

    Parameters
    ----------
    points
        Points without a finished run.
    fused
        Whether every point needs its fused objects.
    stored
        Names of traffic that the cache holds.
    """
    groups: dict[str, list[Point]] = {}
    remarks: dict[str, None] = {}
    for point in points:
        key, remark = _mergeable(point.config)
        groups.setdefault(key, []).append(point)
        if remark:
            remarks[remark] = None
    merged = [
        _merged(group[i : i + MOST_VARIANTS], fused)
        for group in groups.values() for i in range(0, len(group), MOST_VARIANTS)
    ]  # fmt: skip
    return _share_traffic(merged, stored, tuple(remarks))


def _mergeable(config: Config) -> tuple[str, str]:
    """A key, and a remark if something prevents sharing. Points with the same key can become one run."""
    if config.driver.model != "none":
        return "alone " + identity(
            config
        ), "driver: what vehicles believe drives them, so every point has its own traffic"
    evidence = [eta_of(config.trust) if k == "eta" else getattr(config.trust, k) for k in EVIDENCE_KEYS]
    key = shared_identity(config, repr(evidence))
    if config.server.uplink == "rsu":
        key += repr(host_key(variants(config)[0]))
        return key, 'server.uplink = "rsu": broadcasts of trust load the channel, so other trust is another run'
    return key, ""


def _merged(group: Sequence[Point], fused: bool) -> PlannedRun:
    """One run for points that differ only in trust. The trust of the first point is the acting one."""
    base = group[0].config
    if len(group) == 1:
        return PlannedRun(group[0].id, base, ((group[0].id, BASE_VARIANT),), "")
    data = base.to_dict()
    acting = data["trust"]
    data["trust_variant"] = [
        {"name": point.id, "fused": fused}
        | {k: v for k, v in point.config.to_dict()["trust"].items() if k not in acting or acting[k] != v}
        for point in group[1:]
    ]
    config = resolve_data(json.loads(json.dumps(data, default=str)), "the plan", None)
    members = ((group[0].id, BASE_VARIANT), *((point.id, point.id) for point in group[1:]))
    return PlannedRun(identity(config), config, members, "")


def _share_traffic(runs: Sequence[PlannedRun], stored: Collection[str], remarks: tuple[str, ...]) -> StudyPlan:
    """Let runs replay traffic that several of them share or that the cache holds."""
    names: dict[str, str] = {}
    for run in runs:
        if run.config.driver.model == "none" and not _is_replay(run.config):
            names[run.id] = traffic_identity(run.config, TRAFFIC_VERSION)
    used = list(names.values())
    shared = {name for name in used if used.count(name) > 1 or name in stored}
    traffic: dict[str, Config] = {}
    planned = []
    for run in runs:
        name = names.get(run.id, "")
        if name in shared:
            traffic.setdefault(name, run.config)
            run = replace(run, traffic=name)
        planned.append(run)
    return StudyPlan(tuple(planned), traffic, remarks)


def _is_replay(config: Config) -> bool:
    """Whether the config already replays a trace or the folder of a run."""
    return scenario_of(config.traffic.scenario, config.traffic.trace).trace is not None


def as_data(run: PlannedRun) -> dict[str, Any]:
    """A planned run as plain data, for the process that makes it."""
    return {"id": run.id, "config": run.config.to_dict(), "members": dict(run.members), "traffic": run.traffic}
