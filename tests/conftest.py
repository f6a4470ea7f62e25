"""Options: record anew what commands on pages print; check shapes and types."""

import gc

import pytest
from hypothesis import settings

from tests import plain_world, typecheck

settings.register_profile("untimed", deadline=None)  # the first call of a kernel compiles it
settings.load_profile("untimed")

plain_world.enter()
gc.set_threshold(100_000, 50, 100)  # as in `cosim.__main__`


def pytest_addoption(parser):
    parser.addoption("--record-pages", action="store_true", help="record anew what the commands on pages print")
    parser.addoption("--typecheck", default="", help="packages whose shapes and types are checked: trust")


def pytest_configure(config):
    if packages := config.getoption("--typecheck"):
        typecheck.check(packages.split(","))


_FIRST, _LAST = ("tests/trust/", "tests/cosim/radio/"), ("tests/sensors/",)
"""Rooms with which the second worker begins and ends."""


@pytest.hookimpl(
    trylast=True
)  # after the slow tests have been taken out, so that half of the list is half of the tests
def pytest_collection_modifyitems(config, items):
    """Order the tests for two workers, each of which begins with half of the list.

    On a new machine the first worker compiles the kernels of a whole run, in the order of a step. The second worker
    begins with the tests of those that come last, so that the two share the work. It ends with tests that share no
    run: whoever has finished takes half of what is left, and would make the runs that tests share once more.
    """
    first, last = (
        [item for room in rooms for item in items if item.nodeid.startswith(room)] for rooms in (_FIRST, _LAST)
    )
    others = [item for item in items if not item.nodeid.startswith((*_FIRST, *_LAST))]
    half = len(items) // 2
    items[:] = [*others[:half], *first, *others[half:], *last]
    if config.getoption("--typecheck"):
        for item in items:
            if item.get_closest_marker("misuse"):
                item.add_marker(pytest.mark.skip(reason="passes what annotations forbid"))


def pytest_collection_finish():
    """What has been collected lives to the end, so the garbage collector need not look at it again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def record_pages(request):
    return request.config.getoption("--record-pages")
