"""Attacks that withhold or falsify own detections: position, heading, size, class, score, stated accuracy."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.attacks.attack import AttackContext, WithParams, per_actor
from cosim.base.bounds import NotNegative1000, Positive100, Positive1000, Share
from cosim.base.plane import wrapped
from cosim.messages.content import FABRICATED, LEAST_ACCURACY_FACTOR, MOST_ACCURACY_FACTOR, SELF, Detections
from cosim.world import LABELS
from sensors.boxes import iou_3d


@dataclass(frozen=True, kw_only=True, slots=True)
class RemovalParams:
    """Which detections are withheld."""

    remove_p: Share = 1.0
    """Probability that an own detection is withheld from a message."""
    only_victim: bool = False
    """Whether only detections that match the victim are withheld."""
    min_iou: Share = 0.1
    """With `only_victim`: an own detection is withheld if its IoU with the victim is larger. The default is AdvCP's."""


class Removal(WithParams[RemovalParams]):
    """Withholds own detections, but not the self report (AdvCP's object removal, for late fusion)."""

    Params = RemovalParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with the chosen rows not transmitted."""
        p, world = self.params, context.world
        rows = context.own_rows(listed)
        origin = listed.origin[rows]
        rows = rows[(origin != SELF) & (origin != FABRICATED)]
        if p.only_victim:
            victim = context.victim_of()[listed.observer[rows]]
            rows, victim = rows[victim >= 0], victim[victim >= 0]
            overlap = iou_3d(listed.boxes.take(rows), world.boxes.take(victim))
            rows = rows[overlap > p.min_iou]
        names = context.name_key(listed.observer[rows])
        chance = context.uniforms(names, listed.detection_index[rows])[:, 0]
        transmitted = listed.transmitted.copy()
        transmitted[rows[chance < p.remove_p]] = False
        return replace(listed, transmitted=transmitted)


@dataclass(frozen=True, kw_only=True, slots=True)
class FalsifiedParams:
    """Which own content is falsified."""

    content: Literal["detections", "self_report", "all"] = "detections"
    """Content that is falsified: `detections` of other objects, the `self_report`, or `all`."""


def _rows(listed: Detections, context: AttackContext, content: str) -> Int[ndarray, "r"]:
    """Rows of attackers that are falsified."""
    rows = context.own_rows(listed)
    is_self = listed.origin[rows] == SELF
    wanted = {"detections": ~is_self, "self_report": is_self, "all": np.ones(len(rows), bool)}[content]
    return rows[wanted & (listed.origin[rows] != FABRICATED)]


def _moved(listed: Detections, rows: Int[ndarray, "r"], by_m: Float[ndarray, "r 2"]) -> Detections:
    """The lists, with these rows moved."""
    xyz = listed.boxes.xyz_m.copy()
    xyz[rows, :2] += by_m
    return replace(listed, boxes=replace(listed.boxes, xyz_m=xyz))


@dataclass(frozen=True, kw_only=True, slots=True)
class OffsetParams(FalsifiedParams):
    """How far positions are shifted."""

    offset: Literal["constant", "random"] = "constant"
    """`constant`: one shift per attacker for the whole run. `random`: a new shift for every detection and message."""
    min_m: NotNegative1000 = 20.0
    """Smallest shift per axis [m]. The default is NextGen's."""
    max_m: Positive1000 = 70.0
    """Largest shift per axis [m]. The default is NextGen's."""

    def __post_init__(self) -> None:
        if self.min_m > self.max_m:
            raise ValueError(f"attacks.min_m = {self.min_m:g} m is above attacks.max_m = {self.max_m:g} m. Swap them.")


class Offset(WithParams[OffsetParams]):
    """Shifts positions by +-U(min_m, max_m) on each axis; both signs are equally likely (NextGen).

    Notes
    -----
    Deviations: NextGen shifts the sender's own position. Here `content` selects what is shifted, and the default is the
    detections.
    """

    Params = OffsetParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with falsified positions."""
        p = self.params
        rows = _rows(listed, context, p.content)
        names = context.name_key(listed.observer[rows])
        if p.offset == "constant":
            u = context.lasting(names, n=4)
        else:
            u = context.uniforms(names, listed.detection_index[rows], n=4)
        far_m = p.min_m + (p.max_m - p.min_m) * u[:, :2]
        sign = np.where(u[:, 2:] < 0.5, -1.0, 1.0)
        return _moved(listed, rows, far_m * sign)


@dataclass(frozen=True, kw_only=True, slots=True)
class DriftParams(FalsifiedParams):
    """Speed and limit of the drift."""

    speed_mps: Positive100 = 0.5
    """Growth of the shift per second of attack [m/s]."""
    max_m: Positive1000 = 20.0
    """Largest shift [m]."""


class Drift(WithParams[DriftParams]):
    """Shifts positions slowly away from the true ones, in a direction that is drawn for each attacker."""

    Params = DriftParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with positions shifted by the drift since the attack began."""
        p = self.params
        rows = _rows(listed, context, p.content)
        observer = listed.observer[rows]
        began_s = per_actor(context, "began_s", (context.n_active == 0) & context.attacker, context.time_s)
        since = context.time_s - began_s
        angle = 2 * np.pi * context.lasting(context.name_key(observer))[:, 0]
        far_m = np.minimum(p.speed_mps * since[observer], p.max_m)
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        return _moved(listed, rows, far_m[:, None] * direction)


