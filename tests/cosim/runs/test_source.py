"""The hash of the code that made a run."""

import pytest

from cosim.runs import source


@pytest.mark.parametrize("name", ["cosim/step.py", "sensors/profiles/own.toml", "cosim/radio/tables/tbs.csv"])
def test_code_and_the_data_that_it_computes_with_are_hashed(tmp_path, monkeypatch, name):
    monkeypatch.setattr(source, "_ROOT", tmp_path)
    before = source.code_digest.__wrapped__()
    path = tmp_path / name
    path.parent.mkdir(parents=True)
    path.write_text("n = 1")
    changed = source.code_digest.__wrapped__()
    path.with_suffix(".md").write_text("prose")
    assert before != changed == source.code_digest.__wrapped__()
