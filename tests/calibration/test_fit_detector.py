"""The calibration sees what the metrics see: the detections of a run, made again, have the run's own figures."""

import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.addons.perception.detection import precision
from cosim.addons.perception.kitti import LEVELS
from results.archive import open_run
from sensors.statistical_detector import DetectorParams, resolved
from tests.calibration import fit_detector as calibrate
from tests.drive import drive


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrate") / "run"
    settings = ("traffic.duration_s=6", "traffic.warmup_s=200", "fleet.penetration_p=0.5", "attacks=[]")
    return open_run(drive(folder, *settings))


def test_the_same_figures_as_the_metrics(run):
    model = resolved(DetectorParams())
    one = calibrate.sample(run, "avod", model, 10_000)
    table = precision(run, ("local",), max_frames=10_000).set_index(["class", "level"])
    for label in ("car", "pedestrian"):
        answer = calibrate.figures(calibrate.reported([one], model, label), label)
        for level in LEVELS:
            assert answer[level].n_truth == table.n_truth[label, level]
            assert answer[level].ap40 == pytest.approx(table.ap40[label, level], abs=0.5)
        most = calibrate.ceiling([one], label)
        seen = calibrate.of_actors_with_returns([one], label, calibrate.reported([one], model))
        assert all(answer[level].ap11 <= most[level].ap11 for level in LEVELS)
        assert seen["easy"].n_truth == answer["easy"].n_truth and seen["all"].n_truth < answer["all"].n_truth


@pytest.mark.verify
def test_a_fit_moves_one_class_towards_its_aim(run, monkeypatch):
    start = resolved(DetectorParams())
    one = calibrate.sample(run, "avod", start, 10_000)
    monkeypatch.setattr(calibrate, "GENERATIONS", 2)
    aim = [30.0, 25.0, 20.0]
    model = calibrate.fit([one], "car", aim, start)
    before, after = (
        np.array([calibrate.figures(calibrate.reported([one], m, "car"), "car")[v].ap11 for v in LEVELS[:3]])
        for m in (start, model)
    )
    assert np.abs(after - aim).max() < np.abs(before - aim).max()
    assert all((getattr(model, name)[1:] == getattr(start, name)[1:]).all() for name in calibrate.FITTED)


def test_profiles_are_written_as_they_are_read(tmp_path):
    profile = {"source": "x [1, 2]", "first_guess": {"a": [1.0, 2.5], "b": [[0.0, 1e-3], [0.15, -2.0]], "c": 0.1}}
    calibrate.write(tmp_path / "p.toml", profile)
    text = (tmp_path / "p.toml").read_text()
    assert tomllib.loads(text) == profile and "b = [[0.0, 0.001], [0.15, -2.0]]" in text
    assert isinstance(calibrate.as_model(profile["first_guess"]), SimpleNamespace)
