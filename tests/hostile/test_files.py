"""Hostile scenarios and traces: driven, or refused in one line; nothing is written but the run."""

import random
import shutil

import pytest

from sumo_nets.sumo_options import IGNORED, PASSED, READS, REFUSED
from tests.hostile import SEED, N, Tally
from tests.hostile.scenes import HEAD, trace_rows, write_town
from tests.hostile.test_runs import judged
from tests.processes import sets_of_trace

OPTIONS = sorted({*IGNORED, *PASSED, *READS, *REFUSED})
VALUES = (
    "", "nan", "inf", "-1", "0", "1e300", "true", "precious.txt", "../precious.txt", "/dev/zero", "/dev/null", "0:0:0",
    "localhost:1", "&amp;", "precious.txt,precious.txt", "a b", "9" * 400, "town.net.xml",
)  # fmt: skip
CELLS = (
    "", "nan", "inf", "-inf", "1e300", "-1e300", "3e8", "1e7", "-5e7", "1e5", "abc", "9" * 400, "0x10", "1;2", '"',
    "\x00", "é", "-0.0", "1e-320",
)  # fmt: skip
NUMBERS = ("nan", "inf", "-1", "0", "1e300", "1e-300", "abc", "", "9" * 30)


def hostile_config(town, rng):
    """Options of all kinds in the configuration."""
    path = town / "town.sumocfg"
    lines = []
    for _ in range(rng.choice([1, 1, 2, 5])):
        option, value = rng.choice(OPTIONS), rng.choice(VALUES)
        lines.append(f'<{option} value="{value}"/>' if rng.random() < 0.8 else f"<{option}>{value}</{option}>")
    path.write_text(path.read_text().replace("</configuration>", f"<x>{''.join(lines)}</x></configuration>"))
    return f"options {lines}"


def hostile_attribute(town, rng):
    """A number of the demand, the network or the houses that cannot be."""
    path = town / rng.choice(["town.rou.xml", "town.net.xml", "town.poly.xml"])
    text = path.read_text()
    quoted = [i for i, c in enumerate(text) if c == '"']
    at = 2 * rng.randrange(len(quoted) // 2)
    begin, end = quoted[at] + 1, quoted[at + 1]
    value = rng.choice(NUMBERS)
    path.write_text(text[:begin] + value + text[end:])
    return f"{path.name}: {text[max(0, begin - 30) : begin]}{value}"


def hostile_type(town, rng):
    """A vehicle type of impossible size or driving."""
    path = town / "town.rou.xml"
    names = ("length", "width", "height", "minGap", "maxSpeed", "accel", "decel", "tau", "sigma", "speedFactor", "mass",
             "vClass", "carFollowModel", "laneChangeModel", "personCapacity", "boardingDuration")  # fmt: skip
    name, value = rng.choice(names), rng.choice(NUMBERS)
    path.write_text(path.read_text().replace('id="van"', f'id="van" {name}="{value}"'))
    return f"type {name}={value}"


def hostile_bytes(town, rng):
    """A file cut off, with bytes flipped, or of something else."""
    path = town / rng.choice(["town.rou.xml", "town.net.xml", "town.poly.xml", "town.sumocfg"])
    data = bytearray(path.read_bytes())
    how = rng.choice(["cut", "flip", "noise", "empty", "line lost"])
    if how == "cut":
        data = data[: rng.randrange(len(data))]
    elif how == "flip":
        for _ in range(rng.choice([1, 3, 30])):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif how == "noise":
        data = bytearray(rng.randbytes(2000))
    elif how == "line lost":
        lines = bytes(data).splitlines(keepends=True)
        lines.pop(rng.randrange(len(lines)))
        data = bytearray(b"".join(lines))
    else:
        data = bytearray()
    path.write_bytes(bytes(data))
    return f"{path.name}: {how}"


TOWNS = (hostile_config, hostile_config, hostile_attribute, hostile_type, hostile_bytes)


def hostile_trace(folder, rng):
    """A trace with cells that cannot be, rows doubled, lost or out of order, or columns renamed."""
    rows, head = trace_rows(), HEAD
    how = rng.choice(["cells", "cells", "cells", "rows", "head", "bytes"])
    if how == "cells":
        for _ in range(rng.choice([1, 1, 3, 20])):
            rng.choice(rows)[rng.randrange(8)] = rng.choice(CELLS)
    elif how == "rows":
        kind = rng.choice(["shuffle", "double", "lose", "none"])
        if kind == "shuffle":
            rng.shuffle(rows)
        elif kind == "double":
            rows += rows[:3]
        else:
            rows = rng.sample(rows, len(rows) // 2 if kind == "lose" else 0)
    elif how == "head":
        names = HEAD.strip().split(";")
        names[rng.randrange(8)] = rng.choice(["", "vehicle_x", "nonsense", "person_x", "vehicle_id"])
        head = ";".join(names) + "\n"
    content = (head + "".join(";".join(row) + "\n" for row in rows)).encode()
    if how == "bytes":
        content = content[: rng.randrange(len(content))] + rng.choice([b"", rng.randbytes(50)])
    path = folder / rng.choice(["t.csv", "t.csv", "t.csv", "t.csv", "t.csv.gz", "t.xml", "t.parquet"])
    path.write_bytes(content)
    return path, how


@pytest.mark.verify
def test_scenarios(cosim, tmp_path):
    whole = write_town(tmp_path / "whole", end=12).parent
    (whole / "precious.txt").write_text("mine")
    tally = Tally("hostile scenarios")
    for number in range(max(10, N // 2)):
        rng = random.Random(SEED * 10_007 + number)
        folder = tmp_path / "case"
        shutil.copytree(whole, folder)
        harm = rng.choice(TOWNS)
        said = harm(folder, rng)
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        sets = sets_of_trace(folder / "town.sumocfg")
        command = "simulate" if number % 5 else "run"
        ended = cosim(command, *sets, "--set", "traffic.warmup_s=5", "--out", "run", cwd=folder)
        wrong = judged(ended, folder / "run")
        after = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
        changed = sorted(n for n in before.keys() | after.keys() - {".out", ".err"} if before.get(n) != after.get(n))
        tally.add(harm.__name__, ended, f"{number} {said}", wrong or changed)
        shutil.rmtree(folder)
    tally.conclude()


@pytest.mark.verify
def test_traces(cosim, tmp_path):
    tally = Tally("hostile traces")
    for number in range(max(10, N // 2)):
        rng = random.Random(SEED * 20_011 + number)
        folder = tmp_path / "case"
        folder.mkdir()
        path, said = hostile_trace(folder, rng)
        ended = cosim("simulate" if number % 5 else "run", *sets_of_trace(path), "--out", "run", cwd=folder)
        wrong = judged(ended, folder / "run")
        tally.add(said, ended, f"{number} {said}", wrong)
        shutil.rmtree(folder)
    tally.conclude()
