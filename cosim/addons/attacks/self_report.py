"""Attacks that falsify the vehicle's own motion in its self report: speed, braking, stopping."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.attacks.attack import AttackContext, WithParams, per_actor
from cosim.base.bounds import NotNegative100, Positive100, Share
from cosim.messages.content import SELF, Detections


def _selves(listed: Detections, chosen: Bool[ndarray, "n"]) -> Int[ndarray, "r"]:
    """Rows of `listed` that are self reports of the chosen actors. `chosen` is by row of the world."""
    return np.flatnonzero(chosen[listed.observer] & (listed.origin == SELF))


def _told(
    listed: Detections,
    rows: Int[ndarray, "r"],
    speed_mps: Float[ndarray, "r"],
    acceleration_mps2: Float[ndarray, "r"],
) -> Detections:
    speed, acceleration = listed.speed_mps.copy(), listed.acceleration_mps2.copy()
    speed[rows], acceleration[rows] = speed_mps, acceleration_mps2
    return replace(listed, speed_mps=speed, acceleration_mps2=acceleration)


@dataclass(frozen=True, kw_only=True, slots=True)
class SpeedParams:
    """Error of the speed."""

    min_mps: NotNegative100 = 1.0
    """Smallest error [m/s]. The default is NextGen's."""
    max_mps: Positive100 = 7.0
    """Largest error [m/s]. The default is NextGen's."""

    def __post_init__(self) -> None:
        if self.min_mps > self.max_mps:
            raise ValueError(
                f"attacks.min_mps = {self.min_mps:g} m/s is above attacks.max_mps = {self.max_mps:g} m/s. Swap them."
            )


class Speed(WithParams[SpeedParams]):
    """Reports a wrong speed. The error is +-U(min_mps, max_mps), drawn for every message, and the speed is 0 or more
    (NextGen)."""

    Params = SpeedParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with falsified speeds in self reports."""
        p, rows = self.params, _selves(listed, context.attacker)
        u = context.uniforms(context.name_key(listed.observer[rows]), n=2)
        error = p.min_mps + (p.max_mps - p.min_mps) * u[:, 0]
        sign = np.where(u[:, 1] < 0.5, -1.0, 1.0)
        speed = np.maximum(listed.speed_mps[rows] + error * sign, 0.0)
        return _told(listed, rows, speed, listed.acceleration_mps2[rows])


@dataclass(frozen=True, kw_only=True, slots=True)
class BrakingParams:
    """Strength of the feigned braking."""

    min_factor: Positive100 = 2.0
    """Smallest factor on the deceleration. The default is NextGen's."""
    max_factor: Positive100 = 4.0
    """Largest factor on the deceleration. The default is NextGen's."""
    least_mps2: Positive100 = 1.0
    """Deceleration that is multiplied if the vehicle brakes less than this or not at all [m/s2]."""

    def __post_init__(self) -> None:
        if self.min_factor > self.max_factor:
            raise ValueError(
                f"attacks.min_factor = {self.min_factor:g} is above attacks.max_factor = {self.max_factor:g}. "
                "Swap them."
            )


class Braking(WithParams[BrakingParams]):
    """Feigns braking: reports the vehicle's own deceleration times U(2, 4), drawn for every message (NextGen).

    Notes
    -----
    Deviations: a vehicle that does not brake multiplies `least_mps2`. The reported speed is unchanged.
    """

    Params = BrakingParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with falsified accelerations in self reports."""
        p, rows = self.params, _selves(listed, context.attacker)
        u = context.uniforms(context.name_key(listed.observer[rows]))[:, 0]
        factor = p.min_factor + (p.max_factor - p.min_factor) * u
        brakes = np.maximum(-listed.acceleration_mps2[rows], p.least_mps2)
        return _told(listed, rows, listed.speed_mps[rows], -factor * brakes)


@dataclass(frozen=True, kw_only=True, slots=True)
class StopParams:
    """Beginning of the feigned stop."""

    stop_p: Share = 0.05
    """Probability per message that the feigned stop begins. It then lasts. The default is NextGen's; 1 stops at
    once."""


class Stop(WithParams[StopParams]):
    """Feigns a stop: from its beginning, reports speed 0 at the same position (NextGen, F2MD)."""

    Params = StopParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with self reports that stay at the position of the stop."""
        world, attacker = context.world, context.attacker
        begins = context.uniforms(world.name_key)[:, 0] < self.params.stop_p
        anew = attacker & (context.n_active == 0)
        stood = per_actor(context, "stands", anew, 0.0) > 0
        pose = np.column_stack([world.boxes.xyz_m, world.boxes.yaw_rad])
        now = attacker & begins & ~stood
        stands = (per_actor(context, "stands", now, 1.0) > 0) & attacker
        pose = per_actor(context, "pose", now, pose)
        rows = _selves(listed, stands)
        own = pose[listed.observer[rows]]
        xyz, yaw = listed.boxes.xyz_m.copy(), listed.boxes.yaw_rad.copy()
        xyz[rows] = own[:, :3]
        yaw[rows] = own[:, 3]
        held = replace(listed, boxes=replace(listed.boxes, xyz_m=xyz, yaw_rad=yaw))
        return _told(held, rows, np.zeros(len(rows)), np.zeros(len(rows)))
