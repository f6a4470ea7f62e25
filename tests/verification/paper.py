"""Literal transcription of TruPercept with dictionaries and loops: the reference for the code in `trust/`.

A detection's name is (vehicle, detection_index); a world holds for each name its label, score, and whether it is the
vehicle's report of itself. The simulation imports nothing from here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Name = tuple[int, int]


@dataclass
class Detection:
    label: int
    score: float
    is_self: bool = False
    distance_m: float = 0.0


def match(
    lists: list[list[Name]],
    world: dict[Name, Detection],
    iou: Callable[[Name, Name], float],
    tau: float,
    one_per_vehicle: bool = False,
) -> list[list[Name]]:
    """Groups, the seed first. One list per vehicle, the ego's first; class by class."""
    groups: list[list[Name]] = []
    for label in sorted({world[name].label for names in lists for name in names}):
        of_class = [[name for name in names if world[name].label == label] for names in lists]
        matched: set[Name] = set()
        for i, names in enumerate(of_class):
            opened = [[name] for name in names if name not in matched]
            matched.update(group[0] for group in opened)
            for later in of_class[i + 1 :]:
                choices: dict[int, list[tuple[float, Name]]] = {}
                for name in later:
                    if name in matched or not opened:
                        continue
                    ious = [iou(group[0], name) for group in opened]
                    best = ious.index(max(ious))
                    if ious[best] > tau:
                        choices.setdefault(best, []).append((ious[best], name))
                for best, chosen in choices.items():
                    if one_per_vehicle:
                        top = max(value for value, _ in chosen)
                        chosen = [next(c for c in chosen if c[0] == top)]
                    for _, name in chosen:
                        opened[best].append(name)
                        matched.add(name)
            groups.extend(opened)
    return groups


def visibility(p: int, lower: float, upper: float) -> float:
    """Phi of p returns."""
    return min(1.0, max(0.0, p - lower) / (upper - lower))


def evaluate(
    evaluator: int,
    groups: list[list[Name]],
    world: dict[Name, Detection],
    points: Callable[[Name], int],
    plausible: Callable[[Name], bool],
    gammas: list[tuple[float, float]],
    eta: float,
) -> dict[Name, tuple[float, float]]:
    """The evaluator's (e, Phi) of everything in its groups."""
    evaluations: dict[Name, tuple[float, float]] = {}
    for group in groups:
        seed = group[0]
        for name in group:
            phi = visibility(points(name), *gammas[world[name].label])
            if seed[0] == evaluator:
                e = world[seed].score
                if world[seed].is_self:
                    e = phi = 1.0
            else:
                e = eta
                if not plausible(name):
                    phi = 1.0
            evaluations[name] = (e, phi)
    return evaluations


def aggregated(rows: list[tuple[int, float, float]], how: str) -> dict[int, float]:
    """The published code's evaluation per detection from (detection_index, e, Phi): sum Phi e, or its weighted mean."""
    out = {}
    for index in {index for index, _, _ in rows}:
        top = sum(phi * e for i, e, phi in rows if i == index)
        bottom = sum(phi for i, _, phi in rows if i == index)
        out[index] = top if how == "sum" else top / bottom if bottom > 0 else 0.0
    return out


def object_trust(detector: int, evaluations: dict[int, tuple[float, float]]) -> float | None:
    """Equation 3 from {evaluator: (e, Phi)}; None if no other evaluator could see the detection."""
    top = sum(phi * e for v, (e, phi) in evaluations.items() if v != detector)
    bottom = sum(phi for v, (_, phi) in evaluations.items() if v != detector)
    return max(-1.0, min(1.0, top / bottom)) if bottom > 0 else None


def vehicle_trust(
    vehicle: int,
    now: int,
    window: int,
    scores: dict[tuple[int, int, int], float],
    records: dict[tuple[int, int, int], dict[int, tuple[float, float]]],
    default: float = 0.5,
    skip_unseen: bool = False,
    weighted: bool = True,
) -> float:
    """Equation 4 over {(step, vehicle, k): {evaluator: (e, Phi)}}; `window` steps, the present one included."""
    top = bottom = 0.0
    for (step, detector, k), evaluations in sorted(records.items()):
        if detector != vehicle or not now - window < step <= now or not evaluations:
            continue
        trust = object_trust(detector, evaluations)
        if trust is None and skip_unseen:
            continue
        s = scores[step, detector, k] if weighted else 1.0
        top += s * (trust or 0.0)
        bottom += s
    return max(0.0, top / bottom) if bottom > 0 else default


def final_score(
    method: str,
    ego: int,
    group: list[Name],
    world: dict[Name, Detection],
    evaluations: dict[int, dict[Name, tuple[float, float]]],
    trust: dict[int, float],
    points: int,
    plausible: bool,
    in_range: bool,
) -> float:
    """Score of one group; `evaluations` holds those received by the ego and its own, `trust` that of all evaluators."""
    seed, n = group[0], len(group)
    ego_detected, own = seed[0] == ego, world[seed].score
    pairs = [(trust[v], *opinions[name]) for name in group for v, opinions in evaluations.items() if name in opinions]
    top = sum(phi * t * e for t, e, phi in pairs)
    bottom = sum(phi * t for t, _, phi in pairs)
    average = top / bottom if bottom > 0 else 0.0
    additive = top / n

    def checked(value: float) -> float:
        return value if ego_detected or plausible else 0.0

    if method == "trupercept_1":
        score = checked(average)
    elif method == "trupercept_1_local_bias":
        score = checked((average + own) / 2 if ego_detected else average)
    elif method == "trupercept_2":
        score = checked(additive)
    elif method in ("trupercept_3", "trupercept_3_corrected"):
        score = own if ego_detected else additive if not in_range or (points < 10 and plausible) else 0.0
    elif method in ("local", "corrected"):
        score = own if ego_detected else 0.0
    elif method == "any":
        score = 1.0
    elif method == "any_confirmed":
        score = 1.0 if n > 1 else own
    elif method == "confirmed_or_local":
        score = 1.0 if n > 1 else own if ego_detected else 0.0
    elif method == "local_confirmed":
        score = (1.0 if n > 1 else own) if ego_detected else 0.0
    elif method == "averaging":
        weights = [trust[v] for v, _ in group]
        total = sum(weights)
        score = sum(w * world[name].score for w, name in zip(weights, group, strict=True)) / total if total else 0
    elif method == "additive":
        score = sum(trust[name[0]] * world[name].score for name in group)
    elif method == "half_additive":
        score = (sum(world[name].score for name in group) + (own if ego_detected else 0.0)) / 2
    else:
        raise KeyError(method)
    return max(0.0, min(1.0, score))


def closest(group: list[Name], world: dict[Name, Detection], self_reports: bool = True) -> Name:
    """Member nearest to its detector, the first of equals."""
    allowed = [name for name in group if self_reports or not world[name].is_self]
    return min(allowed, key=lambda name: world[name].distance_m) if allowed else group[0]
