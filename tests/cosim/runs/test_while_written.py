"""A run that is being written is read as it was when it was opened; what is said of it loses nothing."""

import json
import shutil

import pytest

from cosim.base.durable import Damaged, Lock
from cosim.config.config import load
from cosim.runs import checkpoint
from cosim.runs.run import resume, run
from results.archive import open_run
from results.measure import measure
from results.progress import progress
from results.verify import verify
from tests.hostile.scenes import street_sets
from tests.hostile.shared import reseal, with_config
from tests.processes import manifest_of

TOPICS = ("traffic", "encounters", "radio")


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """A run with a block in every step, opened after its third; what was said of it then."""
    base = tmp_path_factory.mktemp("watched")
    config = load(None, [*street_sets(base), "record.block_steps=1"])
    seen = {}

    def advance(phase, done, total, note):
        if phase == "run" and done == 3:
            seen["run"] = open_run(base / "run", unfinished=True)
            seen["values"] = measure(seen["run"], topics=TOPICS)
            seen["verify"], seen["progress"] = verify(base / "run"), progress(base / "run")
            seen["late"] = open_run(base / "run", unfinished=True)

    run(config, base / "run", advance)
    return base / "run", seen


def test_a_run_is_measured_as_it_was_opened(watched):
    """Its writer goes on for three blocks, which replace what was open, and adds parts that were not there."""
    _, seen = watched
    late = measure(seen["late"], topics=TOPICS)
    assert late.equals(seen["values"])
    assert not seen["late"].damage and not late.metric.str.endswith("not_measured").any()
    assert seen["late"].manifest["steps"] == 3 and seen["late"].status == "running"


def test_what_is_said_of_a_run_that_is_being_written(watched):
    _, seen = watched
    about, problems = seen["verify"]
    assert (about["status"], about["steps"], problems) == ("running", 3, [])
    assert seen["progress"]["status"] == "running" and seen["progress"]["next"].startswith("wait")
    assert (seen["progress"]["steps"], seen["progress"]["steps_asked"], seen["progress"]["blocks"]) == (3, 6, 3)


def test_what_is_said_of_others(watched, tmp_path):
    folder, _ = watched
    assert progress(folder) | {"bytes": 0} == {
        "status": "finished", "steps": 6, "steps_asked": 6, "blocks": 6, "bytes": 0, "error": "",
        "next": f"cosim report {folder}",
    }  # fmt: skip
    shutil.copytree(folder, tmp_path / "run")
    reseal(tmp_path / "run", status="running")
    found = progress(tmp_path / "run")
    assert found["status"] == "killed" and found["next"] == f"cosim resume {tmp_path / 'run'}"
    with pytest.raises(ValueError, match=r'unfinished \(status "killed".*cosim resume'):
        open_run(tmp_path / "run")
    lock = Lock(tmp_path / "run")
    with pytest.raises(ValueError, match=r'unfinished \(status "running".*Wait for its end'):
        open_run(tmp_path / "run")
    lock.release()
    (tmp_path / "run" / "config.toml").write_text("seed = 4")
    found = progress(tmp_path / "run")
    assert found["error"].startswith("config.toml was changed") and found["next"].startswith("cosim verify")


def test_the_folder_of_an_empty_table_and_a_second_config(watched, tmp_path):
    """A table without rows has a file; the config is written twice, and must say the same both times."""
    shutil.copytree(watched[0], tmp_path / "run")
    (file,) = (tmp_path / "run" / "dropped_detections").iterdir()
    content = file.read_bytes()
    shutil.rmtree(tmp_path / "run" / "dropped_detections")
    assert verify(tmp_path / "run")[1] == [f"dropped_detections/{file.name} is missing"]
    config = manifest_of(watched[0])["config"]
    with_config(tmp_path / "run", config)
    file.parent.mkdir()
    file.write_bytes(content)
    assert verify(tmp_path / "run")[1] == []
    config["lidar"]["n_azimuths"] = 200
    reseal(tmp_path / "run", config=config)
    assert verify(tmp_path / "run")[1] == ["config.toml says something else than manifest.json"]
    with pytest.raises(Damaged, match=r"config\.toml says something else"):
        open_run(tmp_path / "run")


def test_another_runs_manifest_is_one_line(watched, tmp_path):
    """The manifest and the config of a run with another seed; and its checkpoint."""
    config = load(None, [*street_sets(tmp_path), "record.block_steps=1", "seed=5"])
    other = run(config, tmp_path / "other", lambda *_: None)
    shutil.copytree(watched[0], tmp_path / "run")
    for name in ("manifest.json", "config.toml"):
        shutil.copy(other / name, tmp_path / "run" / name)
    with pytest.raises(Damaged, match=r"cannot go on: inventory\.jsonl is not the one"):
        resume(tmp_path / "run", lambda *_: None)


@pytest.mark.parametrize("dtype", ["S0", "U0", []])
def test_a_checkpoint_gets_no_more_memory_than_it_has_bytes(dtype):
    """10^15 strings of no length are 909 TiB, because NumPy gives each of them a byte."""
    head = json.dumps({"tree": ["a", 0, 0], "arrays": [[dtype, [10**15]]]}).encode()
    content = b"cosim state 1\n" + len(head).to_bytes(8, "little") + head
    with pytest.raises(ValueError, match="not a state of this program: an array of 1000000000000000 items"):
        checkpoint.decode(content)
