"""The result of a step. It consists of the results of the stages, and the recorder reads it."""

from dataclasses import dataclass

from jaxtyping import Int
from numpy import ndarray

from cosim.base.deferred import Deferred
from cosim.messages.pseudonyms import PseudonymUse
from cosim.messages.trust_hosts import ServerTraffic
from cosim.step.early_fusion import Early
from cosim.step.evaluate import Evaluated
from cosim.step.exchange import Senders, Vehicles
from cosim.step.known import Known
from cosim.step.listing import Listed
from cosim.step.reactions import Reactions
from cosim.step.reports import EvaluationCarriers
from cosim.step.sense import Positioned
from cosim.step.tracking import Reach, Rounds
from cosim.step.trust import LookedUp
from cosim.traffic.driver import SpeedCommands
from cosim.world import World
from results.encounters import Rows
from trust.fusion import Fused
from trust.tables import TrustScores


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensed:
    """Results of a step in which vehicles sense and exchange messages."""

    vehicles: Vehicles
    """All equipped vehicles on the road."""
    sensing: Vehicles
    """Those that sense in this step. Their rows are the observers and the egos of the other results."""
    senders: Senders
    """The messages of each round, sorted by vehicle and identity."""
    positioned: Positioned
    listed: Listed
    known: Known
    """The detections of this step and those of earlier messages that vehicles use."""
    rounds: Rounds
    """The rounds of detection messages and of evaluation messages."""
    carried: tuple[EvaluationCarriers, ...]
    """The messages that carried evaluations, of this step and of earlier ones whose messages may still arrive."""
    reach: tuple[Reach, Reach]
    """Vehicles in range, for the same two rounds."""
    evaluated: Evaluated
    looked_up: LookedUp
    fused: Deferred[list[Fused | None]]
    """Fused objects per trust variant; None if they were not requested. A run computes them beside the next step."""
    early: Early | None
    """What vehicles detect in merged point clouds; None without `[early_fusion]`."""
    published: list[TrustScores | None]
    """Per trust variant, the values that its server computed in this step."""
    servers: list[ServerTraffic | None]
    """Per trust variant, the traffic from and to its server; None if it has no server."""
    attack_outcomes: Deferred[list[Rows]]
    """Columns of the table `attack_outcomes`, per trust variant that fuses."""

    def observer(self) -> Int[ndarray, "d"]:
        """Pseudonym of the sender of each detection that is listed in this step."""
        return self.senders.pseudonym[self.listed.detections.message]


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """The result of a step."""

    world: World
    encounters: list[Rows]
    """Encounters that have ended, per definition in the config."""
    ended_pseudonyms: PseudonymUse
    sensed: Sensed | None
    """None in steps without sweeps or without equipped vehicles."""
    commands: SpeedCommands
    """The drivers' commands for the next step."""
    reactions: Reactions | None
    """The commands with the objects that caused them; None if the driver gives no reasons."""
