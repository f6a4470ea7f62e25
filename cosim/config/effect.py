"""Keys that a config sets and that change nothing, because another key turns off what they belong to."""

from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields
from fnmatch import fnmatchcase
from functools import cache, partial
from typing import Any

from cosim.attacks.params import AttackParams
from cosim.config.config import Config, chosen, chosen_model, resolve_data
from cosim.door.load import is_own
from cosim.traffic.roadside import RoadsideParams

_SENSING = (
    "sensing_*", "extrapolate", "lidar.*", "weather.*", "gnss.*", "detector.*", "tracking.*", "attacks.*", "cpm.*",
    "early_fusion.*", "radio.*", "rsu.*", "roadside.*", "server.*", "pseudonyms.*", "trust.*", "driver.*",
)  # fmt: skip
_SIDELINK = ("nr_mode2", "lte_mode4")


def _hosts(config: Config) -> set[str]:
    return {config.trust.host, *(variant.trust.host for variant in config.trust_variant)}


def _radio(config: Config, *models: str) -> bool:
    return config.radio.model in models or is_own(config.radio.model)


_OF_MODELS = ("freshness_s", "window", "unseen", "weighting", "least_score")
"""Keys of [trust] that only some trust models read."""


def _is_read(key: str, config: Config) -> bool:
    """Whether any trust model of a config reads a key of [trust]. Attacks may count their periods in windows."""
    choices = [chosen(config, "trust")[0], *(chosen_model(variant)[0] for variant in config.trust_variant)]
    reads = any(one.params is None or key in {f.name for f in fields(one.params)} for one in choices)
    return reads or (key == "freshness_s" and any(a.period_windows is not None for a in config.attacks))


NEEDS: tuple[tuple[tuple[str, ...], str, Callable[[Config], bool]], ...] = (
    (_SENSING, "sensing = true", lambda c: c.sensing),
    (("extrapolate",), "vehicles that sense at different times", lambda c: not c.schedule.is_lock_step),
    (("parked.*",), "parked.per_100_m above 0", lambda c: c.parked.per_100_m > 0),
    (("trees.streets_p",), "trees.per_100_m above 0", lambda c: c.trees.per_100_m > 0),
    (("trees.*",), "trees.per_100_m or trees.from_map", lambda c: c.trees.per_100_m > 0 or c.trees.from_map),
    (("weather.dirty_p",), "weather.dirt", lambda c: bool(c.weather.dirt)),
    (("gnss.correlation_s",), "gnss.std_m or gnss.heading_std_deg above 0", lambda c: not c.gnss.is_exact),
    (("tracking.*",), 'tracking.model = "constant_velocity"', lambda c: c.tracking.model != "none"),
    (("cpm.interval_s",), 'cpm.rules = "etsi"', lambda c: c.cpm.rules == "etsi"),
    (("cpm.redundancy_window_s",), "cpm.redundancy", lambda c: c.cpm.redundancy != "none"),
    (("cpm.redundancy_reports",), 'cpm.redundancy = "frequency"', lambda c: c.cpm.redundancy == "frequency"),
    (
        ("cpm.redundancy_moved_m", "cpm.redundancy_speed_mps"), 'cpm.redundancy = "dynamics"',
        lambda c: c.cpm.redundancy == "dynamics",
    ),
    (("cpm.redundancy_sender_m",), 'cpm.redundancy = "distance"', lambda c: c.cpm.redundancy == "distance"),
    (("early_fusion.*",), "early_fusion.share", lambda c: c.early_fusion.share != "none"),
    (("radio.unit_disk.*",), 'radio.model = "unit_disk"', lambda c: _radio(c, "unit_disk")),
    (
        ("radio.propagation.*", "radio.receiver.*"), 'another radio.model than "unit_disk"',
        lambda c: c.radio.model != "unit_disk",
    ),
    (("radio.access.*", "radio.dcc.*"), 'radio.model = "csma"', lambda c: _radio(c, "csma")),
    (("radio.dcc.*",), "radio.dcc.enabled = true", lambda c: c.radio.dcc.enabled),
    (("radio.dcc.target_cbr",), 'radio.dcc.algorithm = "adaptive"', lambda c: c.radio.dcc.algorithm == "adaptive"),
    (("radio.sidelink.*",), 'radio.model = "nr_mode2" or "lte_mode4"', lambda c: _radio(c, *_SIDELINK)),
    (("radio.nr.*",), 'radio.model = "nr_mode2"', lambda c: _radio(c, "nr_mode2")),
    (("radio.lte.*",), 'radio.model = "lte_mode4"', lambda c: _radio(c, "lte_mode4")),
    (("radio.relay.*",), "radio.relay.max_hops of 2 or more", lambda c: c.radio.relay.max_hops > 1),
    (
        ("radio.relay.forward_p",), 'radio.relay.rule = "probability"',
        lambda c: c.radio.relay.rule == "probability",
    ),
    (("rsu.apart_m", "rsu.height_m"), "rsu.n_at_junctions", lambda c: c.rsu.n_at_junctions > 0),
    (("server.*", "trust.server_period_s"), 'trust.host = "central"', lambda c: "central" in _hosts(c)),
    (("server.backhaul_s",), 'server.uplink = "rsu"', lambda c: c.server.uplink == "rsu"),
    (("server.cellular.*",), 'server.uplink = "cellular"', lambda c: c.server.uplink == "cellular"),
    (("trust.local_evidence",), 'trust.host = "local"', lambda c: "local" in _hosts(c)),
    *(
        ((f"trust.{key}",), 'a trust.model that reads it, such as "trupercept"', partial(_is_read, key))
        for key in _OF_MODELS
    ),
    (("trust.ego_trust",), 'trust.ego_trust_from = "fixed"', lambda c: c.trust.ego_trust_from == "fixed"),
    (
        ("trust.gate_p", "trust.fused_boxes", "trust.least_overlap"), 'trust.matching = "gates"',
        lambda c: c.trust.matching == "gates",
    ),
    (("trust.least_overlap",), 'trust.fused_boxes = "weighted" or "aligned"', lambda c: c.trust.fused_boxes != "best"),
    (("trust.code_aggregate",), "trust.code_parity = true", lambda c: c.trust.code_parity),
    (("pseudonyms.n_accusations",), 'pseudonyms.linkage = "on_demand"', lambda c: c.pseudonyms.linkage == "on_demand"),
    (("pseudonyms.own_*",), 'pseudonyms.linkage = "own"', lambda c: c.pseudonyms.linkage == "own"),
    (
        ("pseudonyms.revoke_below", "pseudonyms.min_evaluations"), "pseudonyms.revocation",
        lambda c: c.pseudonyms.revocation != "none",
    ),
    (("pseudonyms.list_every_s",), 'pseudonyms.revocation = "list"', lambda c: c.pseudonyms.revocation == "list"),
)  # fmt: skip
"""Keys, what they need, and whether a config has it. The first need that a config lacks is named."""


