"""Attacks on the channel and on the way to the trust server: copies, jamming, delay, flooding."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from cosim.adversary.attack import LOUDEST_DBM, AttackContext, Sending


@dataclass(frozen=True, kw_only=True, slots=True)
class DenialOfServiceParams:
    """How many copies."""

    n_copies: Annotated[int, Gt(0), Le(1000)] = 100
    """Further copies of every detection message; the default is ours. F2MD sends at four times the rate (3 copies),
    which a channel with messages of 1 Hz does not notice."""
    ignores_dcc: bool = True
    """Send without congestion control, which would spread the copies over more time than a round has."""


class DenialOfService:
    """Copies of the own detection message, each a frame of its own on the channel that all share.

    Notes
    -----
    Deviations: a receiver that gets several copies counts the first (they carry one signature and one time); what
    copies do is load the channel. Copies are generated at random times of the round's first half, as the message is.
    """

    Params = DenialOfServiceParams

    def __init__(self, params: DenialOfServiceParams) -> None:
        self.params = params

    def sending(self, context: AttackContext) -> Sending:
        """Copies beside the first."""
        p, attacker = self.params, context.attacker
        plain = Sending.plain(len(context.world))
        return replace(plain, n_copies=np.where(attacker, p.n_copies, 0), ignores_dcc=attacker & p.ignores_dcc)


@dataclass(frozen=True, kw_only=True, slots=True)
class JammingParams:
    """How the channel is jammed."""

    mode: Literal["constant", "reactive"] = "constant"
    """constant: noise all the time; reactive: noise only while the jammer detects a frame of another station."""
    power_dbm: Annotated[float, Ge(-20), Le(LOUDEST_DBM)] = 23.0
    """Power of the noise, antenna gain included [dBm]; the default is that of a station."""


class Jamming:
    """Noise on the channel: the noise floor rises at all stations that the jammer reaches.

    Frames that are too weak against it are lost: their preamble is not detected, or their payload has errors. Both
    count as lost by interference (`n_lost_collision`).

    Notes
    -----
    The noise arrives with the mean power of a frame of `power_dbm` over the same link: path loss, buildings, blockage
    and shadowing, without fading. A reactive jammer disturbs the payload of frames that reach it with
    `radio.receiver.detectable_dbm` or more on average; it is too late for the preamble.
    Deviations: carrier sense and the channel busy ratio do not notice the noise, so that stations do not fall silent
    near a constant jammer; the jammer itself goes on to send and receive. `radio.model = "csma"` only.
    """

    Params = JammingParams

    def __init__(self, params: JammingParams) -> None:
        self.params = params

    def sending(self, context: AttackContext) -> Sending:
        """Noise beside the messages."""
        plain = Sending.plain(len(context.world))
        noise = np.where(context.attacker, self.params.power_dbm, -np.inf)
        if self.params.mode == "constant":
            return replace(plain, jam_dbm=noise)
        return replace(plain, react_dbm=noise)


@dataclass(frozen=True, kw_only=True, slots=True)
class DelayParams:
    """How late."""

    delay_s: Annotated[float, Ge(0), Le(10)] = 0.3
    """Added before the detection message goes on the air [s]. A message that then ends after the round
    (radio.timeout_s) is not sent any more; with rounds of 0.4 s, generation in their first half and the default, which
    is ours, that is every second one, and the others are 0.3 s late."""


class Delay:
    """Detection messages held back: true content that arrives late (`generation_offset_s`) or, too late, is lost
    (`n_lost_expired`)."""

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

    n_reports: Annotated[int, Gt(0), Le(100_000)] = 10_000
    """Further copies of every report to the trust server; with the default, which is ours, one attacker sends more than
    a cell of 3.5 MB/s takes."""


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
