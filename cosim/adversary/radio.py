"""Attacks on the channel and on the way to the trust server: copies, delay, flooding."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le

from cosim.adversary.attack import AttackContext, Sending


@dataclass(frozen=True, kw_only=True, slots=True)
class DenialOfServiceParams:
    """How many copies."""

    n_copies: Annotated[int, Gt(0), Le(1000)] = 3
    """Further copies of every detection message. F2MD sends at four times the rate: 3 copies."""


class DenialOfService:
    """Copies of the own detection message, each a frame of its own on the channel that all share.

    Notes
    -----
    Deviations: a receiver that gets several copies counts the first (they carry one signature and one time); what
    copies do is load the channel.
    """

    Params = DenialOfServiceParams

    def __init__(self, params: DenialOfServiceParams) -> None:
        self.params = params

    def sending(self, context: AttackContext) -> Sending:
        """Copies beside the first."""
        plain = Sending.plain(len(context.world))
        return replace(plain, n_copies=np.where(context.attacker, self.params.n_copies, 0))


@dataclass(frozen=True, kw_only=True, slots=True)
class DelayParams:
    """How late."""

    delay_s: Annotated[float, Ge(0), Le(10)] = 0.2
    """Added before the detection message goes on the air [s]; beyond the round (radio.timeout_s) it comes too late."""


class Delay:
    """Detection messages held back: true content that arrives late, or not in time at all."""

    Params = DelayParams

    def __init__(self, params: DelayParams) -> None:
        self.params = params

    def sending(self, context: AttackContext) -> Sending:
        """Later."""
        plain = Sending.plain(len(context.world))
        return replace(plain, delay_s=np.where(context.attacker, self.params.delay_s, 0.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerFloodingParams:
    """How many reports."""

    n_reports: Annotated[int, Gt(0), Le(100_000)] = 50
    """Further copies of every report to the trust server."""


class ServerFlooding:
    """Copies of the own report to the trust server, so that the cell has no capacity left for others.

    Notes
    -----
    Through roadside units reports are what was broadcast, once: there is nothing to flood. Which reports a full cell
    takes is chance, for copies as for others. A copy adds no evidence.
    """

    Params = ServerFloodingParams

    def __init__(self, params: ServerFloodingParams) -> None:
        self.params = params

    def sending(self, context: AttackContext) -> Sending:
        """Reports beside the first."""
        plain = Sending.plain(len(context.world))
        return replace(plain, n_reports=np.where(context.attacker, self.params.n_reports, 0))
