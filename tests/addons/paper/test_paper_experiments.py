"""The paper's tables on drives of ours: what is printed, what is computed, and what a mistake is answered with."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.stats import t as student

from cosim.addons.compare import ego_metrics, experiments, label_rules, page
from cosim.addons.compare.published import AP, FINAL_TRUST, METHODS
from cosim.studies.sweep import prepare_study
from results.archive import open_run
from results.manifest import write_manifest
from results.metrics.kitti import LEVELS, STRICT, LabelledObjects, average_precision
from results.study import open_study
from tests.drive import cosim, simulate

PAPER = Path(__file__).parents[4] / "shared/paper/trupercept.tex"
DRIVES = Path(__file__).parents[3] / "cosim/addons/compare/scenes/paper-drives.toml"
CITIES, REPLICATES = ("helsinki", "adlershof"), 3


def test_published_figures_are_those_of_the_paper():
    if not PAPER.is_file():
        pytest.skip(f"no paper at {PAPER}")
    text = re.sub(r"\\cellcolor\{[^}]*\}", "", PAPER.read_text())
    for method, name in METHODS.items():
        (row, *_) = re.findall(rf"^{name} &(.*)\\\\", text, re.M)
        expected = [AP[method, label, level] for label in ("car", "pedestrian") for level in LEVELS]
        assert [float(word) for word in row.split("&")] == expected
    said = ", ".join(f"{trust:g} {setting}" for setting, trust in list(FINAL_TRUST.items())[:2])
    assert f"{said}, and {FINAL_TRUST['malicious']:g} malicious" in text


def synthetic(folder, keys, rows):
    """The folder of a study whose runs measured these: swept keys, replicate, metric, group, value."""
    rng = np.random.default_rng(3)
    points, frames = [], []
    for number, (at, replicate) in enumerate((at, r) for at in rows for r in range(REPLICATES)):
        point = f"p{number}"
        points.append(
            {"point": point, "run": point, "variant": "base", "replicate": replicate, "state": "finished"} | at
        )
        frames.append(pd.DataFrame([
            {"point": point, "metric": metric, "group": group, "value": rng.normal(50, 5), "unit": "%", "label": ""}
            for metric, groups in {
                "paper.ap11": [f"{label}, {level}" for label in ("car", "pedestrian") for level in LEVELS],
                "paper.ap40": [f"{label}, {level}" for label in ("car", "pedestrian") for level in LEVELS],
                "paper.final_trust.mean": ["honest", "malicious"], "encounters.duration.km_mean_s": ["equipped, 100 m"],
                "attack.believed.share": ["0.5, intended, malicious"], "paper.egos.n": [""],
            }.items() for group in groups
        ]))  # fmt: skip
        job = folder / "jobs" / point
        job.mkdir(parents=True)
        (folder / "runs" / point).mkdir(parents=True)
        made = {"schema_version": 0, "dt_s": 1, "steps": 1, "config": {}, "status": "finished"}
        write_manifest(folder / "runs" / point, made | {"source": {"commit": "0123456789abcdef"}})
        frames[-1].to_parquet(job / "measures.parquet", index=False)
    head = {"name": "paper", "question": "", "keys": keys, "baseline": {}, "measure": {}}
    table = pa.Table.from_pandas(pd.DataFrame(points), preserve_index=False)
    pq.write_table(table.replace_schema_metadata({"study": json.dumps(head)}), folder / "index.parquet")
    return pd.DataFrame(points).merge(pd.concat(frames), on="point")


def by_hand(values):
    """Mean and 95 % interval of Student's t, from the formula."""
    mean, half = np.mean(values), student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / len(values) ** 0.5
    return mean, mean - half, mean + half


