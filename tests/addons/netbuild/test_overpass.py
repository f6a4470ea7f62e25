"""A town by its box: from a stand-in for the Overpass service, on this machine, to traffic or to one line."""

import gzip
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from cosim.addons.netbuild import build, build_from_osm, osm_files, overpass
from sumo_nets import catalogue
from sumo_nets.density import Density
from tests.addons.netbuild.test_build_from_osm import ROADLESS, grid_town
from tests.drive import cosim

BOX = "9.0,50.0,9.0072,50.0046"
"""Just what `grid_town` draws."""


def answer(town: str) -> bytes:
    """A file as an Overpass service words it: a note and the age of its data, and no bounds."""
    head = (
        '<osm version="0.6" generator="Overpass API 0.7.62"><note>data: ODbL</note><meta osm_base="2026-01-01T00:00Z"/>'
    )
    return re.sub(r"<osm[^>]*><bounds[^>]*>", head, town).encode()


@contextmanager
def service(status: int, body: bytes, delay_s: float = 0.0) -> Iterator[tuple[str, list[bytes]]]:
    """Its address, and what it was asked."""
    asked: list[bytes] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked.append(self.rfile.read(int(self.headers["Content-Length"])))
            time.sleep(delay_s)
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/api/interpreter", asked
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.verify
def test_a_box_becomes_a_town_that_can_be_built_again(tmp_path):
    with service(200, answer(grid_town())) as (url, asked):
        done = cosim("nets", "build", "--bbox", BOX, "--overpass", url, "--out", "town", "--no-check", cwd=tmp_path)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    (query,) = asked
    assert b'n="50.0046" s="50.0" w="9.0" e="9.0072"' in query
    net = catalogue.open_folder(tmp_path / "town")
    assert len(net.footprints()) == 4 and net.description == "town, from box_9_50_9.0072_50.0046.osm.xml.gz"
    kept = tmp_path / "town" / "box_9_50_9.0072_50.0046.osm.xml.gz"
    assert osm_files.read(kept).box == pytest.approx((9.0, 50.0, 9.0072, 50.0046))
    assert b"generated on" not in gzip.decompress(kept.read_bytes())  # by whom, where and when it was fetched
    assert kept.name in (tmp_path / "town" / "SHA256SUMS").read_text()
    build.build(tmp_path / "town" / "recipe.toml", kept, tmp_path / "again")
    for path in (tmp_path / "again").iterdir():
        if path.name != "SHA256SUMS":
            assert path.read_bytes() == (tmp_path / "town" / path.name).read_bytes(), path.name


def test_where_streets_leave_the_box_traffic_comes_and_goes(tmp_path):
    """Three streets each way, which a service sends whole: the middle of the town, and a path that leads far away."""
    inner = re.sub(r'<way id="(1|5|6|10)".*?</way>', "", grid_town())
    far = '<node id="90" lat="48" lon="7"/><node id="91" lat="52" lon="11"/>'
    path = '<way id="99"><nd ref="90"/><nd ref="91"/><tag k="highway" v="path"/></way></osm>'
    sent = answer(inner.replace("<node", far + "<node", 1).replace("</osm>", path))
    with service(200, sent) as (url, _):
        build_from_osm.from_box("9.0015,50.001,9.0057,50.0036", tmp_path / "town", Density(), server=url)
    demand = gzip.decompress((tmp_path / "town" / "demand.rou.xml.gz").read_bytes()).decode()
    entered = re.findall(r'departSpeed="max".*?edges="(\S+)', demand, re.DOTALL)
    assert len(set(entered)) == 12


TORN = answer(grid_town())[:4000]
GAVE_UP = answer(grid_town()).replace(
    b"</osm>", b"<remark> runtime error: Query timed out in &quot;x&quot; </remark></osm>"
)
PAGE = b"<!DOCTYPE html><html><body>Please try again later.</body></html>"
BARE = b'<osm version="0.6"></osm>'
SPY = b'<!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/hosts">]>' + BARE

REFUSED = {
    "busy": (429, b"", "HTTP Error 429: Too Many Requests"),
    "overloaded": (504, b"", "HTTP Error 504: Gateway Timeout"),
    "refuses the question": (400, b"", "HTTP Error 400: Bad Request"),
    "a page": (200, PAGE, "returned non-OSM content"),
    "torn": (200, TORN, "what the Overpass service sent"),
    "gave up half-way": (200, GAVE_UP, "the Overpass service gave up (runtime error: Query timed out"),
    "nothing there": (200, BARE, "what the Overpass service sent has no ways"),
    "no connected network of street there": (200, answer(ROADLESS), "sent: the extract has no connected network"),
    "hostile": (200, SPY, "declares a document type"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_a_service_that_does_not_help_gets_one_line(tmp_path, monkeypatch, what):
    monkeypatch.setattr(overpass, "RETRY_S", 0)
    status, body, says = REFUSED[what]
    with service(status, body) as (url, _):
        refuse(tmp_path, url, says)


def test_nobody_listens(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    refuse(tmp_path, f"http://127.0.0.1:{port}/", "Connection refused")


def test_no_answer(tmp_path, monkeypatch):
    monkeypatch.setattr(overpass, "TIME_LIMIT_S", 0.5)
    with service(200, BARE, delay_s=1.5) as (url, _):
        refuse(tmp_path, url, "gave no answer within 0.5 s")


def refuse(folder, url, says):
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        build_from_osm.from_box(BOX, folder / "out", Density(), server=url)
    said = str(caught.value)
    assert said.startswith(f"--bbox {BOX}: ") and "--osm FILE" in said and "\n" not in said and "/tmp" not in said
    assert list(folder.iterdir()) == []


BOXES = {
    "9,50,10": "four numbers are wanted",
    "9,50,east,51": "four numbers are wanted",
    "10,50,9,51": "west < east",
    "9,51,10,50": "south < north",
    "9,50,9,50": "west < east",
    "9,89,10,91": "in degrees",
    "nan,50,10,51": "west < east",
    "9,50,10,51": "7,865 km², and at most 1,000 km² are fetched at once",
}


@pytest.mark.parametrize("box", BOXES)
def test_a_box_is_checked_before_anybody_is_asked(tmp_path, box):
    done = cosim("nets", "build", "--bbox", box, "--overpass", "http://127.0.0.1:9/", "--out", "x", cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == "" and list(tmp_path.iterdir()) == []
    assert f"--bbox {box}: " in done.stderr and BOXES[box] in done.stderr and done.stderr.count("\n") == 1