_OF_ATTACK: tuple[tuple[tuple[str, ...], str, Callable[[AttackParams], bool]], ...] = (
    (
        ("share_p",),
        "a draw (ids or together_with names the attackers)",
        lambda a: not a.ids and a.together_with is None,
    ),
    (("active_p",), 'when = "sporadic"', lambda a: a.when == "sporadic"),
    (("period_s", "period_windows", "duty_p"), 'when = "on_off"', lambda a: a.when == "on_off"),
    (("period_s",), "no period_windows", lambda a: a.period_windows is None),
    (("wake_trust",), 'when = "sleeper"', lambda a: a.when == "sleeper"),
    (("keep_above",), 'when = "camouflage"', lambda a: a.when == "camouflage"),
    (("victim_p",), 'victim = "designated"', lambda a: a.victim == "designated"),
    (("region_m",), 'victim = "region"', lambda a: a.victim == "region"),
    (("renew_below",), 'renewal = "whitewashing"', lambda a: a.renewal == "whitewashing"),
    (("renew_s",), 'renewal = "newcomer"', lambda a: a.renewal == "newcomer"),
)
_OF_UNIT: tuple[tuple[tuple[str, ...], str, Callable[[RoadsideParams], bool]], ...] = (
    (("choose", "listed"), "junctions = N", lambda u: u.junctions is not None),
    (("listed",), 'choose = "listed"', lambda u: u.choose == "listed"),
)


def without_effect(config: Config, is_replayed: bool) -> list[str]:
    """One line for each need that the config lacks, with the keys that it sets in vain.

    A key counts as set if its value is neither that of the preset nor the default. `is_replayed` says whether the
    traffic is that of a trace.
    """
    usual = _usual(config.preset)
    lists = ("attacks.", "roadside.", "encounters.", "trust_variant.", "objects.", "meshes.", "vehicle_meshes.")
    stated = [
        name for name, value in _leaves(config.to_dict())
        if not name.startswith(lists) and all(value != one.get(name) for one in usual)
    ]  # fmt: skip
    simulated = (
        ("traffic.seed", "traffic.scale", "traffic.car_following"),
        "SUMO (traffic is replayed)",
        not is_replayed,
    )
    found = _vain(stated, [simulated, *((keys, need, has(config)) for keys, need, has in NEEDS)])
    for section, default, needs in (("attacks", AttackParams, _OF_ATTACK), ("roadside", RoadsideParams, _OF_UNIT)):
        for number, one in enumerate(getattr(config, section)):
            of = [f.name for f in fields(default) if f.default is not MISSING and getattr(one, f.name) != f.default]
            held = [(tuple(f"{section}.{number}.{key}" for key in keys), need, has(one)) for keys, need, has in needs]
            found += _vain([f"{section}.{number}.{name}" for name in of], held)
    if config.trust.matching == "iou":
        found += [
            f'attacks.{number}.attack = "misstated_accuracy" has no effect without trust.matching = "gates".'
            for number, one in enumerate(config.attacks)
            if one.attack == "misstated_accuracy"
        ]
    return found


@cache
def _usual(preset: str) -> tuple[dict[str, Any], ...]:
    """Keys and values of this preset and of the default preset."""
    made = (resolve_data({"preset": preset}, "", None), resolve_data({}, "", None))
    return tuple(dict(_leaves(config.to_dict())) for config in made)


def _vain(stated: list[str], needs: list[tuple[tuple[str, ...], str, bool]]) -> list[str]:
    """One line for each need that is not held and has stated keys; every key is in one line at most."""
    lines = []
    for keys, need, is_held in needs:
        vain = [] if is_held else [name for name in stated if any(fnmatchcase(name, key) for key in keys)]
        stated = [name for name in stated if name not in vain]
        if vain:
            lines.append(f"{', '.join(vain)} {'have' if len(vain) > 1 else 'has'} no effect without {need}.")
    return lines


def _leaves(data: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys with their full names, and their values."""
    for name, value in data.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