@pytest.mark.verify
def test_tables_are_means_intervals_and_paired_changes(tmp_path):
    keys = ["traffic.scenario", "trust.self_reports", "trust.method"]
    at = [dict(zip(keys, (city, own, method), strict=True))
          for city in CITIES for own in (True, False) for method in METHODS]  # fmt: skip
    all_values = synthetic(tmp_path, keys, at)
    found = experiments.outcome(open_study(tmp_path), "tables")
    ap = found[found.what == "average precision"]
    assert len(ap) == len(at) * 8 and (ap.n == REPLICATES).all()
    for row in ap.to_dict("records"):
        mine = all_values[(all_values["traffic.scenario"] == row["city"]) & (all_values.metric == "paper.ap11")
                          & (all_values["trust.self_reports"] == row["self_reports"])
                          & (all_values.group == f"{row['class']}, {row['level']}")]  # fmt: skip
        values = {m: mine[mine["trust.method"] == m].sort_values("replicate").value.to_numpy() for m in METHODS}
        assert (row["mean"], row["low"], row["high"]) == pytest.approx(by_hand(values[row["method"]]))
        change = values[row["method"]] - values["local"]
        assert (row["change"], row["change_low"], row["change_high"]) == pytest.approx(by_hand(change))
        assert row["paper"] == AP[row["method"], row["class"], row["level"]]
        assert row["paper_change"] == pytest.approx(row["paper"] - AP["local", row["class"], row["level"]])
    between = found[found.what == page.BETWEEN]
    assert len(between) == 2 * len(CITIES) * 2 * 8
    for row in between.to_dict("records"):
        mine = all_values[(all_values["traffic.scenario"] == row["city"]) & (all_values.metric == "paper.ap11")
                          & (all_values["trust.self_reports"] == row["self_reports"])
                          & (all_values.group == f"{row['class']}, {row['level']}")]  # fmt: skip
        one, before = (
            mine[mine["trust.method"] == m].sort_values("replicate").value.to_numpy()
            for m in (row["method"], page.before_of(row["method"]))
        )
        assert (row["mean"], row["low"], row["high"]) == pytest.approx(by_hand(one - before))


@pytest.mark.verify
def test_the_page_of_an_experiment(tmp_path):
    """Figures of the rows, the commit of the runs, and a table for 11 and for 40 recall points."""
    keys = ["traffic.scenario", "trust.self_reports", "trust.method"]
    at = [dict(zip(keys, (city, own, method), strict=True))
          for city in CITIES for own in (True, False) for method in METHODS]  # fmt: skip
    synthetic(tmp_path, keys, at)
    done = experiments.conclude("tables", tmp_path)
    assert done.files[-1].stat().st_size > 20_000
    text = (tmp_path / "tables.md").read_text()
    row = done.rows[(done.rows.what == "average precision") & (done.rows.level == "all")].iloc[1]
    change = f"{row['mean']:.1f} ({row.change:+.1f} ±{(row.change_high - row.change_low) / 2:.1f})"
    assert change in text and "commit `0123456789ab`" in text
    assert text.count("| car, 11 recall points |") == text.count("| pedestrian, 40 recall points |") == 1
    assert "TruPercept 3 minus TruPercept 2 | pedestrian" in text


@pytest.mark.verify
def test_trust_levels_are_against_the_same_vehicles_when_they_are_honest(tmp_path):
    keys = ["attacks.0.start_s", "attacks.0.attack", "attacks.0.role", "traffic.scenario", "trust.method"]
    settings = ((1e8, "ghost_insertion", "malicious"), (0.0, "unreliable", "unreliable"),
                (0.0, "ghost_insertion", "malicious"))  # fmt: skip
    at = [dict(zip(keys, (*setting, city, method), strict=True))
          for setting in settings for city in CITIES for method in ("local", "trupercept_3")]  # fmt: skip
    all_values = synthetic(tmp_path, keys, at)
    found = experiments.outcome(open_study(tmp_path), "trust-levels")
    ap = found[(found.what == "average precision") & (found.city == "helsinki") & (found.method == "trupercept_3")]
    assert ap.groupby("setting").paper.count().to_dict() == {"malicious": 0, "trustworthy": 8, "unreliable": 0}
    mine = all_values[(all_values["traffic.scenario"] == "helsinki") & (all_values["trust.method"] == "trupercept_3")
                      & (all_values.metric == "paper.ap11")
                      & (all_values.group == "car, all")]  # fmt: skip
    honest, malicious = (
        mine[(mine["attacks.0.start_s"] == start) & (mine["attacks.0.attack"] == "ghost_insertion")].value.to_numpy()
        for start in (1e8, 0.0)
    )
    row = ap[(ap.setting == "malicious") & (ap["class"] == "car") & (ap.level == "all")].iloc[0]
    assert (row.change, row.change_low, row.change_high) == pytest.approx(by_hand(malicious - honest))
    trust = found[found.what.str.startswith("mean trust") & (found.city == "helsinki")].dropna(subset="paper")
    assert dict(zip(trust.setting, trust.paper, strict=True)) == FINAL_TRUST
    assert experiments.conclude("trust-levels", tmp_path).files[-1].stat().st_size > 20_000


