"""The picture of the law of freshness and simulations."""

import numpy as np

from cosim.addons.law import figure as law
from results.figures import style


def test_curves_and_points_are_drawn(tmp_path):
    age_s, weight = np.array([1.8, 2.8, 3.8]), np.array([2.0, 1.0, 1.0])
    one = law.Curve("base", age_s, weight)
    points = law.points_of(
        "a city",
        [{f"freshness.newest_evaluation_age.{what}": value for what, value in (("median_s", 2.0), ("p90_s", 4.0))}] * 2,
        [{f"freshness.newest_evaluation_age.{what}": value for what, value in (("median_s", 2.1), ("p90_s", 5.0))}, {}],
    )
    assert points.law_s.tolist() == [[2.0, 4.0]] and points.measured_s.tolist() == [[2.1, 5.0]]  # the other was not run
    figure = law.draw([one], [one, law.Curve("other", age_s, weight)], [points])
    curves, scatter = figure.axes
    step, marks = curves.get_lines()
    assert step.get_ydata()[-1] == 1 and marks.get_ydata().tolist() == [0.5, 0.75, 1.0]
    assert [line.get_label() for line in scatter.get_lines()][-2:] == ["a city, median", "a city, 90th percentile"]
    assert style.save(figure, tmp_path / "law.png").stat().st_size > 5000


def test_nothing_measured_is_an_empty_panel_of_points():
    figure = law.draw([], [], [law.points_of("a city", [{}], [{}])])
    assert len(figure.axes) == 1


def test_curves_that_have_no_room_are_counted():
    curves = [law.Curve(str(number), np.array([1.8, 2.8]), np.ones(2)) for number in range(8)]
    (axes,) = law.draw(curves).axes
    assert len(axes.get_lines()) == 6 and axes.get_title("left").split()[-4:] == ["first", "6", "of", "8"]
