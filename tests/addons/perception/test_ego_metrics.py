"""The paper's tables as facts against its text, and what is computed for them against plain loops."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cosim.addons.compare.facts import load
from cosim.addons.perception.kitti import STRICT, LabelledObjects, average_precision
from cosim.addons.perception.measures import ego_metrics
from results.archive import open_run
from tests import SHARED
from tests.drive import simulate

PAPER = SHARED / "paper/trupercept.tex"
DRIVES = Path(__file__).parents[3] / "cosim/addons/compare/scenes/paper-drives.toml"
METHODS = {
    "local": "AVOD", "trupercept_1": "TruPercept 1", "trupercept_2": "TruPercept 2", "trupercept_3": "TruPercept 3",
    "corrected": "Corrected",
}  # fmt: skip


def test_published_figures_are_those_of_the_paper():
    if not PAPER.is_file():
        pytest.skip(f"no paper at {PAPER}")
    facts, _ = load()
    text = re.sub(r"\\cellcolor\{[^}]*\}", "", PAPER.read_text())
    for method, name in METHODS.items():
        (row, *_) = re.findall(rf"^{name} &(.*)\\\\", text, re.M)
        stated = [value for label in ("car", "pedestrian") for value in facts[f"paper.ap.{method}.{label}"].value]
        assert [float(word) for word in row.split("&")] == stated
    good, unreliable, bad = (facts[f"paper.trust.{s}"].value[0] for s in ("trustworthy", "unreliable", "malicious"))
    assert f"{good:g} trustworthy, {unreliable:g} unreliable, and {bad:g} malicious" in text


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Ten seconds of the paper's drives, seen by every tenth vehicle; each changes its pseudonym after four."""
    folder = tmp_path_factory.mktemp("drive") / "run"
    sets = ("traffic.duration_s=10", "attacks.0.victim_p=0.1", "trust.method=local", "gnss.std_m=1")
    names = ("pseudonyms.policy=periodical", "pseudonyms.period_s=4")
    return open_run(simulate(folder, *sets, *names, config=DRIVES))


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
    vehicles, names = drive.vehicles, drive.pseudonyms.set_index("pseudonym")
    assert names.vehicle.duplicated().any()
    used = drive.trust[drive.trust.step <= drive.trust.subject.map(names.to_step)].sort_values("step")
    last = used.groupby(used.subject.map(names.vehicle)).trust.last()
    egos = set(ego_metrics.egos_of(drive))
    liars = set(drive.detections[drive.detections.lied].observer.map(drive.subjects.vehicle))
    for role in ("honest", "malicious"):
        mine = [v for v in vehicles[vehicles.equipped & (vehicles.role == role)].vehicle if v not in egos]
        mine = [v for v in mine if role == "honest" or v in liars]
        assert found["paper.final_trust.mean", role] == pytest.approx(np.mean([last.get(v, 0.5) for v in mine]))
    assert ego_metrics.of_egos(drive, metric="paper.final_trust.mean", groups=["malicious", "nobody"]) == pytest.approx(
        [found["paper.final_trust.mean", "malicious"], np.nan], nan_ok=True
    )
