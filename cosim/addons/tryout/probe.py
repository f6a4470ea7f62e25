"""Wraps an instance of the tested class, makes every call twice, and measures the processing time of calls."""

import copy
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray

from cosim.attacks.attack import AttackContext, EvaluationRows
from cosim.messages.content import FABRICATED, SELF, SENSED, Detections
from cosim.messages.pseudonyms import PseudonymAges

TOLERANCE = 1e-9
"""Numbers that differ by less (absolute or relative) count as equal, because sums depend on the order of rounding."""


def difference(one: Any, other: Any, where: str = "") -> str:
    """The first difference between two values, in words; empty if they are the same."""
    if type(one) is not type(other):
        return f"{where} is {type(one).__name__} and {type(other).__name__}".strip()
    if isinstance(one, ndarray | np.generic | float | int):
        return _of_arrays(np.asarray(one), np.asarray(other), where)
    ours: Iterable[Any]
    theirs: Iterable[Any]
    if is_dataclass(one):
        names = [f"{where}.{field.name}".lstrip(".") for field in fields(one)]
        ours, theirs = _values(one), _values(other)
    elif isinstance(one, dict):
        if one.keys() != other.keys():
            return f"{where} has the keys {sorted(map(str, one))} and {sorted(map(str, other))}"
        names = [f"{where}[{key!r}]" for key in one]
        ours, theirs = one.values(), [other[key] for key in one]
    elif isinstance(one, list | tuple):
        if len(one) != len(other):
            return f"{where} has {len(one)} and {len(other)} items"
        names = [f"{where}[{i}]" for i in range(len(one))]
        ours, theirs = one, other
    elif hasattr(one, "__dict__"):
        return difference(vars(one), vars(other), where)
    else:
        return "" if one == other else f"{where} is {one!r} and {other!r}"
    return next(filter(None, map(difference, ours, theirs, names)), "")


def _values(one: Any) -> list[Any]:
    """The values of a dataclass, field by field."""
    return [getattr(one, field.name) for field in fields(one)]


def _of_arrays(one: ndarray, other: ndarray, where: str) -> str:
    if one.shape != other.shape:
        return f"{where} has shape {one.shape} and {other.shape}"
    if one.dtype.kind in "fc":
        differ = ~np.isclose(one, other, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True)
    else:
        differ = one != other
    if not np.any(differ):
        return ""
    at = tuple(int(i) for i in np.argwhere(differ)[0])
    place = f"{where}[{', '.join(map(str, at))}]" if at else where
    return f"{place} is {one[at]} and {other[at]}"


@dataclass(slots=True)
class Observations:
    """What a probe has observed. Each sentence describes the first case."""

    seconds: float = 0.0
    n_calls: int = 0
    twice: str = ""
    """A difference between the results of two equal calls."""
    alone: str = ""
    """A vehicle for which a policy gives another result if it is called with this vehicle alone."""
    truth: str = ""
    """A difference in the result of an attack if only ground truth about other vehicles differs."""


@dataclass(slots=True)
class Probe:
    """A wrapper that callers cannot distinguish from the instance `behind` it."""

    behind: Any
    methods: tuple[str, ...]
    """Names of the methods that are observed."""
    seen: Observations = field(default_factory=Observations)

    @property  # type: ignore[misc]
    def __class__(self) -> type:  # so that isinstance() uses the tested class
        return type(self.behind)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.behind, name)
        return self._watched(name, value) if name in self.methods else value

    def _watched(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            kept, again = copy.deepcopy(arguments), copy.deepcopy(arguments)
            begin_s = time.perf_counter()
            answer = method(*arguments)
            self.seen.seconds += time.perf_counter() - begin_s
            self.seen.n_calls += 1
            first = copy.deepcopy(answer)
            second = method(*again)
            if not self.seen.twice and (found := difference(first, second)):
                self.seen.twice = f"{name}() is asked the same twice in a row, and the answers differ: {found}."
            if not self.seen.alone and kept and isinstance(kept[0], PseudonymAges):
                self.seen.alone = _by_others(method, kept[0], first)
            is_of_attack = bool(kept) and isinstance(kept[-1], AttackContext)
            if is_of_attack and not self.seen.truth and not self.seen.twice:
                self.seen.truth = _truth_read(name, method, kept, first)
            return answer

        return call


def _by_others(method: Callable[..., Any], ages: PseudonymAges, answer: ndarray) -> str:
    """Call a policy for each vehicle alone, and describe the first different result."""
    for row in range(len(ages.age_s)):
        alone = PseudonymAges(*(column[[row]] for column in _values(ages)))
        if method(alone)[0] != answer[row]:
            return (
                f"A vehicle of {ages.age_s[row]:g} s, "
                f"{ages.distance_m[row]:.3g} m and {ages.n_messages[row]} messages "
                f"{'changes' if answer[row] else 'does not change'} among {len(answer)} vehicles, and "
                f"{'does not' if answer[row] else 'does'} when it is alone. Decide for each row by that row."
            )
    return ""


def _truth_read(name: str, method: Callable[..., Any], arguments: tuple[Any, ...], answer: Any) -> str:
    """Call an attack again with other ground truth: other origins of detections of others, and other attackers."""
    context = copy.deepcopy(arguments[-1])
    member, attack = context.member, context.world.attack
    swapped = np.where(attack == 0, 255, 0)
    world = replace(context.world, attack=np.where(member, attack, swapped).astype(attack.dtype))
    blind = [_other_truth(copy.deepcopy(one), member) for one in arguments[:-1]]
    other = method(*blind, replace(context, world=world))
    found = difference(*(_of_attackers(one, arguments, context) for one in (answer, other)))
    if not found:
        return ""
    return (
        f"{name}() reads the truth: when other vehicles' detections have another origin (made by a detector, or "
        f"fabricated) and other vehicles attack, what its attackers send changes: {found}. An attack may read "
        "`origin`, `target` and `world.attack` of its own members (`context.member`) alone."
    )


def _other_truth(given: Any, member: ndarray) -> Any:
    if not isinstance(given, Detections):
        return given
    others = ~member[given.observer] & (given.origin != SELF)
    swapped = np.where(given.origin == SENSED, FABRICATED, SENSED)
    origin = np.where(others, swapped, given.origin).astype(given.origin.dtype)
    following = (given.target + 1) % len(member)
    return replace(given, origin=origin, target=np.where(others, following, given.target))


def _of_attackers(answer: Any, arguments: tuple[Any, ...], context: AttackContext) -> Any:
    """The part of a result that concerns attackers."""
    if isinstance(answer, Detections):
        return answer.take(np.flatnonzero(context.attacker[answer.observer]))
    if isinstance(arguments[0], EvaluationRows):
        rows = context.attacker[arguments[0].evaluator]
        return {name: column[rows] for name, column in zip(("evaluation", "visibility"), answer, strict=True)}
    if isinstance(answer, ndarray):
        return answer[context.attacker]
    return {f.name: getattr(answer, f.name)[context.attacker] for f in fields(answer)}
