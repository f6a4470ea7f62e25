"""Facts as data, verdicts by hand, and the report of what needs no runs."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.addons.compare import figure as pictures
from cosim.addons.compare import report
from cosim.addons.compare.facts import ComparedFact, Fact, Measured, chosen, load
from cosim.addons.compare.measures import MEASURES, measured
from cosim.addons.compare.runs import GivenRuns, PlannedRuns, config_of
from cosim.config.config import load as load_config
from tests.drive import assert_refused, cosim
from tests.results.tiny import fleet

ROOT = Path(__file__).parents[3]
FACTS, PLANS = load()
BASE = {
    "id": "x", "group": "g", "quantity": "q", "source": "s", "conditions": "c", "how": "h", "measure": "blockage",
    "verdict": "agrees", "uncertainty_why": "w",
}  # fmt: skip


def fact(**more) -> Fact:
    return Fact(**{"value": (10.0,), "uncertainty": (2.0,), **BASE, **more})


def compared(value: float, half: float = 0.0, **more) -> ComparedFact:
    ours = Measured(np.array([value]), np.array([value - half]), np.array([value + half]), 3)
    return ComparedFact(fact(**more), ours)


def test_every_fact_is_complete():
    assert len(FACTS) >= 60
    for one in FACTS.values():
        assert one.source and one.conditions and one.how and one.quantity
        assert one.measure in MEASURES or (one.measure == "" and one.verdict == "cannot be set")
        assert one.verdict not in ("differs", "cannot be set") or one.reason not in ("", "unknown"), one.id
        assert "http" not in one.source
    used = {name for one in FACTS.values() for name in one.runs}
    assert used == set(PLANS)


def test_the_page_has_todays_counts_and_names_every_fact_that_differs():
    page = (ROOT / "cosim/docs/pages/models/validation.md").read_text(encoding="utf-8")
    for group in ({one.group for one in FACTS.values()}, *({one.group} for one in FACTS.values())):
        stated = [one.verdict for one in FACTS.values() if one.group in group]
        n = [stated.count(v) for v in ("agrees", "differs", "undecided", "cannot be set")]
        name = "all" if len(group) > 1 else next(iter(group))
        assert f"| {name} | {len(stated)} | {' | '.join(map(str, n))} |" in page
    for one in FACTS.values():
        if one.verdict == "differs":
            assert f"`{one.id}" in page or one.id.startswith(("paper.ap.trupercept", "paper.ap.corrected")), one.id


@pytest.mark.parametrize("name", PLANS)
def test_configs_of_runs_are_valid_and_replicates_differ(name):
    one, other = (config_of(PLANS[name], k, False) for k in (0, 1))
    assert one.seed != other.seed and one.traffic.seed != other.traffic.seed
    assert replace(other, seed=one.seed, traffic=one.traffic) == one
    assert config_of(PLANS[name], 0, True).traffic.duration_s >= one.traffic.duration_s
    assert one.preset == ("paper" if PLANS[name].scene else "modern")


def test_verdicts_by_hand():
    # the band is 8 to 12
    assert compared(11).verdict == compared(11, 5).verdict == "agrees"
    assert compared(13).verdict == compared(13, 0.5).verdict == "differs"
    assert compared(13, 1.5).verdict == "undecided"
    assert compared(7, compare="at_least").verdict == "differs" and compared(11, compare="at_least").verdict == "agrees"
    assert compared(50, compare="at_least").verdict == "agrees" and compared(50, compare="at_most").verdict == "differs"
    assert compared(math.nan).verdict == ComparedFact(fact(), None, "why").verdict == "not computed"
    unset = fact(verdict="cannot be set", reason="r", measure="")
    assert ComparedFact(unset, None).verdict == "cannot be set" and not ComparedFact(unset, None).is_lost


def test_what_is_lost_and_gained():
    lost, kept = compared(13), compared(11)
    assert lost.is_lost and not kept.is_lost and ComparedFact(fact(), None, "why").is_lost
    assert not compared(13, 1.5).is_lost, "an interval that reaches the band is no loss"
    assert not compared(13, verdict="differs", reason="r").is_lost
    (line,) = report.lost([lost, kept])
    assert "stated to agree, differs: 13" in line and "\n" not in line
    assert report.gained([compared(11, verdict="differs", reason="r")]) and not report.gained([lost, kept])


def test_interval_of_replicates():
    # mean 2, standard deviation 1, three values: 4.3027 / sqrt(3)
    found = Measured.of([[1.0], [2.0], [3.0]])
    assert found.high[0] - 2 == pytest.approx(4.3027 / math.sqrt(3), rel=1e-4) and found.n == 3
    assert np.isinf(Measured.of([[1.0]]).high).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"value": (1.0, 2.0)},
        {"verdict": "differs"},
        {"compare": "near"},
        {"uncertainty_why": ""},
        {"verdict": "?"},
        {"measure": ""},
    ],
)
def test_incomplete_facts_are_refused(wrong):
    with pytest.raises(ValueError, match="fact x"):
        fact(**wrong)


def test_files_of_facts_with_mistakes(tmp_path):
    line = "\n".join(f"{key} = {json.dumps(value)}" for key, value in (BASE | {"value": 1.0}).items())
    for text, said in ((f"[[fact]]\n{line}\nruns = 'none'", "no runs called none"),
                       (f"[[fact]]\n{line}\nvalu = 1", "unknown keys"),
                       (f"[[fact]]\n{line}\n[[fact]]\n{line}", "twice")):  # fmt: skip
        (tmp_path / "f.toml").write_text(text)
        with pytest.raises(ValueError, match=said):
            load(tmp_path / "f.toml")


def test_choosing():
    assert {one.group for one in chosen(FACTS, ["radio"])} == {"radio"}
    assert [one.id for one in chosen(FACTS, ["cpm.object_bytes"])] == ["cpm.object_bytes"]
    with pytest.raises(ValueError, match="neither a fact nor a group"):
        chosen(FACTS, ["rdio"])


def test_report_without_runs(tmp_path):
    cheap = [one for one in FACTS.values() if not one.runs and one.measure != "scenario_2"]  # see `test_scenarios`
    asked = [one for one in cheap if one.group != "radio"]
    asked += [FACTS["radio.path_loss.los"], FACTS["contacts.gap.tail"]]
    runs = PlannedRuns(tmp_path / "none", PLANS)
    found = report.compare(asked, runs)
    assert not report.lost(found)
    assert {one.fact.id for one in found if one.verdict == "cannot be set"} >= {"contacts.gap.tail", "cooperscene.gain"}
    bad = ComparedFact(replace(asked[0], id="bad", runs=("default",)), None, "nothing there")
    files = report.write([*found, bad], runs, tmp_path / "out")
    assert [path.name for path in files] == ["compare.html", "compare.md", "compare.json"]
    plain = json.loads((tmp_path / "out/compare.json").read_text())
    assert plain["runs"] == "short runs" and len(plain["facts"]) == len(found) + 1
    page, table = (tmp_path / "out/compare.html").read_text(), (tmp_path / "out/compare.md").read_text()
    assert (
        "bad: not computed" in page
        and "nothing there" in page
        and page.count("data:image") == len({one.fact.group for one in found if one.ours is not None})
    )
    assert table.count("\n") == len(found) + 3 and "| contacts.gap.tail |" in table
    assert sum(report.counts(found).values()) == len(found)


def test_runs_of_the_user_stand_in_for_plans(tiny):
    """A fact whose conditions our runs cannot have is measured in a run of the user's."""
    run = tiny(60, vehicles=fleet("honest", "honest"), encounters=[])
    (one,) = report.compare([FACTS["contacts.freeway"]], GivenRuns([run], PLANS))
    assert one.verdict == "not computed" and one.problem
    with pytest.raises(ValueError, match=r"has the traffic and the seeds of .* no replicate"):
        GivenRuns.opened([run.path, run.path], PLANS)


