"""A small world of oddities: left-hand traffic on a hill, without projection, with rail, water, containers, riders."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from sumo_nets import sumotools

NODES = """<nodes>
<node id="a" x="-9000000" y="100" z="3"/>
<node id="b" x="-8999500" y="100" z="11"/>
<node id="c" x="-8999500" y="400" z="11"/>
<node id="d" x="-8999200" y="100" z="3"/>
<node id="r" x="-9000000" y="150"/><node id="s" x="-8999000" y="150"/>
<node id="w" x="-9000000" y="900"/><node id="v" x="-8999000" y="900"/>
</nodes>"""

EDGES = """<edges>
<edge id="ab" from="a" to="b" numLanes="2" speed="13.9" sidewalkWidth="2"/>
<edge id="ba" from="b" to="a" speed="13.9" sidewalkWidth="2"/>
<edge id="bc" from="b" to="c" speed="13.9" sidewalkWidth="2"/>
<edge id="cb" from="c" to="b" speed="13.9" sidewalkWidth="2"/>
<edge id="bd" from="b" to="d" speed="13.9" sidewalkWidth="2"/>
<edge id="db" from="d" to="b" speed="13.9" sidewalkWidth="2"/>
<edge id="rail" from="r" to="s" speed="30" allow="rail"/><edge id="water" from="w" to="v" speed="10" allow="ship"/>
</edges>"""

DEMAND = """<routes>
<vType id="train" vClass="rail"/>
<vType id="ferry" vClass="ship"/>
<vType id="kärra" vClass="truck" length="9.3" width="2.5" height="3.6"/>
<route id="there" edges="ab bd"/>
<vehicle id="train0" type="train" depart="0"><route edges="rail"/></vehicle>
<vehicle id="ferry0" type="ferry" depart="0"><route edges="water"/></vehicle>
<flow id="flow" begin="0" end="40" period="3"><route edges="db bc"/></flow>
<person id="ridden" depart="0"><walk edges="ab" arrivalPos="140"/></person>
<person id="rider" depart="0" departPos="140"><ride from="ab" to="bd" lines="ridden"/><walk edges="bd db"/></person>
<container id="box" depart="0"><transport from="ab" to="bd" lines="ridden"/></container>
<vehicle id="bil.åäö-漢字" type="kärra" depart="1" route="there"/>
<vehicle id="ridden" depart="2"><route edges="ab bd"/><stop lane="ab_1" endPos="150" duration="20"/></vehicle>
<person id="walker" depart="3"><walk edges="ab bc"/></person>
<vehicle id="broken" depart="4" departLane="2"><route edges="ab bd"/>
<stop lane="ab_2" endPos="200" duration="300"/></vehicle>
<vehicle id="behind" depart="6" departLane="2"><route edges="ab bc"/></vehicle>
<vehicle id="parks" depart="8"><route edges="ab bd"/>
<stop lane="ab_1" endPos="120" duration="15" parking="true"/></vehicle>
</routes>"""

CONFIG = """<configuration>
<input><net-file value="odd%20net.net.xml"/>
<route-files value="odd.rou.xml"/>
<additional-files value="odd.add.xml,odd.poly.xml"/></input>
<output><tripinfo-output value="tripinfo.xml"/><fcd-output>fcd.xml</fcd-output><save-state.times value="5"/></output>
<time><begin value="0:0:0"/><end value="{end}"/></time>
<processing><time-to-teleport value="10"/></processing>
<report><verbose value="true"/><log value="log.txt"/><duration-log.statistics value="true"/></report>
</configuration>"""

DETECTOR = '<additional><inductionLoop id="e" lane="ab_1" pos="50" period="10" file="loop.xml"/></additional>'

POLYGONS = """<additional>
<poly id="h" type="building.house" shape="-8999900,130 -8999880,130 -8999880,145 -8999900,145"/>
<poly id="park" type="landuse.park" shape="-8999900,230 -8999880,230 -8999880,245"/>
</additional>"""


def write(folder: Path, end: float = 90) -> Path:
    """The .sumocfg of it, with everything that it names."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "odd net.net.xml").write_bytes(network())
    for name, text in {
        "odd.rou.xml": DEMAND, "odd.add.xml": DETECTOR, "odd.poly.xml": POLYGONS, "odd.sumocfg": CONFIG.format(end=end),
    }.items():  # fmt: skip
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "odd.sumocfg"


@cache
def network() -> bytes:
    """The network file, which netconvert makes once for all tests."""
    with TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "odd.nod.xml").write_text(NODES)
        (folder / "odd.edg.xml").write_text(EDGES)
        sumotools.run(
            "netconvert",
            {"node-files": "odd.nod.xml", "edge-files": "odd.edg.xml", "output-file": "odd net.net.xml",
             "lefthand": True, "offset.disable-normalization": True, "no-warnings": True, "crossings.guess": True},
            folder,
        )  # fmt: skip
        return (folder / "odd net.net.xml").read_bytes()


def edited(scenario: Path, folder: Path, name: str = "odd.sumocfg", change=lambda text: text) -> Path:
    """A copy of a scenario in a folder, with one file changed."""
    for path in scenario.parent.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    text = (folder / name).read_text(encoding="utf-8")
    (folder / name).write_text(change(text), encoding="utf-8")
    return folder / scenario.name
