"""The room's README against the code: widths of what packets carry, and lengths of objects."""

import re
from pathlib import Path

import numpy as np
import pytest

import cosim.messages
from cosim.base.codes import ObjectClass
from cosim.messages import cam, cpm, uper
from cosim.messages.content import cpm_bytes

README = (Path(cosim.messages.__file__).parent / "README.md").read_text()
BASE = ("objectId", "angles", "objectDimensionZ", "objectDimensionY", "objectDimensionX", "objectPerceptionQuality",
        "classification")  # fmt: skip
VELOCITY = (*BASE, "velocity")
SENSOR = (*VELOCITY, "objectAge", "sensorIdList")


def rows_of(kind):
    """Field (and the one that it is in, or neither), type, module, range and bits of all that is written."""
    found = set()
    for row in uper.table(kind):
        parts = [re.sub(r"\W.*", "", part) for part in row.field.split(".")]
        for field in (parts[-1], ".".join(parts[-2:])):
            found.add((field, row.type, row.module, row.range, str(row.bits)))
    return found


def test_every_width_is_that_of_the_schema():
    stated = {
        tuple(cell.strip(" `") for cell in line.split("|")[1:6])
        for line in README.split("## Packets", 1)[1].splitlines() if line.startswith("| `")
    }  # fmt: skip
    known = rows_of(cpm.CPM) | rows_of(cam.CAM)
    assert stated <= known
    numbers = {r.type for kind in (cpm.CPM, cam.CAM) for r in uper.table(kind)}
    assert not numbers - {row[1] for row in stated}, "a type without a row"


@pytest.mark.parametrize(
    ("members", "published"), [(BASE, 23.6), (VELOCITY, 29.4), (SENSOR, 32.8), ((*SENSOR, "zCoordinate"), 36.5)]
)
def test_lengths_of_objects(members, published):
    bits = cpm.object_bits(members)
    assert f"| {published} | {bits[ObjectClass.CAR]} | {bits[ObjectClass.CAR] / 8:.2f} |" in README


def test_lengths_beside_those_of_the_simulation():
    n = np.array([0, 1, 10, 40])
    packet = 44 + cpm.cpm_bytes(np.outer(n, np.arange(4) == ObjectClass.CAR))
    for row in zip(n, cpm_bytes(n), packet + 96, strict=True):
        assert "| " + " | ".join(f"{x:,}" for x in row) + " |" in README


def test_every_clause_has_a_test_or_is_a_deviation():
    table = README.split("### Clause by clause", 1)[1].split("**Sources.**", 1)[0]
    rows = [line.strip("|").split("|") for line in table.splitlines() if re.match(r"\| (\d|change)", line)]
    files = [*Path(__file__).parent.glob("test_*.py"), *Path("tests/addons/export").glob("test_pcap.py")]
    text = "\n".join(file.read_text() for file in files)
    known = set(re.findall(r"^def (test_\w+)", text, re.MULTILINE))
    assert len(rows) == 16
    for clause, _, here, tests in rows:
        named = re.findall(r"`(test_\w+)`", tests)
        assert set(named) <= known, clause
        assert named or "Deviation" in here or "5.3.3" in clause
