"""What a dry run says of the time that sharing saves."""

import pytest

from cosim.cli.console import time_left
from cosim.cli.main import _of_home
from cosim.cli.studies import saving


@pytest.mark.parametrize(
    ("seconds", "says"), [(12.4, "saves 12 s"), (0.3, "saves 0 s"), (-0.3, "saves 0 s"), (-2.6, "costs 3 s")]
)
def test_a_negative_saving_is_a_cost(seconds, says):
    assert saving(seconds) == says


def test_the_time_that_is_left():
    """Runs of a study end several at a time: 2 of 10 after 60 s, whenever they did, leave 240 s."""
    assert time_left((0, 100.0), 0, 10, 130.0) == ""
    assert time_left((0, 100.0), 2, 10, 160.0) == "0:04:00"
    assert time_left((50, 0.0), 60, 100, 10.0) == "0:00:40", "a resumed run begins at its step 50"
    assert time_left((0, 0.0), 1, 3601, 1.0) == "1:00:00" and time_left((0, 0.0), 10, 10, 5.0) == "0:00:00"


@pytest.mark.parametrize(
    ("word", "then"),
    [
        ("--out=~/x", "--out=/home/me/x"), ("~/x", "/home/me/x"), ("~", "/home/me"), ("a~/x", "a~/x"), ("~x", "~x"),
        ("traffic.trace=~/x.csv", "traffic.trace=/home/me/x.csv"), ("--out=x", "--out=x"), ("x=y=~/z", "x=y=~/z"),
    ],
)  # fmt: skip
def test_the_users_folder(monkeypatch, word, then):
    monkeypatch.setenv("HOME", "/home/me")
    assert _of_home(word) == then
