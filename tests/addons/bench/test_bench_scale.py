"""Traffic cropped for the benchmark of growth."""

import numpy as np
import pytest

from cosim.world import World
from tests.bench.scale import piece
from tests.bench.suite import run_scale
from tests.sensors.town import boxes_at


def test_a_piece_is_as_dense_as_the_whole():
    """Twice as dense in the west: a piece of a tenth lies where it has as many neighbours as the mean."""
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(0, 1000, 2000), rng.uniform(1000, 2000, 1000)])
    xyz = np.column_stack([x, rng.uniform(0, 1000, 3000), np.zeros(3000)])
    n, none = 3000, np.zeros(3000)
    world = World(
        0, np.arange(n) + 7, np.arange(n, dtype=np.uint64), np.zeros(n, np.uint8), boxes_at(xyz),
        none, np.ones(n, bool), np.zeros(n, np.uint8),
    )  # fmt: skip
    apart = np.hypot(x[:, None] - x, xyz[:, 1, None] - xyz[:, 1])
    whole = ((apart <= 100).sum() - n) / n
    actor, neighbours = piece([world], 300, whole)
    assert len(actor) == 300 and np.isin(actor, world.actor).all()
    rows = actor - 7
    assert neighbours == pytest.approx(((apart[np.ix_(rows, rows)] <= 100).sum() - len(rows)) / len(rows))
    assert neighbours == pytest.approx(whole, rel=0.02)


@pytest.mark.parametrize("sizes", ["", "a", "0", "5,-1"])
def test_sizes_that_are_none(sizes):
    with pytest.raises(ValueError, match="--vehicles"):
        run_scale("helsinki", None, sizes, 1)
