"""The figure of trust by attack: what its lines are called."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import pytest

from cosim.addons.attacks.figure import _panel, labels
from tests.results import tiny


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


@pytest.mark.parametrize("n_evaluations", [0, 1])
def test_a_single_value_is_a_dot_and_no_value_is_said(tmp_path, n_evaluations):
    row = {"step": 3, "subject": 0, "trust": 0.4, "n_evaluations": n_evaluations}
    run = tiny.make(tmp_path, 9, vehicles=tiny.fleet("honest", "honest"), trust=[row])
    axes = plt.figure().add_subplot()
    if not n_evaluations:
        with pytest.raises(ValueError, match="holds no trust values: none rests on an evaluation"):
            _panel(axes, run)
        return
    _panel(axes, run)
    (line,) = axes.get_lines()
    assert line.get_marker() == "o" and line.get_ydata().tolist() == pytest.approx([0.4], abs=1e-3)
