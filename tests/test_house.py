"""The code stays as small as `[tool.cosim.house]` of `pyproject.toml` says.

A number above its limit fails. So does one that is more than 3 % below it, until the limit is lowered. Ratchets only
fall. Who raises the budget of a room names in CHANGELOG.md what it pays for. `python -m tests.house` prints the table.
"""

import ast

import pytest

from tests import house

NODES, RATCHETS = house.limits()


@pytest.fixture(scope="module")
def today():
    return house.measured()


def test_every_room_has_a_budget(today):
    assert sorted(today.nodes) == sorted(NODES)


def test_rooms_keep_their_budgets(today):
    wrong = [f"{room}: {text}" for room, n in today.nodes.items() if (text := house.problem(n, NODES.get(room, n)))]
    assert not wrong


@pytest.mark.parametrize("name", house.RATCHETS)
def test_ratchets_only_fall(today, name):
    assert not house.problem(today.ratchets[name], RATCHETS[name]), house.RATCHETS[name]


def test_a_line_by_hand():
    """`x = 1` is Assign, Name, Store and Constant; the module counts for the first line; a docstring for none."""
    found = house.with_lines(ast.parse('"""Text."""\nx = 1\n'))
    assert house.per_line(found) == {1: 1, 2: 4}
    apart, joined = (list(house.with_lines(ast.parse(text))) for text in ("x = 1\nx = 1", "x = 1; x = 1"))
    assert len(apart) == len(joined) == 9


def test_a_function_is_wide_from_nine_parameters_on_unless_it_is_compiled():
    wide, narrow = "def f(a, b, c, d, *, e, g, h, i, j): ...", "def f(a, b, c, d, *, e, g, h, i): ..."
    said = {text: house.is_wide(ast.parse(text).body[0]) for text in (wide, narrow, f"@numba.njit(cache=True)\n{wide}")}
    assert list(said.values()) == [True, False, False]


@pytest.mark.parametrize(("found", "is_right"), [(100, True), (101, False), (97, True), (96, False), (0, False)])
def test_a_limit_holds_from_three_per_cent_below_it_on(found, is_right):
    assert (house.problem(found, 100) == "") == is_right


def test_rooms_and_rounding():
    paths = (
        "cosim/base/rng.py",
        "cosim/radio/csma.py",
        "cosim/messages/uper.py",
        "tests/cosim/radio/ns3.py",
        "tests/scene.py",
    )
    rooms = [house.room_of(house.Path(path)) for path in paths]
    assert rooms == ["cosim/base", "cosim/radio", "cosim/messages", "tests/cosim", "tests"]
    assert [house.rounded_up(n) for n in (7, 100, 1000, 1001, 12_345)] == [8, 101, 1010, 1020, 12_500]
