"""Plays recorded evidence through a trust model: what the model then answers whenever trust is looked up."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from time import process_time
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.benchmark.evidence import EvidenceRules, EvidenceStream, Rows
from cosim.base.ragged import ptr_of
from cosim.config.config import resolve_data
from cosim.config.data import override
from cosim.messages.trust_hosts import Variant
from cosim.step.parts import check_choices, sources, variants
from trust.params import EVIDENCE_KEYS
from trust.tables import SERVER, EvaluationMessages, ReceivedEvaluations, TrustScores


@dataclass(frozen=True, slots=True)
class Candidate:
    """A trust model that is scored, with its parameters."""

    name: str
    """As on the command line."""
    variant: Variant
    sha256: str
    """Checksum of the user's file; empty for an included model."""

    def new(self, dt_s: float) -> Any:
        """A new model. Every call of a user's own is checked."""
        v = self.variant
        make = v.make or v.model
        made = make(v.trust if v.own is None else v.own, dt_s)
        return made if v.guard is None else v.guard(made)


def candidate(name: str, sets: Sequence[str], rules: EvidenceRules) -> Candidate:
    """The model that a name refers to.

    Parameters
    ----------
    name
        An included model, or `path.py:Name`.
    sets
        Keys of the section [trust], each as `key=value`: parameters of the model, or `host`.

    Raises
    ------
    ValueError
        In one line: there is no such model, it does not have these parameters, or it cannot be made.
    """
    data: dict[str, Any] = {}
    for text in sets:
        override(data, text)
    given = {"model": name, "freshness_s": rules.freshness_s, "server_period_s": rules.server_period_s}
    config = resolve_data({"trust": given | data, "attacks": [], "encounters": [{}]}, "--set", None)
    check_choices(config)
    variant = variants(config)[0]
    params = getattr(variant.model, "Params", None) or type(config.trust)
    known = {f.name for f in fields(params)} - set(EVIDENCE_KEYS) | {"host"}
    if strange := sorted(data.keys() - known):
        raise ValueError(f"--set {strange[0]}: this key has no effect on recorded evidence. Leave it out.")
    if variant.trust.host == "none":
        raise ValueError('--set host=none: nobody would keep trust. Set "central" or "local".')
    return Candidate(name, variant, sources(config)["trust.model"].sha256)


@dataclass(frozen=True, slots=True)
class Script:
    """The evidence of a stream in the order in which models get it. All models share it."""

    opened: Sequence[tuple[int, ndarray, ndarray, ndarray, ndarray]]
    """By step: the arguments of `TrustModel.open_step`."""
    arrived: Sequence[Sequence[ReceivedEvaluations]]
    """By step: what the server has received at its beginning."""
    received: Sequence[Sequence[ReceivedEvaluations]]
    """By step: the evaluations that vehicles make, and those that they use."""
    lookups: Rows
    first: Int[ndarray, "t+1"]
    """By step: first row of `lookups`."""
    due: Sequence[bool]
    """By step: whether the server broadcasts."""
    dt_s: float

    @staticmethod
    def of(stream: EvidenceStream, rules: EvidenceRules) -> "Script":
        """The evidence of a stream."""
        sent = _messages(stream, rules)
        return Script(
            opened=_opened(stream, rules),
            arrived=_at_server(stream.reports, sent, rules),
            received=_at_vehicles(stream.lookups, sent, rules),
            lookups=stream.lookups,
            first=ptr_of(stream.lookups["step"], rules.n_steps),
            due=_due(rules),
            dt_s=rules.dt_s,
        )


def _due(rules: EvidenceRules) -> list[bool]:
    """By step: whether the server broadcasts."""
    due, last_s = [], -np.inf
    for step in range(rules.n_steps):
        now_s = step * rules.dt_s
        is_due = now_s - last_s >= rules.server_period_s - 1e-9
        due.append(is_due)
        last_s = now_s if is_due else last_s
    return due


def _at_server(
    reports: Rows, sent: Sequence[EvaluationMessages], rules: EvidenceRules
) -> list[list[ReceivedEvaluations]]:
    """What the server has received at the beginning of each step."""
    arrived: list[list[ReceivedEvaluations]] = [[] for _ in sent]
    begins = ptr_of(reports["step"], rules.n_steps)
    for made, messages in enumerate(sent):
        arrival = reports["arrival_step"][begins[made] : begins[made + 1]]
        arrives = (arrival >= 0) & (arrival < rules.n_steps)
        for step in np.unique(arrival[arrives]).tolist():
            row = np.flatnonzero(arrival == step)
            arrived[step] += _received(messages, np.full(len(row), SERVER), row, rules)
    return arrived


def _at_vehicles(
    asked: Rows, sent: Sequence[EvaluationMessages], rules: EvidenceRules
) -> list[list[ReceivedEvaluations]]:
    """The evaluations that vehicles make in each step, and those of the senders whose trust they look up."""
    received = []
    begins = ptr_of(asked["step"], rules.n_steps)
    for step, messages in enumerate(sent):
        own = np.arange(len(messages.evaluator))
        got = _received(messages, messages.evaluator, own, rules, is_own=True)
        here = slice(begins[step], begins[step + 1])
        holder = asked["receiver"][here].astype(np.int64)
        sender = asked["sender"][here].astype(np.int64)
        of_step = asked["message_step"][here].astype(np.int64)
        for earlier in np.unique(of_step).tolist():
            heard = np.flatnonzero(of_step == earlier)
            of_sender = np.searchsorted(sent[earlier].evaluator, sender[heard])
            got += _received(sent[earlier], holder[heard], of_sender, rules)
        received.append(got)
    return received


