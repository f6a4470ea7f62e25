"""Text of others on the terminal: what a terminal would obey is replaced, wherever it is printed."""

import io
import json

import numpy as np
import pytest
from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from cosim.addons.benchmark.evidence import EvidencePlace
from cosim.cli import console
from tests.addons.benchmark.test_evidence import altered
from tests.addons.benchmark.worlds import tiny_set
from tests.addons.perception.test_readers import dair_folder, opv2v_file, vehicle
from tests.drive import cosim

EVIL = "\x1b]0;owned\x07\x1b[31m \x9b41m \u202eder\u2066 \u200e \x08\r\x7f \udcff \u2028"
"""Escape, both sets of control characters, marks of direction, bytes that are no UTF-8, a separator of lines."""


def obeyed(text: str) -> set[str]:
    """Characters that a terminal or a reader's eye would obey."""
    return {c for c in text if not c.isprintable() and c not in "\n\u00a0"}


@pytest.fixture
def printed():
    """A console like `screen`, as on a terminal without colours, and what it has printed."""
    to = io.StringIO()
    made = type(console.screen)(file=to, width=120, markup=False, highlight=False, emoji=False)
    return made, to


@pytest.mark.parametrize("wrapped", [str, Text, lambda text: Text.assemble(("name", "bold"), text)])
def test_whatever_is_printed(printed, wrapped):
    screen, to = printed
    screen.print(wrapped(EVIL), soft_wrap=True)
    table = Table("name", EVIL, box=SIMPLE, title=EVIL)
    table.add_row(wrapped(EVIL), "Stra\u00dfe 7,\u00a01 \u6771\u4eac")
    screen.print(table)
    assert not obeyed(to.getvalue()) and "Stra\u00dfe 7,\u00a01 \u6771\u4eac" in to.getvalue()
    assert to.getvalue().count("owned") == 4, "nothing is cut"


def test_what_a_reader_may_see_is_unchanged():
    for text in (
        "plain",
        "two\nlines",
        "Stra\u00dfe \u00e9\u00e8 \u6771\u4eac \U0001f697",
        "a\u00a0b",
        "\u2212 1 \u2192 2",
    ):
        assert console.clean(text) == text


def test_a_reason_does_not_move_the_values_away(capsys):
    """It stands in the place of a group, and is a sentence: values began at its end, far to the right."""
    about = {"low": None, "high": None, "unit": "", "note": ""}
    reason = "this run holds no attacks: none has begun, and the run ends too early. Run longer."
    missing = about | {"metric": "misbehaviour.not_measured", "group": reason, "value": None}
    console.print_rows("run", [about | {"metric": "radio.sent.n", "group": "", "value": 7.0}, missing])
    *_, sent, _, _, said = capsys.readouterr().out.splitlines()
    assert sent == "radio.sent.n  7" and said == f"  {reason}"


def test_json_is_read_unchanged(capsys):
    content = {"name": EVIL, "plain": "Stra\u00dfe \u6771\u4eac"}
    console.print_json(content)
    said = capsys.readouterr().out
    assert not obeyed(said) and json.loads(said) == content and "Stra\u00dfe \u6771\u4eac" in said


def test_json_has_no_word_for_what_is_no_number(capsys):
    console.print_json({"rows": [{"low": float("nan"), "high": np.float64("inf"), "mean": 1.5}]})
    assert json.loads(capsys.readouterr().out) == {"rows": [{"low": None, "high": None, "mean": 1.5}]}


def evaluated(tmp_path):
    """A class with an escape sequence."""
    label = dair_folder(tmp_path / "d") / "cooperative/label_world/000003.json"
    label.write_text(label.read_text().replace("Van", "\\u001b]0;owned\\u0007Van"))
    return ["evaluate", str(tmp_path / "d"), "--range-m", "1000"]


def with_a_named_agent(tmp_path):
    """A folder of an agent whose name turns the text round and begins a sequence."""
    opv2v_file(tmp_path / "o/s/\u202e\x9b31m0/000000.yaml", [0] * 6, {1: vehicle([9, 0, 1, 4, 2, 2, 0])})
    return ["evaluate", str(tmp_path / "o")]


def study(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s/study.toml").write_text(
        '[study]\nname = "\\u001b]0;owned\\u0007st"\n[base]\nsensing = false\n[grid]\n"traffic.scale" = [1.0]\n'
    )
    return ["status", str(tmp_path / "s")]


def benchmark(tmp_path):
    of = tiny_set()
    places = (EvidencePlace("\x1b[31mhere", 0.3, 1), *of.worlds[1:])
    altered(tmp_path / "b", worlds=places, version="\x1b[31m\u202e1", rules={"cases": ("none", *"abc", "\x1b[31md")})
    return ["benchmark", "beta", "--evidence", str(tmp_path / "b")]


@pytest.mark.parametrize("words", [evaluated, with_a_named_agent, study, benchmark])
def test_commands(tmp_path, words):
    given = words(tmp_path)
    for more in ([], ["--json"]):
        ended = cosim(*given, *more)
        assert ended.returncode == 0, ended.stderr
        assert not obeyed(ended.stdout + ended.stderr)
