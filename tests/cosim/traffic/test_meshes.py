"""Meshes from files: evaluated as prisms are, by the columnar caster, and refused in one line."""

import importlib.util
import logging

import numpy as np
import pytest

from cosim.config.config import load
from cosim.runs import replay_lidar
from cosim.runs.check import changed_since
from cosim.runs.run import resume
from cosim.studies.points import identity
from cosim.traffic.meshes import MeshParams, VehicleMeshParams, read, with_meshes
from results.archive import open_run
from results.manifest import read_manifest
from sensors.boxes import Boxes
from sensors.evidence import observability
from sensors.lidar import LidarParams, scan
from sensors.raycast.mesh import body_triangles
from sensors.scene import Hit, Scene, Shape, prisms
from tests.drive import cosim, drive
from tests.refusals import refused_in_one_line
from tests.sensors.town import boxes_at

trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed: make extra NAME=mesh")

SIZE = (12.0, 6.0, 9.0)

ENGINES = pytest.mark.parametrize("engine", ["embree", pytest.param("open3d", marks=pytest.mark.skipif(
    importlib.util.find_spec("open3d") is None, reason="Open3D is not installed: make extra NAME=open3d"
))])  # fmt: skip


each_form = pytest.fixture(scope="module", params=["obj", "ply", "stl", "glb"])


def exported(mesh, request, tmp_path_factory):
    """A mesh as a file of the form that is asked for."""
    if request.param == "glb":  # y is up there
        mesh.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    path = tmp_path_factory.mktemp("mesh") / f"mesh.{request.param}"
    mesh.export(path)
    return path


@each_form
def house(request, tmp_path_factory):
    """A box on the ground around its origin, 12 m long, 6 m wide and 9 m high, as a file of each form."""
    box = trimesh.creation.box(SIZE)
    box.apply_translation((0, 0, SIZE[2] / 2))
    return exported(box, request, tmp_path_factory)


def sweep(scene, engine):
    n = 6
    angle = np.arange(n)
    xyz = np.column_stack([40 + 25 * np.cos(angle), -20 + 25 * np.sin(angle), np.full(n, 0.75)])
    cars = boxes_at(xyz, (4.5, 1.8, 1.5), angle + np.pi)
    params = LidarParams(profile="vlp16", range_sigma_m=0.0, engine=engine)
    return scan(cars, np.zeros(n, np.uint8), np.arange(n), scene, params, np.arange(n, dtype=np.uint64), unrounded=True)


@ENGINES
def test_a_house_of_triangles_is_seen_as_one_of_prisms(house, engine):
    """Turned by 30 degrees and moved: 99.99 % of the rays agree to 1 mm with the columnar caster's prism."""
    cos, sin = np.cos(np.pi / 6), np.sin(np.pi / 6)
    corner = np.array([[-6, -3], [6, -3], [6, 3], [-6, 3]]) @ np.array([[cos, sin], [-sin, cos]]) + [40, -20]
    prism = sweep(Scene.from_footprints([[corner]], [0.0], [SIZE[2]]), "columnar")
    mesh = sweep(with_meshes(Scene.empty(), [MeshParams(file=str(house), at_m=(40, -20, 0), yaw_deg=30)]), engine)
    far = [np.where(np.isfinite(s.unrounded_m), s.unrounded_m, 1e3) for s in (prism, mesh)]
    differ = np.abs(far[0] - far[1]) > 1e-3
    assert (prism.hit == 2).sum() > 2000, "the house is seen"
    assert differ.mean() <= 1e-4 and (prism.hit != mesh.hit)[~differ].mean() <= 1e-4


def test_scale(house):
    half = with_meshes(Scene.empty(), [MeshParams(file=str(house), scale=0.5)])
    assert half.triangles_m.max(axis=(0, 1)) == pytest.approx([3, 1.5, 4.5])
    assert half.triangles_m.min(axis=(0, 1)) == pytest.approx([-3, -1.5, 0])


def test_mistakes_are_one_line(tmp_path):
    torn = trimesh.creation.box(SIZE)
    torn.update_faces(np.arange(12) > 0)
    torn.export(tmp_path / "torn.obj")
    (tmp_path / "broken.glb").write_bytes(b"no mesh at all")
    (tmp_path / "empty.ply").write_text("")
    for name, says in (
        ("torn.obj", "open edges"), ("broken.glb", "cannot be read as a mesh"), ("empty.ply", "empty.ply: "),
        ("house.dwg", "no such form of mesh"), ("nowhere.stl", "no such file"),
    ):  # fmt: skip
        with refused_in_one_line(rf"meshes\.0\.file.*{says}"):
            with_meshes(Scene.empty(), [MeshParams(file=str(tmp_path / name))])


def test_in_the_config(house, tmp_path):
    config = tmp_path / "mine.toml"
    (tmp_path / house.name).write_bytes(house.read_bytes())
    config.write_text(f'lidar.engine = "embree"\n[[meshes]]\nfile = "{house.name}"\nat_m = [1, 2, 3]\n')
    (mesh,) = load(config).meshes
    assert mesh.file == str(tmp_path / house.name) and mesh.at_m == (1, 2, 3), "beside the config, wherever one stands"
    assert len(read("meshes.0.file", house)[1]) == 12
    config.write_text(f'[[meshes]]\nfile = "{house.name}"\n')
    with pytest.raises(ValueError, match=r'lidar\.engine = "columnar" cannot cast rays at meshes'):
        load(config)


@each_form
def car(request, tmp_path_factory):
    """The prisms of a car of 10 x 4 x 3 units as a file of each form."""
    unit = boxes_at((0.0, 0.0, 0.0), (10.0, 4.0, 3.0))
    triangles = body_triangles(prisms(np.array([Shape.CAR], np.uint8), unit))
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False)
    return exported(mesh, request, tmp_path_factory)


