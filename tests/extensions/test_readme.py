"""The examples of the pages are run as they are printed there."""

import re
from pathlib import Path

import pytest

from results.archive import open_run
from tests.drive import cosim

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXTEND = (ROOT / "cosim/docs/pages/howto/extend.md").read_text(encoding="utf-8")
EXAMPLES = {
    name: code for name, code in re.findall(r"```python\n# (\w+\.py) .*?\n(.*?)```", EXTEND, flags=re.DOTALL)
}  # fmt: skip
CONFIGS = {
    "beta.py": '[trust]\nmodel = "beta.py:Beta"\nprior = 2.0\n',
    "shift.py": '[[attacks]]\nattack = "shift.py:Shift"\nshare_p = 0.3\nstart_s = 2\n',
    "threshold.py": '[detector]\nmodel = "threshold.py:Threshold"\n',
}


@pytest.mark.parametrize("name", CONFIGS)
def test_an_example_runs(tmp_path, name):
    (tmp_path / name).write_text(EXAMPLES[name], encoding="utf-8")
    (tmp_path / "mine.toml").write_text("[traffic]\nduration_s = 12\n" + CONFIGS[name], encoding="utf-8")
    done = cosim("run", "mine.toml", "--out", "run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = open_run(tmp_path / "run")
    assert len(run.trust) > 50 and len(run.detections) > 1000


def test_the_config_of_the_readme_is_accepted(tmp_path):
    (text,) = [block for block in re.findall(r"```toml\n(.*?)```", README, flags=re.DOTALL) if "[fleet]" in block]
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    done = cosim("check", "mine.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 'name = "10 s"' in done.stdout and 'model = "beta"' in done.stdout