def test_both_share_the_runs_with_honest_vehicles(tmp_path):
    ids = [
        {run.id for run in prepare_study(experiments.study_of(name), name, tmp_path / "out").plan.runs}
        for name in experiments.EXPERIMENTS
    ]
    assert len(ids[0] & ids[1]) == 20  # two cities, ten drives


@pytest.mark.parametrize(("words", "said"), [
    (("tables", "--replicates", "0"), "--replicates"),
    (("tables", "--set", "trust.method=local"), "trust.method is varied"),
    (("trust-levels", "--set", "seed=3"), "seed is varied"),
    (("tables", "--set", "trafic.duration_s=3"), "unknown key"),
    (("tables", "--set", "traffic.duration_s=-3"), "traffic.duration_s"),
    (("scenario-1", "--replicates", "2"), "--replicates"),
    (("table",), "table"),
])  # fmt: skip
def test_mistakes_are_one_line(tmp_path, words, said):
    done = cosim("reproduce", *words, "--out", str(tmp_path / "out"))
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and said in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Ten seconds of the paper's drives, seen by every tenth vehicle."""
    folder = tmp_path_factory.mktemp("drive") / "run"
    sets = ("traffic.duration_s=10", "attacks.0.victim_p=0.1", "trust.method=local", "gnss.std_m=1")
    return open_run(simulate(folder, *sets, config=DRIVES))


def plainly(run, egos, table, owner):
    """Boxes of a table ahead of each ego, one ego and step after the other, by the definition of the level `all`."""
    vehicles = run.vehicles.set_index("vehicle")
    world = run.actors.set_index(["step", "actor"])
    errors = run.position_errors.set_index(["step", "vehicle"])
    columns, number = {"truth": [], "found": []}, 0
    kinds = {"car": "car", "van": "car", "pedestrian": "pedestrian"}
    for step in range(int(run.manifest["steps"])):
        there = world.loc[step]
        for ego in [a for a in there.index if a in egos]:
            me = there.loc[ego]
            roof = me.z_m + vehicles.height_m[ego] / 2

            def seen(x, y, z, yaw, me=me, roof=roof):
                dx, dy = x - me.x_m, y - me.y_m
                ahead = np.cos(me.yaw_rad) * dx + np.sin(me.yaw_rad) * dy
                left = np.cos(me.yaw_rad) * dy - np.sin(me.yaw_rad) * dx
                inside = ahead > abs(left) and np.hypot(dx, dy) <= 140
                return (ahead, left, z - roof, yaw - me.yaw_rad) if inside else None

            for actor, one in there.iterrows():
                kind = kinds.get(str(vehicles.vehicle_class[actor]))
                if actor != ego and kind and (at := seen(one.x_m, one.y_m, one.z_m, one.yaw_rad)):
                    size = vehicles.loc[actor, ["length_m", "width_m", "height_m"]].astype(float)
                    columns["truth"].append((number, kind, *at[:3], *size, at[3], 1.0))
            error = errors.loc[(step, ego)]
            for one in table[(table.step == step) & (owner == ego)].itertuples():
                at = seen(one.x_m - error.error_x_m, one.y_m - error.error_y_m, one.z_m, one.yaw_rad)
                if at:
                    kind = str(table["class"][one.Index])
                    columns["found"].append(
                        (number, kind, *at[:3], one.length_m, one.width_m, one.height_m, at[3], one.score)
                    )
            number += 1
    made = []
    for rows in columns.values():
        frame = pd.DataFrame(rows)
        n = len(frame)
        made.append(LabelledObjects(
            frame[0].to_numpy(), frame[1].to_numpy(object), frame[[*range(2, 9)]].to_numpy(float), np.full(n, 1e3),
            np.zeros(n, int), np.zeros(n), frame[9].to_numpy(float),
        ))  # fmt: skip
    return made, number


