"""The figure of trust by attack: what its lines are called."""

from types import SimpleNamespace

from cosim.addons.attacks.figure import labels


def test_a_line_is_called_by_all_that_its_vehicles_do():
    """Sections with `together_with` have no vehicles of their own, so they have no line."""
    sections = [
        {"attack": "offset", "share_p": 0.1},
        {"attack": "bad_mouthing", "together_with": 0},
        {"attack": "offset", "share_p": 0.2},
        {"attack": "sybil", "together_with": 1},
    ]
    found = labels(SimpleNamespace(path="run", config={"attacks": sections}))
    assert found == {0: "offset, share_p 0.1 with bad_mouthing with sybil", 2: "offset, share_p 0.2"}
