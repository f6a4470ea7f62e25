"""The benchmark runs and compares the engines on one scene."""

from tests.bench.sensors import bench, town


def test_bench_reports_every_engine():
    rows = {what: (value, unit) for what, value, unit in bench(town(60, 4), n_observers=4, runs=1)}
    assert all(value > 0 and unit for value, unit in rows.values())
    assert {"columnar, one core", "embree, one core", "columnar / embree"} <= set(rows)
