"""Point clouds as other tools read them."""

import io

import numpy as np
import pytest

from cosim.addons.pictures import clouds
from sensors.scene import Hit
from tests.sensors.town import blocks, exact, traffic


@pytest.fixture(scope="module")
def sample():
    rng = np.random.default_rng(0)
    boxes, shape = traffic(rng, 60)
    sweeps = exact(boxes, shape, np.flatnonzero(shape == 0)[:9], blocks(rng))
    return clouds.cloud_of(sweeps, int(np.argmax((sweeps.hit == Hit.BUILDING).sum(axis=(1, 2)))))


def test_numpy_and_kitti(sample):
    xyz, hit = sample
    assert len(xyz) == len(hit) > 1000 and {Hit.GROUND, Hit.BUILDING} <= set(hit.tolist()) and hit.min() > Hit.NOTHING
    assert np.load(io.BytesIO(clouds.npy(sample))) == pytest.approx(xyz, abs=1e-5)
    rows = np.frombuffer(clouds.kitti(sample), "<f4").reshape(-1, 4)
    assert rows[:, :3] == pytest.approx(xyz, abs=1e-5) and not rows[:, 3].any()


@pytest.mark.parametrize("form", [".ply", ".pcd", ".pcd.txt"])
def test_ply_and_pcd_as_open3d_reads_them(sample, form, tmp_path):
    open3d = pytest.importorskip("open3d")
    path = tmp_path / ("cloud" + form.removesuffix(".txt"))
    path.write_bytes(clouds.FORMATS[form](sample))
    read = open3d.t.io.read_point_cloud(str(path))
    assert read.point.positions.numpy() == pytest.approx(sample[0], abs=1e-4)
    assert (read.point["hit"].numpy()[:, 0] == sample[1]).all()


def test_no_returns():
    nothing = np.zeros((0, 3)), np.zeros(0, np.int32)
    assert all(b"0" in write(nothing) or write(nothing) == b"" for write in clouds.FORMATS.values())


def test_single_precision_is_the_rounded_cloud():
    rng = np.random.default_rng(3)
    boxes, shape = traffic(rng, 40)
    sweeps = exact(boxes, shape, np.flatnonzero(shape == 0)[:4], blocks(rng))
    for o in range(4):
        assert sweeps.cloud(o).tobytes() == sweeps.xyz(o).astype(np.float32).tobytes()
