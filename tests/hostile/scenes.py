"""A street of a few cars as a trace, and a small town for SUMO."""

from pathlib import Path

from sumo_nets import sumotools
from tests.processes import sets_of_trace

HEAD = "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_z;vehicle_angle;vehicle_speed;vehicle_type\n"

ROUTES = """<routes>
<vType id="van" vClass="delivery"/>
<flow id="east" type="van" from="A0B0" to="B2C2" begin="0" end="{end}" period="2"/>
<flow id="west" from="C2B2" to="B0A0" begin="0" end="{end}" period="3"/>
<flow id="north" from="C0C1" to="A1A2" begin="0" end="{end}" period="4"/>
</routes>"""

HOUSES = """<additional>
<poly id="h1" type="building" shape="20,20 80,20 80,80 20,80"/>
<poly id="h2" type="building" shape="120,20 180,20 180,80 120,80"/>
</additional>"""

CONFIG = """<configuration>
<input><net-file value="town.net.xml"/><route-files value="town.rou.xml"/><additional-files value="town.poly.xml"/>
</input><time><begin value="0"/><end value="{end}"/></time></configuration>"""


def trace_rows(n_steps: int = 5) -> list[list[str]]:
    """Cells of a trace: two files of cars towards each other, a person."""
    rows = []
    for t in range(n_steps):
        for k in range(8):
            side = 1 if k % 2 else -1
            x, y, angle = side * (12.0 * t - 30) - 9.0 * side * (k // 2), -2.0 * side, 90 if side > 0 else 270
            rows.append([str(t), f"car{k}", f"{x}", f"{y}", "0", f"{angle}", "12", "car"])
        rows.append([str(t), "walker", f"{1.2 * t}", "6", "0", "90", "1.2", "person"])
    return rows


def write_trace(folder: Path) -> Path:
    """The trace as CSV."""
    path = folder / "street.csv"
    path.write_text(HEAD + "".join(";".join(row) + "\n" for row in trace_rows()))
    return path


def write_town(folder: Path, end: float = 60) -> Path:
    """The .sumocfg of a town of nine junctions, with everything that it names."""
    folder.mkdir(parents=True, exist_ok=True)
    sumotools.run(
        "netgenerate",
        {"grid": True, "grid.number": 3, "grid.length": 100, "output-file": "town.net.xml", "no-warnings": True},
        folder,
    )
    (folder / "town.rou.xml").write_text(ROUTES.format(end=end))
    (folder / "town.poly.xml").write_text(HOUSES)
    (folder / "town.sumocfg").write_text(CONFIG.format(end=end))
    return folder / "town.sumocfg"


def street_sets(folder: Path) -> list[str]:
    """Keys of a run of the street, whose trace is written into the folder."""
    return sets_of_trace(write_trace(folder))[1::2]
