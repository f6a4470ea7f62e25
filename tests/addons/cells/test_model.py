"""The model of a step in cells: it finds the costs of runs that it describes, and predicts others of them."""

import pytest

from cosim.addons.cells.model import CostModel, Measured

RUN_S, CELLS_S, MORE = (2e-4, 0.01), (3e-4, 0.02), 0.1


def run(n_vehicles, n_cells):
    """A run with these costs; half of the busiest cell is sensing, beside half of the run's own first thread.

    The second thread has a fifth of its time.
    """
    run_s, cells_s = (a * n_vehicles + b * n_cells for a, b in (RUN_S, CELLS_S))
    busiest_s = (1 + MORE * (n_cells.bit_length() - 1)) * cells_s / n_cells
    return Measured(n_vehicles, n_cells, run_s, cells_s, busiest_s, 0.5, 0.5, 0.2, 0.1 * n_vehicles, 0.0)


def test_costs_are_found_and_others_predicted():
    model = CostModel.fit([run(1000, n) for n in (1, 2, 4)])
    assert model.run_s == pytest.approx(RUN_S) and model.cells_s == pytest.approx(CELLS_S)
    assert model.imbalance == pytest.approx(MORE)
    want, found = run(5000, 8), model.predict(5000, 8, 100)
    assert (found.run_s, found.cells_s) == pytest.approx((want.run_s, want.cells_s))
    assert found.busiest_s == pytest.approx(want.busiest_s) and found.n_bytes == pytest.approx(500)


def test_a_step_takes_what_its_longest_way_takes_or_what_the_cores_can_do():
    # R = 2e-4 * 1000 + 0.01 * 2 = 0.22, of which 0.176 in the first thread and half of this while cells sense
    # C = 3e-4 * 1000 + 0.02 * 2 = 0.34; busiest = 1.1 * 0.34 / 2 = 0.187, half of it to sense
    model = CostModel.fit([run(1000, n) for n in (1, 2, 4)])
    assert model.predict(1000, 2, 3).step_s == pytest.approx(0.088 + max(0.088, 0.0935) + 0.0935)
    assert model.predict(1000, 2, 1).step_s == pytest.approx(0.22 + 0.34)


def test_a_fit_needs_different_numbers_of_cells():
    with pytest.raises(ValueError, match="2 different numbers of cells"):
        CostModel.fit([run(1000, 2), run(2000, 2)])
    with pytest.raises(ValueError, match="no cost per step of cells"):
        Measured.of({"timings_s": {}})
