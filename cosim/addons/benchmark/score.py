"""Scores a trust model on the evidence set: figures for each attack, with intervals over worlds.

All figures are of look-ups by honest vehicles from the first step of the attacks on. A sender is *excluded* at a
look-up if the value rests on an evaluation and is below the model's threshold. Models have different scales, so the
threshold belongs to the model: it is the largest that excludes at most 5 % of the evaluated look-ups in the worlds
without attack. A sender about whom nothing is known is not excluded.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from cosim.addons.benchmark.evidence import HONEST, EvidenceRules, EvidenceSet, EvidenceStream
from cosim.addons.benchmark.play import Candidate, ModelAnswers, Script, play
from results.metrics.intervals import UNKNOWN, ClusteredEstimate, ratio
from results.metrics.misbehaviour import threshold_at
from results.metrics.survival import kaplan_meier, median, median_band

FALSE_POSITIVES = 0.05
"""Largest share of evaluated look-ups that a model's threshold may exclude where nobody attacks."""
TRUE_DETECTIONS = ("bad_mouthing", "ballot_stuffing", "collusion", "random_evaluations", "trust_flip")
"""Attacks whose vehicles send no false detections."""

Advance = Callable[[str, int, int, str], None]


@dataclass(frozen=True, slots=True)
class Figures:
    """A model under one attack. Intervals are 95 % intervals of the bootstrap over worlds, if nothing else is said."""

    auc: ClusteredEstimate
    """Probability that the value of an honest sender is above that of an attacker at a look-up of the same world."""
    exclusion_s: ClusteredEstimate
    """Median time from the first look-up of an attacker's pseudonym to its first exclusion by any vehicle
    (Kaplan-Meier, with its own interval); NaN if more than half of these pseudonyms are never excluded."""
    wrong_p: ClusteredEstimate
    """Share of honest vehicle-steps that are excluded."""
    believed_p: ClusteredEstimate
    """Damage that was believed: share of the received messages of attackers whose sender is not excluded."""
    age_s: ClusteredEstimate
    """Mean age of the newest evaluation behind a value at look-up."""
    harm: ClusteredEstimate
    """Mean of two shares, averaged over worlds: honest vehicle-steps that are excluded, and received messages that
    attackers send under an attack on detections and that are believed. Whether a message holds a lie is not recorded:
    where no victim is near, it may not."""


@dataclass(frozen=True, slots=True)
class Counts:
    """What the figures of one world rest on: numerators and denominators."""

    above: float
    pairs: float
    """Pairs of an honest and an attacking sender's value, and how many of them are in the right order (ties half)."""
    n_wrong: float
    n_honest: float
    believed: float
    lies_believed: float
    messages: float
    """Received messages of attackers: the believed ones, those of them under an attack on detections, and all."""
    age_s: float
    n_aged: float
    delay_s: Float[ndarray, "a"]
    found: Bool[ndarray, "a"]
    """Time to exclusion of each attacker, and whether it was excluded at all."""


def counts(
    stream: EvidenceStream, answers: ModelAnswers, threshold: float, rules: EvidenceRules, lying: Bool[ndarray, "n"]
) -> Counts:
    """What one world says about a model.

    Parameters
    ----------
    threshold
        Trust below which a sender is excluded.
    lying
        Whether each looked-up message is sent under an attack on detections if its sender attacks.
    """
    asked, attacks = stream.lookups, stream.attackers()
    is_late = asked["step"] >= rules.start_step
    counted = np.flatnonzero(~attacks[asked["receiver"]] & is_late)
    step = asked["step"][counted].astype(np.int64)
    sender = asked["sender"][counted].astype(np.int64)
    trust, age_s = answers.trust[counted], answers.age_s[counted]
    rated, is_attacker = ~np.isnan(trust), attacks[sender]
    lies = is_attacker & lying[counted]
    excluded = rated & (trust < threshold)
    honest = np.sort(trust[rated & ~is_attacker])
    other = trust[rated & is_attacker]
    below, not_above = (np.searchsorted(honest, other, side).sum() for side in ("left", "right"))
    above = len(honest) * len(other) - (below + not_above) / 2
    steps, of = np.unique((step << 16 | sender)[~is_attacker], return_inverse=True)
    n_excluded = np.bincount(of, excluded[~is_attacker], len(steps))
    share = n_excluded / np.bincount(of, minlength=len(steps))
    delay_s, found = _delays(
        step[is_attacker],
        sender[is_attacker],
        excluded[is_attacker],
        rules.dt_s,
    )
    return Counts(
        above=float(above),
        pairs=float(len(honest) * len(other)),
        n_wrong=float(share.sum()),
        n_honest=float(len(steps)),
        believed=float((is_attacker & ~excluded).sum()),
        lies_believed=float((lies & ~excluded).sum()),
        messages=float(is_attacker.sum()),
        age_s=float(age_s[rated].sum()),
        n_aged=float(rated.sum()),
        delay_s=delay_s,
        found=found,
    )


