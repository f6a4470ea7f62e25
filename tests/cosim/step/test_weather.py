"""What fog does to evaluations: beyond the reach of its sensor, a vehicle sees nothing and knows it, or does not."""

import numpy as np
import pytest

from cosim.config.config import load
from cosim.step.parts import seen_in_weather
from results.archive import open_run
from tests.drive import drive
from tests.slow import slow

DENSE = "fleet.penetration_p=0.6"
FOG = ("preset=modern", "weather.visibility_m=50")


@pytest.mark.parametrize(
    ("sets", "area_m", "lidar_m"),
    [
        (FOG, 23.9, 23.9),
        ((*FOG, "weather.known=false"), 70.0, 100.0),
        ((*FOG, "area.range_m=20"), 20.0, 23.9),
        (("preset=modern", "lidar.max_range_m=50"), 50.0, 50.0),
        ((*FOG, "weather.known=false", "lidar.max_range_m=50"), 50.0, 50.0),
    ],
)
def test_the_area_that_is_evaluated_ends_where_the_road_returns_nothing(sets, area_m, lidar_m):
    """By hand, for 100 m in clear air: alpha = ln 20 / 50 = 0.05991; x = alpha 100 = 5.991; W(x) = 1.4315, because
    1.4315 e^1.4315 = 5.991; R = 1.4315 / 0.05991 = 23.9 m."""
    area, lidar = seen_in_weather(load(None, sets))
    assert area.range_m == pytest.approx(area_m, abs=0.05)
    assert lidar.max_range_m == pytest.approx(lidar_m, abs=0.05)


@pytest.mark.parametrize("is_known", [slow(True), False])
def test_true_detections_beyond_the_reach_are_denied_by_those_who_do_not_know_it(tmp_path, is_known):
    sets = (*FOG, DENSE, f"weather.known={str(is_known).lower()}", "traffic.duration_s=3", "record.level=full")
    run = open_run(drive(tmp_path / "run", *sets, "attacks=[]"))
    seen = run.evaluations.merge(
        run.detections[["step", "observer", "detection_index", "truth_actor"]],
        on=["step", "observer", "detection_index"],
    )
    seen = seen[(seen.visibility > 0) & (seen.evaluator != seen.observer)].dropna(subset="truth_actor")
    assert len(seen) > 100
    assert (np.mean(seen.evaluation < 0) < 0.1) == is_known
