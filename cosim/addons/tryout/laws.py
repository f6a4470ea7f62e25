"""Laws of the classes that are part of a step, checked on the tiny scene."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from cosim.addons.tryout import play, trust_laws
from cosim.addons.tryout.findings import Finding, Report, in_one_line, smallest
from cosim.addons.tryout.play import BASE, Stage, Table, WithBeliefs
from cosim.addons.tryout.probe import TOLERANCE, Observations, Probe
from cosim.addons.tryout.scene import ACTORS, N_STEPS, STEP_S, STRANGER, Actor, TinyScene
from cosim.config.config import load
from cosim.door.kinds import KINDS
from cosim.door.load import resolve
from cosim.step.parts import Parts, check_choices
from cosim.step.result import StepResult

INTERRUPTED_AT = 7


@dataclass(frozen=True, slots=True)
class PartKind:
    """A kind of class that is part of a step."""

    tell: Callable[[StepResult, TinyScene], Table]
    """The results that the class determines."""
    draws: str
    """A sentence about the source of its random numbers."""
    keeps: str = "Keep nothing between calls."
    """A sentence about what lasts from step to step."""
    names: str = "Read names (name_key) and positions, never row numbers or actor numbers as such."
    """A sentence about how it tells vehicles apart."""
    change: Callable[[Parts], Parts] = lambda parts: parts
    """Change of the scene's parts that the class needs to be used."""
    sees_truth: bool = False


_IN_STATE = "Keep in the state, as numbers, arrays and plain objects, whatever lasts from step to step."
PARTS = {
    "trust": PartKind(
        play.trust,
        "A trust model draws no random numbers.",
        keeps="Keep in self, as numbers, arrays and plain objects, whatever lasts from step to step.",
        names="Pseudonyms tell vehicles apart: never sort or compute by them.",
    ),
    "attack": PartKind(
        play.messages,
        "Draw with context.uniforms(...), keyed by the vehicle's name.",
        keeps="Keep in context.memory, as numbers, arrays and plain objects, whatever lasts from step to step.",
    ),
    "policy": PartKind(play.renewals, "Draw with ages.trip_draws and ages.step_draws."),
    "medium": PartKind(
        play.receptions,
        "Draw with draws(seed, step, names), the names being keys of stations and messages.",
        keeps=_IN_STATE,
    ),
    "detector": PartKind(play.detections, "Draw with draws.uniforms(seen) or draws.normals(seen).", sees_truth=True),
    "driver": PartKind(
        play.commands,
        "Draw with draws(seed, world.step, world.name_key).",
        keeps=_IN_STATE,
        change=lambda parts: replace(parts, driver=WithBeliefs(parts.driver)),
    ),
}
"""Kinds of classes that are part of a step, by name."""


def try_part(kind: str, name: str, own: Sequence[str]) -> Report:
    """Check a class that is part of a step.

    Parameters
    ----------
    kind
        One of `PARTS`.
    name
        Name of the class.
    own
        Its parameters, each as `key=value`.

    Raises
    ------
    ValueError
        The class or its parameters cannot be loaded. The message is one line.
    """
    part = PARTS[kind]
    section = "attacks.0" if kind == "attack" else KINDS[kind].section
    interferes = kind == "attack" and hasattr(resolve(KINDS[kind], name).of, "sending")
    sets = [*BASE]
    if interferes:  # a unit disk has no interference that an attack on the channel could cause
        sets.append("radio.model=csma")
    sets.append(f"{section}.{KINDS[kind].key}={name}")
    sets += [f"{section}.{one}" for one in own]
    config = load(None, sets)
    config = replace(config, trust_variant=(), attacks=config.attacks[:1])
    check_choices(config)
    stage, seen = Stage(config, part.change), Observations()
    found: list[Finding] = []
    try:
        watched = Stage(config, lambda parts: part.change(_probed(parts, kind, seen)))
        watched.play(TinyScene(), part.tell)
        told = stage.play(TinyScene(), part.tell)
    except Exception as error:  # whatever a user's class does
        found.append(Finding("it runs, and returns what its interface asks for", in_one_line(error)))
        return Report(kind, name, found)
    found.append(Finding("it runs, and returns what its interface asks for"))
    if kind != "trust":
        twice = seen.twice and f"{seen.twice} {part.draws} {part.keeps}"
        found.append(Finding("asked twice, it answers the same", twice))
    if kind == "policy":
        found.append(Finding("each vehicle changes for itself", seen.alone))
    if kind == "attack":
        found.append(Finding("it does not read the truth", seen.truth))
    for law, how in _comparisons(kind).items():
        found.append(_told(law, stage, part, told, how))
    if kind == "trust":
        more, seen = trust_laws.findings(stage)
        found += more
    n_equipped = sum(actor.equipped for actor in ACTORS)
    cost_us = 1e6 * seen.seconds / seen.n_calls / n_equipped if seen.n_calls else np.nan
    return Report(kind, name, found, cost_us, _note(kind, stage, told))


