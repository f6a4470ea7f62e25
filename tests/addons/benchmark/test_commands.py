"""`cosim benchmark`: the model of the page is scored, and wrong use ends in one line with exit status 2."""

import inspect
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.addons.benchmark import table
from cosim.addons.benchmark.evidence import MANIFEST, load
from cosim.cli.main import app
from cosim.door.blame import ExtensionError
from tests.addons.benchmark.worlds import RULES, tiny_set
from tests.cosim.docs import fences
from tests.drive import cosim
from tests.verification.benchmark_page import tables
from trust.models import MODELS

(MODEL,) = [
    block.text for block in fences.blocks((fences.PAGES / "howto" / "benchmark.md").read_text(encoding="utf-8"))
    if block.title == "mine.py"
]  # fmt: skip

BAD = """
from dataclasses import replace
from cosim.extend import TrustScores
from mine import Share

class Raises(Share):
    def scores(self, now_step=None): return 1 / 0

class Nan(Share):
    def scores(self, now_step=None):
        found = super().scores()
        return replace(found, trust=found.trust * float("nan"))

class Silent(Share):
    def add_evaluations(self, received): pass

class NoModel:
    def scores(self, now_step=None): pass
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a tiny set and the model of the page."""
    tiny_set().write(tmp_path / "set")
    (tmp_path / "mine.py").write_text(MODEL)
    (tmp_path / "bad.py").write_text(BAD)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def call(*words):
    """What the command prints, and the error that it ends with."""
    done = CliRunner().invoke(app, ["benchmark", "--evidence", "set", *map(str, words)])
    return done.stdout, done.exception


def test_the_model_of_the_page_is_a_class_of_twelve_lines():
    lines = [line for line in MODEL.splitlines() if line.strip()]
    assert len(lines[lines.index("class Share:") :]) <= 12


def test_the_model_of_the_page_is_scored_beside_stored_rows(folder):
    row = table.row_of(tiny_set(), "beta", (), lambda *_: None)
    text = json.dumps({**table.head(tiny_set()), "rows": [row]})
    (folder / "set" / table.TABLE).write_text(text)
    said, error = call("mine.py:Share", "--adapt", "--budget", 6)
    plain = " ".join(said.split())  # columns wrap where the terminal is narrow
    assert error is None and "adapts" in plain, said
    models = plain.split("all models")[1]
    assert "beta" in models and "evidence set 0" in models
    whole = json.loads(call("mine.py:Share", "--json")[0])
    assert whole["rows"] == [row] and whole["sha256"] == tiny_set().checksum
    assert set(whole["row"]["attacks"]) == set(RULES.cases[1:]) and len(whole["row"]["sha256"]) == 64
    auc = [of["auc"][0] for of in whole["row"]["attacks"].values()]
    assert auc == sorted(auc), "worst first"
    (folder / "set" / table.TABLE).write_text(text.replace(tiny_set().checksum, "0" * 64))
    assert json.loads(call("--json")[0])["rows"] == [], "rows of another set are not shown"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("bad.py:Raises", "scores() raised ZeroDivisionError"),
        ("bad.py:Nan", "returned trust[0] = nan"),
        ("bad.py:Silent", "it rates no vehicle"),
        ("bad.py:NoModel", "has no method open_step"),
        ("bad.py:Missing", "defines no Missing"),
        ("nowhere.py:Share", "no such file"),
        ("betta", "no such choice"),
        ("beta --set tau=0.2", "no effect"),
        ("beta --adapt --budget 2", "--budget 2"),
        ("beta --budget 2", "--budget goes with --adapt"),
        ("--adapt", "goes with a model"),
        ("beta --all", "Leave beta out"),
        ("--make", "is there already"),
        ("--make beta", "takes no model"),
    ],
)
def test_wrong_use_is_told_in_one_line(folder, words, told):
    _, error = call(*words.split())
    assert isinstance(error, ValueError) and not isinstance(error, ExtensionError), error  # exit status 2
    assert told in str(error) and "\n" not in str(error)


@pytest.mark.verify
def test_an_altered_set_ends_with_exit_status_2(folder):
    head = json.loads((folder / "set" / MANIFEST).read_text())
    head["rules"]["start_step"] = 5
    (folder / "set" / MANIFEST).write_text(json.dumps(head))
    done = cosim("benchmark", "mine.py:Share", "--evidence", "set", cwd=folder)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.count("\n") == 1 and "was altered" in done.stderr


def test_rows_are_stored_with_the_set_and_kept(folder):
    def make(*names):
        table.make(tiny_set(), folder / "set", lambda *_: None, {name: MODELS[name] for name in names}, 6)
        return table.stored(tiny_set(), folder / "set")

    rows, remark = make("beta", "raya_bayes")
    assert [row["model"] for row in rows] == ["beta"] and not remark and rows[0]["worst_case"]["budget"] == 6
    more, _ = make("beta", "mate")
    assert [row["model"] for row in more] == ["beta", "mate"] and more[0] == rows[0]
    assert "mate" not in table.ADAPTED and more[1]["worst_case"] is None
    text = (folder / "set" / table.TABLE).read_text()
    (folder / "set" / table.TABLE).write_text(text.replace(table.digest(), "0" * 12))
    assert "computed by other code" in table.stored(tiny_set(), folder / "set")[1]
    (folder / "set" / table.TABLE).write_text("{")
    assert table.stored(tiny_set(), folder / "set")[0] == []
    assert call("beta")[1] is None, "a damaged table does not keep a model from being scored"


def test_rows_depend_on_the_files_of_all_models():
    """Also on those of models in an add-on."""
    read = table.code_files()
    assert {Path(inspect.getfile(model)) for model in MODELS.values()} <= set(read)
    assert len(read) == len(set(read))


def test_the_page_shows_the_stored_table():
    text = (fences.PAGES / "howto" / "benchmark.md").read_text(encoding="utf-8")
    assert tables() in text, "python -m tests.verification.benchmark_page"


@pytest.mark.verify
def test_the_full_set_takes_less_than_ten_minutes_and_gives_the_stored_row(folder):
    shutil.rmtree(folder / "set")
    done = subprocess.run(
        [sys.executable, "-m", "cosim", "benchmark", "mine.py:Share", "--json"],
        capture_output=True, text=True, timeout=600, check=True,
    )  # fmt: skip
    whole = json.loads(done.stdout)
    assert len(whole["row"]["attacks"]) == 13 and whole["rows"]
    stored = next(row for row in whole["rows"] if row["model"] == "beta")
    again = table.row_of(load(), "beta", (), lambda *_: None)
    for attack, of in again["attacks"].items():
        assert of == stored["attacks"][attack], "the stored row is what this code computes"
