"""Cooperative perception warns of a person whom the own sensor cannot see yet."""

from tests.verification.pedestrian_behind_bus import play


def test_believing_others_brakes_earlier_and_before_the_person():
    """Case 1: the ego alone brakes less than a second before it would be there, and reaches the person; believing the
    oncoming car it brakes more than a second earlier, and stops."""
    local, everybody = play(1, "local"), play(1, "any")
    assert everybody.brake_s < local.brake_s - 1.0
    assert local.impact_mps > 0 and everybody.impact_mps == 0
