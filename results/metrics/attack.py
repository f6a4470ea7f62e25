"""What attacks achieve: how often, where and for how long fabricated objects are believed, and real ones lost.

The unit that is counted is a pair: a fabricated (or withheld) detection of a step, and an honest vehicle that received
the message with it (or without it). Lists of attackers are apart. Definitions and sources are in
`results/FRESHNESS.md`.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from results.metrics.intervals import of_units, plain_columns, ratio
from results.run import Run
from results.sensing import interval_steps

THRESHOLDS = (0.1, 0.3, 0.5, 0.7)
"""Scores from which an object counts as believed, where none are given."""
AMONG = ("received", "intended")
"""All vehicles that received it, or the one that the attack aims at."""
HONEST = "honest"


def outcomes(run: Run) -> pd.DataFrame:
    """The table `attack_outcomes` of the run's variant, with `attacker` (vehicle), its role, and the receiver's role.

    Of a removal, only receivers that did not detect the withheld actor themselves: the others do not depend on it.
    """
    frame = run.variant_table("attack_outcomes")
    frame = frame[(frame.effect == "inserted") | ~frame.ego_detected].assign(score=frame.score.astype(float))
    if frame.empty:
        fused = "Give the variant fused = true" if run.variant != "base" and len(run.attack_outcomes) else _MORE
        raise ValueError(f"{run.path} holds no attack that reached another vehicle. {fused} and run again.")
    return frame.assign(
        attacker=frame.observer.map(run.subjects.vehicle).astype(np.int64),
        role=frame.observer.map(run.subjects.role),
        receiver_role=frame.receiver.map(run.roles),
        is_victim_honest=frame.receiver.map(run.roles) == HONEST,
    )


def success(run: Run, thresholds: Sequence[float] = THRESHOLDS) -> pd.DataFrame:
    """Share of pairs (lie, receiver) in which the attack succeeds, by score threshold.

    An inserted object succeeds if the receiver has it with a score of at least the threshold. A removal succeeds if the
    receiver does not have the withheld actor with such a score.

    Returns
    -------
    effect, role (of the attacker), receivers (honest, or attackers: those of any other role), among (`AMONG`),
    threshold, n (pairs: the denominator), share, low, high (95 %, clustered by attacker), n_units (attackers).
    """
    rows: list[dict[str, Any]] = []
    for key, pairs in _groups(outcomes(run)):
        for threshold in thresholds:
            share = of_units(_succeeds(pairs, threshold), pairs.attacker.to_numpy())
            rows.append({**key, "threshold": threshold, "n": len(pairs), **plain_columns(share, "share")})
    return pd.DataFrame(rows)


def curve(run: Run, n_thresholds: int = 51) -> pd.DataFrame:
    """Shares of `success` over thresholds from 0 to 1: effect, role, receivers, among, threshold, share."""
    thresholds = np.linspace(0, 1, n_thresholds)
    rows = []
    for key, pairs in _groups(outcomes(run)):
        score = np.sort(pairs.score.dropna().to_numpy())
        believed = (len(score) - np.searchsorted(score, thresholds)) / len(pairs)
        share = believed if key["effect"] == "inserted" else 1 - believed
        rows.append(pd.DataFrame({**key, "threshold": thresholds, "share": share}))
    return pd.concat(rows, ignore_index=True)


def per_lie(run: Run, thresholds: Sequence[float] = THRESHOLDS) -> pd.DataFrame:
    """Share of the fabricated detections received by an honest vehicle that at least one of these vehicles believes.

    It grows with the number of receivers.

    Returns
    -------
    role, threshold, n (lies: the denominator), share, low, high, n_units (attackers), receivers_mean (honest vehicles
    that received one).
    """
    frame = _honest(outcomes(run), "inserted")
    rows = []
    for role, pairs in frame.groupby("role", observed=True):
        lies = pairs.groupby(["detection_step", "observer", "detection_index"], sort=False).agg(
            best=("score", "max"), attacker=("attacker", "first"), n=("receiver", "size")
        )
        for threshold in thresholds:
            share = of_units((lies.best >= threshold).to_numpy(), lies.attacker.to_numpy())
            rows.append({
                "role": role, "threshold": threshold, "n": len(lies), **plain_columns(share, "share"),
                "receivers_mean": float(lies.n.mean()),
            })  # fmt: skip
    return pd.DataFrame(rows, columns=["role", "threshold", "n", "share", "low", "high", "n_units", "receivers_mean"])


def believed_duration(run: Run, threshold: float = 0.5) -> pd.DataFrame:
    """How long an honest vehicle goes on believing one attacker: successive sensing steps with a believed lie of it.

    Returns
    -------
    role, among, n (stretches), mean_s, low, high (clustered by attacker), n_units, longest_s. A stretch that the end of
    the run cuts off counts as long as it was observed.
    """
    frame = _honest(outcomes(run), "inserted")
    frame = frame[frame.score >= threshold]
    rows = []
    for (role, among), believed in _by_among(frame, ["role"]):
        steps = believed[["attacker", "receiver", "step"]].drop_duplicates()
        steps = steps.sort_values(["attacker", "receiver", "step"])
        pair = steps.attacker.to_numpy() * (1 << 32) + steps.receiver.to_numpy()
        every = interval_steps(run, steps.receiver.to_numpy(np.int64))
        begins = np.r_[True, (np.diff(pair) != 0) | (np.diff(steps.step.to_numpy()) > every[1:])]
        duration_s = np.bincount(np.cumsum(begins) - 1, every) * run.dt_s
        mean = of_units(duration_s, steps.attacker.to_numpy()[begins])
        rows.append({
            "role": role, "among": among, "n": len(duration_s), **plain_columns(mean, "mean_s"),
            "longest_s": float(duration_s.max()),
        })  # fmt: skip
    return pd.DataFrame(rows, columns=["role", "among", "n", "mean_s", "low", "high", "n_units", "longest_s"])


def false_in_path(run: Run, threshold: float = 0.5) -> pd.DataFrame:
    """How wrong a victim's view is: fabricated boxes in the path of honest vehicles that it believes.

    Returns
    -------
    among (every honest vehicle that received a lie in a step, or those at which one was aimed), n (vehicle-steps: the
    denominator), share with a believed fabricated box in the path, low, high (clustered by vehicle), n_units
    (vehicles), boxes_mean (fabricated boxes believed in the path per vehicle-step; a box reported by several attackers
    counts once for each).
    """
    rows = []
    for (among,), pairs in _by_among(_honest(outcomes(run), "inserted"), []):
        wrong = pairs.in_path.astype(bool) & (pairs.score >= threshold)
        seconds = wrong.groupby([pairs.receiver, pairs.step]).sum().reset_index(name="n")
        share = of_units((seconds.n > 0).to_numpy(), seconds.receiver.to_numpy())
        rows.append({
            "among": among, "n": len(seconds), **plain_columns(share, "share"), "boxes_mean": float(seconds.n.mean())
        })  # fmt: skip
    return pd.DataFrame(rows, columns=["among", "n", "share", "low", "high", "n_units", "boxes_mean"])


def damage(run: Run, threshold: float = 0.5) -> pd.DataFrame:
    """Believed ghosts x seconds x victims: each fabricated detection that an honest vehicle believes in a sensing step
    counts for the time to the next one.

    Returns
    -------
    role (of the attacker), among, n (believed pairs), total_s, per_attacker_s, low, high (clustered by attacker),
    n_units (attackers with a lie that an honest vehicle received).
    """
    rows = []
    for (role, among), pairs in _by_among(_honest(outcomes(run), "inserted"), ["role"]):
        believed = (pairs.score >= threshold).to_numpy()
        held_s = believed * interval_steps(run, pairs.receiver.to_numpy(np.int64)) * run.dt_s
        of_attacker = np.bincount(pd.factorize(pairs.attacker, sort=True)[0], held_s)
        mean = ratio(of_attacker, np.ones(len(of_attacker)))
        rows.append({
            "role": role, "among": among, "n": int(believed.sum()), "total_s": float(of_attacker.sum()),
            **plain_columns(mean, "per_attacker_s"),
        })  # fmt: skip
    return pd.DataFrame(rows, columns=["role", "among", "n", "total_s", "per_attacker_s", "low", "high", "n_units"])


_MORE = "Raise the share_p of an attack, or run longer than its start_s,"


def _honest(frame: pd.DataFrame, effect: str) -> pd.DataFrame:
    return frame[(frame.effect == effect) & frame.is_victim_honest]


def _groups(frame: pd.DataFrame) -> Iterator[tuple[dict[str, str], pd.DataFrame]]:
    """Pairs by effect, role of the attacker, whose list it is, and whether the attack aims at the receiver."""
    receivers = pd.Series(np.where(frame.is_victim_honest, HONEST, "attackers"), frame.index, name="receivers")
    by = [frame.effect.astype(str), frame.role.astype(str), receivers]
    for (effect, role, of), pairs in frame.groupby(by, sort=True):
        for among in AMONG:
            chosen = pairs if among == "received" else pairs[pairs.intended.astype(bool)]
            if len(chosen):
                yield {"effect": str(effect), "role": str(role), "receivers": str(of), "among": among}, chosen


def _by_among(frame: pd.DataFrame, by: list[str]) -> Iterator[tuple[tuple[str, ...], pd.DataFrame]]:
    for among in AMONG:
        chosen = frame if among == "received" else frame[frame.intended.astype(bool)]
        if by:
            for key, some in chosen.groupby(by, observed=True):
                yield (*map(str, key), among), some
        elif len(chosen):
            yield (among,), chosen


def _succeeds(pairs: pd.DataFrame, threshold: float) -> np.ndarray:
    believed = (pairs.score >= threshold).to_numpy()
    return np.where((pairs.effect == "inserted").to_numpy(), believed, ~believed)
