"""Predictions from configs: what is refused, what points of a study share, and a short run beside its prediction."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from cosim.addons.law import freshness
from cosim.addons.law.comparison import differences, measured_by
from cosim.addons.law.prediction import MODEL_ERROR, Prediction, with_intervals
from cosim.addons.law.scope import left_out, server_of, servers_of
from cosim.config.config import load, resolve_data, with_defaults
from cosim.studies import study as studies
from cosim.studies.folder import StudyFolder
from cosim.studies.points import points_of
from tests.drive import assert_refused, cosim, drive
from tests.processes import set_words
from tests.refusals import refused_in_one_line

SHORT = {"attacks": [], "traffic": {"duration_s": 8, "warmup_s": 30}, "fleet": {"penetration_p": 0.5}}
CONFIG = """
attacks = []
[traffic]
duration_s = 30
warmup_s = 150
[fleet]
penetration_p = 0.5
[trust]
server_period_s = 1
[[trust_variant]]
name = "7 s"
server_period_s = 7
freshness_s = 15
"""

RETURNS = """
sensing_phase = "common"
attacks = []
traffic = { scenario = "trace.csv", duration_s = 20 }
fleet.penetration_p = 1.0
detector.model = "ideal"
radio = { model = "unit_disk", unit_disk.loss_p = 0.0 }
server.cellular = { uplink_loss_p = 0.0, downlink_loss_p = 0.0, delay_min_s = 0.01, delay_mean_s = 0.01 }
"""


def config_of(**changes):
    return resolve_data(with_defaults(json.loads(json.dumps(SHORT | changes))), "the test", None)


@pytest.mark.parametrize(
    "changes",
    [
        {"trust": {"host": "local"}},
        {"trust": {"model": "beta"}},
        {"radio": {"evaluations": "piggybacked"}},
        {"cpm": {"rules": "etsi"}},
        {"cpm": {"max_objects": 2}},
        {"server": {"outages": [[1, 2]]}},
        {"sensing": False},
        {"early_fusion": {"share": "objects"}},
    ],
)
def test_what_the_law_does_not_cover_is_refused_in_one_line(changes):
    with refused_in_one_line("the law of freshness covers"):
        servers_of(config_of(**changes))


def test_servers_by_hand():
    # Sensing every 2 s and a half-open window of 9 s: evidence of 0, 2, 4, 6, 8 s counts, so 5 steps.
    config = config_of(sensing_interval_s=2.0, trust={"freshness_s": 9, "server_period_s": 3, "unseen": "zero"})
    (server,) = servers_of(config)
    assert (server.name, server.period_s, server.window_steps, server.zero) == ("base", 3, 5, True)
    off = server_of("x", replace(config.trust, freshness_s="off"), config)
    assert off.window_s == np.inf and off.window_steps > 10**6
    assert left_out(config) == [] and len(left_out(config_of(attacks=[{"attack": "removal"}]))) == 1
    more = config_of(trust={"evidence": ["detections", "missing"]}, lidar={"dropout_p": 0.1})
    assert [line.partition(":")[0] for line in left_out(more)] == ["trust.evidence", "lidar.dropout_p"]


def test_intervals_by_hand():
    # The smallest and the largest of the runs, and 5.5 % of the value more on both sides. One without a value says
    # nothing, and neither do all if there is none.
    none, names = np.zeros(1), ("freshness.evaluators.mean", "freshness.value_age.median_s")
    own = Prediction("base", 1.0, 50.0, none, none, none, none, {names[0]: 2.0, names[1]: np.nan})
    found = with_intervals(own, [{names[0]: value, names[1]: 1.0} for value in (3.0, 1.5, np.nan, 2.5)])
    assert MODEL_ERROR[names[0]] == 0.055
    assert found.low == pytest.approx({names[0]: 1.39}) and found.high == pytest.approx({names[0]: 3.11})


def test_lookups_that_are_not_evaluated_have_the_error_of_those_without_a_value():
    """The interval had no width: 0.0312 to 0.0312 for the variant `paper`, of which a run has 0.0299."""
    none, name = np.zeros(1), "freshness.lookup_state.share:unevaluated"
    for value, low, high in ((0.0312, 0.0132, 0.0492), (0.0, 0.0, 0.0)):
        own = Prediction("paper", 1.0, 50.0, none, none, none, none, {name: value})
        found = with_intervals(own, [{name: value}])
        assert (found.low[name], found.high[name]) == pytest.approx((low, high))


def test_no_interval_of_a_share_is_above_one():
    none, name = np.zeros(1), "freshness.lookup_state.share:no value"
    own = Prediction("base", 1.0, 50.0, none, none, none, none, {name: 1.0})
    found = with_intervals(own, [{name: 1.0}])
    assert found.low == {name: pytest.approx(1.0 - MODEL_ERROR[name])} and found.high == {name: 1.0}


def test_points_that_differ_in_their_server_share_one_replay(tmp_path, monkeypatch):
    path = tmp_path / "study.toml"
    path.write_text(
        "[base]\nattacks = []\ntraffic.duration_s = 5\n[grid]\nfleet.penetration_p = [0.2, 0.4]\n"
        "trust.server_period_s = [1, 5]\ntrust.freshness_s = [10, 20]\n"
    )
    asked = []

    def answered(experiments, advance, n_fleets):
        asked.extend(experiments)
        said = [[f"{of.config.fleet.penetration_p} {s.period_s} {s.window_steps}" for s in of.servers]
                for of in experiments]  # fmt: skip
        return [freshness.Predicted(one, {}) for one in said]

    monkeypatch.setattr(freshness, "predict_all", answered)
    found = freshness.predict_study(studies.load(path), "study.toml", lambda *_: None)
    assert len(asked) == 2 and [len(of.servers) for of in asked] == [4, 4]
    for keys, answer in found:
        want = keys["fleet.penetration_p"], float(keys["trust.server_period_s"]), keys["trust.freshness_s"]
        assert answer == "{} {} {}".format(*want)


def test_what_is_neglected_at_any_point_of_a_study_is_said_once(tmp_path):
    (tmp_path / "study.toml").write_text(
        "[base]\nattacks = []\nfleet.penetration_p = 1\ntrust.least_score = 0\n"
        "traffic = {duration_s = 5, warmup_s = 0}\n"
        "[grid]\ngnss.std_m = [0, 0.2]\ntrust.server_period_s = [1, 5]\n"
    )
    done = cosim("predict", "freshness", "study.toml", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["neglected"] == ["gnss: the law takes positions for exact."]


@pytest.mark.parametrize(("back_s", "no_value", "without_trust"), [(17, 10 / 24, 0.0), (72, 14 / 24, 0.5)])
def test_a_vehicle_that_returns_has_what_it_received_before(tmp_path, back_s, no_value, without_trust):
    # Two cars 15 m apart; b is away from second 10 to 17 or 72. Step 0 is the moment before the trace, so sweeps are in
    # the seconds 1, 2, ..., and the server publishes in 1, 6, 11, ... Nothing is lost, and each sees the other. Lookups
    # in both directions in the seconds 1 to 10, and in the two after the return. None has a value before the
    # publication of second 6. After 7 s, b still has that one. After 62 s it has forgotten it, and what a received in
    # second 71 rests on no evidence in the window of 50 s: the second of two encounters is without trust.
    rows = [
        f"{k / 5},{name},{2 * k + ahead},0,90,10,car\n"
        for k in range(5 * back_s + 16) for name, ahead in (("a", 0), ("b", 15))
        if name == "a" or not 50 <= k < 5 * back_s
    ]  # fmt: skip
    (tmp_path / "trace.csv").write_text("time,id,x,y,angle,speed,type\n" + "".join(rows))
    path = tmp_path / "law.toml"
    path.write_text(RETURNS.replace("duration_s = 20", f"duration_s = {back_s + 3}"))
    found = freshness.predict(load(path), print).predictions[0].metrics
    assert found["freshness.lookup_state.share:no value"] == pytest.approx(no_value)
    assert found["freshness.encounters_without_trust.share"] == pytest.approx(without_trust)
    assert not any(0 < value < 1e-9 for value in found.values())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("law")
    (folder / "law.toml").write_text(CONFIG)
    drive(folder / "run", config=folder / "law.toml")
    return folder


@pytest.mark.verify
def test_a_short_run_is_as_predicted(run):
    done = cosim(
        "predict", "freshness", "law.toml", "--against", "run", "--fleets", "1", "--json", "--out", "law.json",
        "--picture", "law.png", cwd=run,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = {(row["variant"], row["metric"]): row for row in json.loads(done.stdout)["rows"]}
    for variant in ("base", "7 s"):
        for name in ("median_s", "p90_s"):
            row = rows[variant, f"freshness.newest_evaluation_age.{name}"]
            assert row["value"] == pytest.approx(row["measured"], rel=0.2)
        for state in ("evaluated", "stale", "no value"):
            row = rows[variant, f"freshness.lookup_state.share:{state}"]
            assert row["value"] == pytest.approx(row["measured"], abs=0.04)
            assert row["low"] is None or row["low"] <= row["high"]
        row = rows[variant, "freshness.evaluators.mean"]
        assert row["value"] == pytest.approx(row["measured"], rel=0.15)
    kept = json.loads((run / "law.json").read_text())
    assert [p["variant"] for p in kept["predictions"]] == ["base", "7 s"] and kept["made"]
    ages = kept["predictions"][1]["newest_evaluation_age"]
    assert sum(ages["share"]) == pytest.approx(1, abs=1e-6) and ages["age_s"][0] >= 1.8
    assert (run / "law.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["law.toml", "--set", "trust.host=local"], 'host = "local": the law of freshness covers'),
        (["freshness", "--grid", "x.toml"], "--set and --grid go with a config"),
        (["--grid", "fleet.penetration_p=0.2"], "the name of a study file to write"),
        (["--out", "law.png"], "--out law.png: predictions are JSON"),
        (["nothing.toml"], "nothing.toml"),
        (["freshness", "--against", "run"], "a config is compared with a run, and a study with a study"),
        (["law.toml", "--set", "fleet.penetration_p=0"], "no equipped vehicle was on the road"),
    ],
)
def test_mistakes_are_one_line(run, words, message):
    done = cosim("predict", "freshness", *words, cwd=run)
    assert_refused(done, message)
    assert "Traceback" not in done.stderr and not (run / "x.toml").exists()


def test_a_run_of_another_config_is_told_apart(run):
    """Keys that change nothing of what is measured, such as those of [record], do not count."""

    def found(*sets):
        return differences(run / "run", load(run / "law.toml", list(sets)))

    assert found() == found("record.level=full", "compute.threads=1") == []
    (line,) = found("trust.server_period_s=1.5")
    assert line.startswith("trust.server_period_s = ") and line.endswith(" instead of 1.5")
    assert ["trust_variant.7 s.freshness_s = 15 instead of 9"] == found("trust_variant.0.freshness_s=9")


def test_encounters_of_the_definition_that_is_predicted_are_compared(tmp_path):
    """The law counts those of the first definition; measures are sorted by radius."""
    names, share = ["equipped, 50 m", "equipped, 200 m"], "freshness.encounters_without_trust.share"
    frame = pd.DataFrame({"metric": share, "group": names, "value": [0.25, 0.5]})
    two = config_of(fleet={"penetration_p": 1}, encounters=[{"radius_m": 200}, {"radius_m": 50}])
    (predicted,) = freshness.predict(two, lambda *_: None).predictions
    assert predicted.definition == names[1] and measured_by(frame, predicted.definition) == {share: 0.5}


def test_a_study_is_compared_with_one_of_the_same_keys(tmp_path):
    def study(keys):
        path = tmp_path / "law.toml"
        path.write_text(f'[study]\nname = "law"\n[base]\nseed = 3\n[grid]\n{keys}\n')
        return studies.load(path)

    measured = study("fleet.penetration_p = [0.1, 0.5]")
    folder = StudyFolder(tmp_path / "study")
    folder.prepare(measured)
    folder.write_index(measured, points_of(measured, "law.toml"))
    assert differences(folder.path, measured) == []
    assert differences(folder.path, replace(measured, base=measured.base | {"seed": 4})) == ["seed = 3 instead of 4"]
    with pytest.raises(ValueError, match=r"varies fleet\.penetration_p, and what .* varies radio\.range_m"):
        differences(folder.path, study("radio.range_m = [100, 200]"))


@pytest.mark.verify
def test_a_grid_is_a_study_that_can_be_swept(run):
    done = cosim("predict", "freshness", "law.toml", "--grid", "grid.toml", cwd=run)
    assert done.returncode == 0, done.stderr
    done = cosim("sweep", "grid.toml", "--out", "swept", "--dry-run", cwd=run)
    assert done.returncode == 0, done.stderr


@pytest.mark.verify
@pytest.mark.parametrize(
    "sets",
    [
        ["sensing_interval_s=2", "trust.freshness_s=21", "server.cellular.downlink_loss_p=0.3"],
        ["server.cellular.delay_mean_s=1.5", "server.cellular.uplink_loss_p=0.3", "trust.unseen=zero"],
        ["radio.model=unit_disk", "radio.range_m=150", "lidar.profile=vlp16", "detector.model=ideal"],
    ],
)
def test_other_sensors_delays_and_losses(tmp_path, sets):
    (tmp_path / "law.toml").write_text(CONFIG.replace("30", "90"))
    words = set_words(sets)
    drive(tmp_path / "run", *sets, config=tmp_path / "law.toml")
    done = cosim(
        "predict", "freshness", "law.toml", *words, "--against", "run", "--fleets", "0", "--json", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    for row in json.loads(done.stdout)["rows"]:
        if "newest" in row["metric"] and "mean" in row["metric"]:
            assert row["value"] == pytest.approx(row["measured"], rel=0.06), row
        if "lookup_state" in row["metric"]:
            assert row["value"] == pytest.approx(row["measured"], abs=0.03), row
        if "evaluators" in row["metric"]:
            assert row["value"] == pytest.approx(row["measured"], rel=0.08), row
