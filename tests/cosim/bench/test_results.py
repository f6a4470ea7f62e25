"""The benchmark runs, and says what it measured."""

from cosim.bench.results import bench


def test_every_figure_is_positive():
    rows = bench(steps=2)
    assert all(value > 0 for _, value, _ in rows) and len({what for what, _, _ in rows}) == len(rows)
