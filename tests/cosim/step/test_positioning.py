"""Position errors: their statistics, that they are each vehicle's own, and that they displace what is transmitted."""

import numpy as np
import pytest

from cosim.addons.perception.kitti_frames import actors_ahead, boxes_ahead
from cosim.config.config import load
from cosim.traffic.position_errors import GnssParams, PositionErrors
from results.archive import open_run
from tests.drive import assert_refused, cosim, drive

KEYS = np.random.default_rng(5).integers(0, 2**63, 4000).astype(np.uint64)


def walk(rows, steps, params, dt_s=1.0):
    """Errors of these vehicles, step by step [steps, vehicles, 3]."""
    errors, found = PositionErrors(), []
    for step in steps:
        errors, error = errors.next(step, rows, KEYS[rows], params, dt_s, 7)
        found.append(error)
    return np.array(found)


def test_standard_deviation_and_correlation():
    """4,000 vehicles, two axes: the standard error of a standard deviation is 0.8 %, of a correlation 0.011."""
    params = GnssParams(std_m=2.0, heading_std_deg=np.rad2deg(2.0), correlation_s=10.0)
    found = walk(np.arange(4000), range(0, 21, 5), params)
    assert found.std(axis=(1, 2)) == pytest.approx(2.0, rel=0.04)
    assert found[..., 2].std(axis=1) == pytest.approx(2.0, rel=0.05)
    for lag in range(1, 5):
        alike = (found[0] * found[lag]).mean() / 4.0
        assert alike == pytest.approx(np.exp(-5 * lag / 10.0), abs=0.05)
    assert abs((found[0, :, 0] * found[0, :, 1]).mean()) / 4.0 < 0.05, "east and north are independent"
    assert abs((found[0, :, 0] * found[0, :, 2]).mean()) / 4.0 < 0.05, "position and heading are independent"


def test_an_error_is_the_vehicles_own():
    params = GnssParams(std_m=1.0)
    everyone, few = walk(np.arange(9), range(6), params), walk(np.array([2, 7]), range(6), params)
    np.testing.assert_array_equal(everyone[:, [2, 7]], few)
    assert len(np.unique(everyone[0, :, :2])) == 18 and not everyone[..., 2].any()


def test_two_half_steps_have_the_correlation_of_one():
    params = GnssParams(std_m=1.0, correlation_s=4.0)
    whole, halves = walk(np.arange(4000), [0, 1], params, 2.0), walk(np.arange(4000), [0, 1, 2], params, 1.0)
    np.testing.assert_array_equal(whole[0], halves[0])
    assert (whole[0] * whole[1]).mean() == pytest.approx((halves[0] * halves[2]).mean(), abs=0.05)


@pytest.mark.parametrize("key", ["gnss.std_m=-1", "gnss.correlation_s=0", "gnss.sigma_m=1", "gnss.heading_std_deg=181"])
def test_bad_input(tmp_path, key):
    done = cosim("check", "--set", key)
    assert_refused(done, key.split("=")[0])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    common = (
        "traffic.duration_s=5",
        "traffic.warmup_s=300",
        "attacks.0.share_p=0",
        "attacks.1.share_p=0",
        "radio.model=unit_disk",
    )
    errors = {"off": (), "on": ("gnss.std_m=3",), "turned": ("gnss.std_m=1", "gnss.heading_std_deg=3")}
    return [open_run(drive(folder / name, *common, *sets)) for name, sets in errors.items()]


def by_detection(run):
    """Detections by step, the vehicle that sent them, and index."""
    boxes = run.detections.assign(observer=run.detections.observer.map(run.subjects.vehicle))
    return boxes.set_index(["step", "observer", "detection_index"])


def test_all_that_a_vehicle_transmits_is_displaced_by_its_error(runs):
    off, on, _ = runs
    assert not len(off.position_errors) and load(off.path / "config.toml").gnss.std_m == 0
    error = on.position_errors.rename(columns={"vehicle": "observer"})
    assert error.error_x_m.std() == pytest.approx(3.0, rel=0.3)
    tables = [by_detection(run) for run in (off, on)]
    there = tables[1].join(error.set_index(["step", "observer"]), on=["step", "observer"])
    assert there.index.equals(tables[0].index) and (there.origin == "self").any()
    for axis in "xy":
        shift = there[f"{axis}_m"] - there[f"error_{axis}_m"]
        np.testing.assert_allclose(shift, tables[0][f"{axis}_m"], atol=2.0**-6)
    assert (there.score == tables[0].score).all() and (there.n_points == tables[0].n_points).all()


def test_a_vehicles_own_view_stays_right_and_that_of_others_does_not(runs):
    """Returns inside its own boxes are the same; of boxes that others sent, fewer."""
    found = []
    for run in runs[:2]:
        seen = run.evaluations
        found.append(seen.assign(own=seen.evaluator == seen.observer).groupby("own").n_points.sum())
    assert found[1][True] == pytest.approx(found[0][True], rel=1e-3)
    assert found[1][False] < 0.8 * found[0][False]
    steps = np.arange(8)
    ahead = [boxes_ahead(run, "local", steps, actors_ahead(run, steps, 70.0)[1], 70.0) for run in runs[:2]]
    near = min(len(one) for one in ahead)
    assert abs(len(ahead[0]) - len(ahead[1])) <= 2, "at the edge of what is ahead, by rounding"
    assert np.median(np.abs(ahead[0].box[:near, 6] - ahead[1].box[:near, 6])) < 1e-6


def test_an_error_of_the_heading_turns_all_that_a_vehicle_transmits_around_it(runs):
    """By hand, from the tables: displaced by the position's error, turned around the true position."""
    off, _, on = runs
    assert not runs[1].position_errors.error_yaw_rad.any()
    error = on.position_errors.rename(columns={"vehicle": "observer"}).set_index(["step", "observer"])
    assert np.rad2deg(error.error_yaw_rad.std()) == pytest.approx(3.0, rel=0.3)
    tables = [by_detection(run) for run in (off, on)]
    actors = off.actors.rename(columns={"actor": "observer"}).set_index(["step", "observer"])[["x_m", "y_m"]]
    there = tables[1].join(error, on=["step", "observer"]).join(actors.add_suffix("_true"), on=["step", "observer"])
    assert there.index.equals(tables[0].index)
    relative = (tables[0].x_m - there.x_m_true) + 1j * (tables[0].y_m - there.y_m_true)
    placed = relative * np.exp(1j * there.error_yaw_rad)
    np.testing.assert_allclose(there.x_m - there.x_m_true - there.error_x_m, np.real(placed), atol=0.02)
    np.testing.assert_allclose(there.y_m - there.y_m_true - there.error_y_m, np.imag(placed), atol=0.02)
    turned = np.angle(np.exp(1j * (there.yaw_rad - tables[0].yaw_rad - there.error_yaw_rad)))
    assert np.abs(turned).max() < 2.0**-8  # headings are stored to 2**-9 rad


def test_average_precision_of_ones_own_sensor_does_not_depend_on_the_error_of_the_heading(runs):
    steps = np.arange(8)
    off, _, on = (boxes_ahead(run, "local", steps, actors_ahead(run, steps, 70.0)[1], 70.0) for run in runs)
    apart = np.abs(np.sort(off.box[:, 0])[:200] - np.sort(on.box[:, 0])[:200])
    assert np.median(apart) < 0.01
