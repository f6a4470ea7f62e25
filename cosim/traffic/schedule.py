"""When each equipped vehicle senses: its interval, and its phase within the interval."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, Int, UInt64
from numpy import ndarray

from cosim.base.bounds import PositiveShare


@dataclass(frozen=True, kw_only=True, slots=True)
class SensingGroup:
    """A `[[sensing_groups]]` section: a share of the equipped vehicles that senses at another interval.

    Roadside units belong to groups as vehicles do.
    """

    share_p: PositiveShare
    """Share of the equipped vehicles. The shares of all groups add up to 1 at most."""
    interval_s: Annotated[float, Ge(0.1), Le(3600)]
    """Time between two LiDAR sweeps of a vehicle of the group, and between two of its messages [s]. It must be a
    multiple of traffic.step_s."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """Intervals and phases of all vehicles, in traffic steps. Both are drawn from a vehicle's name."""

    interval_steps: tuple[int, ...]
    """Interval of each group; the last one is that of the vehicles that belong to no group."""
    until_p: tuple[float, ...]
    """Sum of the shares up to each group; 1 for the last."""
    is_random: bool
    """Whether each vehicle has a phase of its own. Otherwise all intervals begin at step 0."""
    step_s: float
    seed: int

    @staticmethod
    def of(interval_s: float, phase: str, groups: Sequence[SensingGroup], step_s: float, seed: int) -> "Schedule":
        """The schedule of a config.

        Raises
        ------
        ValueError
            In one line, if an interval is not a multiple of the step, if shares add up to more than 1, or if phases are
            random and no interval has more than one step.
        """
        names = [*(f"sensing_groups.{number}.interval_s" for number in range(len(groups))), "sensing_interval_s"]
        interval_steps = []
        for name, seconds in zip(names, [*(group.interval_s for group in groups), interval_s], strict=True):
            steps = seconds / step_s
            if abs(steps - round(steps)) > 1e-9 or steps < 1 - 1e-9:
                raise ValueError(
                    f"{name} = {seconds:g} s is not a multiple of traffic.step_s = {step_s:g} s, and every sweep takes "
                    "place at a traffic step. Change one of them."
                )
            interval_steps.append(round(steps))
        until = np.cumsum([group.share_p for group in groups])
        if len(until) and until[-1] > 1 + 1e-9:
            raise ValueError(
                f"sensing_groups: the shares add up to {until[-1]:g}, more than all equipped vehicles. Lower a share_p."
            )
        if phase == "random" and max(interval_steps) == 1:
            raise ValueError(
                f'sensing_phase = "random", but traffic.step_s = {step_s:g} s is as long as the sensing interval, so '
                "all vehicles would sense at the same time. Set traffic.step_s to a fraction of it, such as "
                f'{step_s / 2:g}, or sensing_phase = "common".'
            )
        return Schedule(tuple(interval_steps), (*until.tolist(), 1.0), phase == "random", step_s, seed)

    @property
    def longest_steps(self) -> int:
        """Longest interval. A message is used for less than this."""
        return max(self.interval_steps)

    @property
    def shortest_s(self) -> float:
        """Shortest interval [s]. The messages of a sweep arrive or expire before the next one."""
        return min(self.interval_steps) * self.step_s

    @property
    def sweeps_per_s(self) -> float:
        """Sweeps of a vehicle per second, mean over all groups."""
        shares = np.diff(self.until_p, prepend=0.0)
        return float((shares / (np.array(self.interval_steps) * self.step_s)).sum())

    @property
    def exchange_every_steps(self) -> int:
        """Steps between two steps in which any vehicle can sense."""
        return 1 if self.is_random else math.gcd(*self.interval_steps)

    @property
    def exchange_interval_s(self) -> float:
        """Time between two steps in which any vehicle can sense [s]."""
        return self.exchange_every_steps * self.step_s

    @property
    def is_lock_step(self) -> bool:
        """Whether all vehicles sense at the same steps, so that no message is older than the sweep that judges it."""
        return len(set(self.interval_steps)) == 1 and not self.is_random

    def senses(self, step: int, name_key: UInt64[ndarray, "n"]) -> Bool[ndarray, "n"]:
        """Whether each vehicle, by the hash of its name, senses in a step while it is on the road."""
        interval, phase = self.of_vehicles(name_key)
        return step % interval == phase

    def of_vehicles(
        self,
        name_key: UInt64[ndarray, "n"],
    ) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
        """Interval and phase of each vehicle.

        Parameters
        ----------
        name_key
            Hash of each vehicle's name.

        Returns
        -------
        Interval n and phase p in steps, 0 <= p < n. A vehicle senses in the steps k with k % n == p.
        """
        from cosim.base import rng  # compiles kernels; every reading of a config imports this module

        of_sensing = rng.key(self.seed, rng.Stream.SENSING)
        group, within = rng.uniforms(of_sensing, name_key, n=2).T
        number = np.searchsorted(self.until_p[:-1], group, "right")
        interval = np.asarray(self.interval_steps)[number]
        if not self.is_random:
            return interval, np.zeros_like(interval)
        return interval, (within * interval).astype(np.int64)
