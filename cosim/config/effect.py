"""Keys that a config sets and that change nothing, because another key turns off what they belong to."""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from fnmatch import fnmatchcase
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from cosim.attacks.params import AttackParams
from cosim.config.config import PAPER_RULE, Config, chosen, chosen_model, resolve_data
from cosim.config.data import leaves
from cosim.door.load import is_own
from cosim.traffic.roadside import RoadsideParams
from sensors.weather import extinction_per_m

_TEXT = Path(__file__).with_name("needs.toml").read_text("utf-8")
_NEEDS: dict[str, list[dict[str, Any]]] = tomllib.loads(_TEXT)
"""What keys of the config and of sections of lists need, as the file explains."""


def _hosts(config: Config) -> set[str]:
    """Where the trust models of a config and of its variants run."""
    return {config.trust.host, *(variant.trust.host for variant in config.trust_variant)}


def _is_read(config: Config, key: str) -> bool:
    """Whether any trust model of a config reads a key of [trust]. Attacks may count their periods in windows."""
    name = key.removeprefix("trust.")
    of_variants = [chosen_model(variant)[0] for variant in config.trust_variant]
    for choice in (chosen(config, "trust")[0], *of_variants):
        if choice.params is None or name in {f.name for f in fields(choice.params)}:
            return True
    return name == "freshness_s" and any(attack.period_windows is not None for attack in config.attacks)


_RULES: Mapping[str, Callable[[Any, str], bool]] = {
    "different_times": lambda config, _: not config.schedule.is_lock_step,
    "fog_or_rain": lambda config, _: extinction_per_m(config.weather) > 0,
    "dirt": lambda config, _: bool(config.weather.dirt),
    "central_host": lambda config, _: "central" in _hosts(config),
    "local_host": lambda config, _: "local" in _hosts(config),
    "read_by_a_model": _is_read,
    "drawn": lambda attack, _: not attack.ids and attack.together_with is None,
    "no_windows": lambda attack, _: attack.period_windows is None,
    "jammers": lambda config, _: any(attack.attack == "jamming" for attack in config.attacks),
    "at_junctions": lambda unit, _: unit.junctions is not None,
}
"""Conditions that compare more than one key with values. They take the config or the section, and the key in need."""


def _holds(condition: Mapping[str, Any], section: Any, key: str) -> bool:
    """Whether a condition of the file holds for a config, or for a section of a list."""
    if "rule" in condition:
        return _RULES[condition["rule"]](section, key)
    value = attrgetter(condition["key"])(section)
    if "above" in condition:
        return value > condition["above"]
    if "is_not" in condition:
        return value not in condition["is_not"]
    return value in condition["is"] or (isinstance(value, str) and is_own(value))


class _Need(NamedTuple):
    """Keys, and what they need."""

    keys: tuple[str, ...]
    """With * for any end."""
    need: str
    is_held: bool
    """Whether this config, or this section of a list, has it."""
    deciding: frozenset[str] = frozenset()
    """The keys that decide on it. They have an effect."""


def _needs(name: str, section: Any, prefix: str = "") -> list[_Need]:
    """What keys of this config, or of this section of a list, need."""
    return [
        _Need(
            tuple(prefix + key for key in need["keys"]),
            need["need"],
            any(_holds(condition, section, need["keys"][0]) for condition in need["if"]),
            frozenset(prefix + condition["key"] for condition in need["if"] if "key" in condition),
        )
        for need in _NEEDS[name]
    ]


def without_effect(config: Config, is_replayed: bool) -> list[str]:
    """One line for each need that the config lacks, with the keys that it sets in vain.

    A key counts as set if its value is neither that of the preset nor the default. `is_replayed` says whether the
    traffic is that of a trace.
    """
    usual = _usual(config.preset)
    lists = ("attacks.", "roadside.", "encounters.", "trust_variant.", "objects.", "meshes.", "vehicle_meshes.")
    stated = []
    for name, value in leaves(config.to_dict()):
        is_usual = any(value == one.get(name) for one in usual)
        if not is_usual and not name.startswith(lists):
            stated.append(name)
    simulated = _Need(
        ("traffic.seed", "traffic.scale", "traffic.car_following"),
        "SUMO (traffic is replayed)",
        not is_replayed,
    )
    found = _vain(stated, [simulated, *_needs("config", config)])
    for section, default in (("attacks", AttackParams), ("roadside", RoadsideParams)):
        for number, one in enumerate(getattr(config, section)):
            prefix = f"{section}.{number}."
            optional = (f for f in fields(default) if f.default is not MISSING)
            changed = [f.name for f in optional if getattr(one, f.name) != f.default]
            of_section = [prefix + name for name in changed]
            found += _vain(of_section, _needs(section, one, prefix))
    found += _unread_by_variants(config)
    if config.trust.matching == "iou":
        found += [
            f'attacks.{number}.attack = "misstated_accuracy" has no effect without trust.matching = "gates".'
            for number, one in enumerate(config.attacks)
            if one.attack == "misstated_accuracy"
        ]
    return found


def _unread_by_variants(config: Config) -> list[str]:
    """One line for each key of a trust variant that differs from [trust] and that the variant's model does not read."""
    read_by_models = {
        need["keys"][0].removeprefix("trust."): need["need"]
        for need in _NEEDS["config"]
        if {"rule": "read_by_a_model"} in need["if"]
    }
    found = []
    for number, variant in enumerate(config.trust_variant):
        if {"name": variant.name, "fused": variant.fused, **variant.changes} == PAPER_RULE:
            continue  # that of the default run: nobody has asked for it
        params = chosen_model(variant)[0].params
        for name, value in variant.changes.items():
            is_read = params is None or name in {f.name for f in fields(params)}
            if name in read_by_models and not is_read and value != getattr(config.trust, name):
                found.append(f"trust_variant.{number}.{name} has no effect without {read_by_models[name]}.")
    return found


@cache
def _usual(preset: str) -> tuple[dict[str, Any], ...]:
    """Keys and values of this preset and of the default preset."""
    made = (resolve_data({"preset": preset}, "", None), resolve_data({}, "", None))
    return tuple(dict(leaves(config.to_dict())) for config in made)


def _vain(stated: list[str], needs: list[_Need]) -> list[str]:
    """One line for each need that is not held and has stated keys; every key is in one line at most."""
    lines = []
    for keys, need, is_held, deciding in needs:
        if is_held:
            continue
        named = [name for name in stated if any(fnmatchcase(name, key) for key in keys)]
        vain = [name for name in named if name not in deciding]
        stated = [name for name in stated if name not in vain]
        if vain:
            verb = "have" if len(vain) > 1 else "has"
            lines.append(f"{', '.join(vain)} {verb} no effect without {need}.")
    return lines
