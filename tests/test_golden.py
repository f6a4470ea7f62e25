"""A tiny run of the shipped city: its figures move only when somebody means them to."""

import json
from pathlib import Path

import pytest

from results.archive import open_run
from results.measure import measure
from tests.drive import drive

GOLDEN = Path(__file__).parent / "golden" / "helsinki.json"


def figures(folder):
    """Every measure, and how many rows each table has."""
    run = open_run(folder)
    rows = {f"rows of {name}": float(len(run.table(name))) for name in run.tables}
    measured = {
        f"{row.metric} | {row.group}": float(row.value)
        for row in measure(run).itertuples() if row.value == row.value
    }  # fmt: skip
    return rows | measured


def test_golden(tmp_path, update_golden):
    found = figures(drive(tmp_path / "run", "record.level=full", "traffic.warmup_s=600"))
    if update_golden:
        GOLDEN.write_text(json.dumps(found, indent=1) + "\n")
    expected = json.loads(GOLDEN.read_text())
    assert found.keys() == expected.keys()
    # Two in a hundred: another processor may round the last bit otherwise, and one detection more or less follows.
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=0.02, abs=0.02), name
