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
from cosim.studies.density import scenario_of
from cosim.studies.points import Point, identity, shared_identity, traffic_identity
from trust.params import evidence_values

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

    @staticmethod
    def of(point: Point) -> "PlannedRun":
        """A run for one point alone."""
        return PlannedRun(point.id, point.config, ((point.id, BASE_VARIANT),), "")


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
        key, remark = _sharing(point.config)
        groups.setdefault(key, []).append(point)
        if remark:
            remarks[remark] = None
    runs = []
    for group in groups.values():
        for i in range(0, len(group), MOST_VARIANTS):
            runs.append(_merged(group[i : i + MOST_VARIANTS], fused))
    return _share_traffic(runs, stored, tuple(remarks))


def _sharing(config: Config) -> tuple[str, str]:
    """What decides with which points a point can share a run.

    Returns
    -------
    A key, which points of one run have in common, and the reason why the point cannot share with all points that
    differ only in trust; empty if it can.
    """
    if config.driver.model != "none":
        reason = "driver: what vehicles believe drives them, so every point has its own traffic"
        return "alone " + identity(config), reason
    key = shared_identity(config, repr(evidence_values(config.trust)))
    if reason := _acting(config):
        return key + repr(host_key(variants(config)[0])), f"{reason}, so other trust is another run"
    if any(attack.period_windows for attack in config.attacks):
        reason = "attacks.period_windows: attacks begin and end by trust.freshness_s, so another one is another run"
        return f"{key} {config.trust.freshness_s}", reason
    return key, ""


def _acting(config: Config) -> str:
    """What the trust of a run changes besides trust, and how; empty if nothing."""
    relay = config.radio.relay
    if config.server.uplink == "rsu":
        return 'server.uplink = "rsu": broadcasts of trust load the channel'
    if config.pseudonyms.revocation != "none":
        return "pseudonyms.revocation: trust decides whose messages are dropped"
    if config.pseudonyms.linkage == "own":
        return 'pseudonyms.linkage = "own": receivers link pseudonyms in which they have trust'
    if relay.min_trust > 0 and relay.max_hops > 1:
        return "radio.relay.min_trust: trust decides which messages are forwarded"
    if any(attack.reads_trust for attack in config.attacks):
        return "attacks: attackers act by the trust in them"
    return ""


def _merged(group: Sequence[Point], fused: bool) -> PlannedRun:
    """One run for points that differ only in trust. The trust of the first point is the acting one."""
    first, *others = group
    if not others:
        return PlannedRun.of(first)
    data = first.config.to_dict()
    acting = data["trust"]
    data["trust_variant"] = []
    members = [(first.id, BASE_VARIANT)]
    for point in others:
        variant = {"name": point.id, "fused": fused}
        of_model = point.config.own.get("trust", {})  # a variant inherits none of these where models differ
        for key, value in point.config.to_dict()["trust"].items():
            if key in of_model or key not in acting or acting[key] != value:
                variant[key] = value
        data["trust_variant"].append(variant)
        members.append((point.id, point.id))
    as_in_a_file = json.loads(json.dumps(data, default=str))
    config = resolve_data(as_in_a_file, "the plan", None)
    return PlannedRun(identity(config), config, tuple(members), "")


def _share_traffic(runs: Sequence[PlannedRun], stored: Collection[str], remarks: tuple[str, ...]) -> StudyPlan:
    """Let runs replay traffic that several of them share or that the cache holds."""
    names: dict[str, str] = {}
    for run in runs:
        if run.config.driver.model == "none" and not _is_replay(run.config):
            names[run.id] = traffic_identity(run.config)
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
