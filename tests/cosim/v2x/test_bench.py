"""The benchmark runs, and says what it measured in what unit; how fast is no matter for a test."""

import pytest

from cosim.v2x.bench import bench


@pytest.mark.verify
def test_bench_reports_the_network_step_the_event_loop_and_sight():
    rows = bench()
    assert all(figure > 0 and unit for _, figure, unit in rows)
    for words in ("network step, 1,000", "network step, 5,000", "event loop, 1,000", "line of sight, remembered"):
        assert any(what.startswith(words) for what, _, _ in rows)
