"""Runs held against the number in which they differ."""

import pytest

from results.metrics import compare
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
    assert compare.differing(study(one, two)) == {"encounters.0.radius_m": [50.0, 100.0]}
