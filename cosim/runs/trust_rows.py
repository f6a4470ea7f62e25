"""Rows of the tables about evaluations and trust, as `cosim.runs.recording` appends them."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.codes import EvaluationKind, LookupState
from cosim.base.ragged import stable_order
from cosim.messages.content import FABRICATED
from cosim.messages.trust_hosts import Lookups, ServerTraffic
from cosim.runs.rows import Columns, TakesRows
from cosim.step.result import Sensed
from cosim.step.trackers import evidence_audit
from cosim.world import World
from results.encounters import Rows
from trust.tables import TrustScores


def evaluation_rows(sensed: Sensed) -> Columns:
    """Evaluations of what is new to each evaluator since it last sensed."""
    evaluated, known, detections = sensed.evaluated, sensed.known, sensed.known.detections
    member, evaluator = evaluated.lists.member, evaluated.lists.owner[evaluated.lists.of_member()]
    rows: Rows = {
        "evaluator": known.pseudonym[evaluator],
        "observer": known.pseudonym[detections.message[member]],
        "detection_index": detections.detection_index[member],
        "evaluation": evaluated.reported.evaluation,
        "visibility": evaluated.reported.visibility,
        "n_points": evaluated.n_points,
        "plausible": evaluated.plausible,
        "plausible__valid": ~evaluated.matched,
        "matched": evaluated.matched,
        "lied": evaluated.lied,
        "detection_step": known.detection_step(member),
    }
    if evaluated.number is not None:
        rows["detection_index"], rows["kind"] = np.divmod(evaluated.number, len(EvaluationKind))
        rows["plausible__valid"] = (rows["kind"] == EvaluationKind.DETECTION) & ~evaluated.matched
    new = np.flatnonzero(known.is_new(sensed.senders.source[evaluator], member))
    return {name: column.take(new) for name, column in rows.items()}


def transmitted(recorder: TakesRows, now_step: int, sensed: Sensed) -> None:
    """Append evaluations as transmitted, and the scores that were transmitted with the detections."""
    sent, own = sensed.evaluated.sent, sensed.evaluated.kept_messages
    rows = {
        "evaluator": np.repeat(sent.evaluator, np.diff(sent.ptr)),
        "observer": sent.observer,
        "detection_index": sent.detection_index,
        "evaluation": sent.evaluation,
        "visibility": sent.visibility,
        "own_evaluation": own.evaluation,
        "own_visibility": own.visibility,
        "detection_step": sent.detection_step,
    }
    if sensed.evaluated.number is not None:
        rows["detection_index"], rows["kind"] = np.divmod(sent.detection_index, len(EvaluationKind))
    recorder.append("transmitted_evaluations", now_step, rows)
    detections, chosen = sensed.listed.detections, sensed.listed.objects.transmitted
    scores = {
        "observer": sensed.observer()[chosen],
        "detection_index": detections.detection_index[chosen],
        "score": detections.score[chosen],
    }
    recorder.append("transmitted_scores", now_step, scores)


def evidence_rows(world: World, sensed: Sensed) -> Columns:
    """Counts of what the new evaluations say of real and of fabricated detections."""
    known, (lists, _, reported) = sensed.known, sensed.evaluated.of_detections()
    evaluator = lists.owner[lists.of_member()]
    new = np.flatnonzero(known.is_new(sensed.senders.source[evaluator], lists.member))
    evaluations = evidence_audit.AuditedEvaluations(
        evaluator=evaluator[new],
        detection=lists.member[new],
        evaluation=reported.evaluation[new],
        visibility=reported.visibility[new],
    )
    detections = evidence_audit.AuditedDetections(
        message=known.detections.message,
        actor=known.truth.actor_row,
        is_real=known.truth.is_real,
        is_fabricated=known.objects.origin == FABRICATED,
    )
    attacks = world.attack[sensed.vehicles.row[known.vehicle]] > 0
    n_copies = 0
    for broadcast in sensed.rounds:
        n_copies += broadcast.round.frames.n_duplicate
        for late in (*broadcast.late, *broadcast.late_clouds):
            n_copies += late.round.frames.n_duplicate
    return evidence_audit.audit(evaluations, detections, attacks, n_copies)


def trust(recorder: TakesRows, world: World, sensed: Sensed, dt_s: float) -> None:
    """Append the tables of trust, which are about vehicles: without look-ups of roadside units or about them."""
    used = sensed.looked_up.messages
    receiver = sensed.sensing.actor[used.receiver]
    subject = sensed.known.pseudonym[used.message]
    # Several messages of one sender may be in use; its trust is looked up once.
    _, chosen = np.unique(receiver.astype(np.int64) << 32 | subject, return_index=True)
    units = world.is_roadside[sensed.vehicles.row]
    pseudonym = sensed.vehicles.pseudonym[units]
    if units.any():
        by_vehicle = ~np.isin(receiver, sensed.vehicles.actor[units])
        chosen = chosen[(by_vehicle & ~np.isin(subject, pseudonym))[chosen]]

    lookups = [found.take(chosen) for found in sensed.looked_up.lookups]
    of_variant = []
    for variant, scores in enumerate(sensed.published):
        if scores is None:
            continue
        if units.any():
            scores = scores.take(~np.isin(scores.subject, pseudonym))
        of_variant.append((variant, scores))
    _published(recorder, world.step, dt_s, of_variant)
    recorder.append("server", world.step, _server_rows(sensed.servers))
    _lookups(recorder, world.step, receiver[chosen], subject[chosen], lookups)


def _server_rows(servers: Sequence[ServerTraffic | None]) -> Columns:
    """One row per trust variant that has a server: the traffic from and to it."""
    names = ("variant", *_UP, *_DOWN)
    rows: dict[str, list[int]] = {name: [] for name in names}
    for variant, server in enumerate(servers):
        if server is None:
            continue
        rows["variant"].append(variant)
        for name in _UP:
            rows[name].append(getattr(server.up, name))
        for name in _DOWN:
            rows[name].append(getattr(server.down, name))
    return {name: np.array(values, np.int64) for name, values in rows.items()}


_UP = ("n_reports", "n_reached", "n_lost", "n_late", "n_over_capacity", "n_outage", "uplink_bytes")
_DOWN = ("n_addressed", "n_informed")


def _published(recorder: TakesRows, now_step: int, dt_s: float, of_variant: Sequence[tuple[int, TrustScores]]) -> None:
    """Append the trust scores that servers computed in this step, one variant after another.

    `of_variant` has the number of each variant whose server computed scores, and these scores.
    """
    if not of_variant:
        return

    def joined(name: str) -> ndarray:
        return np.concatenate([getattr(scores, name) for _, scores in of_variant])

    n = [len(scores.subject) for _, scores in of_variant]
    uncertainty, is_evaluated, oldest = (joined(x) for x in ("uncertainty", "is_evaluated", "oldest_evaluation_step"))
    n_evaluators = [s.n_evaluations if s.n_evaluators is None else s.n_evaluators for _, s in of_variant]
    rows = {
        "variant": np.repeat([v for v, _ in of_variant], n),
        "subject": joined("subject"),
        "trust": joined("trust"),
        "uncertainty": uncertainty,
        "uncertainty__valid": ~np.isnan(uncertainty),
        "weight": joined("weight"),
        "state": np.where(is_evaluated, LookupState.EVALUATED, LookupState.UNEVALUATED),
        **_evaluations_behind(
            n=joined("n_evaluations"),
            n_evaluators=np.concatenate(n_evaluators),
            newest_s=(now_step - joined("newest_evaluation_step")) * dt_s,
            oldest_s=np.where(oldest < 0, np.nan, (now_step - oldest) * dt_s),
            some=is_evaluated,
            counted=np.repeat([scores.n_evaluators is not None for _, scores in of_variant], n),
        ),
    }
    recorder.append("trust", now_step, rows)


def _lookups(
    recorder: TakesRows,
    now_step: int,
    receiver: Int[ndarray, "n"],
    subject: Int[ndarray, "n"],
    lookups: Sequence[Lookups],
) -> None:
    """Append look-ups of trust and their sums, sorted by variant and subject.

    Parameters
    ----------
    receiver, subject
        Per look-up, the actor number of the vehicle that looks up, and the pseudonym that it asks about.
    lookups
        Per trust variant, the answers, aligned with `receiver` and `subject`.
    """
    n, n_variants = len(receiver), len(lookups)
    nothing = np.zeros(n, np.int64)

    def joined(name: str) -> ndarray:
        columns = (getattr(found, name) for found in lookups)
        return np.concatenate([nothing if column is None else column for column in columns])

    answers = Lookups(*(joined(field.name) for field in fields(Lookups)))
    recorder.append("lookup_totals", now_step, _lookup_totals(answers, n_variants))
    order = stable_order(subject)
    first = n * np.arange(n_variants)  # row of the first answer of each variant
    found = answers.take((first[:, None] + order).ravel())
    rows = {
        "variant": np.repeat(np.arange(n_variants), n),
        "subject": np.tile(subject[order], n_variants),
        "receiver": np.tile(receiver[order], n_variants),
        "trust": found.trust,
        "source": found.source,
        "state": found.state,
        "age_s": found.age_s,
        "age_s__valid": ~found.is_default,
        **_evaluations_behind(
            n=found.n_evaluations,
            n_evaluators=np.asarray(found.n_evaluators),
            newest_s=found.newest_evaluation_age_s,
            oldest_s=found.oldest_evaluation_age_s,
            some=found.is_known,
            counted=np.repeat([one.n_evaluators is not None for one in lookups], n),
        ),
    }
    recorder.append("trust_lookups", now_step, rows)


def _lookup_totals(found: Lookups, n_variants: int) -> Rows:
    """Sums over the look-ups of a step by variant and state, without states that do not occur.

    `found` holds the look-ups of all variants, one variant after another.
    """
    n_states = len(LookupState)
    n_groups = n_variants * n_states
    variant = np.repeat(np.arange(n_variants), len(found.state) // n_variants)
    group = variant * n_states + found.state
    has_value, is_known = ~found.is_default, found.is_known

    def total(of: ndarray, weight: ndarray | None = None) -> ndarray:
        return np.bincount(group[of], None if weight is None else weight[of], n_groups)

    oldest_s = total(is_known, found.oldest_evaluation_age_s)
    rows = {
        "variant": np.repeat(np.arange(n_variants), n_states),
        "state": np.tile(np.arange(n_states), n_variants),
        "n": np.bincount(group, minlength=n_groups),
        "n_valued": total(has_value),
        "age_sum_s": total(has_value, found.age_s),
        "newest_evaluation_age_sum_s": total(is_known, found.newest_evaluation_age_s),
        "oldest_evaluation_age_sum_s": oldest_s,
        "oldest_evaluation_age_sum_s__valid": ~np.isnan(oldest_s),
    }
    occurs = rows["n"] > 0
    return {name: column[occurs] for name, column in rows.items()}


def _evaluations_behind(
    n: Int[ndarray, "n"],
    n_evaluators: Int[ndarray, "n"],
    newest_s: Float[ndarray, "n"],
    oldest_s: Float[ndarray, "n"],
    some: Bool[ndarray, "n"],
    counted: Bool[ndarray, "n"],
) -> Rows:
    """Columns about the evaluations behind trust values.

    `some` is true for values with at least one evaluation, `counted` where the number of evaluators is known. An oldest
    age that the model does not keep is NaN.
    """
    return {
        "n_evaluations": n,
        "n_evaluators": n_evaluators,
        "n_evaluators__valid": counted,
        "newest_evaluation_age_s": newest_s,
        "newest_evaluation_age_s__valid": some,
        "oldest_evaluation_age_s": oldest_s,
        "oldest_evaluation_age_s__valid": some & ~np.isnan(oldest_s),
    }
