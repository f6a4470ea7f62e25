"""What survives a step."""

import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.adversary.adversary import AttackState
from cosim.mobility.position_errors import PositionErrors
from cosim.step.parts import Parts
from cosim.step.reactions import ReactionTruth
from cosim.step.stages import SentEvaluations
from cosim.step.trackers.attack_start import AttackStartTracker
from cosim.step.trackers.encounters import EncounterTrackers
from cosim.step.trackers.inter_reception import InterReceptionTracker
from cosim.step.trackers.motion import LastSpeeds
from cosim.step.tracking import ReceptionTrackers
from cosim.v2x.cpm_generation import InclusionMemory
from cosim.v2x.pseudonyms import PseudonymState
from cosim.v2x.relinking import KnownSenders
from cosim.v2x.trust_hosts import TrustState
from results.codes import DetectionFault


@dataclass(frozen=True, slots=True)
class State:
    """All that survives a step.

    A step makes a new state from the one that it is given, and uses that one up: evidence of trust models, encounters
    under way and what attacks and media remember are updated in place. To go on twice from one state, `copy` it first.
    """

    medium: Any
    trust: TrustState
    encounters: EncounterTrackers
    attacks: AttackState
    driver: object = None
    reaction_truth: ReactionTruth = field(default_factory=ReactionTruth)
    """For the table of reactions alone."""
    pseudonyms: PseudonymState = field(default_factory=PseudonymState)
    included: InclusionMemory = field(default_factory=InclusionMemory)
    piggybacked: SentEvaluations | None = None
    inter_reception: ReceptionTrackers = field(
        default_factory=lambda: (InterReceptionTracker(), InterReceptionTracker())
    )
    """Of detection and of evaluation messages."""
    attack_start: AttackStartTracker = field(default_factory=AttackStartTracker)
    known_senders: KnownSenders = field(default_factory=KnownSenders)
    """With pseudonyms.linkage = "own" alone."""
    last_speeds: LastSpeeds = field(default_factory=LastSpeeds)
    position_errors: PositionErrors = field(default_factory=PositionErrors)
    n_dropped: Int[ndarray, "f"] = field(default_factory=lambda: np.zeros(len(DetectionFault), np.int64))
    """Detections dropped so far because they cannot be sent, by `DetectionFault`."""
    is_consumed: bool = False
    """A step has used this state up."""

    @staticmethod
    def start(parts: Parts) -> "State":
        """Before the first step."""
        c = parts.config
        return State(
            medium=parts.medium.start(),
            trust=parts.trust.start(),
            encounters=EncounterTrackers(c.encounters, c.traffic.step_s, len(parts.trust.variants)),
            attacks=parts.adversary.start(),
        )

    def copy(self) -> "State":
        """A state that shares nothing with this one."""
        return copy.deepcopy(self)

    def consume(self) -> "State":
        """The state to go on with. RuntimeError where an earlier step has used this one up."""
        if self.is_consumed:
            raise RuntimeError("an earlier step consumed this state: go on from the state that it returned, or from a "
                               "copy made before it")  # fmt: skip
        going_on = replace(self)
        object.__setattr__(self, "is_consumed", True)  # the one thing about a state that ever changes
        return going_on
