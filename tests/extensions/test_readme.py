"""The examples of the pages are run as they are printed there."""

import re
from pathlib import Path

import pytest

from cosim.addons.tryout import templates
from cosim.config.config import load
from cosim.step.parts import check_choices
from results.archive import open_run
from tests.cosim.docs import fences
from tests.drive import cosim, simulate

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXTEND = fences.blocks((fences.PAGES / "howto" / "extend.md").read_text(encoding="utf-8"))
CONFIGS = [block.text for block in EXTEND if block.language == "toml"]
TEMPLATES = Path(templates.__file__).parent
WRITTEN = {p.name: p.read_text(encoding="utf-8") for p in TEMPLATES.glob("[a-z]*.py")}
EXAMPLES = {"my_trust.py" if name == "trust.py" else name: text for name, text in WRITTEN.items()}
"""A file trust.py would hide the package."""


def test_the_page_shows_what_cosim_new_writes():
    """The examples are those that `cosim try` is asked about in tests/addons/tryout/test_commands.py."""
    shown = {block.text for block in EXTEND if block.language == "python"}
    assert shown and shown <= set(EXAMPLES.values())
    ours = r"^(?:from|import) ((?:cosim|trust|sensors|results)\b[\w.]*)"
    assert {name for text in EXAMPLES.values() for name in re.findall(ours, text, re.MULTILINE)} == {"cosim.extend"}


@pytest.mark.parametrize("text", CONFIGS)
def test_a_config_of_the_page_is_accepted(tmp_path, text):
    for name, code in EXAMPLES.items():
        (tmp_path / name).write_text(code, encoding="utf-8")
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    check_choices(load(tmp_path / "mine.toml"))


@pytest.mark.verify
def test_all_examples_of_the_page_run_together(tmp_path):
    for name, code in EXAMPLES.items():
        (tmp_path / name).write_text(code, encoding="utf-8")
    config = "".join(CONFIGS) + "[traffic]\nduration_s = 12\nstep_s = 0.5\n"
    (tmp_path / "mine.toml").write_text(config, encoding="utf-8")
    run = open_run(
        simulate(tmp_path / "run", "attacks.0.start_s=2", "record.level=full", config=tmp_path / "mine.toml")
    )
    assert len(run.trust) > 50 and len(run.receptions) > 1000 and (run.pseudonyms.identity == 0).all()


def test_the_config_of_the_readme_is_accepted(tmp_path):
    (text,) = [block for block in re.findall(r"```toml\n(.*?)```", README, flags=re.DOTALL) if "[fleet]" in block]
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    done = cosim("check", "mine.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 'name = "10 s"' in done.stdout and 'model = "beta"' in done.stdout
