"""Random numbers that depend only on the seed, their purpose, the step and identifiers such as names.

A draw is `unit(mix(mix(key(seed, stream, step), who), whom))`. `mix(h, x)` is number x of the SplitMix64 sequence [1]_
that begins at h. No state is shared or advanced. A draw therefore does not depend on the order of the rows, on who else
is there, or on threads. If one stream is not used, the draws of all others stay the same.

References
----------
.. [1] G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014.
"""

from enum import IntEnum
from hashlib import blake2b

import numpy as np
from jaxtyping import Float, UInt64
from numpy import ndarray

from cosim.base import hash_rng
from cosim.base.hash_rng import mix
from cosim.base.kernel import compiled


class Stream(IntEnum):
    """What a draw is for. Append only: the numbers are part of every published result."""

    EQUIPPED = 1
    ROLE = 2
    SWEEP = 3
    DETECTION = 4
    CLUTTER = 5
    OMISSION = 6
    FABRICATION = 7
    RADIO_DETECTIONS = 8
    RADIO_EVALUATIONS = 9
    UPLINK = 10
    DOWNLINK = 11
    SHADOWING = 12
    CHANNEL = 13
    GENERATION = 14
    DETECTION_MEMORY = 15
    RELAY = 16
    CLUTTER_MEMORY = 17
    ATTACK = 18
    PSEUDONYM = 19
    DRIVER = 20
    ATTACK_LASTING = 21
    ATTACK_TIME = 22
    SENDER = 23
    VICTIM = 24
    POSITIONING = 25
    OWN = 26
    SENSING = 27
    PARKED = 28
    TREES = 29
    REFLECTIVITY = 30
    DIRT = 31
    PLACEMENT = 32
    HEADING = 33


@compiled
def _mix_rows(h, ids):
    out = np.empty(ids.shape[0], np.uint64)
    for row in range(ids.shape[0]):
        z = h
        for column in range(ids.shape[1]):
            z = mix(z, ids[row, column])
        out[row] = z
    return out


def key(seed: int, stream: Stream, step: int = 0) -> np.uint64:
    """Prefix of all draws of one purpose in one step. Draws that are the same in every step have step 0."""
    prefix = np.array([[stream, step]], np.uint64)
    return _mix_rows(np.uint64(seed), prefix)[0]


def keys(prefix: np.uint64, *ids: ndarray | np.unsignedinteger) -> UInt64[ndarray, "n"]:
    """One key per row of identifiers.

    Parameters
    ----------
    prefix
        From `key`, or one key from an earlier call.
    ids
        Columns of identifiers: arrays of one length, or scalars, which count for all rows. They are converted to
        uint64. Another order of the columns gives other keys.
    """
    columns = [np.atleast_1d(np.asarray(i)).astype(np.uint64) for i in ids]
    rows = np.empty((np.broadcast(*columns).size, len(columns)), np.uint64)
    for number, column in enumerate(columns):
        rows[:, number] = column
    return _mix_rows(prefix, rows)


def uniforms(prefix: np.uint64, *ids: ndarray | np.unsignedinteger, n: int = 1) -> Float[ndarray, "rows n"]:
    """`n` uniforms in [0, 1) for each row of identifiers (see `keys`). The first columns do not depend on `n`."""
    return hash_rng.uniforms(keys(prefix, *ids), n)


def draws(
    seed: int,
    step: int,
    names: ndarray | tuple[ndarray, ...],
    n: int = 1,
) -> Float[ndarray, "rows n"]:
    """`n` uniforms in [0, 1) for each row of names: the draws of a class of a user's own.

    The same seed, step and names give the same numbers. The order of the rows and other rows have no effect.

    Parameters
    ----------
    names
        What each row is about: `world.name_key`, `stations.key`, numbers of messages; several columns as a tuple.

    Raises
    ------
    ValueError
        If one of these is no whole number: 3.2 and 3.9 would both be 3, and get the same draws.
    """
    columns = names if isinstance(names, tuple) else (names,)
    for value in map(np.asarray, (seed, step, *columns)):
        if value.size and value.dtype.kind not in "biu":
            raise ValueError(
                f"draws(seed, step, names) takes whole numbers, and {value.flat[0]} is none: the draws of all numbers "
                "with one whole part would be equal. Name actors, stations or messages, and steps, not seconds."
            )
    return uniforms(key(seed, Stream.OWN, step), *columns, n=n)


def normals(prefix: np.uint64, *ids: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
    """`n` standard normals for each row of identifiers (see `keys`). The first columns do not depend on `n`."""
    return hash_rng.normals(keys(prefix, *ids), n)


def name_key(name: str) -> int:
    """The 64-bit identity of an actor: a hash of its name. It does not depend on other actors."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "little")
