"""What the law of freshness covers: the trust servers of a config, and what it leaves out."""

from typing import NamedTuple

import numpy as np

from cosim.base.codes import BASE_VARIANT
from cosim.config.config import Config
from cosim.messages.cpm_params import MOST_OBJECTS
from trust.params import TrustParams, open_window_steps, window_of


class Server(NamedTuple):
    """A trust variant whose freshness is predicted."""

    name: str
    period_s: float
    window_s: float
    """Evidence of this age or older does not count [s]; inf if it never expires."""
    window_steps: int
    """That age in steps of the law."""
    zero: bool
    """Whether detections that no other vehicle could see are evidence (`trust.unseen = "zero"`)."""


def servers_of(config: Config) -> list[Server]:
    """The trust variants of a config.

    Raises
    ------
    ValueError
        In one line, if the law does not cover the config.
    """
    for key, value, allowed in (
        ("sensing", config.sensing, (True,)),
        ("driver.model", config.driver.model, ("none",)),
        ("early_fusion.share", config.early_fusion.share, ("none",)),
        ("radio.evaluations", config.radio.evaluations, ("alone",)),
        ("radio.propagation.blockage", config.radio.propagation.blockage, ("probabilistic", "none")),
        ("sensing_phase", config.sensing_phase, ("common", "random")),
        ("sensing_groups", config.sensing_groups, ((),)),
        ("cpm.rules", config.cpm.rules, ("all",)),
        ("cpm.redundancy", config.cpm.redundancy, ("none",)),
        ("cpm.max_objects", config.cpm.max_objects, (MOST_OBJECTS,)),
        ("radio.relay.max_hops", config.radio.relay.max_hops, (1,)),
        ("server.uplink", config.server.uplink, ("cellular",)),
        ("server.outages", config.server.outages, ((),)),
        ("objects", config.objects, ((),)),
        ("weather", "clear" if config.weather.is_clear else "set", ("clear",)),
        ("parked.per_100_m", config.parked.per_100_m, (0.0,)),
        ("roadside", "set" if config.roadside else "none", ("none",)),
        ("pseudonyms.policy", config.pseudonyms.policy, ("none",)),
        ("pseudonyms.revocation", config.pseudonyms.revocation, ("none",)),
    ):
        if value not in allowed:
            raise ValueError(
                f"{key} = {value!r}: the law of freshness covers {key} = {allowed[0]!r} only (cosim/docs/pages/models/"
                "freshness-law.md says what it covers). Change it, or simulate."
            )
    variants = [(BASE_VARIANT, config.trust)]
    variants += [(v.name, v.trust) for v in config.trust_variant]
    return [server_of(name, trust, config) for name, trust in variants]


def server_of(name: str, trust: TrustParams, config: Config) -> Server:
    """The server of a trust variant, or of `[trust]` itself. Raises ValueError if the law does not cover it."""
    where = "trust" if name == BASE_VARIANT else f'trust_variant "{name}"'
    if trust.host != "central":
        raise ValueError(
            f'{where}.host = "{trust.host}": the law of freshness covers host = "central" only. Change it, or simulate.'
        )
    if trust.model != "trupercept":
        raise ValueError(
            f'{where}.model = "{trust.model}": the law of freshness covers model = "trupercept" only. Change it, or '
            "simulate."
        )
    every = config.schedule.exchange_every_steps
    if trust.freshness_s == "off":
        return Server(name, trust.server_period_s, np.inf, 2**31, trust.unseen == "zero")
    steps = -(-open_window_steps(trust, config.traffic.step_s) // every)
    return Server(name, trust.server_period_s, window_of(trust), steps, trust.unseen == "zero")


def left_out(config: Config) -> list[str]:
    """What the config has that the law neglects, one sentence each."""
    found = []
    if config.attacks:
        found.append("attacks: the law takes all vehicles for honest; ghosts and lies add evaluations.")
    if config.trust.least_score > 0:
        found.append("trust.least_score: the law takes all detections for evidence, whatever their score.")
    if len(config.trust.evidence) > 1:
        found.append("trust.evidence: the law takes detections alone for evidence.")
    if config.lidar.dropout_p > 0:
        found.append("lidar.dropout_p: the law takes no ray for lost.")
    if any(config.trust.gamma_lower_points):
        found.append("trust.gamma_lower_points: the law takes one return of an object for enough to see it.")
    if config.gnss.std_m > 0:
        found.append("gnss: the law takes positions for exact.")
    if config.trees.per_100_m or config.trees.from_map:
        found.append("trees: the law sees the prisms of buildings and vehicles only.")
    if config.meshes or config.vehicle_meshes:
        found.append("meshes: the law sees the prisms of buildings and vehicles only.")
    return found
