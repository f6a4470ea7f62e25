"""The warm process that all hostile commands share."""

import pytest

from tests.hostile.processes import Warm


@pytest.fixture(scope="session")
def cosim(tmp_path_factory):
    with Warm(tmp_path_factory.mktemp("warm")) as warm:
        yield warm
