"""A street that the tests of detectors share."""

import numpy as np
import pytest

from sensors.evidence import observability
from sensors.scene import LABEL_OF_SHAPE
from tests.sensors.town import blocks, exact, traffic


@pytest.fixture(scope="session")
def street():
    """Sweeps of a street, what each sensor could see, all boxes and their labels."""
    rng = np.random.default_rng(3)
    boxes, shape = traffic(rng, 250)
    sweeps = exact(boxes, shape, np.flatnonzero(shape == 0), blocks(rng), profile="vlp32c")
    return sweeps, observability(sweeps, boxes, shape), boxes, LABEL_OF_SHAPE[shape]
