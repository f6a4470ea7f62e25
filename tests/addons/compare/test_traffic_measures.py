"""Braking, speeds, headways and overlaps of cars, by hand on a few poses."""

from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pytest

from cosim.addons.compare.measures import measured
from tests.results.tiny import fleet, make


class Tiny:
    """Stands for a run with steps of 0.5 s: cars 1 and 2, pedestrian 3, each with (x, speed) per step on one line."""

    dt_s, path = 0.5, Path("tiny")

    def __init__(self, **tracks):
        self._rows = [
            {"step": step, "actor": int(name[1:]), "x_m": x, "y_m": 0.0, "z_m": 0.75, "yaw_rad": 0.0, "speed_mps": v}
            for name, track in tracks.items() for step, (x, v) in enumerate(track)
        ]  # fmt: skip
        self._rows.sort(key=lambda row: (row["step"], row["actor"]))  # as tables are

    def require(self, *names):
        pass

    def table(self, name, columns):
        about = {
            "vehicle": [1, 2, 3, 4], "sumo_id": ["a1", "a2", "a3", "parked/e/4"],
            "vehicle_class": ["car", "car", "pedestrian", "car"], "length_m": 5.0, "width_m": 2.0,
            "height_m": 1.5,
        }  # fmt: skip
        return pd.DataFrame(self._rows if name == "actors" else about)[columns]

    def sql(self, query, **values):
        with duckdb.connect() as database:
            database.register("actors", pd.DataFrame(self._rows))
            columns = ["vehicle", "sumo_id", "vehicle_class", "length_m", "width_m", "height_m"]
            database.register("vehicles", self.table("vehicles", columns))
            return database.execute(query, {"dt_s": self.dt_s} | values).df()


def value(name, run, **options):
    return float(measured(name, [[run]], options).value[0])


def test_sudden_slowing_by_hand():
    """Over one second (two steps): 12 to 8.5 is 3.5, 10 to 6 is 4, 8.5 to 4 is 4.5, all of one event from the first
    that reaches 3.576; 6 to 4 is 2; 4 to 4 ends it at 0. 48.5 m/s x 0.5 s are 24.25 m: 1 / 0.02425 km.
    The pedestrian, and a car that is gone for a step, do not count."""
    speeds = [12, 10, 8.5, 6, 4, 4, 4]
    run = Tiny(a1=[(0.0, v) for v in speeds], a3=[(90.0, v) for v in (9, 9, 1, 1)], a4=[(50.0, 0.0)] * 7)
    assert value("sudden_slowing", run, drop_mps=3.576) == pytest.approx(1000 / 0.02425)
    run._rows = [row for row in run._rows if row["step"] not in (2, 3)]
    assert value("sudden_slowing", run, drop_mps=3.576) == 0.0


def test_mild_braking_by_hand():
    """Decelerations of 2, 4, 0 (end), 3: two events with peaks of 4 and 3, of which one stays below 3.9."""
    run = Tiny(a1=[(0.0, v) for v in (10, 9, 7, 7, 5.5)])
    assert value("mild_braking", run, begin_mps2=1.0, limit_mps2=3.9) == 0.5


def test_mean_speed_counts_standing_cars_and_neither_pedestrians_nor_parked_cars():
    run = Tiny(a1=[(0.0, 10.0)], a2=[(50.0, 0.0)], a3=[(9.0, 1.0)], a4=[(60.0, 0.0)])
    assert value("mean_speed", run) == pytest.approx(3.6 * 5)


def test_steady_headway_by_hand():
    """20 m from centre to centre at 10 m/s is 2 s from front to front. In the first step the acceleration is unknown;
    in the third the leader is 2 m/s slower. The gap is 15 m."""
    run = Tiny(a1=[(0, 10), (5, 10), (10, 10)], a2=[(20, 10), (25, 10), (30, 8)])
    options = {"closing_mps": 1.52, "acceleration_mps2": 0.75, "range_m": 50.0, "longest_s": 3.0}
    assert value("steady_headway", run, slowest_mps=8.0, **options) == pytest.approx(2.0)
    assert np.isnan(value("steady_headway", run, slowest_mps=8.0, **options | {"longest_s": 1.9}))
    with pytest.raises(ValueError, match="no car followed"):
        measured("steady_headway", [[run]], {"slowest_mps": 11.0, **options})
    with pytest.raises(ValueError, match="no car followed"):
        measured("steady_headway", [[run]], {"slowest_mps": 8.0, **options, "range_m": 14.0})


def test_times_between_cams_by_hand():
    """At steps of 0.1 s, a car has moved 6 m at step 2 and then stands: three CAMs follow at the same 0.2 s, and the
    next after a second. A pedestrian sends none."""
    run = Tiny(a1=[(min(3 * step, 6), 0.0) for step in range(19)], a3=[(9.0 * step, 9.0) for step in range(19)])
    run.dt_s = 0.1
    assert value("cam_interval", run) == pytest.approx((4 * 0.2 + 1.0) / 5)
    found = measured("cam_interval_shares", [[run]], {"edges_s": [0.0, 0.3, 0.9, 1.0]})
    assert found.value == pytest.approx([0.8, 0.0, 0.2])


def test_cams_after_changes_of_speed_and_heading_by_hand():
    """In one place, on paper: 0.6 m/s faster at step 4; two steps later turned by 4.1 degrees, across south."""
    run = Tiny(a1=[(0.0, speed) for speed in (0.0, 0.1, 0.2, 0.4, 0.6, 0.6, 0.6)])
    for row, degrees in zip(run._rows, (178, 178, 178, 178, 178, -178.1, -177.9), strict=True):
        row["yaw_rad"] = np.radians(degrees)
    run.dt_s = 0.1
    found = measured("cam_interval_shares", [[run]], {"edges_s": [0.0, 0.2, 0.3, 0.4]})
    assert found.value.tolist() == [0.5, 0.0, 0.5]


def test_overlaps_by_hand():
    """Two cars of 5 m overlap by 1 m in two steps: one pair. 20 m/s x 2 x 0.5 s are 0.02 km."""
    run = Tiny(a1=[(0, 10), (5, 10)], a2=[(4, 10), (9, 10)])
    assert np.isclose(value("overlapping", run), 1e6 / 0.02)


def test_littles_law_by_hand(tmp_path):
    """Two cars are 90 m apart in steps 2 to 5 of 20, else 110 m. Each has one contact in 20 s, for 4 s, and 0.2
    neighbours: 0.05 x 4 / 0.2. A duration of 8 s that is wrong doubles it. Other definitions of the run change nothing:
    one with a hysteresis, by which the two meet for 8 s, and one with pedestrians."""
    met = {"a": 0, "b": 1, "pairs": "all", "start_step": 2, "radius_m": 100.0}
    actors = [
        {"step": step, "actor": car, "x_m": car * (90.0 if 2 <= step < 6 else 110.0)}
        for step in range(20) for car in (0, 1)
    ]  # fmt: skip
    cars = fleet("honest", "honest", vehicle_class="car")
    for n, folder in ((1, tmp_path / "right"), (2, tmp_path / "wrong")):
        folder.mkdir()
        run = make(
            folder, 20, vehicles=[dict(car) for car in cars], actors=actors,
            encounters=[met | {"end_step": 2 + 4 * n},
                        *(met | {"end_step": 10} | more for more in ({"hysteresis_s": 3}, {"pedestrians": True}))],
        )  # fmt: skip
        assert value("littles_law", run, radius_m=100.0) == pytest.approx(n)
