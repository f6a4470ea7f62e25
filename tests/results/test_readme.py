"""The examples of the README run as they stand."""

import re
from contextlib import chdir
from pathlib import Path

import pytest

import results
from results.measure import TOPICS


def test_examples(run, tmp_path):
    text = (Path(results.__file__).parent / "README.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "helsinki-1").symlink_to(run.path)
    names: dict = {}
    with chdir(tmp_path):
        for block in blocks:
            exec(block, names)
    assert (tmp_path / "trust.pdf").exists() and (tmp_path / "encounters.svg").exists()


def test_measures_of_a_run(run):
    assert run.measure.trust.final().equals(TOPICS["trust"].final(run))
    assert dir(run.measure) == sorted([*TOPICS, "value"])
    for topic in TOPICS:
        assert "plot" in dir(getattr(run.measure, topic)) and len(dir(getattr(run.measure, topic))) > 2
    with pytest.raises(AttributeError, match="The topics are encounters"):
        run.measure.encunters.summary()
    with pytest.raises(AttributeError, match=r"It has by_distance, by_los, by_place, clouds, .*, to_server"):
        run.measure.radio.overal()