@ENGINES
def test_cars_of_triangles_are_seen_as_those_of_prisms(car, engine):
    """Turning cars of several sizes around vans with sensors: 99.99 % of the rays agree to 1 mm with the prisms'.

    A mesh fills its box and prisms do not quite: the cars of triangles have the extent of the prisms for a box.
    """
    rng = np.random.default_rng(5)
    n, van = 40, 4
    shape = np.where(np.arange(n) < van, Shape.VAN, Shape.CAR).astype(np.uint8)
    lwh = rng.uniform([3.5, 1.6, 1.4], [5.5, 2.1, 1.9], (n, 3))
    xyz = np.column_stack([rng.uniform(-45, 45, (n, 2)), 0.5 * lwh[:, 2]])
    boxes = Boxes(xyz, lwh, rng.uniform(-np.pi, np.pi, n))
    unit = body_triangles(prisms(np.array([Shape.CAR], np.uint8), boxes_at((0.0, 0.0, 0.0))))
    low, high = unit.min(axis=(0, 1)), unit.max(axis=(0, 1))
    ahead = np.column_stack([np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)])
    middle = 0.5 * (low + high) * lwh
    cars = shape == Shape.CAR
    own_xyz, own_lwh = xyz.copy(), lwh.copy()
    own_xyz[cars, :2] += middle[cars, :1] * ahead[cars]
    own_xyz[cars, 2] += middle[cars, 2]
    own_lwh[cars] *= high - low
    seen = [
        scan(
            b,
            shape,
            np.arange(van),
            scene,
            LidarParams(profile="os1_64", range_sigma_m=0.0, engine=name),
            keys,
            unrounded=True,
        )
        for b, scene, name, keys in (
            (boxes, Scene.empty(), "columnar", np.zeros(van, np.uint64)),
            (
                Boxes(own_xyz, own_lwh, boxes.yaw_rad),
                with_meshes(Scene.empty(), [], [VehicleMeshParams(file=str(car))]),
                engine,
                np.zeros(van, np.uint64),
            ),
        )
    ]
    far = [np.where(np.isfinite(s.unrounded_m), s.unrounded_m, 1e3) for s in seen]
    differ = np.abs(far[0] - far[1]) > 1e-3
    assert (seen[0].hit >= Hit.ACTOR + van).sum() > 3000, "cars are seen"
    assert differ.mean() <= 1e-4 and (seen[0].hit != seen[1].hit)[~differ].mean() <= 1e-4
    counted = observability(seen[1], boxes, shape)
    assert (counted.n_returns <= counted.n_unoccluded).all()


def test_mistakes_with_vehicles_are_one_line(car, tmp_path):
    torn = trimesh.creation.box(SIZE)
    torn.update_faces(np.arange(12) > 0)
    torn.export(tmp_path / "torn.obj")
    with pytest.raises(ValueError, match=r"vehicle_meshes\.0\.file = .*open edges"):
        with_meshes(Scene.empty(), [], [VehicleMeshParams(file=str(tmp_path / "torn.obj"))])
    config = tmp_path / "mine.toml"
    section = f'[[vehicle_meshes]]\nfile = "{car}"\n'
    config.write_text(section)
    with pytest.raises(ValueError, match=r"columnar.*\[\[vehicle_meshes\]\]"):
        load(config)
    config.write_text('lidar.engine = "embree"\n' + 2 * section)
    with pytest.raises(ValueError, match=r'vehicle_meshes\.1\.vehicle_class = "car" has a mesh already'):
        load(config)
    config.write_text('lidar.engine = "embree"\n' + section + 'vehicle_class = "boat"\n')
    with pytest.raises(ValueError, match=r"vehicle_meshes\.0\.vehicle_class"):
        load(config)
    bodies = with_meshes(Scene.empty(), [], [VehicleMeshParams(file=str(car))])
    with pytest.raises(ValueError, match="casts upright prisms"):
        sweep(bodies, "columnar")


@pytest.mark.verify
def test_a_mesh_that_was_changed_is_noticed(tmp_path, caplog):
    """By a resumed run, a run of the same config, a replay and a study; another name for the same content is none."""
    body = tmp_path / "body.ply"
    trimesh.creation.box((4, 2, 1.5)).export(body)
    config = tmp_path / "mine.toml"
    text = 'lidar.engine = "embree"\n[[vehicle_meshes]]\nfile = "body.ply"\n'
    config.write_text(text)
    folder = drive(tmp_path / "run", "traffic.duration_s=2", "traffic.warmup_s=30", config=config)
    before, named = read_manifest(folder)["net"], identity(load(config))
    assert len(before["sha256 vehicle_meshes.0.file"]) == 64
    assert changed_since(folder / "config.toml", load(folder / "config.toml")) == []
    trimesh.creation.box((4, 2, 1.5)).export(tmp_path / "other.ply")
    config.write_text(text.replace("body", "other"))
    assert identity(load(config)) == named
    trimesh.creation.cylinder(1, 2).export(body)
    config.write_text(text)
    assert identity(load(config)) != named
    (remark,) = changed_since(folder / "config.toml", load(folder / "config.toml"))
    assert "vehicle_meshes.0.file" in remark
    checked = cosim("check", str(folder / "config.toml"))
    assert checked.returncode == 0 and "vehicle_meshes.0.file" in checked.stderr
    with pytest.raises(ValueError, match=r"inputs have changed since: sha256 vehicle_meshes\.0\.file"):
        resume(folder, lambda *step: None)
    with caplog.at_level(logging.WARNING):
        replay_lidar.config_of(open_run(folder))
    assert caplog.messages[-1].endswith("changed since it was recorded: vehicle_meshes.0.file")
