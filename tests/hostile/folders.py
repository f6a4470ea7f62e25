"""Run folders with harm done to them."""

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

Harm = Callable[[Path, random.Random], str]


def _part(folder: Path, rng: random.Random) -> Path:
    return rng.choice(sorted(folder.glob("*/*.parquet")))


def flip(folder: Path, rng: random.Random) -> str:
    """One byte of any file of the run."""
    files = [*sorted(folder.glob("*/*.parquet")), *(folder / n for n in ("manifest.json", "inventory.jsonl"))]
    path = rng.choice(files)
    data = bytearray(path.read_bytes())
    at = rng.randrange(len(data))
    data[at] ^= 1 << rng.randrange(8)
    path.write_bytes(bytes(data))
    return f"bit of byte {at} of {path.name}"


def delete(folder: Path, rng: random.Random) -> str:
    path = _part(folder, rng)
    path.unlink()
    return f"{path.parent.name}/{path.name} deleted"


def duplicate(folder: Path, rng: random.Random) -> str:
    path = _part(folder, rng)
    copy = path.with_name(f"part-{rng.randrange(90000, 99999):05d}.parquet")
    shutil.copy(path, copy)
    return f"{path.name} doubled as {copy.name}"


def foreign(folder: Path, rng: random.Random) -> str:
    """A part in the place of another, of the same table or of another one."""
    one, other = _part(folder, rng), _part(folder, rng)
    while other.read_bytes() == one.read_bytes():
        other = _part(folder, rng)
    shutil.copy(one, other)
    return f"{one.parent.name}/{one.name} in the place of {other.parent.name}/{other.name}"


def truncate(folder: Path, rng: random.Random) -> str:
    path = _part(folder, rng)
    data = path.read_bytes()
    path.write_bytes(data[: rng.randrange(len(data))])
    return f"{path.name} truncated"


def drop_table(folder: Path, rng: random.Random) -> str:
    path = _part(folder, rng).parent
    shutil.rmtree(path)
    return f"{path.name} removed"


def link(folder: Path, rng: random.Random) -> str:
    """A part that is a link to itself elsewhere."""
    path = _part(folder, rng)
    aside = folder / "aside.bin"
    path.rename(aside)
    path.symlink_to(aside)
    return f"{path.name} is a link"


def edit_manifest(folder: Path, rng: random.Random) -> str:
    """A value of the manifest changed by hand."""
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    key = rng.choice(["steps", "status", "dt_s", "config", "schema_version", "inventory"])
    values = [0, -1, 10, None, "finished", [], {}, 1e300, "x" * 1000]
    content[key] = rng.choice([value for value in values if value != content[key]])
    path.write_text(json.dumps(content))
    return f"manifest: {key} = {str(content[key])[:20]}"


def lose_line(folder: Path, rng: random.Random) -> str:
    """A line of the inventory left out, doubled or moved."""
    path = folder / "inventory.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    at = rng.randrange(len(lines))
    how = rng.choice(["lost", "doubled", "moved"]) if len(lines) > 1 else "lost"
    line = lines.pop(at)
    if how == "doubled":
        lines[at:at] = [line, line]
    elif how == "moved":
        lines.insert((at + 1) % (len(lines) + 1) if at + 1 <= len(lines) else 0, line)
    path.write_bytes(b"".join(lines))
    return f"line {at} of the inventory {how}"


HARMS: tuple[Harm, ...] = (
    flip, flip, flip, delete, duplicate, foreign, truncate, drop_table, link, edit_manifest, lose_line,
)  # fmt: skip
