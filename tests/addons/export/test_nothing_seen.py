"""Every export of a run, or of steps, in which nothing is seen goes on, or says in one line what is missing."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.base.earth import Projection
from cosim.door.kinds import KINDS
from tests.addons.export import truck


def self_report(table, row):
    return table == "detections" and row["detection_index"] == 0


KEPT = {
    "nothing at all": (lambda table, row: False, np.arange(4)),
    "self reports alone": (self_report, np.arange(4)),
    "nothing in the last steps": (lambda table, row: row["step"] < 2, np.arange(2, 4)),
    "self reports in the last steps": (lambda table, row: row["step"] < 2 or self_report(table, row), np.arange(2, 4)),
}


@pytest.fixture(scope="module", params=KEPT)
def chosen(request, tmp_path_factory):
    """Vehicles of a run, and steps in which none of them sees anything."""
    keep, steps = KEPT[request.param]
    run = truck.make(tmp_path_factory.mktemp("nothing") / "run", keep)
    assert not run.observability.step.isin(steps).any()
    return replace(truck.selection(run), projection=lambda: Projection(60.0, 25.0), steps=steps)


EXPORTERS = KINDS["exporter"].shipped


@pytest.mark.parametrize("form", EXPORTERS)
def test_all_formats(chosen, form, tmp_path):
    if form == "mcap":
        pytest.importorskip("mcap")
    detections = chosen.run.detections
    if form == "veremi-nextgen" and not detections.step.isin(chosen.steps).any():
        with pytest.raises(ValueError, match="no self report"):
            EXPORTERS[form]().plan(chosen)
        return
    files = truck.written(EXPORTERS[form]().plan(chosen), tmp_path)
    assert files
    if form == "kitti":
        labels = [content for path, content in files.items() if "/label_2/" in path]
        assert len(labels) == len(chosen.presence)
        assert set(labels) == {b"DontCare -1 -1 -10 0 0 0 0 -1 -1 -1 -1000 -1000 -1000 -10\n"}
