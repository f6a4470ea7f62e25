"""The map of where encounters begin."""

from itertools import combinations, pairwise

import numpy as np
import pytest

from cosim.addons.pictures import map_figure
from tests.results import tiny
from tests.slow import slow


@pytest.mark.parametrize("n", [70, slow(700)])
def test_every_encounter_that_is_seen_to_begin_counts(tmp_path, n):
    """n vehicles all meet in step 1 of 36 s, a hundredth of an hour. One more encounter was under way in step 0."""
    actors = [{"step": step, "actor": a, "x_m": a % 90.0, "y_m": a % 70.0} for step in (0, 1) for a in range(n)]
    under_way = [{"a": 0, "b": 1, "radius_m": 50.0, "end_step": 9, "censored_left": True}]
    begun = [{"a": a, "b": b, "radius_m": 50.0, "start_step": 1, "end_step": 9} for a, b in combinations(range(n), 2)]
    run = tiny.make(tmp_path, 36, actors=actors, encounters=under_way + begun)
    cells = map_figure.draw([run]).axes[0].collections[1]
    assert np.ma.sum(cells.get_array()) == pytest.approx(100 * n * (n - 1) / 2)

    (tmp_path / "under_way").mkdir()
    run = tiny.make(tmp_path / "under_way", 36, actors=actors, encounters=under_way)
    with pytest.raises(ValueError, match="no encounter begins while it is recorded"):
        map_figure.draw([run])


def test_numbers_beside_the_colours_do_not_overlap(tmp_path):
    """One encounter in a cell, and 990 in another one: three decades."""
    actors = [{"step": 1, "actor": a, "x_m": 500.0 * (a < 2), "y_m": 0.0} for a in range(47)]
    pairs = [(0, 1), *combinations(range(2, 47), 2)]
    begun = [{"a": a, "b": b, "radius_m": 50.0, "start_step": 1, "end_step": 9} for a, b in pairs]
    figure = map_figure.draw([tiny.make(tmp_path, 36, actors=actors, encounters=begun)])
    figure.canvas.draw()
    labels = [label.get_window_extent() for label in figure.axes[-1].get_xticklabels()]
    assert len(labels) > 1 and all(one.x1 < other.x0 for one, other in pairwise(labels))
