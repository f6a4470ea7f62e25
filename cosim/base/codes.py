"""Codes of categories and edges of histogram bins. Programs write the codes, and tables show the labels."""

from enum import IntEnum

import numpy as np

PARKED = "parked/"
"""Prefix of the names of parked cars, which are objects and no traffic."""
OBJECT = "object/"
"""Prefix of the names of `[[objects]]`, which are no traffic either. Their number in the config follows it."""


class VehicleClass(IntEnum):
    """Classes of actors: SUMO's vehicle classes, some of them merged, pedestrians, and units at the roadside."""

    CAR = 0
    VAN = 1
    TRUCK = 2
    BUS = 3
    MOTORCYCLE = 4
    BICYCLE = 5
    PEDESTRIAN = 6
    ROADSIDE_UNIT = 7


class Role(IntEnum):
    """How an equipped vehicle behaves; roles of a user's own attacks follow from 3 on (`Recorder(roles=...)`)."""

    HONEST = 0
    UNRELIABLE = 1
    MALICIOUS = 2


class ObjectClass(IntEnum):
    """Classes that a detector distinguishes."""

    CAR = 0
    PEDESTRIAN = 1
    CYCLIST = 2
    TRUCK = 3


class Origin(IntEnum):
    """Where a detection comes from: the detector, the vehicle's own pose, an attack."""

    SENSED = 0
    SELF = 1
    FABRICATED = 2


class DetectionFault(IntEnum):
    """Why a detection is dropped before it is sent. If several causes apply, one of them."""

    NOT_FINITE = 0
    TOO_FAR = 1
    BAD_SIZE = 2
    BAD_SCORE = 3
    UNKNOWN_CLASS = 4
    BAD_NUMBER = 5
    REPEATED_NUMBER = 6
    TOO_MANY = 7
    BAD_MOTION = 8


class TrustSource(IntEnum):
    """Where a trust value comes from: the trust server, the holder's own evidence, the default of the config."""

    SERVER = 0
    OWN = 1
    DEFAULT = 2


class AttackEffect(IntEnum):
    """Effect of an attack on a list: a fabricated detection is inserted, or a real one is withheld."""

    INSERTED = 0
    REMOVED = 1


class LookupState(IntEnum):
    """What a trust value rests on when it is looked up.

    Evaluated: at least one evaluation within the window, by a vehicle other than the subject that could see (visibility
    above 0). Unevaluated: a value without such an evaluation. Stale: such evaluations, but all are older than the
    window.
    """

    EVALUATED = 0
    UNEVALUATED = 1
    STALE = 2
    NO_VALUE = 3


class MessageType(IntEnum):
    """What a round of messages carries: collective perception messages, or evaluations of their detections."""

    CPM = 0
    EVALUATION = 1


class EvaluationKind(IntEnum):
    """What an evaluation is about: a detection, objects that a message lacks, or a claimed velocity."""

    DETECTION = 0
    MISSING = 1
    SPEED = 2


class LosState(IntEnum):
    """Line of sight between the two ends of a link: no building, a building, or not modelled."""

    LOS = 0
    NLOS = 1
    UNKNOWN = 2


class EncounterPairs(IntEnum):
    """Which pairs can have an encounter: all, equipped ones, equipped ones with line of sight, or all with it."""

    ALL = 0
    EQUIPPED = 1
    LOS = 2
    ALL_LOS = 3


class LosBlockers(IntEnum):
    """What cuts a line of sight between two actors: buildings, or the bodies of third actors too."""

    BUILDINGS = 0
    BUILDINGS_AND_VEHICLES = 1


def labels(codes: type[IntEnum]) -> tuple[str, ...]:
    """Labels of a code, in the order of its numbers: the names of its members in lower case."""
    numbers = [int(member) for member in codes]
    assert numbers == list(range(len(codes))), f"{codes.__name__} has gaps"
    return tuple(member.name.lower() for member in codes)


BASE_VARIANT = "base"
"""Name of the trust variant that acts: its broadcasts load the channel, and its fused objects are believed."""

DISTANCE_BIN_M = 25
"""Width of a distance bin in the table `pdr_by_distance` [m]."""

LATENCY_EDGES_S = 1e-4 * 2.0 ** (np.arange(-2, 33) / 2)
"""Edges of the bins of the table `latency_histogram` [s]; one more bin reaches from 0 to the first edge."""
