"""One option: renew the golden figures after a change that is meant to move them."""

import pytest


def pytest_addoption(parser):
    parser.addoption("--update-golden", action="store_true", help="write the golden figures anew; say why in CHANGELOG")


@pytest.fixture
def update_golden(request):
    return request.config.getoption("--update-golden")
