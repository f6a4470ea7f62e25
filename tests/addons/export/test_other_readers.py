"""Exports as readers of other projects take them, which `make verify` installs: pypcd4, pykitti, TrackEval, PyYAML."""

import shutil

import pytest

from cosim.addons.export import kitti, opv2v
from tests.addons.export import truck


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_opv2v_by_pypcd4_and_pyyaml(run, tmp_path):
    pypcd4, yaml = pytest.importorskip("pypcd4"), pytest.importorskip("yaml")
    truck.written(opv2v.Opv2v().plan(truck.selection(run)), tmp_path)
    for path in tmp_path.rglob("*.pcd"):
        cloud = pypcd4.PointCloud.from_path(path)
        assert cloud.fields == ("x", "y", "z", "rgb") and cloud.points == 3
        said = yaml.safe_load(path.with_suffix(".yaml").read_text())
        assert len(said["lidar_pose"]) == 6 and all(len(v["extent"]) == 3 for v in said["vehicles"].values())


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_kitti_by_pykitti(run, tmp_path):
    utils = pytest.importorskip("pykitti.utils")
    made = truck.written(kitti.Kitti().plan(truck.selection(run)), tmp_path)
    for name in made:
        if name.startswith("object/training/velodyne"):
            assert utils.load_velo_scan(tmp_path / name).shape == (3, 4)
        if name.startswith("object/training/calib"):
            assert utils.read_calib_file(tmp_path / name)["P2"].reshape(3, 4)[0].tolist() == [960, 0, 960, 0]


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_kitti_tracking_by_trackeval(run, tmp_path):
    """Its labels as truth and as a tracker's answer: everything is found."""
    trackeval = pytest.importorskip("trackeval")
    made = truck.written(kitti.Kitti().plan(truck.selection(run)), tmp_path)
    truth, answer = tmp_path / "truth", tmp_path / "trackers/same/data"
    answer.mkdir(parents=True)
    shutil.copytree(tmp_path / "tracking/training/label_02", truth / "label_02")
    rows = []
    for path in sorted((truth / "label_02").iterdir()):
        lines = [line for line in path.read_text().splitlines() if "DontCare" not in line]
        (answer / path.name).write_text("".join(f"{line} 1.0\n" for line in lines))
        n = sum(name.startswith(f"tracking/training/velodyne/{path.stem}/") for name in made)
        rows.append(f"{path.stem} empty 000000 {n:06d}\n")
    (truth / "evaluate_tracking.seqmap.training").write_text("".join(rows))
    quiet = {"PRINT_CONFIG": False}
    data = trackeval.datasets.Kitti2DBox(quiet | {
        "GT_FOLDER": str(truth), "TRACKERS_FOLDER": str(tmp_path / "trackers"), "TRACKERS_TO_EVAL": ["same"],
        "CLASSES_TO_EVAL": ["car"], "SPLIT_TO_EVAL": "training",
    })  # fmt: skip
    off = ("USE_PARALLEL", "PRINT_RESULTS", "OUTPUT_SUMMARY", "OUTPUT_DETAILED", "PLOT_CURVES", "TIME_PROGRESS")
    judge = trackeval.Evaluator(quiet | {"BREAK_ON_ERROR": True} | dict.fromkeys(off, False))
    found, _ = judge.evaluate([data], [trackeval.metrics.CLEAR()])
    clear = found["Kitti2DBox"]["same"]["COMBINED_SEQ"]["car"]["CLEAR"]
    assert clear["MOTA"] == 1 and clear["CLR_TP"] > 0
