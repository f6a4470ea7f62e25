"""Studies that run: what is shared changes no value, and nothing that goes wrong is lost."""

import json
import shutil
import statistics

import numpy as np
import pandas as pd
import pytest

from cosim.base.codes import BASE_VARIANT
from cosim.studies.folder import StudyFolder
from cosim.studies.stages import Cache
from results.archive import open_run
from results.study import open_study
from tests import drive
from tests.cosim.studies.runs import SHORT, assert_same
from tests.cosim.studies.runs import drive as drive_city

BASE = """
[base]
traffic.duration_s = 14
traffic.warmup_s = 60
compute.threads = 1
attacks = [
  { attack = "ghost_insertion", role = "malicious", start_s = 5, share_p = 0.3 },
  { attack = "unreliable", role = "unreliable", start_s = 5 },
]
[limits]
retries = 0
"""
STUDY = f"""
[study]
name = "short"
replicates = 2
baseline = {{ "trust.freshness_s" = 20, "trust.host" = "local" }}
{BASE}
[[zip]]
trust.freshness_s = [6, 20]
trust.host = ["central", "local"]
[grid]
fleet.penetration_p = [0.2]
"""
HALF = f"""
[study]
name = "short"
{BASE.replace("duration_s = 14", "duration_s = 8")}
[grid]
attacks.0.attack = ["ghost_insertion", "crash.py:Crash"]
"""

CRASH = '''
"""An attack that fails."""


class Crash:
    def detections(self, listed, context):
        raise RuntimeError("as intended")
'''


def cosim(folder, *words):
    """`cosim` in a folder, with a cache of its own."""
    return drive.cosim(*words, cwd=folder, COSIM_CACHE=str(folder / "cache"))


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """A folder with a study of two runs on one recorded traffic, of which the second fails, and how the sweep ended."""
    folder = tmp_path_factory.mktemp("half")
    (folder / "crash.py").write_text(CRASH)
    (folder / "study.toml").write_text(HALF)
    return folder, cosim(folder, "sweep", "study.toml", "--out", "out", "--workers", "1", "--json")


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A folder with a finished study of two runs, each of two points; `test_recovery.py` kills some."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "study.toml").write_text(STUDY)
    done = cosim(folder, "sweep", "study.toml", "--out", "out", "--workers", "2")
    assert done.returncode == 0, done.stderr + done.stdout
    (folder / "stdout.txt").write_text(done.stdout)
    (folder / "stderr.txt").write_text(done.stderr)
    return folder


def test_a_sweep_says_what_it_does(swept):
    """Without a terminal: a line per finished run, then the core metrics of one column per penetration, then what next.

    Half an interval of two replicates: t(0.975, 1) / sqrt(2) = 12.706 / 1.4142 = 8.98 standard deviations.
    """
    first, *lines = (swept / "stderr.txt").read_text().splitlines()
    assert first.startswith("note: study.replicates = 2: a 95 % interval reaches 9.0 standard deviations")
    assert lines[0].startswith("about ") and "2 workers on free cores" in lines[0]
    runs = [line for line in lines if line.startswith("run ")]
    assert [line.split(":")[0] for line in runs] == [f"run {n} of 2" for n in (1, 2)]
    for replicate in (0, 1):
        (line,) = (x for x in runs if f"fleet.penetration_p = 0.2, replicate {replicate}, 2 points: " in x)
        assert line.endswith("of processor time)")
    said = (swept / "stdout.txt").read_text()
    assert (
        "4 finished" in said and "packet delivery ratio" in said and "newest evaluation at lookup, mean age [s]" in said
    )
    assert said.splitlines()[-1] == "next: cosim report out   cosim measure out"


