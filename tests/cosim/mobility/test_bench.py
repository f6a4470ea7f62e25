"""What reading costs, held to what is claimed of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BOLOGNA = Path(__file__).parents[4] / "shared" / "nets" / "bologna" / "run.sumocfg"


@pytest.mark.verify
def test_reading_costs_at_most_a_third_of_sumo():
    """A thousand vehicles in Bologna's rush hour; the best of three, because machines have other things to do."""
    if not BOLOGNA.is_file():
        pytest.skip(f"{BOLOGNA} is not there")
    code = f"""
import json; from pathlib import Path; from cosim.mobility.bench import bench
print(json.dumps(bench(Path({str(BOLOGNA)!r}), scale=1.0, steps=300)))
"""
    answers = []
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        answers.append({name: value for name, value, _ in json.loads(done.stdout)})
    assert all(900 < answer["actors on the road"] < 1400 for answer in answers)
    assert min(answer["reading, over SUMO alone"] for answer in answers) <= 1.3, answers
