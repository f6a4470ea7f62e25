"""Chance as a function of who, whom, when and what for.

A draw is `unit(mix(mix(key(seed, stream, step), who), whom))`: a SplitMix64 stream per prefix, walked to
the position named by the next identifier. Nothing is shared and nothing advances, so neither order,
membership nor threads can change a draw, and switching one stream's use off leaves all others as they were.

References
----------
.. [1] G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014.
"""

from enum import IntEnum
from hashlib import blake2b

import numpy as np
from jaxtyping import Float, UInt64
from numpy import ndarray

from sensors import hash_rng
from sensors.hash_rng import mix
from sensors.kernel import compiled


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
    """Prefix of all draws of one purpose in one step."""
    prefix = np.array([[stream, step]], np.uint64)
    return _mix_rows(np.uint64(seed), prefix)[0]


def keys(prefix: np.uint64, *ids: ndarray | np.unsignedinteger) -> UInt64[ndarray, "n"]:
    """One key per row of identifiers (arrays of one length, or scalars beside one)."""
    columns = [np.atleast_1d(np.asarray(i)).astype(np.uint64) for i in ids]
    rows = np.empty((np.broadcast(*columns).size, len(columns)), np.uint64)
    for number, column in enumerate(columns):
        rows[:, number] = column
    return _mix_rows(prefix, rows)


def uniforms(prefix: np.uint64, *ids: ndarray | np.unsignedinteger, n: int = 1) -> Float[ndarray, "rows n"]:
    """`n` uniforms in [0, 1) for each row of identifiers."""
    return hash_rng.uniforms(keys(prefix, *ids), n)


def draws(seed: int, step: int, names: ndarray | tuple[ndarray, ...], n: int = 1) -> Float[ndarray, "rows n"]:
    """`n` uniforms in [0, 1) for each row of names: the draws of a class of a user's own.

    The same seed, step and names give the same numbers, in any order of the rows and whoever else is there.

    Parameters
    ----------
    names
        What each row is about: `world.name_key`, `stations.key`, numbers of messages; several columns as a tuple.
    """
    columns = names if isinstance(names, tuple) else (names,)
    return uniforms(key(seed, Stream.OWN, step), *columns, n=n)


def normals(prefix: np.uint64, *ids: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
    """`n` standard normals for each row of identifiers."""
    return hash_rng.normals(keys(prefix, *ids), n)


def persistent(
    prefix: np.uint64, *ids: ndarray, time_s: float, memory_s: float, n: int = 1
) -> Float[ndarray, "rows n"]:
    """`n` standard normals for each row of identifiers, as functions of time that change slowly.

    Notes
    -----
    Normals stand every `memory_s` seconds, at moments of each row's own; between two of them, a and b, the value is
    (1 - w) a + w b at unit variance. Hence no state and no order. The correlation is 0.72 over half of `memory_s`,
    0.28 over all of it, and 0 over twice as much and more.
    """
    phase = uniforms(prefix, *ids)[:, 0]
    cell, w = np.divmod(time_s / memory_s + phase, 1.0)
    before, after = (normals(prefix, *ids, cell + step, n=n) for step in (1.0, 2.0))
    w = w[:, None]
    return ((1.0 - w) * before + w * after) / np.sqrt((1.0 - w) ** 2 + w**2)


def name_key(name: str) -> int:
    """The 64-bit identity of an actor: a hash of its name, whoever else is there."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "little")