class Mirror:
    """Mirrors own detections to the other side of the vehicle's longitudinal axis: oncoming traffic is in its lane."""

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with positions and headings mirrored."""
        rows = _rows(listed, context, "detections")
        poses = context.world.boxes
        own = listed.observer[rows]
        yaw = poses.yaw_rad[own]
        left = np.column_stack([-np.sin(yaw), np.cos(yaw)])
        own_m = poses.xyz_m[own, :2]
        between_m = listed.boxes.xyz_m[rows, :2] - own_m
        away_m = (between_m * left).sum(axis=1)
        moved = _moved(listed, rows, -2 * away_m[:, None] * left)
        turned = moved.boxes.yaw_rad.copy()
        turned[rows] = wrapped(2 * yaw - turned[rows])
        return replace(moved, boxes=replace(moved.boxes, yaw_rad=turned))


@dataclass(frozen=True, kw_only=True, slots=True)
class HeadingParams(FalsifiedParams):
    """Angle by which headings are turned."""

    turn_deg: Annotated[float, Ge(-180), Le(180)] = 30.0
    """Angle that is added to every heading, counter-clockwise [deg]. The default is VASP's."""


class Heading(WithParams[HeadingParams]):
    """Turns headings (VASP)."""

    Params = HeadingParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with falsified headings."""
        rows = _rows(listed, context, self.params.content)
        yaw = listed.boxes.yaw_rad.copy()
        yaw[rows] = wrapped(yaw[rows] + np.radians(self.params.turn_deg))
        return replace(listed, boxes=replace(listed.boxes, yaw_rad=yaw))


@dataclass(frozen=True, kw_only=True, slots=True)
class SizeParams(FalsifiedParams):
    """Factor on the sizes."""

    factor: Positive100 = 2.0
    """Factor on length, width and height. The bottom of a box stays where it is."""


class Size(WithParams[SizeParams]):
    """Makes boxes larger or smaller."""

    Params = SizeParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with falsified sizes."""
        rows = _rows(listed, context, self.params.content)
        lwh, xyz = listed.boxes.lwh_m.copy(), listed.boxes.xyz_m.copy()
        higher_m = lwh[rows, 2] * (self.params.factor - 1)
        xyz[rows, 2] += higher_m / 2
        lwh[rows] *= self.params.factor
        return replace(listed, boxes=replace(listed.boxes, xyz_m=xyz, lwh_m=lwh))


class Classification:
    """Changes classes: cars become pedestrians, and all other objects become cars. Boxes are unchanged."""

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with falsified classes."""
        rows = _rows(listed, context, "detections")
        label = listed.label.copy()
        car = LABELS.index("car")
        label[rows] = np.where(label[rows] == car, LABELS.index("pedestrian"), car)
        return replace(listed, label=label)


@dataclass(frozen=True, kw_only=True, slots=True)
class ScoreParams(FalsifiedParams):
    """The score that is claimed."""

    claimed: Share = 0.05
    """Score of every falsified detection."""


class Score(WithParams[ScoreParams]):
    """Falsifies scores: low ones, so that true objects are not believed, or high ones, so that false positives are."""

    Params = ScoreParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with the claimed score."""
        rows = _rows(listed, context, self.params.content)
        score = listed.score.copy()
        score[rows] = self.params.claimed
        return replace(listed, score=score)


@dataclass(frozen=True, kw_only=True, slots=True)
class MisstatedAccuracyParams:
    """The accuracy that is stated."""

    factor: Annotated[float, Ge(LEAST_ACCURACY_FACTOR), Le(MOST_ACCURACY_FACTOR)] = 10.0
    """Factor on the standard deviations that an honest vehicle would state. Above 1 the error is overstated, so that a
    detection is hard to deny. Below 1 it is understated, so that it dominates fused boxes."""
    content: Literal["detections", "fabricated", "self_report", "all"] = "detections"
    """Content whose accuracy is misstated: `detections` of other objects, only `fabricated` ones, the `self_report`, or
    `all`."""


class MisstatedAccuracy(WithParams[MisstatedAccuracyParams]):
    """Misstates how accurate detections are: the standard deviations of position, velocity, heading and size.

    It has an effect where accuracies are stated (`trust.matching = "gates"`). In a section after that of another
    attack, with `together_with`, it misstates what that attack has fabricated or falsified, too.

    Notes
    -----
    Deviations: this attack has no source. The accuracy of the vehicle's own pose is not stated in messages here: all
    receivers take it to be that of `gnss`.
    """

    Params = MisstatedAccuracyParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with the factor on what will be stated."""
        p, rows = self.params, context.own_rows(listed)
        origin = listed.origin[rows]
        wanted = {
            "detections": origin != SELF,
            "fabricated": origin == FABRICATED,
            "self_report": origin == SELF,
            "all": np.ones(len(rows), bool),
        }
        factor = listed.accuracy_factor.copy()
        factor[rows[wanted[p.content]]] = p.factor
        return replace(listed, accuracy_factor=factor)
