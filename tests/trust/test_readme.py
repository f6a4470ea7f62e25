"""The room's README against the code: models, defaults, and what a look that counts several times does to each."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

import trust
from tests.trust.histories import add, open_step, trust_of
from trust.models import MODELS, params_of
from trust.params import TrustParams

README = (Path(trust.__file__).parent / "README.md").read_text()


def table_after(heading):
    """Rows of the first table after a heading, by the name in the first column."""
    text = README.split(heading, 1)[1]
    rows = re.findall(r"^\| (.*) \|$", re.split(r"\n\n#{2,3} ", text)[0], re.M)
    return {cells[0].strip("` "): cells for cells in (re.split(r" +\| +", row) for row in rows) if "`" in cells[0]}


def flat(default):
    return [value for part in default for value in flat(part)] if isinstance(default, tuple) else [default]


def test_every_model_and_every_default_is_documented():
    rows = table_after("## Trust models")
    for name, model in MODELS.items():
        key = "raya_*" if name.startswith("raya_") else name
        assert key in rows, name
        stated = rows[key][3]
        for field in fields(model.Params):
            if name == "trupercept" or field.name == "grace_s":
                continue
            assert field.name in stated, (name, field.name)
            for value in flat(field.default):
                text = f"{value:g}" if isinstance(value, float) else str(value)
                assert text in stated.replace(",", ""), (name, field.name, text)
        assert "Deviations:" in (model.__doc__ if key != "raya_*" else model.__mro__[1].__doc__)


def audited(name, n_repeated=1, n_echoes=0):
    """Trust in vehicle 1 after ten steps in which vehicles 2 and 4 confirm its one detection and 3 denies it.

    The look of vehicle 3 counts for `n_repeated` detections of the same object; colluders confirm as 2 does.
    """
    model = MODELS[name](params_of(MODELS[name], TrustParams()), 1.0)
    for step in range(10):
        open_step(model, step, {1: [1.0] * n_repeated} | {v: [1.0] for v in range(2, 5 + n_echoes)})
        about = [(v, 1, 0, 1.0, 1.0) for v in (2, 4, *range(5, 5 + n_echoes))]
        about += [(3, 1, k, -1.0, 1.0) for k in range(n_repeated)]
        others = [(v, i, 0, 1.0, 1.0) for v in (2, 3, 4) for i in (2, 3, 4) if v != i]
        add(model, step, about + others)
    return trust_of(model, 1)


def said(name, n_deniers, n_times):
    """Trust in vehicle 1, whose detection four vehicles confirm in ten steps, if others deny it in the last steps."""
    model = MODELS[name](params_of(MODELS[name], TrustParams()), 1.0)
    for step in range(10):
        open_step(model, step, {v: [1.0] for v in range(1, 16)})
        about = [(v, i, 0, 1.0, 1.0) for v in range(2, 16) for i in range(2, 16) if v != i]
        about += [(v, 1, 0, 1.0, 1.0) for v in range(2, 6)]
        about += [(6 + k, 1, 0, -1.0, 1.0) for k in range(n_deniers)] * (step >= 10 - n_times)
        add(model, step, about)
    return trust_of(model, 1)


@pytest.mark.parametrize("name", MODELS)
def test_what_each_model_makes_of_one_voice_and_of_many(name):
    rows = table_after("### The same evaluator again")
    cells = rows["raya_*" if name.startswith("raya_") else name][1:]
    found = [said(name, *case) for case in ((0, 0), (1, 1), (1, 10), (10, 1))]
    assert [float(cell) for cell in cells[:4]] == pytest.approx(found, abs=0.006)
    _, once, again, many = found
    if once - many < 0.006:
        assert cells[4] == "-"
    else:
        assert cells[4] == "all" if abs(again - once) < 0.006 else "some" if again - many > 0.05 else "none"


@pytest.mark.parametrize("name", MODELS)
def test_what_each_model_makes_of_a_look_that_counts_several_times(name):
    rows = table_after("## Audit of evidence")
    stated = [float(cell) for cell in rows["raya_*" if name.startswith("raya_") else name][1:4]]
    assert stated == pytest.approx([audited(name), audited(name, 4), audited(name, 1, 4)], abs=0.006)


def test_one_repeated_look_is_one_vote():
    """Models that take one vote per message do not notice repetition; sums do."""
    for name in ("minhas", "report_count"):
        assert audited(name, 4) == audited(name)
    for name in ("beta", "beta_discounted", "subjective_logic", "mate", "trupercept"):
        assert audited(name, 4) < audited(name) - 0.01
