"""Run and study folders that somebody else made: with the seals made anew, and with code in every place for it."""

import hashlib
import json
import shutil
import signal
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from cosim.base import durable
from cosim.config.config import load
from cosim.door.kinds import SECTIONS
from cosim.runs import run as running
from cosim.runs.manifest import toml_text
from cosim.runs.stop import Stopped
from cosim.studies.folder import StudyFolder
from cosim.studies.points import points_of
from cosim.studies.study import load as load_study
from results import inventory
from results.manifest import read_manifest, write_manifest
from tests.hostile.scenes import street_sets
from tests.processes import manifest_of, sets_of_trace

TRAP = """
from pathlib import Path
Path({sentinel!r}).write_text("code ran")
class Trap:
    pass
def trap(run):
    return None
"""


def make_runs(folder: Path) -> tuple[Path, Path]:
    """A finished run of a street, and the same run interrupted after its first block."""
    config = load(None, street_sets(folder))
    whole = running.run(config, folder / "whole", lambda *_: None)
    with suppress(Stopped):
        running.run(config, folder / "part", _interrupting(4))
    assert read_manifest(folder / "part")["status"] == "interrupted"
    return whole, folder / "part"


def make_other(folder: Path) -> Path:
    """Another run of the same street."""
    sets = [*sets_of_trace(folder / "street.csv")[1::2], "seed=5", "lidar.n_azimuths=200", "attacks.0.share_p=0.4"]
    return running.run(load(None, sets), folder / "other", lambda *_: None)


def _interrupting(after: int) -> Callable[..., None]:
    def advance(phase: str, done: int, total: int, note: str) -> None:
        if phase == "run" and done == after:
            signal.raise_signal(signal.SIGINT)

    return advance


def reseal(folder: Path, **entries: Any) -> None:
    """Change the manifest of a run, with its checksum made anew."""
    write_manifest(folder, manifest_of(folder) | entries)


def with_config(folder: Path, config: dict[str, Any]) -> None:
    """Give a run another config: in its manifest, in its file, all checksums right."""
    text = toml_text(config).encode()
    (folder / "config.toml").write_bytes(text)
    reseal(folder, config=config, config_sha256=hashlib.sha256(text).hexdigest())


def reseal_inventory(folder: Path, change: Callable[[list[dict[str, Any]]], None]) -> None:
    """Change the lines of an inventory, with its chain of checksums, and the manifest's, made anew."""
    lines = [json.loads(line) for line in (folder / inventory.FILE).read_text().splitlines()]
    change(lines)
    before, written = "", []
    for line in (line if isinstance(line, dict) else {"line": line} for line in lines):
        digest = hashlib.sha256(json.dumps(line | {"chain": before}, separators=(",", ":")).encode()).hexdigest()
        written.append(json.dumps(line | {"chain": digest}, separators=(",", ":")))
        before = digest
    (folder / inventory.FILE).write_text("".join(text + "\n" for text in written))
    said = manifest_of(folder)
    try:
        found = inventory.read(folder)
    except durable.Damaged:
        return  # whatever the manifest says of it
    reseal(folder, inventory=found.summary(said["inventory"]["tables"]))


def set_trap(folder: Path, sentinel: Path, elsewhere: Path) -> None:
    """Name code in every place of a run's config in which there can be some, in all the ways in which it is named."""
    for path in (folder / "trap.py", elsewhere / "trap_elsewhere.py", folder / "trap_module.py"):
        path.write_text(TRAP.format(sentinel=str(sentinel)))
    names = ["trap.py:Trap", f"{elsewhere}/trap_elsewhere.py:Trap", "trap_module:Trap", f"{folder}/trap.py:Trap"]
    config = manifest_of(folder)["config"]
    for number, (section, kind) in enumerate(SECTIONS.items()):
        sections = config[section] if isinstance(config[section], list) else [config[section]]
        for one in sections:
            one[kind.key] = names[number % len(names)]
    config["trust_variant"][0]["model"] = names[0]
    with_config(folder, config)


STUDY = """
[study]
name = "street"
question = "Does code run?"
[base]
traffic.scenario = {scenario!r}
traffic.duration_s = 6
fleet.penetration_p = 1.0
[grid]
"trust.freshness_s" = [5.0, 10.0]
"""


def make_study(folder: Path, run: Path, sentinel: Path, scenario: Path) -> Path:
    """The folder of a study whose file was changed: code in its base and among its measures."""
    folder.mkdir()
    file = folder / "mine.toml"
    file.write_text(STUDY.format(scenario=str(scenario)))
    study = load_study(file)
    out = StudyFolder(folder / "out")
    out.prepare(study)
    points = points_of(study, "mine.toml")
    for point in points:
        shutil.copytree(run, out.run(point.id))
        out.job(point.id).mkdir(parents=True)
        job = {
            "id": point.id, "config": {"trust": {"model": "trap.py:Trap"}}, "members": {point.id: "base"}, "topics": [],
            "traffic": "", "tables": None, "measure": {"own": "trap.py:trap"}, "cache": str(folder),
        }  # fmt: skip
        (out.job(point.id) / "job.json").write_text(json.dumps(job))
    out.write_index(study, points)
    trap = out.path / "trap.py"
    trap.write_text(TRAP.format(sentinel=str(sentinel)))
    data = tomllib.loads((out.path / "study.toml").read_text())
    data["base"].setdefault("trust", {})["model"] = f"{trap}:Trap"
    data["measure"]["own"] = f"{trap}:trap"
    (out.path / "study.toml").write_text(toml_text(data))
    return out.path
