"""Who attacks, when, and whom: the keys that every `[[attacks]]` section has."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import UInt8
from numpy import ndarray

from results.codes import Role

When = Literal["persistent", "sporadic", "on_off", "sleeper", "camouflage"]
Victim = Literal["nearest", "one", "region", "random", "designated"]
Renewal = Literal["by_policy", "whitewashing", "newcomer"]
Coordinate = Annotated[float, Ge(-1e6), Le(1e6)]
"""In the world's frame [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AttackParams:
    """One attack: what, by whom, when, against whom. Its own parameters stand in the same section."""

    attack: str = "ghost_insertion"
    """Name of the attack, or one of your own: path.py:Name."""
    role: Literal["malicious", "unreliable"] = "malicious"
    """What its vehicles are called in tables and figures; unreliable where it is left out and the attack is."""
    share_p: Annotated[float, Ge(0), Le(1)] = 0.1
    """Share of the equipped vehicles that carry it out, decided vehicle by vehicle from its name."""
    ids: tuple[str, ...] = ()
    """SUMO ids of the vehicles that carry it out, where they are equipped; share_p is then not read."""
    together_with: Annotated[int, Ge(0), Le(255)] | None = None
    """Number of an earlier section, from 0, whose vehicles carry this one out too; share_p is then not read."""
    ring_size: Annotated[int, Ge(0), Le(1_000_000)] = 0
    """Attackers per ring of colluders, in the order in which they appear, those who appear at once by place; 0: all of
    the section are one ring."""
    start_s: Annotated[float, Ge(0), Le(1e8)] = 60.0
    """Recorded time from which it is carried out [s]; until then its vehicles are honest and build up trust."""
    when: When = "persistent"
    """persistent: in every step; sporadic: with probability active_p; on_off: for duty_p of every period; sleeper: once
    the attacker's own trust has reached wake_trust; camouflage: while its own trust is above keep_above."""
    active_p: Annotated[float, Ge(0), Le(1)] = 0.5
    """sporadic: chance of a step in which it is carried out, vehicle by vehicle."""
    period_s: Annotated[float, Gt(0), Le(1e8)] = 50.0
    """on_off: length of a period, which begins with the attack; all vehicles of the section at once [s]."""
    period_windows: Annotated[float, Gt(0), Le(1e6)] | None = None
    """on_off: the same in windows of evidence (trust.freshness_s); period_s is then not read."""
    duty_p: Annotated[float, Ge(0), Le(1)] = 0.5
    """on_off: share of the period, at its beginning, in which it is carried out."""
    wake_trust: Annotated[float, Ge(0), Le(1)] = 0.9
    """sleeper: trust in itself, as last broadcast, that makes a vehicle begin."""
    keep_above: Annotated[float, Ge(0), Le(1)] = 0.6
    """camouflage: it is carried out while the vehicle's trust, as last broadcast, is above this."""
    victim: Victim = "nearest"
    """Which other equipped vehicle an attacker aims at: the nearest, the one of victim_id, the nearest of those in a
    region, a random one in every step, or the nearest of those designated; always within victim_range_m."""
    victim_id: str = ""
    """one: SUMO id of the vehicle that all attackers aim at, as in the paper."""
    victim_range_m: Annotated[float, Gt(0), Le(10_000)] = 100.0
    """Farthest victim [m]."""
    victim_p: Annotated[float, Ge(0), Le(1)] = 0.05
    """designated: share of the equipped vehicles that are victims, decided vehicle by vehicle from its name; attackers
    are none. All attackers around one aim at it, as in the paper."""
    region_m: tuple[Coordinate, Coordinate, Annotated[float, Gt(0), Le(1e6)]] = (0.0, 0.0, 100.0)
    """region: x, y and radius, in the world's frame [m]."""
    renewal: Renewal = "by_policy"
    """When its vehicles change their pseudonyms: by_policy as all do; whitewashing: also once their own trust, as last
    broadcast, is below renew_below; newcomer: also every renew_s, to live on the default trust."""
    renew_below: Annotated[float, Ge(0), Le(1)] = 0.5
    """whitewashing: trust below which a vehicle takes a new pseudonym."""
    renew_s: Annotated[float, Gt(0), Le(1e8)] = 10.0
    """newcomer: life of a pseudonym [s]."""

    @property
    def reads_trust(self) -> bool:
        """Whether its vehicles follow what is broadcast about themselves."""
        return self.when in ("sleeper", "camouflage") or self.renewal == "whitewashing"

    def period_of(self, freshness_s: float | str) -> float:
        """Length of a period of `on_off` [s]."""
        return self.period_s if self.period_windows is None else self.period_windows * float(freshness_s)


