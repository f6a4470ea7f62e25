"""Options: renew the golden figures after a change that is meant to move them; check shapes and types."""

import pytest

from tests import typecheck


def pytest_addoption(parser):
    parser.addoption("--update-golden", action="store_true", help="write the golden figures anew; say why in CHANGELOG")
    parser.addoption("--typecheck", default="", help="packages whose shapes and types are checked: trust")


def pytest_configure(config):
    if packages := config.getoption("--typecheck"):
        typecheck.check(packages.split(","))


def pytest_collection_modifyitems(config, items):
    if config.getoption("--typecheck"):
        for item in items:
            if item.get_closest_marker("misuse"):
                item.add_marker(pytest.mark.skip(reason="passes what annotations forbid"))


@pytest.fixture
def update_golden(request):
    return request.config.getoption("--update-golden")