def _delays(step: ndarray, sender: ndarray, excluded: ndarray, dt_s: float) -> tuple[ndarray, ndarray]:
    """Time from each sender's first look-up to its first exclusion, or else to its last look-up; whether it was."""
    who, of = np.unique(sender, return_inverse=True)
    since, first = np.full((2, len(who)), np.inf)
    last = np.full(len(who), -np.inf)
    np.minimum.at(since, of, step)
    np.maximum.at(last, of, step)
    np.minimum.at(first, of[excluded], step[excluded])
    found = np.isfinite(first)
    return (np.where(found, first, last) - since) * dt_s, found


def figures(of_worlds: list[Counts]) -> Figures:
    """The figures of an attack from the counts of all worlds."""
    column = {}
    for name in Counts.__slots__[:-2]:
        column[name] = np.array([getattr(one, name) for one in of_worlds])
    delays = [np.concatenate([getattr(one, name) for one in of_worlds]) for name in ("delay_s", "found")]
    curve = kaplan_meier(*delays)
    n = len(delays[0])
    wait = ClusteredEstimate(median(curve), *median_band(curve), n) if n else UNKNOWN
    attacked = column["messages"] > 0
    harm = (
        column["n_wrong"][attacked] / np.maximum(column["n_honest"][attacked], 1)
        + column["lies_believed"][attacked] / column["messages"][attacked]
    ) / 2
    return Figures(
        auc=ratio(column["above"], column["pairs"]),
        exclusion_s=wait,
        wrong_p=ratio(column["n_wrong"], column["n_honest"]),
        believed_p=ratio(column["believed"], column["messages"]),
        age_s=ratio(column["age_s"], column["n_aged"]),
        harm=ratio(harm, np.ones(len(harm))),
    )


@dataclass(frozen=True, slots=True)
class ModelScore:
    """A model on the whole set."""

    model: str
    sha256: str
    """Checksum of a user's own file."""
    threshold: float
    quiet_p: float
    """Share of vehicle-steps that are excluded without attack: at most 0.05 of the evaluated look-ups."""
    attacks: dict[str, Figures]
    """By attack, worst AUC first."""
    cost_us: float
    """Processor time per received evaluation."""


def threshold_of(evidence: EvidenceSet, candidate: Candidate, advance: Advance) -> tuple[float, list[ModelAnswers]]:
    """The model's threshold, and its answers in the worlds without attack, from which it follows.

    Raises
    ------
    ValueError
        In one line, if the model rates no vehicle at all.
    """
    rules, n_worlds = evidence.rules, len(evidence.worlds)
    found, values = [], []
    for world in range(n_worlds):
        stream = evidence.stream(world, 0)
        answers = play(Script.of(stream, rules), candidate)
        found.append(answers)
        counted = (stream.lookups["step"] >= rules.start_step) & ~np.isnan(answers.trust)
        values.append(answers.trust[counted])
        advance(f"{candidate.name}: threshold", world + 1, n_worlds, "worlds")
    threshold = threshold_at(np.concatenate(values), FALSE_POSITIVES)
    if np.isnan(threshold):
        raise ValueError(f"{candidate.name}: it rates no vehicle. Give scores of subjects with evaluations.")
    return threshold, found


def score(evidence: EvidenceSet, candidate: Candidate, advance: Advance) -> ModelScore:
    """Score a model: it is played through every world without attack and under every attack.

    Raises
    ------
    ValueError
        In one line, if the model fails, or rates no vehicle at all.
    """
    rules, n_worlds = evidence.rules, len(evidence.worlds)
    threshold, quiet = threshold_of(evidence, candidate, advance)
    found: dict[str, Figures] = {}
    played = list(quiet)
    for case, name in enumerate(rules.cases):
        of_worlds = []
        for world in range(n_worlds):
            stream = evidence.stream(world, case)
            answers = quiet[world] if case == 0 else play(Script.of(stream, rules), candidate)
            lying = np.full(len(answers.trust), name not in TRUE_DETECTIONS)
            of_worlds.append(counts(stream, answers, threshold, rules, lying))
            played += [answers] if case else []
            n_done = case * n_worlds + world + 1
            advance(f"{candidate.name}: attacks", n_done, len(rules.cases) * n_worlds, name)
        found[name] = figures(of_worlds)
    quiet_p = found.pop(HONEST).wrong_p.value
    auc = {name: of.auc.value for name, of in found.items()}

    def place(name: str) -> tuple[bool, float]:
        return bool(np.isfinite(auc[name])), auc[name]

    ordered = {name: found[name] for name in sorted(auc, key=place)}
    cost_s = sum(one.cost_s for one in played)
    n_evaluations = sum(one.n_evaluations for one in played)
    cost_us = 1e6 * cost_s / max(n_evaluations, 1)
    return ModelScore(candidate.name, candidate.sha256, threshold, quiet_p, ordered, cost_us)
