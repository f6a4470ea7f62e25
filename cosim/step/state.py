"""The state of a simulation between two steps."""

import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.attacks.adversary import AttackState
from cosim.base.codes import DetectionFault
from cosim.messages.cpm_generation import CpmState
from cosim.messages.pseudonyms import PseudonymState
from cosim.messages.relinking import KnownSenders
from cosim.messages.trust_hosts import TrustState
from cosim.step.broadcast import SentEvaluations
from cosim.step.early_fusion import Clouds
from cosim.step.inbox import Inbox
from cosim.step.parts import Parts
from cosim.step.reactions import ReactionTruth
from cosim.step.reports import EvaluationCarriers
from cosim.step.trackers.attack_start import AttackStartTracker
from cosim.step.trackers.encounters import Encounters
from cosim.step.trackers.inter_reception import InterReceptionTracker
from cosim.step.trackers.motion import LastSpeeds
from cosim.step.tracking import ReceptionTrackers
from cosim.traffic.position_errors import PositionErrors
from results.encounters import EncounterTracker
from sensors.tracking.tracks import TrackMemory


@dataclass(frozen=True, slots=True)
class State:
    """Everything that a step passes on to the next one.

    A step returns a new state and consumes the one that it gets, because it updates the evidence of trust models, open
    encounters and the memory of attacks and media in place. To continue twice from one state, `copy` it first.
    """

    medium: Any
    trust: TrustState
    encounters: Encounters
    attacks: AttackState
    driver: object = None
    reaction_truth: ReactionTruth = field(default_factory=ReactionTruth)
    """Used only for the table of reactions."""
    pseudonyms: PseudonymState = field(default_factory=PseudonymState)
    cpm: CpmState = field(default_factory=CpmState)
    piggybacked: SentEvaluations | None = None
    carried: tuple[EvaluationCarriers, ...] = ()
    """Evaluations of earlier steps whose messages may still arrive."""
    inbox: Inbox = field(default_factory=Inbox)
    """Messages of earlier steps that vehicles may still use."""
    clouds: Clouds = field(default_factory=Clouds)
    """Point clouds that vehicles still use; empty without `[early_fusion]`."""
    inter_reception: ReceptionTrackers = field(
        default_factory=lambda: (InterReceptionTracker(), InterReceptionTracker())
    )
    """For detection messages and for evaluation messages."""
    attack_start: AttackStartTracker = field(default_factory=AttackStartTracker)
    known_senders: KnownSenders = field(default_factory=KnownSenders)
    """Used only with pseudonyms.linkage = "own"."""
    last_speeds: LastSpeeds = field(default_factory=LastSpeeds)
    position_errors: PositionErrors = field(default_factory=PositionErrors)
    tracks: TrackMemory = field(default_factory=TrackMemory)
    """Observers are known by their actor numbers."""
    n_dropped: Int[ndarray, "f"] = field(
        default_factory=lambda: np.zeros(len(DetectionFault), np.int64),
    )
    """Detections dropped so far because they cannot be sent, by `DetectionFault`."""
    is_consumed: bool = False
    """Whether a step has consumed this state."""

    @staticmethod
    def start(parts: Parts) -> "State":
        """The state before the first step."""
        step_s = parts.config.traffic.step_s
        n_variants = len(parts.trust.variants)
        return State(
            medium=parts.medium.start(),
            trust=parts.trust.start(),
            encounters=tuple(EncounterTracker(p, step_s, n_variants) for p in parts.config.encounters),
            attacks=parts.adversary.start(),
        )

    def copy(self) -> "State":
        """A copy that shares nothing with this state."""
        return copy.deepcopy(self)

    def consume(self) -> "State":
        """Mark this state as consumed and return the one to continue with.

        Raises
        ------
        RuntimeError
            If an earlier step has consumed this state.
        """
        if self.is_consumed:
            raise RuntimeError(
                "an earlier step consumed this state: go on from the state that it returned, or from a copy made "
                "before it"
            )
        going_on = replace(self)
        object.__setattr__(self, "is_consumed", True)  # the only field of a state that changes
        return going_on