def _note(kind: str, stage: Stage, told: list[Table]) -> str:
    """A sentence if the class did nothing in the scene, so that the laws say little about it; empty otherwise."""
    nothing: list[Table] = [{} for _ in told]
    if kind == "attack":
        nothing = replace(stage, change=play.with_harmless_attackers).play(TinyScene(), PARTS[kind].tell)
    if first_difference(nothing, told)[1]:
        return ""
    return (
        f"It did nothing in the {N_STEPS * STEP_S:g} s of this scene, and so could break no law. "
        "Let it act: --set changes its parameters."
    )


class _Comparison(NamedTuple):
    """A second play that differs from the first in one respect."""

    says: str
    """The difference between the plays."""
    cure: str
    """What to do if results differ."""
    scene: Callable[[TinyScene], TinyScene] = lambda one: one
    change: Callable[[Parts], Parts] | None = None
    """Change of the parts in both plays."""
    interrupted_at: int | None = None


def _comparisons(kind: str) -> dict[str, _Comparison]:
    """Laws that compare two plays."""
    part = PARTS[kind]
    found = {
        "the same seed gives the same result": _Comparison(
            says="played a second time with the same seed",
            cure=part.draws,
        ),
        "numbers and order of the actors change nothing": _Comparison(
            scene=TinyScene.renumbered,
            says="with other actor numbers, and the rows in their order",
            cure=part.names,
        ),
        "a vehicle that one does not meet changes nothing": _Comparison(
            scene=TinyScene.with_stranger,
            says="with one more vehicle, 9 km away",
            cure=f"Each vehicle's result follows from what it perceives and receives. {part.draws}",
        ),
        "it goes on from a checkpoint": _Comparison(
            interrupted_at=INTERRUPTED_AT,
            says=f"interrupted and resumed before step {INTERRUPTED_AT}",
            cure=part.keeps,
        ),
    }
    if not part.sees_truth and kind != "attack":
        found["it does not read the truth"] = _Comparison(
            scene=TinyScene.with_other_attackers,
            change=play.with_harmless_attackers,
            says="with other vehicles as attackers, all of which do nothing",
            cure="Who attacks is known to the tables alone: leave `attack` and all that is called truth unread.",
        )
    return found


def _told(
    law: str,
    stage: Stage,
    part: PartKind,
    told: list[Table],
    other: _Comparison,
) -> Finding:
    """Check a law: play once more with this one difference. `told` are the results of the first play."""
    change, says, cure = other.change, other.says, other.cure
    if change is not None:
        stage, told = replace(stage, change=lambda parts: change(part.change(parts))), []

    def compared(one: TinyScene, n_steps: int, first: list[Table]) -> tuple[int, str]:
        first = first or stage.play(one, part.tell, n_steps)
        return first_difference(first, stage.play(other.scene(one), part.tell, n_steps, other.interrupted_at))

    actors = list(TinyScene().actors)
    try:
        step, found = compared(TinyScene(), N_STEPS, told)
        if not found:
            return Finding(law)
        n_steps, examples = step + 1, {len(actors): (step, found)}

        def is_broken(some: list[Actor]) -> bool:
            step, found = compared(TinyScene(tuple(some)), n_steps, [])
            if found:
                examples[len(some)] = step, found
            return bool(found)

        n = len(smallest(actors, is_broken))
    except Exception as error:  # whatever a user's class does
        begin = says[0].upper() + says[1:]
        return Finding(law, f"{begin}: {in_one_line(error)} {cure}")
    step, found = examples[n]
    actors_left = f"{n} actors" if n > 1 else "1 actor"
    return Finding(law, f"Step {step}, {actors_left}: {found} {says}. {cure}")


def first_difference(one: list[Table], other: list[Table]) -> tuple[int, str]:
    """The first step in which two plays differ, and the difference in words; empty if they are the same."""
    for number, (a, b) in enumerate(zip(one, other, strict=True)):
        for who in dict.fromkeys([*a, *b]):
            if STRANGER.name in who:
                continue
            if who not in a or who not in b:
                return number, f"{who} is {'there as it is, but not' if who in a else 'not there as it is, but it is'}"
            for name, x in a[who].items():
                y = b[who][name]
                if not np.isclose(x, y, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True):
                    return number, f"{name} of {who} is {x:.6g}, but {y:.6g}"
    return 0, ""


def _probed(parts: Parts, kind: str, seen: Observations) -> Parts:
    """The parts, with a probe around the class that is tested."""

    def probe(behind: Any) -> Any:
        return Probe(behind, tuple(KINDS[kind].hooks), seen)

    if kind == "attack":
        attacks = tuple(probe(one) for one in parts.adversary.attacks)
        return replace(parts, adversary=replace(parts.adversary, attacks=attacks))
    if kind == "policy":
        return replace(parts, pseudonyms=replace(parts.pseudonyms, policy=probe(parts.pseudonyms.policy)))
    if kind == "detector":
        parts.perception.detector = probe(parts.perception.detector)  # type: ignore[attr-defined]
        return parts
    if kind == "medium":
        return replace(parts, medium=probe(parts.medium))
    if kind == "driver":
        return replace(parts, driver=probe(parts.driver))
    return parts
