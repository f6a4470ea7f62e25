"""The keys that every `[[attacks]]` section has: which vehicles attack, when they attack, and whom."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import UInt8
from numpy import ndarray

from cosim.base.bounds import Share
from cosim.base.codes import Role

When = Literal["persistent", "sporadic", "on_off", "sleeper", "camouflage"]
Victim = Literal["nearest", "one", "region", "random", "designated"]
Renewal = Literal["by_policy", "whitewashing", "newcomer"]
Coordinate = Annotated[float, Ge(-1e6), Le(1e6)]
"""A coordinate in the world frame [m]."""


NEVER_S = 1e8
"""The `start_s` of an attack that is not meant to begin."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AttackParams:
    """An `[[attacks]]` section: the attack, its attackers, its times and its victims.

    The parameters that only this attack has are keys of the same section.
    """

    attack: str = "ghost_insertion"
    """Name of the attack, or a class of your own as path.py:Name."""
    role: Literal["malicious", "unreliable"] = "malicious"
    """Role of its vehicles in tables and figures. The default is `unreliable` for the attack `unreliable`, and
    `malicious` for all others."""
    share_p: Share = 0.1
    """Share of the equipped vehicles that carry out the attack. Whether a vehicle does is drawn from its name."""
    ids: tuple[str, ...] = ()
    """SUMO ids of the vehicles that carry out the attack if they are equipped. If this is set, `share_p` is ignored."""
    together_with: Annotated[int, Ge(0), Le(255)] | None = None
    """Number of an earlier section, counted from 0. The vehicles of that section carry out this attack as well, and
    `share_p` is ignored."""
    ring_size: Annotated[int, Ge(0), Le(1_000_000)] = 0
    """Number of attackers in each ring of colluders. Attackers join rings in the order of their appearance, and those
    that appear in the same step by position. 0 means that all attackers of the section form one ring."""
    appearance: Literal["detected", "paper"] = "detected"
    """What ghosts look like. `detected`: their score, size, returns and speed are those of real detections at similar
    distances. `paper`: their score is 1 and their size fixed, as in the paper's experiments; this marks them."""
    start_s: Annotated[float, Ge(0), Le(NEVER_S)] = 30.0
    """Recorded time at which the attack begins [s]; 1e8 is never. Before it, its vehicles are honest and build up
    trust. With `together_with`, it begins with that section unless this is set."""
    when: When = "persistent"
    """Steps in which the attack is active. `persistent`: in every step. `sporadic`: with probability `active_p`.
    `on_off`: for the share `duty_p` of every period. `sleeper`: from the time at which the attacker's own trust has
    reached `wake_trust`. `camouflage`: while the attacker's own trust is above `keep_above`."""
    active_p: Share = 0.5
    """With `sporadic`: probability that a vehicle attacks in a step."""
    period_s: Annotated[float, Gt(0), Le(1e8)] = 50.0
    """With `on_off`: length of a period [s]. The first period begins with the attack, and all vehicles of the section
    have the same periods."""
    period_windows: Annotated[float, Gt(0), Le(1e6)] | None = None
    """With `on_off`: length of a period in windows of evidence (`trust.freshness_s`). If this is set, `period_s` is
    ignored."""
    duty_p: Share = 0.5
    """With `on_off`: share of each period, from its beginning, in which the attack is active."""
    wake_trust: Share = 0.9
    """With `sleeper`: a vehicle begins once the last broadcast trust in it has reached this value."""
    keep_above: Share = 0.6
    """With `camouflage`: a vehicle attacks while the last broadcast trust in it is above this value."""
    victim: Victim = "nearest"
    """Victim of an attacker, always another equipped vehicle within `victim_range_m`. `nearest`: the nearest one.
    `one`: the vehicle `victim_id`. `region`: the nearest one in `region_m`. `random`: a random one in every step.
    `designated`: the nearest one of those that `victim_p` selects."""
    victim_id: str = ""
    """With `one`: SUMO id of the victim of all attackers, as in the paper."""
    victim_range_m: Annotated[float, Gt(0), Le(10_000)] = 100.0
    """Largest distance between an attacker and its victim [m]."""
    victim_p: Share = 0.05
    """With `designated`: share of the equipped vehicles that are victims, drawn from their names. Attackers are never
    victims. All attackers near a victim aim at it, as in the paper."""
    region_m: tuple[Coordinate, Coordinate, Annotated[float, Gt(0), Le(1e6)]] = (0.0, 0.0, 100.0)
    """With `region`: x and y of the centre in the world frame, and the radius [m]."""
    renewal: Renewal = "by_policy"
    """When its vehicles change their pseudonyms. `by_policy`: by the pseudonym policy, like all vehicles.
    `whitewashing`: also when the last broadcast trust in them is below `renew_below`. `newcomer`: also every
    `renew_s`, so that they always have the default trust. Further identities of a Sybil attacker keep their pseudonyms,
    whatever the policy."""
    renew_below: Share = 0.5
    """With `whitewashing`: a vehicle takes a new pseudonym if its trust is below this value."""
    renew_s: Annotated[float, Gt(0), Le(1e8)] = 10.0
    """With `newcomer`: time after which a vehicle changes its pseudonym [s]."""

    @property
    def is_meant_to_begin(self) -> bool:
        """Whether the attack has attackers, and a time at which it begins."""
        has_attackers = self.share_p > 0 or bool(self.ids) or self.together_with is not None
        return has_attackers and self.start_s < NEVER_S

    @property
    def reads_trust(self) -> bool:
        """Whether its vehicles depend on the trust that is broadcast about them."""
        return self.when in ("sleeper", "camouflage") or self.renewal == "whitewashing"

    def period_of(self, freshness_s: float | str) -> float:
        """Length of a period of `on_off` [s]. `freshness_s` is the window of evidence."""
        return self.period_s if self.period_windows is None else self.period_windows * float(freshness_s)


