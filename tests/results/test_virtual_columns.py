"""Columns of `fused` that are not on disk: those of the detection that a row names."""

import numpy as np
import pyarrow.compute as pc
import pytest

from results.archive import open_run
from results.tables import TABLES
from tests.results.tiny import fleet


@pytest.fixture
def run(tiny):
    """Vehicle 1 accepts detection 3 of vehicle 0 with the pose of detection 5 of vehicle 2, and its own detection 1."""
    size = {"length_m": 4, "width_m": 2, "height_m": 1.5}
    detections = [
        {"step": s, "observer": o, "detection_index": k, "class": label, "x_m": 10 * o + s,
         "yaw_rad": o, "truth_actor": who, **size}
        for s in (0, 12) for o, k, label, who in ((0, 3, "truck", 7), (1, 1, "car", None), (2, 5, "car", 8))
    ]  # fmt: skip
    fused = [
        {"step": s, "observer": 1, "fused_index": i, **row}
        for s in (0, 12)
        for i, row in enumerate(({"source": 0, "source_index": 3, "pose": 2, "pose_index": 5},
                                 {"source": 1, "source_index": 1}))
    ]  # fmt: skip
    return tiny(20, vehicles=fleet(*["honest"] * 9), detections=detections, fused=fused)


def test_box_of_the_source_and_pose_of_another(run):
    frame = run.fused
    assert list(frame.columns) == list(TABLES["fused"].columns)
    assert frame["class"].tolist() == ["truck", "car"] * 2
    assert frame.x_m.tolist() == [20, 10, 32, 22]
    assert frame.yaw_rad.tolist() == [2, 1, 2, 1]
    assert frame.truth_actor.fillna(-1).tolist() == [7, -1, 7, -1]


def test_fused_boxes_differ_from_the_source_by_what_was_moved(tiny):
    """A box of 4 m at x = 10 with a heading of 3.1 is fused to 4.25 m at 10.5, turned by 0.125 beyond pi."""
    size = {"length_m": 4, "width_m": 2, "height_m": 1.5}
    one = {"step": 0, "observer": 0, "detection_index": 1, "class": "car", "x_m": 10, "yaw_rad": 3.1, **size}
    moved = {"moved_x_m": 0.5, "moved_length_m": 0.25, "moved_height_m": -0.25, "moved_yaw_rad": 0.125}
    row = {"step": 0, "observer": 1, "fused_index": 0, "source": 0, "source_index": 1, **moved}
    run = tiny(2, vehicles=fleet("honest", "honest"), detections=[one], fused=[row])
    box = run.fused.iloc[0]
    assert (box.x_m, box.length_m, box.width_m, box.height_m) == (10.5, 4.25, 2, 1.25)
    assert box.yaw_rad == pytest.approx(3.225 - 2 * np.pi, abs=2e-3)
    assert run.table("fused", ["width_m"], pc.field("length_m") > 4.2).width_m.tolist() == [2]
    assert run.table("fused", ["width_m"], pc.field("length_m") < 4.2).empty


def test_columns_and_rows_on_demand(run):
    assert run.table("fused", ["x_m"]).x_m.tolist() == [20, 10, 32, 22]
    assert run.table("fused", ["x_m", "fused_index"], pc.field("step") == 12).x_m.tolist() == [32, 22]
    assert run.table("fused", ["fused_index"], pc.field("truth_actor") == 7).fused_index.tolist() == [0, 0]
    assert run.table("fused", ["score", "x_m"], pc.field("x_m") > 21).x_m.tolist() == [32, 22]
    assert [part.x_m.tolist() for part in run.parts("fused", ["x_m"])] == [[20, 10], [32, 22]]


def test_names_decide_not_positions(run):
    frame = run.fused.set_index(["step", "source", "source_index"])
    named = run.detections.set_index(["step", "observer", "detection_index"])
    assert np.array_equal(frame.length_m, named.length_m.reindex(frame.index))


def test_what_is_named_must_be_there(run):
    part = run.path / "detections" / "part-00001.parquet"
    part.unlink()
    with pytest.raises(ValueError, match=r"damaged: detections/part-00001\.parquet"):
        open_run(run.path).table("fused", ["x_m"])
    assert len(open_run(run.path).table("fused", ["score"])) == 4
    (run.path / "detections" / "part-00000.parquet").rename(part)
    with pytest.raises(ValueError, match=r"damaged: detections/part-0000[01]\.parquet"):
        open_run(run.path).fused.head()
    part.unlink()
    part.parent.rmdir()
    with pytest.raises(ValueError, match="damaged: detections/part-00000"):
        open_run(run.path).fused.head()
