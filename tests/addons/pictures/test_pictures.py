"""A run's sweeps, cast again from its tables, as pictures and as point clouds."""

import io
from pathlib import Path

import numpy as np
import pytest

from cosim.addons.pictures import pictures
from cosim.runs import replay_lidar
from results.archive import open_run
from sensors.range_steps import NO_RETURN
from tests.drive import assert_refused, cosim, drive


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return drive(
        tmp_path_factory.mktemp("pictures") / "run", "traffic.duration_s=6", "traffic.warmup_s=120", "gnss.std_m=3"
    )


def test_plot_sweep(folder, tmp_path):
    run = open_run(folder)
    sensed = run.detections
    sensed = sensed[(sensed.step == 4) & (sensed.origin == "sensed")]
    vehicle = int(sensed.observer.value_counts().index[0])
    seen = pictures.replay_scan(run, vehicle, 4)
    assert len(seen.reported) == (sensed.observer == vehicle).sum() and len(seen.actors) > 0
    me = run.actors[(run.actors.step == 4) & (run.actors.actor == vehicle)].iloc[0]
    errors = run.position_errors
    error = errors[(errors.step == 4) & (errors.vehicle == vehicle)].iloc[0]
    assert np.hypot(error.error_x_m, error.error_y_m) > 0.05, "boxes are where the LiDAR measured them nevertheless"
    heading, listed = me.yaw_rad + error.error_yaw_rad, sensed[sensed.observer == vehicle]
    east_m, north_m = listed.x_m - me.x_m - error.error_x_m, listed.y_m - me.y_m - error.error_y_m
    ahead_m = np.cos(heading) * east_m + np.sin(heading) * north_m
    assert seen.reported.xyz_m[:, 0] == pytest.approx(ahead_m, abs=0.02)
    words = ("plot", "sweep", str(folder), "--vehicle", str(vehicle), "--step", "4", "--out")
    for name in ("above.png", "cloud.npy"):
        done = cosim(*words, str(tmp_path / name))
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "above.png").stat().st_size > 10_000
    points = np.load(io.BytesIO((tmp_path / "cloud.npy").read_bytes()))
    assert len(points) == (seen.sweeps.range_steps != NO_RETURN).sum() and np.abs(points).max() < 81


@pytest.mark.parametrize(
    ("vehicle", "step", "out", "says"),
    [
        (0, 99, None, "no vehicle sensed then"),
        (99_999, 2, None, "no sensor on the road"),
        (None, 2, Path("cloud.las"), "neither a picture"),
    ],
)
def test_mistakes(folder, vehicle, step, out, says):
    run = open_run(folder)
    there = run.actors[run.actors.step == step].actor
    sensing = run.vehicles.vehicle[run.vehicles.equipped & run.vehicles.vehicle.isin(there)]
    with pytest.raises(ValueError, match=says):
        pictures.sweep([run], [int(sensing.iloc[0]) if vehicle is None else vehicle], step, out)


def test_a_mistake_is_one_line(folder):
    done = cosim("plot", "sweep", str(folder), "--step", "2")
    assert_refused(done, "plot sweep RUN")


def test_plot_scene(folder, tmp_path):
    """The city at one moment; clouds in the world frame lie where the actors that returned them are."""
    run = open_run(folder)
    out = pictures.scene([run], [], 4, tmp_path / "scene.png")
    assert out.stat().st_size > 50_000
    config = replay_lidar.config_of(run)
    world = next(replay_lidar.worlds(run, np.array([4])))
    sweeps = replay_lidar.sweep(config, replay_lidar.city_of(config), world, np.flatnonzero(world.equipped)[:4])
    for o in range(4):
        xyz, hit = sweeps.poses.to_world(o, sweeps.xyz(o)), sweeps.hit[o][sweeps.has_return(o)]
        of = hit[hit >= 3] - 3
        away = np.abs(xyz[hit >= 3] - world.boxes.xyz_m[of])
        assert (
            np.linalg.norm(away[:, :2], axis=1) < 0.5 * np.linalg.norm(world.boxes.lwh_m[of, :2], axis=1) + 0.2
        ).all()
    done = cosim("plot", "scene", str(folder), "--step", "4", "--vehicle", "999999", "--out", str(tmp_path / "no.png"))
    assert_refused(done, "--vehicle 999999 has no sensor on the road in step 4")
    done = cosim("plot", "scene", str(folder))
    assert_refused(done)
