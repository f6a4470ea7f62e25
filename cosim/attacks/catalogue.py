"""All attacks that are included, by name."""

from collections.abc import Mapping

from cosim.addons.attacks import ghosts, identity, radio, self_report
from cosim.attacks import evaluations, falsification
from cosim.attacks.ghost_insertion import GhostInsertion
from cosim.attacks.unreliable import Unreliable

ATTACKS: Mapping[str, type] = {
    "ghost_insertion": GhostInsertion,
    "unreliable": Unreliable,
    "approaching_ghost": ghosts.ApproachingGhost,
    "ghost_in_shadow": ghosts.GhostInShadow,
    "replay": ghosts.Replay,
    "stale": ghosts.Stale,
    "removal": falsification.Removal,
    "offset": falsification.Offset,
    "drift": falsification.Drift,
    "mirror": falsification.Mirror,
    "heading": falsification.Heading,
    "size": falsification.Size,
    "classification": falsification.Classification,
    "score": falsification.Score,
    "speed": self_report.Speed,
    "braking": self_report.Braking,
    "stop": self_report.Stop,
    "bad_mouthing": evaluations.BadMouthing,
    "ballot_stuffing": evaluations.BallotStuffing,
    "collusion": evaluations.Collusion,
    "discrimination": evaluations.Discrimination,
    "random_evaluations": evaluations.RandomEvaluations,
    "majority_copying": evaluations.MajorityCopying,
    "replayed_evaluations": evaluations.ReplayedEvaluations,
    "sybil": identity.Sybil,
    "denial_of_service": radio.DenialOfService,
    "jamming": radio.Jamming,
    "delay": radio.Delay,
    "server_flooding": radio.ServerFlooding,
}
"""Classes of the included attacks, by their name in the config."""
