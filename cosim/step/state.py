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
from cosim.step.stages import Piggybacked
from cosim.step.trackers.attack_start import AttackStartTracker
from cosim.step.trackers.encounters import EncounterTrackers
from cosim.step.trackers.inter_reception import InterReceptionTracker
from cosim.step.trackers.motion import AccelerationTracker
from cosim.v2x.cpm_generation import InclusionMemory
from cosim.v2x.pseudonyms import PseudonymState
from cosim.v2x.relinking import KnownSenders
from cosim.v2x.trust_hosts import TrustState
from results.codes import DetectionFault


@dataclass(slots=True)
class State:
    """All that survives a step. A step consumes the state that it is given, because large buffers are used again: to go
    on twice from one state, `copy` it first."""

    medium: Any
    trust: TrustState
    encounters: EncounterTrackers
    attacks: AttackState
    driver: object = None
    reaction_truth: ReactionTruth = field(default_factory=ReactionTruth)
    """For the table of reactions alone."""
    pseudonyms: PseudonymState = field(default_factory=PseudonymState)
    included: InclusionMemory = field(default_factory=InclusionMemory)
    piggybacked: Piggybacked | None = None
    inter_reception: tuple[InterReceptionTracker, InterReceptionTracker] = field(
        default_factory=lambda: (InterReceptionTracker(), InterReceptionTracker())
    )
    """Of detection and of evaluation messages."""
    attack_start: AttackStartTracker = field(default_factory=AttackStartTracker)
    known_senders: KnownSenders = field(default_factory=KnownSenders)
    """With pseudonyms.linkage = "own" alone."""
    accelerations: AccelerationTracker = field(default_factory=AccelerationTracker)
    position_errors: PositionErrors = field(default_factory=PositionErrors)
    n_dropped: Int[ndarray, "f"] = field(default_factory=lambda: np.zeros(len(DetectionFault), np.int64))
    """Detections dropped so far because they cannot be sent, by `DetectionFault`."""
    is_consumed: bool = False

    @staticmethod
    def start(parts: Parts) -> "State":
        """Before the first step."""
        c = parts.config
        encounters = EncounterTrackers(c.encounters, c.traffic.step_s, len(parts.trust.variants))
        return State(parts.medium.start(), parts.trust.start(), encounters, parts.adversary.start())

    def copy(self) -> "State":
        """A state that shares nothing with this one."""
        return copy.deepcopy(self)

    def consume(self) -> "State":
        """The state to go on with; RuntimeError where another step went on from this one already."""
        if self.is_consumed:
            raise RuntimeError("this state was consumed by an earlier step: go on from a copy made before")
        self.is_consumed = True
        return replace(self, is_consumed=False)
