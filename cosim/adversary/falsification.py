"""Own detections withheld or falsified: position, heading, size, class, score."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.adversary.attack import AttackContext, per_actor, wrapped
from cosim.v2x.messages import FABRICATED, SELF, Detections
from cosim.world import LABELS
from sensors.boxes import iou_3d


@dataclass(frozen=True, kw_only=True, slots=True)
class RemovalParams:
    """What is withheld."""

    remove_p: Annotated[float, Ge(0), Le(1)] = 1.0
    """Chance, per own detection and message, that it is withheld."""
    only_victim: bool = False
    """Withhold what matches the victim alone."""
    min_iou: Annotated[float, Ge(0), Le(1)] = 0.1
    """With only_victim: own detections of which more than this overlaps the victim are withheld; AdvCP's value."""


class Removal:
    """Own detections withheld; the report of oneself is not (AdvCP's object removal, for late fusion)."""

    Params = RemovalParams

    def __init__(self, params: RemovalParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows hidden."""
        p, world = self.params, context.world
        rows = context.own_rows(listed)
        rows = rows[(listed.origin[rows] != SELF) & (listed.origin[rows] != FABRICATED)]
        if p.only_victim:
            victim = context.victim_of()[listed.observer[rows]]
            rows, victim = rows[victim >= 0], victim[victim >= 0]
            rows = rows[iou_3d(listed.boxes.take(rows), world.boxes.take(victim)) > p.min_iou]
        chance = context.uniforms(context.name_key(listed.observer[rows]), listed.detection_index[rows])[:, 0]
        transmitted = listed.transmitted.copy()
        transmitted[rows[chance < p.remove_p]] = False
        return replace(listed, transmitted=transmitted)


@dataclass(frozen=True, kw_only=True, slots=True)
class FalsifiedParams:
    """Which own rows are falsified."""

    content: Literal["detections", "self_report", "all"] = "detections"
    """Detections of others, the vehicle's report of itself, or both."""


def _rows(listed: Detections, context: AttackContext, content: str) -> Int[ndarray, "r"]:
    """Own rows of attackers to falsify."""
    rows = context.own_rows(listed)
    is_self = listed.origin[rows] == SELF
    wanted = {"detections": ~is_self, "self_report": is_self, "all": np.ones(len(rows), bool)}[content]
    return rows[wanted & (listed.origin[rows] != FABRICATED)]


def _moved(listed: Detections, rows: Int[ndarray, "r"], by_m: Float[ndarray, "r 2"]) -> Detections:
    """The lists with these rows moved."""
    xyz = listed.boxes.xyz_m.copy()
    xyz[rows, :2] += by_m
    return replace(listed, boxes=replace(listed.boxes, xyz_m=xyz))


@dataclass(frozen=True, kw_only=True, slots=True)
class OffsetParams(FalsifiedParams):
    """How far positions are shifted."""

    offset: Literal["constant", "random"] = "constant"
    """constant: one shift per attacker, for good; random: another one for every detection and message."""
    min_m: Annotated[float, Ge(0), Le(1000)] = 20.0
    """Smallest shift per axis [m]; default as in NextGen."""
    max_m: Annotated[float, Gt(0), Le(1000)] = 70.0
    """Largest shift per axis [m]; default as in NextGen."""

    def __post_init__(self) -> None:
        if self.min_m > self.max_m:
            raise ValueError(f"attacks.min_m = {self.min_m:g} m is above attacks.max_m = {self.max_m:g} m. Swap them.")


class Offset:
    """Positions shifted by +-U(min_m, max_m) on each axis, either sign equally likely (NextGen).

    Notes
    -----
    Deviations: NextGen shifts the sender's own position; here `content` says what is shifted, and the default is what
    collective perception adds, the detections.
    """

    Params = OffsetParams

    def __init__(self, params: OffsetParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows moved."""
        p = self.params
        rows = _rows(listed, context, p.content)
        names = context.name_key(listed.observer[rows])
        if p.offset == "constant":
            u = context.lasting(names, n=4)
        else:
            u = context.uniforms(names, listed.detection_index[rows], n=4)
        by_m = (p.min_m + (p.max_m - p.min_m) * u[:, :2]) * np.where(u[:, 2:] < 0.5, -1.0, 1.0)
        return _moved(listed, rows, by_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class DriftParams(FalsifiedParams):
    """How fast positions drift away."""

    speed_mps: Annotated[float, Gt(0), Le(100)] = 0.5
    """Shift gained per second of attack [m/s]."""
    max_m: Annotated[float, Gt(0), Le(1000)] = 20.0
    """Largest shift [m]."""


class Drift:
    """Positions that drift away slowly, each attacker's in a direction of its own, from the true place on."""

    Params = DriftParams

    def __init__(self, params: DriftParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows moved by as much as has built up since the attack began."""
        p = self.params
        rows = _rows(listed, context, p.content)
        observer = listed.observer[rows]
        began_s = per_actor(context, "began_s", (context.n_active == 0) & context.attacker, context.time_s)
        since = context.time_s - began_s
        angle = 2 * np.pi * context.lasting(context.name_key(observer))[:, 0]
        far_m = np.minimum(p.speed_mps * since[observer], p.max_m)
        return _moved(listed, rows, far_m[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


class Mirror:
    """Own detections mirrored to the other side of the vehicle's own axis: oncoming traffic in its own lane."""

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows mirrored: left and right, and the heading with them."""
        rows = _rows(listed, context, "detections")
        poses = context.world.boxes
        own = listed.observer[rows]
        yaw = poses.yaw_rad[own]
        left = np.column_stack([-np.sin(yaw), np.cos(yaw)])
        away_m = ((listed.boxes.xyz_m[rows, :2] - poses.xyz_m[own, :2]) * left).sum(axis=1)
        moved = _moved(listed, rows, -2 * away_m[:, None] * left)
        turned = moved.boxes.yaw_rad.copy()
        turned[rows] = wrapped(2 * yaw - turned[rows])
        return replace(moved, boxes=replace(moved.boxes, yaw_rad=turned))


@dataclass(frozen=True, kw_only=True, slots=True)
class HeadingParams(FalsifiedParams):
    """How headings are turned."""

    turn_deg: Annotated[float, Ge(-180), Le(180)] = 30.0
    """Added to every heading, counter-clockwise [deg]; default as in VASP."""


class Heading:
    """Headings turned (VASP)."""

    Params = HeadingParams

    def __init__(self, params: HeadingParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows turned."""
        rows = _rows(listed, context, self.params.content)
        yaw = listed.boxes.yaw_rad.copy()
        yaw[rows] = wrapped(yaw[rows] + np.radians(self.params.turn_deg))
        return replace(listed, boxes=replace(listed.boxes, yaw_rad=yaw))


@dataclass(frozen=True, kw_only=True, slots=True)
class SizeParams(FalsifiedParams):
    """How sizes are changed."""

    factor: Annotated[float, Gt(0), Le(100)] = 2.0
    """Length, width and height are multiplied by it; boxes keep standing on the ground."""


class Size:
    """Boxes made larger or smaller."""

    Params = SizeParams

    def __init__(self, params: SizeParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows scaled."""
        rows = _rows(listed, context, self.params.content)
        lwh, xyz = listed.boxes.lwh_m.copy(), listed.boxes.xyz_m.copy()
        xyz[rows, 2] += lwh[rows, 2] * (self.params.factor - 1) / 2
        lwh[rows] *= self.params.factor
        return replace(listed, boxes=replace(listed.boxes, xyz_m=xyz, lwh_m=lwh))


class Classification:
    """Classes changed: cars become pedestrians, and everything else becomes a car; the boxes stay."""

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows of another class."""
        rows = _rows(listed, context, "detections")
        label = listed.label.copy()
        car = LABELS.index("car")
        label[rows] = np.where(label[rows] == car, LABELS.index("pedestrian"), car)
        return replace(listed, label=label)


@dataclass(frozen=True, kw_only=True, slots=True)
class ScoreParams(FalsifiedParams):
    """What confidence is claimed."""

    claimed: Annotated[float, Ge(0), Le(1)] = 0.05
    """Score of every row."""


class Score:
    """Confidence falsified: low, so that true objects are not believed, or high, so that false positives are."""

    Params = ScoreParams

    def __init__(self, params: ScoreParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows with the claimed score."""
        rows = _rows(listed, context, self.params.content)
        score = listed.score.copy()
        score[rows] = self.params.claimed
        return replace(listed, score=score)
