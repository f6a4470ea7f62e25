"""Mutated run folders, checksums made anew or not, read in every way: no code, no wrong figure unsaid, no lossy advice.

HOSTILE_N=200 python -m pytest -m verify -s tests/hostile/test_mutated_folders.py    # 1,000 folders
"""

import json
import random
import re
import shutil
from collections import Counter

import pytest

from cosim.addons.export.export import export
from cosim.runs.run import resume
from cosim.runs.stop import Failed
from results import inventory
from results.archive import open_run
from results.figures.catalogue import FIGURES
from results.measure import measure
from results.progress import progress
from results.verify import verify
from tests.fingerprint import fingerprint
from tests.hostile import SEED, N, shared
from tests.hostile.folders import HARMS
from tests.processes import manifest_of

VALUES = (
    None, 0, -1, 1, 3, 10**12, 2.5, 1e300, True, False, "", "finished", "x" * 2000, "\x1b]0;owned\x07", [], {}, [[]],
    "trap.py:Trap", "../../../etc/passwd", ["base"], {"file": "/etc/passwd"},
)  # fmt: skip
LOSES_DATA = re.compile(r"\b(delete|remove|rm|overwrite|clear)\b", re.IGNORECASE)


def places(data, at=()):
    """Every place of nested plain data: the keys that lead there."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*at, key)
        yield from places(value, (*at, key))


def edit(data, rng):
    """One value changed, moved in from elsewhere, or left out; says where."""
    *parents, last = rng.choice(list(places(data)))
    holder = data
    for key in parents:
        holder = holder[key]
    if rng.random() < 0.2:
        del holder[last]
    elif isinstance(holder[last], int | float) and rng.random() < 0.5:
        holder[last] = rng.choice([holder[last] + 1, holder[last] * 2, -holder[last]])
    else:
        holder[last] = rng.choice([value for value in VALUES if value != holder[last] or value is None])
    return ".".join(map(str, (*parents, last)))


def sealed_manifest(folder, rng):
    """A value of the manifest, its checksum made anew."""
    content = manifest_of(folder)
    said = edit(content, rng)
    (folder / "manifest.json").unlink()
    shared.write_manifest(folder, content)
    return f"manifest {said}, sealed"


def sealed_inventory(folder, rng):
    """A value of the inventory, all checksums made anew."""
    said = []
    shared.reseal_inventory(folder, lambda lines: said.append(edit(lines, rng)))
    return f"inventory {said[0]}, sealed"


def lost_block(folder, rng):
    """The last block gone, with all checksums, and the number of steps, made anew."""
    shared.reseal_inventory(folder, lambda lines: lines.pop())
    left = inventory.read(folder)
    shared.reseal(folder, steps=left.end_step)
    for path in folder.glob("*/*.parquet"):
        if f"{path.parent.name}/{path.name}" not in {part.name for part in left.parts}:
            path.unlink()
    return "the last block, sealed"


def sealed_part(folder, rng):
    """A part in the place of another one, of this table or another; the inventory says so."""
    one, other = rng.sample(sorted(folder.glob("*/*.parquet")), 2)
    shutil.copy(one, other)
    digest, size = shared.durable.sha256(other), other.stat().st_size

    def change(lines):
        for part in (part for line in lines for part in (*line["parts"], *line["open"])):
            if (part["table"], part["file"]) == (other.parent.name, other.name):
                part |= {"sha256": digest, "n_bytes": size}

    shared.reseal_inventory(folder, change)
    return f"{one.parent.name}/{one.name} as {other.parent.name}/{other.name}, sealed"


def config_file(folder, rng):
    """A byte of the config file, or a value of it with its checksum made anew, or none of it."""
    path, how = folder / "config.toml", rng.choice(["flip", "cut", "value", "code"])
    data = bytearray(path.read_bytes())
    if how == "flip":
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif how == "cut":
        del data[rng.randrange(len(data)) :]
    else:
        old, new = (b"n_azimuths = 300", b"n_azimuths = 200") if how == "value" else (b'"avod"', b'"trap.py:Trap"')
        data = bytearray(bytes(data).replace(old, new))
    path.write_bytes(data)
    if how in ("value", "code"):
        shared.reseal(folder, config_sha256=shared.durable.sha256(path))
    return f"config.toml: {how}"


def foreign(folder, rng):
    """A file of another run in the place of its own."""
    name = rng.choice(["manifest.json", "config.toml", "inventory.jsonl"])
    shutil.copy(folder.parent / "other" / name, folder / name)
    return f"{name} of another run"


def code(folder, rng):
    """Code in the config, everything made anew: the one harm that leaves a folder whole."""
    shared.set_trap(folder, folder.parent / "sentinel", folder.parent)
    return "code"


MUTATIONS = (
    *HARMS, sealed_manifest, sealed_manifest, sealed_manifest, sealed_manifest, sealed_inventory, sealed_inventory,
    sealed_inventory, sealed_part, sealed_part, lost_block, config_file, config_file, foreign, code,
)  # fmt: skip


def measured(run):
    """Values by metric and group; those that could not be measured are left out."""
    values = measure(run, topics=("traffic", "encounters", "trust", "freshness", "radio")).set_index(
        ["metric", "group"]
    )
    return values.value[~values.index.get_level_values(0).str.endswith("not_measured")].to_dict()


def exported(folder):
    out = folder.parent / "export"
    shutil.rmtree(out, ignore_errors=True)
    export(open_run(folder), "kitti", out)
    return {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*.txt")}


def drawn(folder):
    run = open_run(folder)
    axes = FIGURES["radio"]([run]).axes
    return {n: [line.get_ydata().tolist() for line in of.lines] for n, of in enumerate(axes)}, run.damage


def tables(folder):
    run = open_run(folder)
    return {name: run.table(name).to_csv() for name in ("trust", "encounters", "vehicles")}


def shown(folder):
    run = open_run(folder, unfinished=True)
    return measured(run), run.damage


READ = {"measure": shown, "export": exported, "plot": drawn, "tables": tables}


def attempt(read, folder):
    """What a way of reading gives: a result and nothing said, or the line in which it refuses."""
    try:
        return read(folder), ""
    except (ValueError, Failed, OSError) as error:
        return None, " ".join(str(error).split()) or type(error).__name__


def judge(folder, want, ways, same=True):
    """What is wrong with how a mutated folder is read; empty for nothing. `same` is false where it is whole, but says
    something else than before."""
    (about, problems), lines = verify(folder), []
    lines += problems
    state, refused = attempt(progress, folder)
    lines.append(refused or state["error"])
    for name in ways:
        found, line = attempt(READ[name], folder)
        lines.append(line)
        if found is None or not same:
            continue
        if name in ("measure", "plot"):
            values, damage = found
            lines += damage
            kept = values if name == "plot" and damage else {key: want[name][0].get(key) for key in values}
            if repr(kept) != repr(values) or (len(values) < len(want[name][0]) and not damage):
                return f"{name} gives something else, and says nothing ({about['status']}, {problems[:1]})"
        elif found != want[name]:
            return f"{name} gives something else, and says nothing ({problems[:1]})"
    if (folder.parent / "sentinel").exists():
        return "code has run"
    return next((f"advice that loses data: {line}" for line in lines if LOSES_DATA.search(line)), "")


def judge_resumed(folder, marks):
    """What is wrong with how a mutated folder is resumed; empty for nothing."""
    _, line = attempt(lambda path: resume(path, lambda *_: None), folder)
    if not line and fingerprint(folder) != marks:
        return "resumed to other tables, and said nothing"
    if (folder.parent / "sentinel").exists():
        return "code has run"
    return f"advice that loses data: {line}" if LOSES_DATA.search(line) else ""


@pytest.fixture(scope="module")
def runs(street_runs):
    """A finished run, an interrupted one, another one, and what each way of reading gives of the first."""
    whole, part = street_runs
    other = shared.make_other(whole.parent)
    return whole, part, other, {name: read(whole) for name, read in READ.items()}, fingerprint(whole)


def carry_out(runs, tmp_path, numbers, ways, resumes):
    whole, part, other, want, marks = runs
    shutil.copytree(other, tmp_path / "other")
    counts, wrongs = Counter(), []
    for number in numbers:
        rng = random.Random(SEED * 50_021 + number)
        mutate, folder = MUTATIONS[number % len(MUTATIONS)], tmp_path / "run"
        shutil.copytree(part if resumes else whole, folder)
        said = mutate(folder, rng)
        try:
            wrong = judge_resumed(folder, marks) if resumes else judge(folder, want, ways, mutate is not code)
            counts["sound" if not verify(folder)[1] else "found"] += 1
        except Exception as error:  # what a user would see as a traceback
            wrong = f"{type(error).__name__}: {error}"
        if wrong:
            wrongs.append(f"{number} {said}: {wrong}")
            print(wrongs[-1], flush=True)
        shutil.rmtree(folder)
        (tmp_path / "sentinel").unlink(missing_ok=True)
    print(f"\nmutated folders, seed {SEED}: {dict(counts)}, {len(wrongs)} wrong")
    assert not wrongs, "\n".join(wrongs)


def test_some_mutated_folders(runs, tmp_path):
    """Every mutation once."""
    carry_out(runs, tmp_path, range(len(MUTATIONS)), ("tables",), resumes=False)


@pytest.mark.verify
def test_mutated_folders_are_read(runs, tmp_path):
    carry_out(runs, tmp_path, range(4 * N), tuple(READ), resumes=False)


@pytest.mark.verify
def test_mutated_folders_are_resumed(runs, tmp_path):
    carry_out(runs, tmp_path, range(N), (), resumes=True)


def test_values_that_are_no_json_are_refused(runs, tmp_path):
    """A manifest of another kind is one line, whatever it is."""
    shutil.copytree(runs[0], tmp_path / "run")
    for text in ("[]", "1", '"x"', "{}", "[" * 5000, '{"schema_version": 9}', json.dumps({"schema_version": []})):
        (tmp_path / "run" / "manifest.json").write_text(text)
        _, line = attempt(open_run, tmp_path / "run")
        assert "damaged" in line or "schema version" in line, text
