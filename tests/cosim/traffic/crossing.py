"""A crossing of two streets with four lanes and two lanes, its traffic, and four blocks of houses, as files of SUMO."""

from pathlib import Path

from sumo_nets import sumotools

NODES = """<nodes>
<node id="w" x="0" y="150"/><node id="c" x="200" y="150" type="traffic_light"/><node id="e" x="400" y="150"/>
<node id="s" x="200" y="0"/><node id="n" x="200" y="300"/>
</nodes>"""
EDGES = """<edges>
<edge id="wc" from="w" to="c" numLanes="2" speed="13.9"/><edge id="ce" from="c" to="e" numLanes="2" speed="13.9"/>
<edge id="ec" from="e" to="c" numLanes="2" speed="13.9"/><edge id="cw" from="c" to="w" numLanes="2" speed="13.9"/>
<edge id="sc" from="s" to="c" speed="13.9"/><edge id="cn" from="c" to="n" speed="13.9"/>
<edge id="nc" from="n" to="c" speed="13.9"/><edge id="cs" from="c" to="s" speed="13.9"/>
</edges>"""
DEMAND = """<routes><vType id="car" vClass="passenger"/>
<flow id="a" begin="0" end="300" period="2" from="wc" to="ce" type="car" departLane="free" departSpeed="max"/>
<flow id="b" begin="0" end="300" period="4" from="sc" to="cn" type="car" departSpeed="max"/>
</routes>"""
BLOCKS = ((20, 20), (220, 20), (20, 170), (220, 170))
"""South-western corners of blocks of 160 x 110 m between the streets."""


def write(
    folder: Path,
    *flags: str,
    nodes: str = NODES,
    edges: str = EDGES,
    more: str = "",
    files: str = "",
    proj: str = "",
) -> Path:
    """Write the scenario; `flags` are options of netconvert that are true, `more` options of SUMO."""
    (folder / "plain.nod.xml").write_text(nodes)
    (folder / "plain.edg.xml").write_text(edges)
    (folder / "city.rou.xml").write_text(DEMAND)
    plain = {"node-files": "plain.nod.xml", "edge-files": "plain.edg.xml", "output-file": "city.net.xml"}
    sumotools.run("netconvert", plain | dict.fromkeys(flags, True) | ({"proj": proj} if proj else {}), folder)
    listed = f'<additional-files value="{files}"/>' if files else ""
    inputs = f'<net-file value="city.net.xml"/><route-files value="city.rou.xml"/>{listed}'
    config = folder / "city.sumocfg"
    config.write_text(f"<configuration><input>{inputs}</input>{more}</configuration>")
    return config


def houses(kinds: tuple[str, ...] = ("building",) * 4, east_m: float = 0.0, north_m: float = 0.0) -> str:
    """A file of polygons: the blocks, moved, 12 m high."""
    polygons = []
    for n, (kind, (x, y)) in enumerate(zip(kinds, BLOCKS, strict=True)):
        corners = [(x, y), (x + 160, y), (x + 160, y + 110), (x, y + 110)]
        shape = " ".join(f"{east + east_m},{north + north_m}" for east, north in corners)
        high = '<param key="height" value="12"/>'
        polygons.append(f'<poly id="b{n}" type="{kind}" shape="{shape}">{high}</poly>')
    return f"<additional>{''.join(polygons)}</additional>"
