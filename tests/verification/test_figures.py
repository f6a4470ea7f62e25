"""Commands of figures are named on their pages, and exist."""

import importlib.util

import pytest

from cosim.studies.study import SHIPPED
from tests.verification import figures


@pytest.mark.parametrize("name", figures.FIGURES)
def test_a_page_names_its_command(name):
    figure = figures.FIGURES[name]
    text = (figures.ROOT / figure.page).read_text(encoding="utf-8")
    assert figure.command in " ".join(text.split())
    program, verb, *rest = figure.command.split()
    if program == "python":
        assert importlib.util.find_spec(rest[0])
    elif verb == "sweep":
        assert (SHIPPED / f"{rest[0]}.toml").exists()


def test_what_moved_is_listed(tmp_path, monkeypatch, capsys):
    """The same command three times: it prints one line, the same, and another one."""
    monkeypatch.setattr(figures, "BUILD", tmp_path)
    for text, found in (("1", "made for the first time"), ("1", "the same"), ("2", "2 lines moved")):
        monkeypatch.setitem(figures.FIGURES, "one", figures.Figure("README.md", "python -c", (f"print({text})",)))
        assert figures.main(["one"]) == 0
        assert f"one: {found} (README.md)" in capsys.readouterr().out
    monkeypatch.setitem(figures.FIGURES, "one", figures.Figure("README.md", "python -c", ("raise SystemExit(3)",)))
    assert figures.main(["one"]) == 1 and "one: status 3" in capsys.readouterr().out


def test_an_unknown_name_is_refused(capsys):
    assert figures.main(["presetz"]) == 2
    assert "no figure is called presetz" in capsys.readouterr().err
