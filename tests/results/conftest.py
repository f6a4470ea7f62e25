"""Runs for all tests of this room that need one."""

import shutil
from functools import partial

import pytest

from results.archive import open_run
from tests.drive import drive
from tests.results.tiny import make


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """Twenty seconds of the shipped city, with every table."""
    return open_run(drive(tmp_path_factory.mktemp("runs") / "base", "record.level=full", "trust_variant=[]"))


@pytest.fixture(scope="session")
def other(tmp_path_factory):
    """The same city with another seed."""
    return open_run(drive(tmp_path_factory.mktemp("runs") / "other", "trust_variant=[]", "seed=2"))


@pytest.fixture(scope="session")
def short(tmp_path_factory):
    """Ten seconds at the usual level, for copies to spoil."""
    return drive(tmp_path_factory.mktemp("runs") / "short", "record.level=standard", "traffic.duration_s=10")


@pytest.fixture
def broken(short, tmp_path):
    """A short run to spoil."""
    return shutil.copytree(short, tmp_path / "broken")


@pytest.fixture
def tiny(tmp_path):
    """Makes a run of a few rows: tiny(steps, table=[{column: value}])."""
    return partial(make, tmp_path)
