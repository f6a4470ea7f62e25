"""Who hears whom: one board for both models of the air, and the air itself as the cycle sees it."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt
from jaxtyping import Int
from numpy import ndarray

from cosim import rng
from cosim.v2x import csma, disk
from cosim.v2x.channel import AccessParams
from cosim.v2x.dcc import DccParams
from cosim.v2x.disk import DiskParams
from cosim.v2x.exchange import Exchange, RelayParams
from cosim.v2x.messages import FRAME_BYTES
from cosim.v2x.obstruction import Sight, Walls
from cosim.v2x.propagation import PropagationParams
from cosim.v2x.reception import ReceiverParams, airtime_ns
from cosim.v2x.roadside import Sites
from cosim.world import World
from sensors.scene import Scene


class Round(IntEnum):
    """The two rounds of messages of one turn."""

    DETECTIONS = 0
    VERDICTS = 1


@dataclass(frozen=True, kw_only=True, slots=True)
class RadioParams:
    """Range-limited broadcast, relay and packet loss."""

    model: Literal["csma", "disk"] = "csma"
    """`csma`: packet by packet over the city's propagation. `disk`: everybody within reach, but for flat losses."""
    reach_m: Annotated[float, Gt(0)] = 300.0
    """Largest distance of one hop [m]; frames from farther away are dropped, and under `csma` still interfere."""
    timeout_s: Annotated[float, Gt(0)] | None = None
    """Length of a round of messages, of which a turn has two [s]; two fifths of the sensing interval when not set."""
    antenna_above_roof_m: Annotated[float, Ge(0)] = 0.1
    """Height of the antenna above the roof [m]."""
    cpm_rules: Literal["all", "etsi"] = "all"
    """Which detections a message includes: all of them, or those that the rules of ETSI TS 103 324 ask for."""
    verdicts: Literal["alone", "piggybacked"] = "alone"
    """Verdicts go out at once in messages of their own, or ride on the detection message of the next turn."""
    disk: DiskParams = field(default_factory=DiskParams)
    relay: RelayParams = field(default_factory=RelayParams)
    propagation: PropagationParams = field(default_factory=PropagationParams)
    receiver: ReceiverParams = field(default_factory=ReceiverParams)
    access: AccessParams = field(default_factory=AccessParams)
    dcc: DccParams = field(default_factory=DccParams)

    def __post_init__(self) -> None:
        if self.reach_m < 5:
            raise ValueError(
                f"radio.reach_m = {self.reach_m:g} m is shorter than one vehicle: nobody hears anybody. "
                "Metres, not kilometres? Set radio.reach_m to at least 5."
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


@dataclass(slots=True)
class Radio:
    """The radios of all equipped vehicles and roadside units, and the air between them."""

    params: RadioParams
    timeout_s: float
    """Length of one round [s]."""
    seed: int
    sites: Sites
    air: csma.Air

    @staticmethod
    def start(params: RadioParams, sensing_interval_s: float, seed: int, city: Scene, sites: Sites) -> "Radio":
        """Silence over a city; its buildings stand in the way."""
        timeout_s = 0.4 * sensing_interval_s if params.timeout_s is None else params.timeout_s
        return Radio(params, timeout_s, seed, sites, csma.Air.start(Sight.of(walls_of(city)), seed))

    def exchange(
        self, what: Round, world: World, radios: Int[ndarray, "e"], length_bytes: Int[ndarray, "e"], begin_s: float,
        site_bytes: int = 0,
    ) -> Exchange:  # fmt: skip
        """One round from `begin_s` on: a message from every radio with anything to say.

        Parameters
        ----------
        radios
            Vehicles, rows of the world.
        site_bytes
            Length of what every roadside unit says.
        """
        p, n = self.params, len(radios)
        names = np.concatenate([world.name_key[radios], self.sites.name_key])
        xyz_m = np.concatenate([world.boxes.xyz_m[radios], self.sites.xyz_m])
        xyz_m[:n, 2] += world.boxes.lwh_m[radios, 2] / 2 + p.antenna_above_roof_m
        length_bytes = np.concatenate([length_bytes, np.full(len(self.sites), site_bytes)])
        talks = length_bytes > 0
        if p.model == "disk" or len(names) == 0:
            stream = (rng.Stream.RADIO_DETECTIONS, rng.Stream.RADIO_VERDICTS)[what]
            chance = rng.key(self.seed, stream, world.step)
            heard, frames = disk.broadcast(
                xyz_m[:, :2], names, talks, length_bytes, chance, p.reach_m, self.timeout_s, p.disk, p.relay
            )
        else:
            heard, frames = csma.broadcast(
                self.air, xyz_m, names, talks, length_bytes, len(Round) * world.step + what, begin_s, self.timeout_s,
                p.reach_m, p.propagation, p.receiver, p.access, p.dcc, p.relay,
            )  # fmt: skip
        return Exchange.of(heard, frames, n)


def walls_of(city: Scene) -> Walls:
    """The buildings that light meets, as obstacles for radio."""
    return Walls.of([
        (np.array(polygon.exterior.coords), [np.array(hole.coords) for hole in polygon.interiors], low, high)
        for polygon, low, high in zip(
            city.footprints, city.buildings.base_m, city.buildings.top_m, strict=True
        )
    ])  # fmt: skip