@pytest.mark.verify
def test_precision_at_the_egos_is_that_of_their_own_detections_and_of_plain_loops(drive):
    """With `local` fusion adds nothing: what is fused is ranked as what the detectors reported."""
    found = ego_metrics.measures(drive).set_index(["metric", "group"]).value
    targets = drive.detections.dropna(subset="target")
    assert set(targets.target) and set(targets.target) <= set(ego_metrics.egos_of(drive)), "attackers aim at egos alone"
    boxes = drive.detections[drive.detections.origin == "sensed"].reset_index(drop=True)
    (truth, reported), n_frames = plainly(
        drive, set(ego_metrics.egos_of(drive)), boxes, boxes.observer.map(drive.subjects.vehicle)
    )
    assert found["paper.frames.n", ""] == n_frames > 40
    for label in ("car", "pedestrian"):
        answer = average_precision(truth, reported, label, "3d", STRICT[label])["all"]
        assert found["paper.objects.n", f"{label}, all"] == answer.n_truth
        assert found["paper.ap11", f"{label}, all"] == pytest.approx(answer.ap11, abs=0.5)  # rounded coordinates


def test_final_trust_of_a_run_by_hand(drive):
    found = ego_metrics.measures(drive).set_index(["metric", "group"]).value
    vehicles, names = drive.vehicles, drive.pseudonyms.set_index("vehicle").pseudonym
    until = drive.trust.subject.map(drive.pseudonyms.set_index("pseudonym").to_step)
    last = drive.trust[drive.trust.step <= until].sort_values("step").groupby("subject").trust.last()
    egos = set(ego_metrics.egos_of(drive))
    liars = set(drive.detections[drive.detections.lied].observer.map(drive.subjects.vehicle))
    for role in ("honest", "malicious"):
        mine = [v for v in vehicles[vehicles.equipped & (vehicles.role == role)].vehicle if v not in egos]
        mine = [v for v in mine if role == "honest" or v in liars]
        assert found["paper.final_trust.mean", role] == pytest.approx(np.mean([last.get(names[v], 0.5) for v in mine]))


@pytest.mark.verify
def test_label_rules(drive):
    found = label_rules.label_rules([drive], max_frames=12)
    for label, some in found.groupby("class"):
        why = some.iloc[0][["returned", "behind_buildings", "behind_actors", "too_far", "too_sparse"]]
        assert sum(why) == pytest.approx(1.0), label
        share = some.set_index("rule").share
        assert share["every actor"] == 1.0 > share["with a visible pixel"] > share["with a return"] > 0.2
        assert share["with a return"] == pytest.approx(why.returned)
        ap = some.set_index("rule").ap11
        assert ap["with a return"] > ap["every actor"], "fewer actors that nobody could find"


@pytest.mark.verify
def test_command_from_end_to_end_and_resumed(tmp_path):
    env = {"COSIM_CACHE": str(tmp_path / "cache")}
    os.environ.update(env)
    short = ("--set", "traffic.duration_s=12", "--set", "traffic.warmup_s=60", "--replicates", "1", "--out", "short")
    none = cosim("reproduce", "tables", *short, cwd=tmp_path)
    assert none.returncode == 2 and "has 41 objects" in none.stderr and not (tmp_path / "short/tables.csv").exists()
    words = ("--set", "traffic.duration_s=60", "--set", "traffic.warmup_s=60", "--replicates", "2", "--out", "paper")
    first = cosim("reproduce", "tables", *words, cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    assert "TruPercept 3, no self-reports" in first.stdout and (tmp_path / "paper/tables.png").is_file()
    again = cosim("reproduce", "tables", *words, "--json", cwd=tmp_path)
    rows = pd.DataFrame(json.loads(again.stdout)["rows"])
    table = pd.read_csv(tmp_path / "paper/tables.csv")
    np.testing.assert_allclose(rows["mean"].astype(float), table["mean"])
    runs = {path.name for path in (tmp_path / "paper/runs").iterdir()}
    assert len(runs) == 16
    levels = cosim("reproduce", "trust-levels", *words, "--json", cwd=tmp_path)
    assert levels.returncode == 0, levels.stderr
    assert len(list((tmp_path / "paper/runs").iterdir())) == 16 + 8, "the honest ones are there already"
    assert any(row["what"].startswith("mean trust at the end") for row in json.loads(levels.stdout)["rows"])
