"""What happened in a step: all that the recorder reads. It is made of the results of the stages."""

from dataclasses import dataclass

from cosim.driver.driver import SpeedCommands
from cosim.step.exchange import Senders, Vehicles
from cosim.step.reactions import Reactions
from cosim.step.stages import Evaluated, Listed, Positioned
from cosim.step.tracking import Reach, Rounds
from cosim.step.trust_stages import LookedUp
from cosim.v2x.pseudonyms import PseudonymUse
from cosim.v2x.trust_hosts import ServerTraffic
from cosim.world import World
from results.encounters import Rows
from trust.fusion import Fused
from trust.tables import TrustScores


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensed:
    """What happened in a step in which vehicles sense and exchange messages."""

    vehicles: Vehicles
    senders: Senders
    """Messages of either kind, by vehicle and identity."""
    positioned: Positioned
    listed: Listed
    rounds: Rounds
    """Of detection messages, and of evaluation messages."""
    reach: tuple[Reach, Reach]
    """The same."""
    evaluated: Evaluated
    looked_up: LookedUp
    fused: list[Fused | None]
    """Per trust variant; None where it was not asked for."""
    published: list[TrustScores | None]
    """Per trust variant: what its server computed in this step."""
    servers: list[ServerTraffic | None]
    """Per trust variant; None where its trust does not live on a server."""
    attack_outcomes: list[Rows]
    """Per trust variant that fuses: columns of the table `attack_outcomes`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """What happened in a step."""

    world: World
    encounters: list[Rows]
    """Encounters that are over, per definition."""
    ended_pseudonyms: PseudonymUse
    sensed: Sensed | None
    """None in steps between two sweeps, and without equipped vehicles."""
    commands: SpeedCommands
    """What drivers do next."""
    reactions: Reactions | None
    """The same with what they react to; None where the driver gives no reasons."""
