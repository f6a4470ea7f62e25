"""What the picture of stale trust shows, by hand."""

import pytest

from cosim.addons.pictures import stale, stale_figure
from tests.results.tiny import fleet


def test_stale_by_place(tiny):
    lookups = [
        {
            "step": 1,
            "variant": "base",
            "subject": s,
            "receiver": r,
            "newest_evaluation_age_s": age,
            "state": "evaluated",
        }
        for s, r, age in ((5, 0, 3.0), (6, 0, 10.0), (7, 0, 10.5), (5, 1, None))
    ]
    actors = [{"step": 1, "actor": a, "x_m": 10.0 * a, "y_m": 5.0} for a in (0, 1)]
    run = tiny(3, vehicles=fleet("honest", "honest"), trust_lookups=lookups, actors=actors)
    found = stale.placed(run, 10.0).sort_values("x_m")
    assert found[["x_m", "y_m", "n", "n_stale"]].to_numpy().tolist() == [[0, 5, 3, 1], [10, 5, 1, 1]]


def of_steps(tiny, n_steps, n_each, dt_s):
    """A run in which one vehicle looks up so many values in each step."""
    lookups = [
        {"step": step, "variant": "base", "subject": 5 + s, "receiver": 0, "state": "no_value"}
        for step in range(n_steps) for s in range(n_each)
    ]  # fmt: skip
    actors = [{"step": step, "actor": 0, "x_m": 1.0, "y_m": 5.0} for step in range(n_steps)]
    return tiny(n_steps, dt_s=dt_s, vehicles=fleet("honest"), trust_lookups=lookups, actors=actors)


@pytest.mark.parametrize("n_steps", [1, 3, 12])
def test_every_step_has_a_column_of_its_own(tiny, n_steps):
    """3 x 0.2 s is more than 0.6 s by rounding: two steps fell into one column."""
    _, over_time, *_ = stale_figure.draw([of_steps(tiny, n_steps, 5, 0.2)]).axes
    assert over_time.collections[0].get_array().compressed().tolist() == [1.0] * n_steps
    assert over_time.get_xlim()[1] == pytest.approx(0.2 * n_steps)


def test_too_few_lookups_are_said(tiny):
    assert [text.get_text() for axes in stale_figure.draw([of_steps(tiny, 2, 2, 0.2)]).axes for text in axes.texts] == [
        "too few lookups"
    ] * 2
