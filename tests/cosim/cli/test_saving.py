"""What a dry run says of the time that sharing saves."""

import pytest

from cosim.cli.studies import saving


@pytest.mark.parametrize(
    ("seconds", "says"), [(12.4, "saves 12 s"), (0.3, "saves 0 s"), (-0.3, "saves 0 s"), (-2.6, "costs 3 s")]
)
def test_a_negative_saving_is_a_cost(seconds, says):
    assert saving(seconds) == says
