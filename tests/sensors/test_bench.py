"""The benchmark runs and compares the engines on one scene."""

from sensors.bench import bench, town


def test_bench_reports_every_engine():
    rows = {row["what"]: row for row in bench(town(60, 4), n_observers=4, runs=1)}
    assert all(row["value"] > 0 and row["unit"] for row in rows.values())
    assert rows["columnar / embree"]["value"] > 1
    assert rows["two threads / one"]["value"] > 0