@pytest.mark.verify
def test_notes_on_runs_are_said_once(tmp_path):
    """Two runs of a trace that ends after 9 s of the 20 s that are asked for."""
    rows = [f"{t};a;{5 * t};0;90;car;5" for t in range(10)]
    head = "timestep_time;vehicle_id;" + ";".join(f"vehicle_{c}" for c in ("x", "y", "angle", "type", "speed"))
    (tmp_path / "trace.csv").write_text("\n".join([head, *rows]))
    (tmp_path / "short.toml").write_text(
        f"""
        [study]
        name = "short"
        [base]
        sensing = false
        traffic.scenario = "{tmp_path}/trace.csv"
        traffic.duration_s = 20
        traffic.step_s = 1
        [[base.encounters]]
        pairs = "all"
        [grid]
        encounters.0.radius_m = [50, 100]
        """
    )
    done = cosim(tmp_path, "sweep", "short.toml", "--out", "out", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("run 2 of 2: ") == done.stderr.count("note: the traffic ended before the 20 s asked") == 1


def test_core_metrics_of_a_study(swept):
    """Pivoted, short, never cut; values that there are."""
    done = cosim(swept, "measure", "out", "--over", "fleet.penetration_p", "--where", "trust.freshness_s=20.0")
    assert done.returncode == 0, done.stderr
    (line,) = (x for x in done.stdout.splitlines() if "honest above attacker at lookup (AUC)" in x)
    mine = open_study(swept / "out").summary.query(
        "metric == 'misbehaviour.at_lookup.auc' and group == 'malicious' and `trust.freshness_s` == 20"
    )
    assert len(mine) == 1 and all(f" {mean:.3g}" in line for mean in mine["mean"])
    wrong = cosim(swept, "measure", "out", "--where", "trust.freshness_s=7")
    drive.assert_refused(wrong, "no point has trust.freshness_s = 7. There are 6, 20.")
    wrong = cosim(swept, "measure", f"out/runs/{open_study(swept / 'out').points.run[0]}", "--over", "x")
    drive.assert_refused(wrong, "go with a study")
    done = cosim(swept, "measure", "out", "--json", "--where", "fleet.penetration_p=0.2", "--metric", "encounters.n")
    summary, differences = json.loads(done.stdout).values()
    assert {row["fleet.penetration_p"] for row in summary + differences} == {0.2} and differences
    done = cosim(swept, "measure", "out", "--csv", "means.csv", "--where", "fleet.penetration_p=0.2")
    assert done.returncode == 0 and set(pd.read_csv(swept / "means.csv")["fleet.penetration_p"]) == {0.2}
    for command, option in (
        ("measure", "--fresh-s 10"), ("measure", "--threshold 0"), ("measure", "--variant x"), ("measure", "--set a=1"),
        ("plot encounters", "--radius-m 7"), ("plot encounters", "--step 0"), ("plot trust", "--vehicle 3"),
    ):  # fmt: skip
        wrong = cosim(swept, *command.split(), "out", *option.split())
        said = f"error: {option.split()[0]} goes with a run, and out is a study. Leave it out"
        drive.assert_refused(wrong, said)
    wrong = cosim(swept, "measure", "out", "--json", "--over", "fleet.penetration_p")
    drive.assert_refused(wrong, "--json has a row for each mean")
    for figure in ("durations", "ages"):
        done = cosim(swept, "plot", figure, "out", "--out", f"{figure}.png")
        assert done.returncode == 0, done.stderr
    assert all((swept / "out/jobs" / run / "curves.parquet").is_file() for run in open_study(swept / "out").points.run)


def test_merged_points_equal_plain_runs(swept, tmp_path):
    study = open_study(swept / "out")
    assert (study.points.state == "finished").all() and len(study.points) == 4
    assert study.points["run"].nunique() == 2 and not Cache(swept / "cache").names("traffic"), "no run shares it"
    assert not list(swept.rglob("*.partial"))
    points = study.points.query("replicate == 1")
    assert len(points) == 2
    for row in points.to_dict("records"):  # the acting variant, and one with another window and host
        plain = drive_city(
            tmp_path / row["point"], *(text for text in SHORT if "share" not in text), "attacks.0.share_p=0.3",
            f"trust.freshness_s={row['trust.freshness_s']}", f"trust.host={row['trust.host']}",
            "fleet.penetration_p=0.2", "seed=5", "traffic.seed=2", "trust_variant=[]",
        )  # fmt: skip
        assert_same(plain, study.run(row["point"]))


def test_a_replayed_point_equals_a_plain_run(half, tmp_path):
    folder, _ = half
    study = open_study(folder / "out")
    assert len(Cache(folder / "cache").names("traffic")) == 1 and not list(folder.rglob("*.partial"))
    (point,) = study.points.query("state == 'finished'").point
    drive.simulate(tmp_path / "plain", config=study.run(point).path / "config.toml")
    assert_same(open_run(tmp_path / "plain"), study.run(point))


def test_finished_points_are_skipped(swept):
    again = cosim(swept, "sweep", "study.toml", "--out", "out", "--dry-run", "--json")
    plan = json.loads(again.stdout)
    assert (plan["points"], plan["finished"], plan["runs"]) == (4, 4, 0)
    more = STUDY.replace("[6, 20]", "[6, 20, 40]").replace('["central", "local"]', '["central", "local", "local"]')
    (swept / "more.toml").write_text(more)
    plan = json.loads(cosim(swept, "sweep", "more.toml", "--out", "out", "--dry-run", "--json").stdout)
    assert (plan["points"], plan["finished"], plan["runs"]) == (6, 4, 2)


def test_status_says_what_to_type_next(swept, tmp_path):
    assert cosim(swept, "status", "out").stdout.splitlines()[-1] == "next: cosim report out"
    shutil.copytree(swept / "out", tmp_path / "out")
    next((tmp_path / "out" / "jobs").glob("*/measures.parquet")).unlink()
    said = cosim(tmp_path, "status", "out").stdout.splitlines()
    assert said[-1] == "next: cosim sweep out/study.toml --out out"


def test_time_left_follows_from_the_processor_time_of_finished_runs(swept):
    """A run that waits for others takes longer by the clock, and not more of the processor."""
    attempts = [json.loads(file.read_text())[-1] for file in (swept / "out" / "jobs").glob("*/attempts.json")]
    typical_s = statistics.median(one["cpu_s"] for one in attempts)
    (swept / "third.toml").write_text(STUDY.replace("replicates = 2", "replicates = 3"))
    plan = json.loads(cosim(swept, "sweep", "third.toml", "--out", "out", "--dry-run", "--json").stdout)
    assert plan["seconds"] == pytest.approx(typical_s * plan["runs"], abs=1)


def test_keys_without_effect_are_named(swept):
    """The parked vans in all points, the server's period in those whose trust is local."""
    study = STUDY.replace("[base]", "[base]\nparked.vans_p = 0.5\ntrust.server_period_s = 7")
    (swept / "vain.toml").write_text(study)
    done = cosim(swept, "sweep", "vain.toml", "--out", "vain", "--dry-run", "--json")
    assert done.stderr.splitlines() == [
        "note: parked.vans_p has no effect without parked.per_100_m above 0.",
        'note: trust.server_period_s has no effect without trust.host = "central", in 2 of 4 points.',
        "note: study.replicates = 2: a 95 % interval reaches 9.0 standard deviations of a replicate to either side (5 "
        "replicates: 1.2). A smaller paired difference cannot be told from chance.",
    ]


def test_answers(swept):
    study = open_study(swept / "out")
    summary = study.summary.query("metric == 'freshness.newest_evaluation_age.mean_s' and group == 'all'")
    assert len(summary) == 2 and (summary.n == 2).all() and (summary.low <= summary["mean"]).all()
    one = summary.iloc[0]
    keys = {key: one[key] for key in study.keys}
    mine = study.measures.query("metric == 'freshness.newest_evaluation_age.mean_s' and group == 'all'")
    for key, value in keys.items():
        mine = mine[mine[key] == value]
    a, b = mine.value  # by hand: t(1) at 97.5 % is 12.706; an age has no upper bound, so its logarithm is Student's
    mean, half = (a + b) / 2, 12.7062 * abs(a - b) / 2
    assert (one["mean"], one.high) == pytest.approx((mean, mean * np.exp(half / mean)))
    difference = study.differences.query("metric == 'trust.final.median'")
    assert (difference["trust.freshness_s"] == 6).all() and len(difference)
    done = cosim(swept, "measure", "out")
    assert done.returncode == 0, done.stderr
    assert {"summary.csv", "summary.parquet", "differences.csv", "measures.parquet"} <= {
        path.name for path in (swept / "out").iterdir()
    }
    assert cosim(swept, "report", "out").returncode == 0
    done = cosim(swept, "report", "out", "--out", "other.html", "--figures", "study.toml")
    drive.assert_refused(done, "--figures study.toml is a file. Give a folder.")
    assert not (swept / "other.html").exists()
    wrong = cosim(swept, "plot", "freshness", "out", "--over", "lidar.range_m")
    drive.assert_refused(wrong, "is not swept")


def test_a_run_that_fails_does_not_stop_the_others(half):
    folder, done = half
    assert done.returncode == 1
    answer = json.loads(done.stdout)
    assert answer["points"]["finished"] == 1 and answer["points"]["failed"] == 1
    assert "crash.py:7: attack Crash: detections() raised RuntimeError" in next(iter(answer["failed"].values()))
    logs = [path.read_text() for path in (folder / "out" / "jobs").glob("*/log.txt")]
    assert any("as intended" in log for log in logs)
    assert json.loads(cosim(folder, "status", "out", "--json", "--trust-code").stdout)["points"] == answer["points"]


def test_a_cache_that_was_changed_is_not_used(half):
    cache = Cache(half[0] / "cache")
    (name,) = cache.names("traffic")
    entry = cache.find("traffic", name)
    part = next((entry / "actors").glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:-8] + b"tampered")
    assert cache.find("traffic", name) is None and not entry.exists()


@pytest.mark.verify
def test_scheduler_that_is_not_there(swept):
    done = cosim(swept, "sweep", "study.toml", "--out", "elsewhere", "--scheduler", "tcp://127.0.0.1:9")
    said = [line for line in done.stderr.splitlines() if not line.startswith(("note: ", "about "))]
    assert done.returncode == 2 and len(said) == 1 and "no scheduler answers" in said[0]


def test_two_sweeps_of_one_folder(swept):
    folder = StudyFolder(swept / "out")
    assert not folder.is_swept()
    with folder.locked(), pytest.raises(ValueError, match="another `cosim sweep`"), folder.locked():
        pass
    with folder.locked():
        assert folder.is_swept()
    assert BASE_VARIANT in set(open_study(swept / "out").points.variant)
