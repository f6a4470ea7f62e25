"""Laws of trust models about received messages, checked with the evidence of the tiny scene."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray

from cosim.addons.tryout.findings import Finding, in_one_line, smallest
from cosim.addons.tryout.play import Stage, Table
from cosim.addons.tryout.probe import TOLERANCE, Observations, difference
from cosim.addons.tryout.scene import TinyScene
from cosim.door.blame import ExtensionError
from cosim.step.result import StepResult
from cosim.step.state import State
from trust.tables import EvaluationMessages, ReceivedEvaluations, TrustScores

AT_ONCE = "it scores evaluations in the step that they are about"
ORDER = "the order of messages changes nothing"
HOLDERS = "what one holder receives changes nothing for another"
ASKING = "asking for scores changes nothing"


Transmitted = tuple[int, ndarray, ndarray, ndarray, ndarray]
"""Everything that was transmitted in a step: the arguments of `TrustModel.open_step`."""


@dataclass(frozen=True, slots=True)
class Reception:
    """One evaluation message at one holder."""

    messages: EvaluationMessages
    holder: int
    row: int

    def __str__(self) -> str:
        return f"from {self.messages.evaluator[self.row]} at {self.holder} in step {self.messages.step}"


def recorded(stage: Stage) -> tuple[list[Transmitted], list[Reception]]:
    """All transmissions in the scene, and all evaluation messages that vehicles receive or send."""
    steps: list[Transmitted] = []
    receptions: list[Reception] = []

    def tell(happened: StepResult, scene: TinyScene) -> Table:
        sensed = happened.sensed
        if sensed is not None:
            sent, row = sensed.listed.objects.transmitted, sensed.listed.detections
            pseudonyms, messages = sensed.senders.pseudonym, sensed.evaluated.sent
            of_detections = row.message[sent], row.detection_index[sent], row.score[sent]
            steps.append((happened.world.step, pseudonyms, *of_detections))
            got, actor = sensed.rounds[1].links.vehicles, sensed.vehicles.actor
            pairs = [*zip(actor[got.receiver].tolist(), got.message.tolist(), strict=True)]
            receptions.extend(Reception(messages, holder, row) for holder, row in pairs)
        return {}

    stage.play(TinyScene(), tell)
    return steps, receptions


def findings(stage: Stage) -> tuple[list[Finding], Observations]:
    """Findings about the laws, and the processing time of the model."""
    steps, receptions = recorded(stage)
    parts, seen = stage.parts(TinyScene()), Observations()

    def new_model() -> Any:
        model = State.start(parts).trust.hosts[0].model
        guard = parts.trust.models[0].guard
        return model if guard is None else guard(model)

    def played(rows: list[Reception], **how: Any) -> TrustScores:
        return _played(new_model(), steps, rows, **how)

    def found(law: str, breaks: Callable[..., str]) -> Finding:
        try:
            return Finding(law, breaks(receptions, played))
        except ExtensionError as error:
            return Finding(law, in_one_line(error))

    try:
        played(receptions)  # compiles
    except ExtensionError as error:
        return [Finding(AT_ONCE, in_one_line(error))], seen
    begin_s = time.perf_counter()
    played(receptions, n_asked=1)
    seen.seconds, seen.n_calls = time.perf_counter() - begin_s, len(steps)
    return [found(ORDER, _order), found(HOLDERS, _holders), found(ASKING, _asking)], seen


def _played(
    model: Any,
    steps: list[Transmitted],
    receptions: list[Reception],
    late_steps: int = 0,
    reverse: bool = False,
    n_asked: int = 0,
) -> TrustScores:
    """Scores of a model at the end of the scene.

    Parameters
    ----------
    late_steps
        Number of steps by which every second message is late. All messages have arrived at the end.
    reverse
        Messages arrive one by one, the last first. Otherwise the messages of a step arrive together.
    n_asked
        How often scores are also computed in every step.
    """
    due: list[list[Reception]] = [[] for _ in steps]
    number_of = {step: number for number, (step, *_) in enumerate(steps)}
    for k, one in enumerate(receptions):
        arrives = number_of[one.messages.step] + late_steps * (k % 2)
        due[min(arrives, len(steps) - 1)].append(one)
    for number, now in enumerate(steps):
        model.open_step(*now)
        for received in _batches(due[number], reverse):
            model.add_evaluations(received)
        for _ in range(n_asked):
            model.scores(now[0])
    return model.scores(steps[-1][0])


def _batches(receptions: list[Reception], one_by_one: bool) -> list[ReceivedEvaluations]:
    """Receptions as arguments of `add_evaluations`: one by one, last first, or those of one step together."""
    groups: dict[int, list[Reception]] = {}
    for number, one in enumerate(receptions):
        groups.setdefault(number if one_by_one else one.messages.step, []).append(one)
    batches = []
    for group in groups.values():
        holder = np.array([one.holder for one in group])
        row = np.array([one.row for one in group])
        batches.append(ReceivedEvaluations(group[0].messages, holder, row))
    return batches[::-1] if one_by_one else batches


def _order(receptions: list[Reception], played: Callable[..., TrustScores]) -> str:
    """A sentence if trust depends on the order of messages, within a step or across steps; empty otherwise."""
    others: dict[str, dict[str, Any]] = {
        "arrive in the opposite order": {"reverse": True},
        "arrive up to two rounds of messages later": {"late_steps": 2},
    }
    for what, how in others.items():

        def differs(some: list[Reception], how: dict[str, Any] = how) -> str:
            return _first_row(played(some), played(some, **how))

        if differs(receptions):
            few = smallest(receptions, lambda some: bool(differs(some)))
            n, which = len(few), "; ".join(map(str, few[:3]))
            more = f" and {n - 3} more" if n > 3 else ""
            messages = "1 message" if n == 1 else f"{n} messages"
            return (
                f"{messages} ({which}{more}) {what}: {differs(few)}. "
                "Sum evidence by the step in `received.messages.step`, and decide nothing by who comes first."
            )
    return ""


def _holders(receptions: list[Reception], played: Callable[..., TrustScores]) -> str:
    holder = receptions[0].holder
    its_own = [one for one in receptions if one.holder == holder]
    whole, alone = played(receptions), played(its_own)
    rows = whole.take(whole.holder == holder)
    found = _first_row(rows, alone.take(alone.holder == holder))
    return found and f"Without the messages that others receive, {found}. Keep the evidence of each holder apart."


def _asking(receptions: list[Reception], played: Callable[..., TrustScores]) -> str:
    found = _first_row(played(receptions), played(receptions, n_asked=2))
    return found and f"Asked for scores twice in every step before, {found}. scores() changes nothing in the model."


def _first_row(one: TrustScores, other: TrustScores) -> str:
    """The first different trust value, in words; empty if the scores are the same."""
    if difference((one.holder, one.subject), (other.holder, other.subject)):
        holder, subject = min(_pairs(one) ^ _pairs(other))
        return f"{holder} has no trust value of {subject} any more, or has one that it had not"
    differ = np.flatnonzero(~np.isclose(one.trust, other.trust, rtol=TOLERANCE, atol=TOLERANCE))
    if not differ.size:
        return ""
    row = differ[0]
    trust = f"trust of {one.holder[row]} in {one.subject[row]}"
    return f"{trust} is {other.trust[row]:.6g} instead of {one.trust[row]:.6g}"


def _pairs(scores: TrustScores) -> set[tuple[int, int]]:
    return set(zip(scores.holder.tolist(), scores.subject.tolist(), strict=True))
