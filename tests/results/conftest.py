"""Made-up runs for all tests of this room that need one."""

from functools import partial

import pytest

from results.archive import open_run
from tests.results.synthetic import write
from tests.results.tiny import make


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    return open_run(write(tmp_path_factory.mktemp("runs") / "base"))


@pytest.fixture(scope="session")
def other(tmp_path_factory):
    """The same city with a shorter reach of the radio and another seed."""
    return open_run(write(tmp_path_factory.mktemp("runs") / "reach-120", seed=1, reach_m=120.0))


@pytest.fixture
def tiny(tmp_path):
    """Makes a run of a few rows: tiny(steps, table=[{column: value}])."""
    return partial(make, tmp_path)
