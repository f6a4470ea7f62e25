"""The benchmark runs, and says what it measured in what unit; no speed is tested."""

import pytest

from tests.bench.radio import bench


@pytest.mark.verify
def test_bench_reports_the_network_step_the_event_loop_and_whole_rounds():
    rows = bench()
    assert all(figure > 0 and unit for _, figure, unit in rows)
    for words in (
        "network step, 1,000", "network step, 5,000", "event loop, 1,000", "whole round, first of a step, 1,000",
        "whole round, second of a step, 5,000", "round of 3 hops",
    ):  # fmt: skip
        assert any(what.startswith(words) for what, _, _ in rows)
