"""Three vehicles on one lane of 600 m, all at 10 m/s, and a closed loop over them in a process of its own."""

import json
from pathlib import Path

from sumo_nets import sumotools
from tests.drive import python

NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="600" y="0"/><node id="c" x="900" y="0"/></nodes>'
EDGES = '<edges><edge id="ab" from="a" to="b" speed="10"/><edge id="bc" from="b" to="c" speed="10"/></edges>'
DEMAND = """<routes>
<vType id="car" length="5" width="2" height="1.5" sigma="0" speedDev="0" speedFactor="1" minGap="2.5" decel="4.5"/>
<vehicle id="first" type="car" depart="0" departPos="100" departSpeed="10"><route edges="ab bc"/></vehicle>
<vehicle id="second" type="car" depart="0" departPos="60" departSpeed="10"><route edges="ab bc"/></vehicle>
<vehicle id="third" type="car" depart="0" departPos="40" departSpeed="10"><route edges="ab bc"/></vehicle>
</routes>"""
CONFIG = """<configuration><input><net-file value="lane.net.xml"/><route-files value="lane.rou.xml"/></input>
<time><begin value="0"/><end value="200"/></time></configuration>"""


def write(folder: Path) -> Path:
    """The .sumocfg of it, with everything that it names."""
    (folder / "lane.nod.xml").write_text(NODES)
    (folder / "lane.edg.xml").write_text(EDGES)
    (folder / "lane.rou.xml").write_text(DEMAND)
    (folder / "lane.sumocfg").write_text(CONFIG)
    sumotools.run(
        "netconvert", {"node-files": "lane.nod.xml", "edge-files": "lane.edg.xml", "output-file": "lane.net.xml",
                       "no-warnings": True}, folder,
    )  # fmt: skip
    return folder / "lane.sumocfg"


def in_process(code: str) -> object:
    """What a process of its own prints as JSON."""
    return json.loads(python(code).splitlines()[-1])
