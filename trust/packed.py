"""Arrays that are not needed for a while, compressed together."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from jaxtyping import UInt8
from numpy import ndarray

_CODEC = "zstd"


class Packed(NamedTuple):
    """Some arrays, compressed."""

    content: UInt8[ndarray, "bytes"]
    kinds: tuple[tuple[str, tuple[int, ...]], ...]
    """Dtype and shape of each array."""
    n_bytes: int
    """Before compression."""


def pack(arrays: Sequence[ndarray]) -> Packed:
    """Compress arrays."""
    whole = b"".join(a.tobytes() for a in arrays)
    compressed = pa.compress(whole, _CODEC)  # in room for as many bytes as before
    content = np.frombuffer(pa.allocate_buffer(compressed.size), np.uint8)  # not among NumPy's, which come and go
    content[:] = np.frombuffer(compressed, np.uint8)
    return Packed(content, tuple((a.dtype.str, a.shape) for a in arrays), len(whole))


def unpack(packed: Packed) -> list[ndarray]:
    """The same arrays again."""
    whole, at = pa.decompress(pa.py_buffer(packed.content), packed.n_bytes, _CODEC), 0
    arrays: list[ndarray] = []
    for dtype, shape in packed.kinds:
        arrays.append(np.ndarray(shape, dtype, whole, at).copy())
        at += arrays[-1].nbytes
    return arrays
