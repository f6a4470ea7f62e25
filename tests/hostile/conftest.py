"""The warm process that all hostile commands share, and runs of which tests change copies."""

import pytest

from tests.hostile import shared
from tests.processes import warm


@pytest.fixture(scope="session")
def cosim():
    return warm()


@pytest.fixture(scope="session")
def street_runs(tmp_path_factory):
    """A finished run of a street, and the same run interrupted, in a folder with the trace."""
    return shared.make_runs(tmp_path_factory.mktemp("street"))
