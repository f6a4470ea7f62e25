"""Parameters of the radio."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from cosim.base.bounds import NotNegative100, Share
from cosim.radio import sidelink_params
from cosim.radio.channel import AccessParams
from cosim.radio.dcc import DccParams
from cosim.radio.phy import ReceiverParams, airtime_ns
from cosim.radio.propagation import PropagationParams
from cosim.radio.segmentation import FRAME_BYTES
from cosim.radio.sidelink_params import LteParams, NrParams, SidelinkParams


@dataclass(frozen=True, kw_only=True, slots=True)
class UnitDiskParams:
    """The unit disk model, for theory and quick runs. It has no walls and no collisions."""

    loss_p: Share = 0.05
    """Probability that one hop fails at one receiver."""
    latency_min_s: Annotated[float, Ge(0), Le(3600)] = 0.0004
    """Shortest time from the start of a hop to its reception [s]. The default is that of Eclipse MOSAIC's SNS."""
    latency_max_s: Annotated[float, Ge(0), Le(3600)] = 0.0024
    """Longest time from the start of a hop to its reception [s]. The time is uniformly distributed between the two."""

    def __post_init__(self) -> None:
        if self.latency_max_s < self.latency_min_s:
            raise ValueError(
                f"radio.unit_disk.latency_max_s = {self.latency_max_s:g} s is below radio.unit_disk.latency_min_s = "
                f"{self.latency_min_s:g} s. Set the larger one as maximum."
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class RelayParams:
    """Multi-hop forwarding of messages."""

    max_hops: Annotated[int, Ge(1), Le(10)] = 1
    """Largest number of hops of a message. 1 means no forwarding."""
    forward_range_m: Annotated[float, Gt(0), Le(100_000)] = 600.0
    """Largest distance from its sender at which a message is forwarded [m]."""
    rule: Literal["contention", "probability"] = "contention"
    """`contention`: the farthest station forwards first, and stations that receive its copy do not forward (with
    `unit_disk` all forward). `probability`: each station forwards with probability `forward_p`."""
    forward_p: Share = 0.5
    """With `probability`: probability that a station forwards a message."""
    min_trust: Share = 0.0
    """A vehicle forwards a message only if its trust in the sender is at least this, as it knew it when the step
    began. An unknown sender has `trust.default_trust`. With 0 trust has no effect on forwarding."""
    timer_min_s: Annotated[float, Gt(0), Le(10)] = 0.001
    """Contention timer at `timer_distance_m` from the previous hop, and beyond [s]."""
    timer_max_s: Annotated[float, Gt(0), Le(10)] = 0.1
    """Contention timer at distance 0 from the previous hop [s]. With `probability`, timers are uniformly distributed
    between `timer_min_s` and `timer_max_s`."""
    timer_distance_m: Annotated[float, Gt(0), Le(100_000)] = 400.0
    """Distance from the previous hop at which the contention timer reaches `timer_min_s` [m]."""

    def __post_init__(self) -> None:
        if self.timer_max_s < self.timer_min_s:
            raise ValueError(
                f"radio.relay.timer_max_s = {self.timer_max_s:g} s is below radio.relay.timer_min_s = "
                f"{self.timer_min_s:g} s. Set the larger one as maximum."
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class RadioParams:
    """V2X broadcast between vehicles and roadside units."""

    model: str = "csma"
    """Radio medium. `csma`: IEEE 802.11p, each packet is simulated, with propagation in the city. `nr_mode2`: sidelink
    of NR-V2X. `lte_mode4`: sidelink of LTE-V2X. `unit_disk`: every station in range receives, except for a constant
    loss probability. Or a class of your own as path.py:Name."""
    range_m: Annotated[float, Gt(0), Le(32_000)] = 300.0
    """Communication range: largest horizontal distance of one hop [m]. Frames from farther away are not received. With
    `csma` they still interfere."""
    timeout_s: Annotated[float, Gt(0), Le(3600)] | None = None
    """Longest time from the beginning of a step until its detection messages have arrived [s]; its evaluation messages
    have twice that. A message that is not sent by then expires. If it is not set, it is two fifths of the shortest
    sensing interval. With `unit_disk` and the sidelinks, a message ends with its round, which is shorter where vehicles
    sense at different times."""
    antenna_above_roof_m: NotNegative100 = 0.1
    """Height of the antenna above the roof [m]."""
    evaluations: Literal["alone", "piggybacked"] = "alone"
    """`alone`: evaluations are sent at once in their own messages. `piggybacked`: they are sent with the detection
    message of the next step."""
    unit_disk: UnitDiskParams = field(default_factory=UnitDiskParams)
    relay: RelayParams = field(default_factory=RelayParams)
    propagation: PropagationParams = field(default_factory=PropagationParams)
    receiver: ReceiverParams = field(default_factory=ReceiverParams)
    access: AccessParams = field(default_factory=AccessParams)
    dcc: DccParams = field(default_factory=DccParams)
    sidelink: SidelinkParams = field(default_factory=SidelinkParams)
    nr: NrParams = field(default_factory=NrParams)
    lte: LteParams = field(default_factory=LteParams)

    def __post_init__(self) -> None:
        if self.range_m < 5:
            raise ValueError(
                f"radio.range_m = {self.range_m:g} m is shorter than one vehicle: no message is received. "
                "Metres, not kilometres? Set radio.range_m to at least 5."
            )
        air_s = airtime_ns(np.array([FRAME_BYTES]), self.receiver.rate_mbps)[0] * 1e-9
        if self.access.lifetime_s < air_s:
            raise ValueError(
                f"radio.access.lifetime_s = {self.access.lifetime_s:g} s is shorter than the transmission of a full "
                f"frame, {air_s * 1e3:.3g} ms: nothing would ever be sent. Set it higher."
            )
        if self.timeout_s is not None and self.timeout_s < 10 * air_s:
            raise ValueError(
                f"radio.timeout_s = {self.timeout_s:g} s leaves no time for more than a few frames of "
                f"{air_s * 1e3:.3g} ms. Set it to at least {10 * air_s:.3g}."
            )

        sidelink_params.check(self.model, self.sidelink, self.nr, self.lte, self.relay.max_hops)

    def lifetime_s(self, sensing_interval_s: float) -> float:
        """Longest time that the detection messages of a step may take [s]."""
        return 0.4 * sensing_interval_s if self.timeout_s is None else self.timeout_s
