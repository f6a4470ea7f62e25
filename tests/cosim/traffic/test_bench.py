"""The benchmark runs; what it finds is for `cosim bench mobility` to say, not for a test."""

import json
import subprocess
import sys

import pytest


@pytest.mark.verify
def test_bench_compares_sumo_alone_with_sumo_and_reading():
    code = "import json; from tests.bench.mobility import bench; print(json.dumps(bench()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    answer = {name: value for name, value, _ in json.loads(done.stdout)}
    assert all(value > 0 for value in answer.values())
    for city in ("adlershof", "koenigs-wusterhausen"):
        assert answer[f"{city}: actors on the road"] > 500 and answer[f"{city}: reading, over SUMO alone"] > 1
