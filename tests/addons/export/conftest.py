"""The truck of the tests by hand."""

import pytest

from tests.addons.export import truck


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    return truck.make(tmp_path_factory.mktemp("export") / "run")
