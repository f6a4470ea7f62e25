"""What happened in a step: all that the recorder reads."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.driver.driver import SpeedCommands
from cosim.radio.message_round import LinkReceptions, MessageRound, Receptions
from cosim.step.ground_truth import GroundTruth
from cosim.step.perception import Observed
from cosim.step.reactions import Reactions
from cosim.step.senders import Senders, Vehicles
from cosim.v2x.messages import Detections
from cosim.v2x.pseudonyms import PseudonymUse
from cosim.v2x.trust_hosts import Lookups, ServerTraffic
from cosim.world import World
from results.encounters import Rows
from trust import tables
from trust.fusion import Fused
from trust.tables import EvaluationMessages, Evaluations, ObjectLists, TrustScores


@dataclass(frozen=True, slots=True)
class Sensed:
    """What happened in a step in which vehicles sense and talk."""

    vehicles: Vehicles
    senders: Senders
    """Messages of either kind, by vehicle and identity."""
    observed: Observed
    listed: Detections
    """Detections as each vehicle lists and transmits them, attacks included."""
    truth: GroundTruth
    withheld: Bool[ndarray, "d"]
    """Kept from others by an attack."""
    detections: tables.Detections
    """The same as trust sees them: message as a row of `senders`."""
    rounds: tuple[MessageRound, MessageRound]
    """Of detection messages, and of evaluation messages."""
    links: tuple[LinkReceptions, LinkReceptions]
    """Their receptions by kind of link."""
    lists: ObjectLists
    """What is evaluated under each identity of each vehicle."""
    reported: Evaluations
    """Evaluations as transmitted."""
    messages: tuple[EvaluationMessages, EvaluationMessages]
    """Evaluations of what was transmitted: as transmitted, and as evaluators keep them; the same rows."""
    n_points: Int[ndarray, "m"]
    plausible: Bool[ndarray, "m"]
    matched: Bool[ndarray, "m"]
    """The vehicle detected the object itself."""
    lied: Bool[ndarray, "m"]
    """Transmitted otherwise than made."""
    used: Receptions
    """Messages whose senders' trust each vehicle looks up."""
    lookups: list[Lookups]
    """Per trust variant; rows as in `used`."""
    fused: list[Fused | None]
    """Per trust variant; None where it was not asked for."""
    published: list[TrustScores | None]
    """Per trust variant: what its server computed in this step."""
    server: list[ServerTraffic | None]
    """Per trust variant; None where its trust does not live on a server."""
    in_range: list[tuple[Int[ndarray, "p"], Int[ndarray, "p"]]]
    """Per round: senders and the vehicles within range of them; rows of `vehicles`."""
    inter_reception: list[Rows]
    """Per round: columns of the table `packet_inter_reception`."""
    n_dropped: Int[ndarray, "f"]
    """Detections that could not be sent, by `DetectionFault`."""
    attack_outcomes: list[Rows]
    """Per trust variant that fuses: columns of the table `attack_outcomes`."""
    position_error_m: Float[ndarray, "e 2"] | None
    """Where vehicles believe to be less where they are, east and north; None without `[gnss]`."""


@dataclass(frozen=True, slots=True)
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
