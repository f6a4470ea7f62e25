"""The shipped city: whole, clean, and what its catalogue entry says."""

import gzip
import hashlib
import re
import subprocess

import pytest
import shapely

from sumo_nets import catalogue, sumotools
from sumo_nets.ground import ground_of
from sumo_nets.network import check_for_cars

CITY = catalogue.find("helsinki")
FILES = sorted(path for path in CITY.folder.iterdir() if path.is_file())


def test_the_catalogue_lists_it():
    assert "helsinki" in catalogue.names()
    assert CITY.licence == "ODbL-1.0"
    assert CITY.attribution == "© OpenStreetMap contributors"
    assert CITY.attribution in (CITY.folder / "LICENSE").read_text(encoding="utf-8")
    width, height = CITY.size_m
    assert 900 < width < 1200
    assert 1500 < height < 1900
    assert CITY.end_s - CITY.warm_up_s >= 7200
    check_for_cars(CITY.net_path)


def test_an_unknown_city_is_named_with_those_there_are():
    with pytest.raises(ValueError, match=r"'atlantis' does not ship with cosim; there are: .*helsinki"):
        catalogue.find("atlantis")


def test_every_file_has_the_checksum_that_was_written_down():
    written = {}
    for line in (CITY.folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines():
        digest, name = line.split("  ")
        written[name] = digest
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in FILES}
    assert written == {name: found[name] for name in found if name not in ("SHA256SUMS", "README.md")}


def test_it_is_small():
    assert all(path.stat().st_size < 2_000_000 for path in FILES)
    assert sum(path.stat().st_size for path in FILES) < 4_000_000


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_no_file_names_a_machine_or_a_day(path):
    raw = path.read_bytes()
    if raw[:2] == b"\x1f\x8b":
        assert raw[3] == 0, "the gzip header names a file"
        assert raw[4:8] == b"\0\0\0\0", "the gzip header names a time"
        raw = gzip.decompress(raw)
    text = raw.decode("utf-8")
    assert not re.search(r"(?<![\w.:/])/(tmp|home|root|usr|var|opt|work|Users|mnt)\b|[A-Z]:\\\\|site-packages", text)
    assert "generated on" not in text


def test_buildings_are_valid_stand_upright_and_inside_the_city():
    footprints = CITY.footprints()
    polygons = [footprint.polygon for footprint in footprints]
    assert len(footprints) > 500
    assert all(polygon.is_valid and polygon.area > 0.9 for polygon in polygons)
    assert all((f.outer[0] == f.outer[-1]).all() and len(f.outer) >= 4 for f in footprints)
    assert all(polygon.exterior.is_ccw for polygon in polygons)
    assert all(not ring.is_ccw for polygon in polygons for ring in polygon.interiors)
    assert all(0 <= f.base_z_m < f.top_z_m < 80 for f in footprints)
    assert sum(len(f.holes) for f in footprints) > 50
    x0, y0, x1, y1 = CITY.bounds_m
    city = shapely.box(x0, y0, x1, y1).buffer(60)
    assert city.covers(shapely.union_all(polygons))


def test_no_building_stands_on_a_street_or_pavement():
    standing = shapely.union_all([f.polygon for f in CITY.footprints() if f.base_z_m < 3.0])
    ground = shapely.union(*ground_of(CITY.net_path))
    assert standing.intersection(ground).area < 1.0  # of 150,000 m², by rounding to centimetres


def test_streets_are_lined_with_buildings():
    # From the middle of most streets a building stands within 40 m: the two come from the same place on earth.
    import sumolib

    walls = shapely.union_all([f.polygon for f in CITY.footprints()])
    net = sumolib.net.readNet(str(CITY.net_path))
    middles = [shapely.LineString(e.getShape()).interpolate(0.5, normalized=True) for e in net.getEdges()]
    near = [middle.distance(walls) < 40.0 for middle in middles]
    assert sum(near) > 0.85 * len(near)


def test_it_runs_as_plain_sumo():
    words = [str(sumotools.home() / "bin" / "sumo"), "-c", str(CITY.sumocfg_path), "--end", "120", "--no-step-log"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Error" not in done.stderr