PAPER: tuple[dict[str, Any], ...] = (
    {"attack": "ghost_insertion", "role": "malicious"},
    {"attack": "unreliable", "role": "unreliable"},
)
"""The default: the two behaviours of TruPercept's experiments."""


def check_attacks(params: Sequence[AttackParams], freshness_s: float | str, interval_s: float) -> None:
    """Raise a ValueError of one line if a section is not possible. `interval_s` is the time between two messages."""
    total = sum(shares(params))
    if total > 1 + 1e-9:
        raise ValueError(
            f"attacks: the shares share_p sum to {total:g}, more than all equipped vehicles. "
            "Lower one of them so that they sum to at most 1."
        )
    named = [name for p in params if p.together_with is None for name in p.ids]
    if twice := sorted({name for name in named if named.count(name) > 1}):
        raise ValueError(
            f'attacks: "{twice[0]}" stands in ids twice. Name it once, and set together_with in its second section.'
        )
    for number, p in enumerate(params):
        _check(p, number, freshness_s, interval_s)


def _check(p: AttackParams, number: int, freshness_s: float | str, interval_s: float) -> None:
    where = f"attacks.{number}"
    if p.together_with is not None and p.together_with >= number:
        cure = (
            f"Set it to a number below {number}." if number else "The first has none before it: put it after another."
        )
        raise ValueError(
            f"{where}.together_with = {p.together_with} is no earlier section. Sections are numbered from 0. {cure}"
        )
    if p.ids and p.ring_size > len(p.ids):
        raise ValueError(
            f"{where}.ring_size = {p.ring_size} is larger than its {len(p.ids)} attackers. "
            f"Set it to at most {len(p.ids)}, or name more ids."
        )
    if p.when == "on_off":
        if p.period_windows is not None and freshness_s == "off":
            raise ValueError(
                f'{where}.period_windows = {p.period_windows:g}, but with trust.freshness_s = "off" there are no '
                f"windows. Set {where}.period_s."
            )
        if (period_s := p.period_of(freshness_s)) < interval_s - 1e-9:
            raise ValueError(
                f"{where}: a period of {period_s:g} s is shorter than one step of {interval_s:g} s, so no vehicle can "
                f"be on and off in it. Set {where}.period_s to {2 * interval_s:g} or more."
            )
    if p.victim == "one" and not p.victim_id:
        raise ValueError(f'{where}.victim = "one" needs a victim. Set {where}.victim_id to its SUMO id.')
    if p.victim_id and p.victim != "one":
        raise ValueError(f'{where}.victim_id = "{p.victim_id}" is used only with victim = "one". Set {where}.victim.')


def rings_too_large(params: Sequence[AttackParams], attack: UInt8[ndarray, "n"]) -> list[str]:
    """One line for each section whose ring size is larger than its number of attackers.

    If attackers are drawn by a share, their number is known only at the end of a run.

    Parameters
    ----------
    attack
        The attack of each actor of the run, as in `world.attack`.
    """
    n_of = np.bincount(attack, minlength=len(params) + 1)
    return [
        f"attacks.{number}.ring_size = {p.ring_size} is larger than its {n_of[owner + 1]} attackers: no ring was "
        f"complete. Raise share_p or fleet.penetration_p, or set it to at most {n_of[owner + 1]}."
        for number, (p, owner) in enumerate(zip(params, owners(params), strict=True))
        if p.ring_size > n_of[owner + 1]
    ]


def owners(params: Sequence[AttackParams]) -> tuple[int, ...]:
    """For each section, the number of the section that defines its vehicles."""
    found: list[int] = []
    for number, p in enumerate(params):
        found.append(number if p.together_with is None else found[p.together_with])
    return tuple(found)


def shares(params: Sequence[AttackParams]) -> tuple[float, ...]:
    """Share of the equipped vehicles that is drawn for each section; 0 if its vehicles are not drawn."""
    return tuple(0.0 if p.ids or p.together_with is not None else p.share_p for p in params)


def named(params: Sequence[AttackParams]) -> dict[str, int]:
    """SUMO ids that sections name, and the number of the section, counted from 0."""
    section_of: dict[str, int] = {}
    for number, p in enumerate(params):
        if p.together_with is None:
            section_of |= dict.fromkeys(p.ids, number)
    return section_of


def roles_of(params: Sequence[AttackParams]) -> UInt8[ndarray, "a"]:
    """Code of the role (`cosim.base.codes.Role`) for each number of `world.attack`. Number 0 means honest."""
    roles = [Role[p.role.upper()] for p in params]
    return np.array([Role.HONEST, *roles], np.uint8)
