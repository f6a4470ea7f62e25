"""Lengths of messages."""

from collections.abc import Sequence

from cosim.addons.compare.facts import Measured
from cosim.messages import etsi
from results.run import Run

_CORE = ("objectId", "angles", "objectDimensionZ", "objectDimensionY", "objectDimensionX", "classification")
"""Optional members of every perceived object here: identity, heading, size and class."""


def cpm_object_bytes(runs: Sequence[Run], *, more: Sequence[Sequence[str]]) -> Measured:
    """Length of one perceived car in a CPM of release 2 with these further members [B]."""
    return Measured.exact([etsi.object_bits((*_CORE, *members))[0] / 8 for members in more])
