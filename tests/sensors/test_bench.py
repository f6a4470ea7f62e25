"""The benchmark runs and compares both engines on one scene."""

from sensors.bench import bench, town


def test_bench_reports_both_engines():
    rows = {row["what"]: row for row in bench(town(60, 4), n_observers=4, runs=1)}
    assert all(row["value"] > 0 and row["unit"] for row in rows.values())
    assert rows["columnar / embree"]["value"] > 1