def test_conditions_that_the_users_runs_lack_are_named():
    """Car-following is a condition; that attacks are left out, which saves time, is none."""
    config = load_config(None, ["traffic.step_s=0.5"]).to_dict()
    given = GivenRuns([SimpleNamespace(config=config)], PLANS)
    assert given.unlike("calibrated") == ['traffic.car_following = "scenario", not "calibrated"']


def test_blockage_by_hand():
    """Both antennas below 1.6 m lose 9 dB, one of them 5, none of them nothing."""
    found = measured("blockage", [], {"heights_m": [[1.5, 1.5], [1.5, 1.7], [1.7, 1.7]], "distance_m": 50})
    assert found.value.tolist() == [9, 5, 0]


def test_command_line(tmp_path):
    out = str(tmp_path / "v")
    ended = cosim("compare", "radio.blockage", "position.gnss", "--out", out, "--json")
    assert ended.returncode == 0, ended.stderr
    assert {row["id"]: row["verdict"] for row in json.loads(ended.stdout)["facts"]} == {
        "radio.blockage": "agrees", "position.gnss": "differs",
    }  # fmt: skip
    for words, said in (
        (("compare", "nothing", "--out", out), "neither a fact nor a group"),
        (("compare", "--full", "--run", out), "Choose one"),
        (("reproduce", "tables"), "cosim compare paper"),
        (("judge", "contacts", "runs/mine"), "cosim compare encounters --run RUN"),
    ):
        ended = cosim(*words)
        assert_refused(ended, said)


def test_a_picture_has_room_for_intervals():
    one = pictures.Panel("x", "m", ["here"], [10.0], [8.0], [math.inf], [11.0], [-30.0], [52.0], "undecided")
    low, high = pictures.draw([one]).axes[0].get_ylim()
    assert low < -30 and high > 52
