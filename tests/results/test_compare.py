"""Runs held against the number in which they differ."""

import pytest

from results.archive import open_run
from results.figures.catalogue import FIGURES
from results.metrics import compare, freshness
from tests.results.synthetic import write
from tests.results.tiny import fleet, make


@pytest.fixture
def study(tmp_path):
    """Makes runs with these configurations: study({...}, {...})."""

    def runs(*configs):
        made = []
        for i, config in enumerate(configs):
            (tmp_path / f"run-{i}").mkdir()
            made.append(make(tmp_path / f"run-{i}", 20, config, vehicles=fleet("honest")))
        return made

    return runs


def test_what_differs(study):
    one = {"seed": 1, "traffic": {"seed": 1}, "trust": {"freshness_s": 10, "host": "none"}, "record": {"level": "b"}}
    two = {"seed": 2, "traffic": {"seed": 3}, "trust": {"freshness_s": 50, "host": "none"}, "record": {"level": "a"}}
    assert compare.differing(study(one, two)) == {"trust.freshness_s": [10, 50]}


def test_sections_in_lists(study):
    one, two = ({"encounters": [{"radius_m": r, "pairs": "all"}]} for r in (50.0, 100.0))
    assert compare.axis(study(one, two))[0] == "encounters.0.radius_m"
    assert compare.label("encounters.0.radius_m") == "encounters.0.radius_m [m]"
    assert compare.label("fleet.penetration_p") == "fleet.penetration_p"


def test_only_one_number(study):
    base = {"a": {"x_s": 1, "y_m": 2}, "where": "here"}
    runs = study(base, {"a": {"x_s": 5, "y_m": 3}, "where": "there"})
    assert compare.axis(runs) is None
    assert compare.axis(runs, "a.y_m")[1].tolist() == [2, 3]
    with pytest.raises(ValueError, match=r"over where: .* These are: a.x_s, a.y_m"):
        compare.axis(runs, "where")
    with pytest.raises(ValueError, match=r"do not differ in one number alone, but in a\.x_s, a\.y_m, where"):
        compare.tabulate(runs, None, {})
    assert compare.axis(runs[:1]) is None


def test_table_is_sorted_and_says_what_is_missing(study):
    runs = study(*({"trust": {"freshness_s": v}} for v in (30, 10)))
    frame = compare.tabulate(runs, None, {"steps": lambda run: run.manifest["steps"], "stale": freshness.states})
    assert frame["trust.freshness_s"].tolist() == [10, 30] and frame.run.tolist() == ["run-1", "run-0"]
    assert frame.steps.tolist() == [20, 20] and frame.stale.isna().all()


@pytest.mark.verify
def test_picture_over_the_number(run, tmp_path):
    """Two repetitions at one value, one run at another: points for all, lines through means."""
    shorter = [write(tmp_path / name, seed=seed, reach_m=120.0) for name, seed in (("a", 1), ("b", 2))]
    figure = FIGURES["freshness"]([run, *map(open_run, shorter)])
    ages, rests, believed = figure.axes
    assert ages.get_xlabel() == rests.get_xlabel() == believed.get_xlabel() == "radio.range_m [m]"
    assert ages.get_xscale() == "log"
    dots, line = ages.lines[:2]
    assert len(dots.get_xdata()) == 3 and list(line.get_xdata()) == [120, 200]
    with pytest.raises(ValueError, match=r"cannot be compared over trust\.host"):
        FIGURES["freshness"]([run, open_run(shorter[0])], over="trust.host")