def _received(
    messages: EvaluationMessages,
    holder: Int[ndarray, "m"],
    row: Int[ndarray, "m"],
    rules: EvidenceRules,
    is_own: bool = False,
) -> list[ReceivedEvaluations]:
    """Receptions of messages, once for each step of which they evaluate detections."""
    parts = messages.of_one_step()
    return [ReceivedEvaluations(part, holder, row, rules.eta, is_own) for part in parts]


def _opened(stream: EvidenceStream, rules: EvidenceRules) -> list[tuple[int, ndarray, ndarray, ndarray, ndarray]]:
    """The detections of each step, and the pseudonyms of who sends or evaluates them."""
    rows, evaluations, found = stream.detections, stream.evaluations, []
    begins = ptr_of(rows["step"], rules.n_steps)
    order = np.argsort(evaluations["detection_step"], kind="stable")
    evaluators = evaluations["evaluator"][order]
    of = ptr_of(evaluations["detection_step"][order], rules.n_steps)
    for step in range(rules.n_steps):
        here = slice(begins[step], begins[step + 1])
        observer = rows["observer"][here]
        evaluator = evaluators[of[step] : of[step + 1]]
        who = np.union1d(observer, evaluator).astype(np.int64)
        index = rows["detection_index"][here].astype(np.int64)
        score = rows["score"][here] / 100
        found.append((step, who, np.searchsorted(who, observer), index, score))
    return found


def _messages(stream: EvidenceStream, rules: EvidenceRules) -> list[EvaluationMessages]:
    """The evaluation messages of each step."""
    rows, reports, found = stream.evaluations, stream.reports, []
    begins = ptr_of(rows["step"], rules.n_steps)
    sender_begins = ptr_of(reports["step"], rules.n_steps)
    for step in range(rules.n_steps):
        here = slice(begins[step], begins[step + 1])
        senders = slice(sender_begins[step], sender_begins[step + 1])
        evaluator = reports["evaluator"][senders].astype(np.int64)
        by = rows["evaluator"][here].astype(np.int64)
        ptr = np.append(np.searchsorted(by, evaluator), len(by))
        observer, index, of_step = (
            rows[name][here].astype(np.int64) for name in ("observer", "detection_index", "detection_step")
        )
        value = rows["evaluation"][here] / 100
        visibility = rows["visibility"][here] / 100
        found.append(EvaluationMessages(step, evaluator, ptr, observer, index, value, visibility, of_step))
    return found


@dataclass(frozen=True, slots=True)
class ModelAnswers:
    """What a model answers to the look-ups of a stream."""

    trust: Float[ndarray, "n"]
    """NaN where the value rests on no evaluation, or there is none."""
    age_s: Float[ndarray, "n"]
    """Age of the newest evaluation behind each value."""
    cost_s: float
    """Processor time of the model."""
    n_evaluations: int
    """Number of received evaluations."""


def play(script: Script, candidate: Candidate) -> ModelAnswers:
    """Play the evidence of a stream through a new model.

    The server gets messages when they arrived in the simulation, and a receiver looks up the newest broadcast that it
    had then. With `host = "local"` every vehicle keeps the evaluations that it made, and those that it uses.
    """
    model, asked = candidate.new(script.dt_s), script.lookups
    is_central = candidate.variant.trust.host == "central"
    trust, age_s = np.full((2, len(asked["step"])), np.nan)
    published: dict[int, TrustScores] = {}
    n, begin_s = 0, process_time()
    for step, opened in enumerate(script.opened):
        if is_central:
            for received in script.arrived[step]:
                model.add_evaluations(received)
                n += len(received)
            if script.due[step]:
                published[step] = model.scores(step)
        model.open_step(*opened)
        if not is_central:
            for received in script.received[step]:
                model.add_evaluations(received)
                n += len(received)
            rows = np.arange(script.first[step], script.first[step + 1])
            _fill(trust, age_s, script, rows, model.scores(step), asked["receiver"][rows])
    cost_s = process_time() - begin_s
    for step, scores in published.items():
        rows = np.flatnonzero(asked["broadcast_step"] == step)
        _fill(trust, age_s, script, rows, scores, np.full(len(rows), SERVER))
    return ModelAnswers(trust, age_s, cost_s, n)


def _fill(
    trust: ndarray,
    age_s: ndarray,
    script: Script,
    rows: Int[ndarray, "k"],
    scores: TrustScores,
    holder: Int[ndarray, "k"],
) -> None:
    """Write the values of these look-ups that rest on an evaluation."""
    asked = script.lookups
    sender = asked["sender"][rows].astype(np.int64)
    at, known = scores.rows_of(holder.astype(np.int64), sender)
    at, rows = at[known], rows[known]
    is_evaluated = scores.is_evaluated[at]
    at, rows = at[is_evaluated], rows[is_evaluated]
    trust[rows] = scores.trust[at]
    age_steps = asked["step"][rows] - scores.newest_evaluation_step[at]
    age_s[rows] = age_steps * script.dt_s
