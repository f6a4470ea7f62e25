"""The warm process that all hostile commands share."""

import pytest

from tests.processes import warm


@pytest.fixture(scope="session")
def cosim():
    return warm()