PAPER: tuple[dict[str, Any], ...] = (
    {"attack": "ghost_insertion", "role": "malicious"},
    {"attack": "unreliable", "role": "unreliable"},
)
"""The two behaviours of TruPercept's experiments: the default."""


def check_attacks(params: Sequence[AttackParams], freshness_s: float | str, interval_s: float) -> None:
    """ValueError in one line for sections that cannot be carried out; `interval_s` is the time between two messages."""
    total = sum(p.share_p for p in params if not p.ids and p.together_with is None)
    if total > 1 + 1e-9:
        raise ValueError(
            f"attacks: the shares share_p sum to {total:g}, more than all equipped vehicles. "
            "Lower one of them so that they sum to at most 1."
        )
    named = [name for p in params if p.together_with is None for name in p.ids]
    if twice := sorted({name for name in named if named.count(name) > 1}):
        raise ValueError(
            f'attacks: "{twice[0]}" stands in ids twice. Name it once, and give its second attack together_with.'
        )
    for number, p in enumerate(params):
        _check(p, number, freshness_s, interval_s)


def _check(p: AttackParams, number: int, freshness_s: float | str, interval_s: float) -> None:
    where = f"attacks.{number}"
    if p.together_with is not None and p.together_with >= number:
        raise ValueError(
            f"{where}.together_with = {p.together_with} is no earlier section; they are numbered from 0. "
            f"Set it to a number below {number}."
        )
    if p.ids and p.ring_size > len(p.ids):
        raise ValueError(
            f"{where}.ring_size = {p.ring_size} is larger than its {len(p.ids)} attackers. "
            f"Set it to at most {len(p.ids)}, or name more ids."
        )
    if p.when == "on_off":
        if p.period_windows is not None and freshness_s == "off":
            raise ValueError(
                f'{where}.period_windows = {p.period_windows:g}, but trust.freshness_s = "off" is no length of a '
                f"window. Set {where}.period_s."
            )
        if (period_s := p.period_of(freshness_s)) < interval_s - 1e-9:
            raise ValueError(
                f"{where}: a period of {period_s:g} s is shorter than one step, {interval_s:g} s: no vehicle could be "
                f"on and off in it. Set {where}.period_s to {2 * interval_s:g} or more."
            )
    if p.victim == "one" and not p.victim_id:
        raise ValueError(f'{where}.victim = "one" of which vehicle? Set {where}.victim_id to its SUMO id.')
    if p.victim_id and p.victim != "one":
        raise ValueError(f'{where}.victim_id = "{p.victim_id}" is read with victim = "one" alone. Set {where}.victim.')


def rings_too_large(params: Sequence[AttackParams], attack: UInt8[ndarray, "n"]) -> list[str]:
    """A line for each section whose rings are larger than all its vehicles: with a share, known when a run ends.

    Parameters
    ----------
    attack
        Of all actors of the run, as in `world.attack`.
    """
    n_of = np.bincount(attack, minlength=len(params) + 1)
    return [
        f"attacks.{number}.ring_size = {p.ring_size} is larger than its {n_of[owner + 1]} attackers: no ring was ever "
        f"whole. Raise share_p or fleet.penetration_p, or set it to at most {n_of[owner + 1]}."
        for number, (p, owner) in enumerate(zip(params, owners(params), strict=True))
        if p.ring_size > n_of[owner + 1]
    ]


def owners(params: Sequence[AttackParams]) -> tuple[int, ...]:
    """Per section, the section that says who its vehicles are."""
    found: list[int] = []
    for number, p in enumerate(params):
        found.append(number if p.together_with is None else found[p.together_with])
    return tuple(found)


def shares(params: Sequence[AttackParams]) -> tuple[float, ...]:
    """Share of the equipped vehicles that is drawn for each section; 0 where they are named otherwise."""
    return tuple(0.0 if p.ids or p.together_with is not None else p.share_p for p in params)


def named(params: Sequence[AttackParams]) -> dict[str, int]:
    """SUMO ids that are named, and the number of their section, from 0."""
    return {name: number for number, p in enumerate(params) if p.together_with is None for name in p.ids}


def roles_of(params: Sequence[AttackParams]) -> UInt8[ndarray, "a"]:
    """Code of the role (`results.codes.Role`) that goes with each number of `world.attack`; 0 is honest."""
    return np.array([Role.HONEST, *(Role[p.role.upper()] for p in params)], np.uint8)
