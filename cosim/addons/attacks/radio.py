"""Attacks on the channel and on the link to the trust server: copies, jamming, delay, flooding."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from cosim.attacks.attack import LOUDEST_DBM, AttackContext, Sending, WithParams


@dataclass(frozen=True, kw_only=True, slots=True)
class DenialOfServiceParams:
    """Number of copies."""

    n_copies: Annotated[int, Gt(0), Le(1000)] = 100
    """Number of copies of every detection message in addition to the first. The default has no source. F2MD sends at
    four times the rate (3 copies), which has no effect on a channel with messages at 1 Hz."""
    ignores_dcc: bool = True
    """Whether the attacker sends without congestion control. With it, the copies would need more time than a round."""


class DenialOfService(WithParams[DenialOfServiceParams]):
    """Sends copies of the own detection message, each as a frame on the shared channel.

    Notes
    -----
    Deviations: a receiver uses only the first of several copies, because they have the same signature and time. The
    effect of copies is the load on the channel. Like the message, copies are generated at random times in the first
    half of the round.
    """

    Params = DenialOfServiceParams

    def sending(self, context: AttackContext) -> Sending:
        """Sending with copies."""
        p, attacker = self.params, context.attacker
        plain = Sending.plain(len(context.world))
        return replace(plain, n_copies=np.where(attacker, p.n_copies, 0), ignores_dcc=attacker & p.ignores_dcc)


@dataclass(frozen=True, kw_only=True, slots=True)
class JammingParams:
    """Mode and power of the jammer."""

    mode: Literal["constant", "reactive"] = "constant"
    """`constant`: noise all the time. `reactive`: noise only while the jammer detects a frame of another station."""
    power_dbm: Annotated[float, Ge(-20), Le(LOUDEST_DBM)] = 23.0
    """Power of the noise, including the antenna gain [dBm]. The default is the power of a station."""


class Jamming(WithParams[JammingParams]):
    """Transmits noise on the channel, which raises the noise floor at all stations that it reaches.

    Frames that are too weak are lost: their preamble is not detected, or their payload has errors. Both count as lost
    by interference (`n_lost_collision`).

    Notes
    -----
    The noise has the mean received power of a frame of `power_dbm` over the same link: with path loss, buildings,
    blockage and shadowing, without fading. A reactive jammer disturbs frames that reach it with a mean power of
    `radio.receiver.detectable_dbm` or more. It disturbs their payload only, because it is too late for the preamble.
    Deviations: carrier sense and the channel busy ratio ignore the noise, so that stations near a constant jammer still
    send. The jammer itself still sends and receives. The attack has no effect with `radio.model = "unit_disk"`.
    """

    Params = JammingParams

    def sending(self, context: AttackContext) -> Sending:
        """Sending with noise."""
        plain = Sending.plain(len(context.world))
        noise = np.where(context.attacker, self.params.power_dbm, -np.inf)
        if self.params.mode == "constant":
            return replace(plain, jam_dbm=noise)
        return replace(plain, react_dbm=noise)


@dataclass(frozen=True, kw_only=True, slots=True)
class DelayParams:
    """Length of the delay."""

    delay_s: Annotated[float, Ge(0), Le(10)] = 0.3
    """Delay before the detection message is transmitted [s]. A message whose transmission would end later than
    `radio.timeout_s` after its step is not sent. Messages are generated in the first half of a round. Where all
    vehicles sense together, a round lasts 0.4 s, and half of the messages with the default delay are not sent. Where
    they sense at phases of their own, with `csma`, the messages arrive in a later step. The default has no source."""


class Delay(WithParams[DelayParams]):
    """Delays detection messages. Their true content arrives late (`generation_offset_s`), or is too late and lost
    (`n_lost_expired`)."""

    Params = DelayParams

    def sending(self, context: AttackContext) -> Sending:
        """Sending with a delay."""
        plain = Sending.plain(len(context.world))
        return replace(plain, delay_s=np.where(context.attacker, self.params.delay_s, 0.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerFloodingParams:
    """Number of reports."""

    n_reports: Annotated[int, Gt(0), Le(100_000)] = 10_000
    """Number of copies of every report to the trust server in addition to the first. With the default, one attacker
    exceeds the capacity of a cell of 3.5 MB/s. The default has no source."""


class ServerFlooding(WithParams[ServerFloodingParams]):
    """Sends copies of the own report to the trust server, so that the cell has no capacity left for other vehicles.

    Notes
    -----
    The attack has no effect with roadside units, because they forward the one message that was broadcast. A full cell
    accepts reports in random order, copies included. A copy adds no evidence.
    """

    Params = ServerFloodingParams

    def sending(self, context: AttackContext) -> Sending:
        """Sending with copies of the report."""
        plain = Sending.plain(len(context.world))
        return replace(plain, n_reports=np.where(context.attacker, self.params.n_reports, 0))
