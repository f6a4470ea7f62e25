"""All attacks that are included, by name."""

from collections.abc import Mapping

from cosim.attacks import evaluations, falsification
from cosim.attacks.ghost_insertion import GhostInsertion
from cosim.attacks.unreliable import Unreliable
from cosim.base.addons import Choices

ATTACKS: Mapping[str, type] = Choices(
    "attack",
    {
        "ghost_insertion": GhostInsertion,
        "unreliable": Unreliable,
        "removal": falsification.Removal,
        "offset": falsification.Offset,
        "drift": falsification.Drift,
        "mirror": falsification.Mirror,
        "heading": falsification.Heading,
        "size": falsification.Size,
        "classification": falsification.Classification,
        "score": falsification.Score,
        "misstated_accuracy": falsification.MisstatedAccuracy,
        "bad_mouthing": evaluations.BadMouthing,
        "ballot_stuffing": evaluations.BallotStuffing,
        "collusion": evaluations.Collusion,
        "discrimination": evaluations.Discrimination,
        "random_evaluations": evaluations.RandomEvaluations,
        "majority_copying": evaluations.MajorityCopying,
        "replayed_evaluations": evaluations.ReplayedEvaluations,
    },
)
"""Classes of the included attacks, by their name in the config."""
