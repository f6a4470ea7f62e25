"""Test of a network's demand: one simulation, with counts of jams, teleports and waiting vehicles."""

from __future__ import annotations

import tempfile
from collections.abc import Collection
from dataclasses import dataclass
from math import inf
from pathlib import Path

from sumo_nets import sumotools
from sumo_nets.catalogue import Net
from sumo_nets.xml import Attributes, stream

JAMMED = 0.1
"""A street is jammed where the mean speed is below this share of the speed limit."""
_BUSY_S = 900.0
"""Vehicle-seconds on a street below which its mean speed is not used."""


@dataclass(frozen=True, slots=True)
class Flow:
    """Figures of a simulation after warm-up."""

    seconds: float
    vehicles_mean: float
    """On the road."""
    speed_kmh: float
    """Mean over vehicles and time, stops included."""
    trips: int
    """Ended."""
    teleports: int
    """Vehicles that SUMO teleported out of a jam."""
    waiting: int
    """Vehicles waiting to enter at the end."""
    collisions: int
    jammed: tuple[str, ...]
    """Jammed streets (edges)."""
    jammed_p: float
    """Share of the vehicles' time that is spent on jammed streets."""

    @property
    def assessment(self) -> str:
        """One line: whether the traffic flows, and if not, why."""
        faults = []
        if self.vehicles_mean < 1:
            faults.append("no vehicle is on the road")
        if self.teleports > 0.02 * max(self.trips, 1):
            faults.append(f"{self.teleports} teleports in {self.trips} trips")
        if self.waiting > max(10.0, 0.1 * self.vehicles_mean):
            faults.append(f"{self.waiting} vehicles wait to enter")
        if self.jammed_p > 0.1:
            faults.append(f"{self.jammed_p:.0%} of the time is spent in jams, on {len(self.jammed)} streets")
        return f"it does not flow: {', '.join(faults)}; a lower density may help" if faults else "it flows"


def measure(net: Net, seconds: float = 1200.0) -> Flow:
    """Simulate a network's demand for its warm-up and `seconds` more."""
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as name:
        work = Path(name)
        simulate(net, seconds, work)
        return _flow(work, net.warm_up_s, seconds, _free_mps(net.net_path))


def simulate(net: Net, seconds: float, work: Path, types: Collection[str] = ()) -> Path:
    """Simulate a network's demand for its warm-up and `seconds` more, with SUMO's outputs in the folder `work`.

    Parameters
    ----------
    types
        Vehicle types that are counted on streets; all if there are none.

    Returns
    -------
    The file with what happened on each street after the warm-up.
    """
    begin, end = net.warm_up_s, net.warm_up_s + seconds
    of = f'vTypes="{" ".join(types)}" ' if types else ""
    wanted = f'<edgeData id="e" file="edges.xml" begin="{begin}" end="{end}" {of}excludeEmpty="true"/>'
    (work / "edges.add.xml").write_text(f"<additional>{wanted}</additional>", encoding="utf-8")
    options = {  # names in the city's folder, whose path may have commas, at which SUMO cuts
        "configuration-file": net.sumocfg_path.name,
        "additional-files": f"vtypes.add.xml,stops.add.xml,{work / 'edges.add.xml'}",
        "end": end,
        "summary-output": work / "summary.xml",
        "no-step-log": True,
        "no-warnings": True,
        "duration-log.statistics": True,
        "verbose": False,
    }
    sumotools.run("sumo", options, net.folder)
    return work / "edges.xml"


def _flow(work: Path, begin_s: float, seconds: float, free_mps: dict[str, float]) -> Flow:
    warm_up: list[Attributes] = []
    rows: list[Attributes] = []
    jammed: list[str] = []
    spent_s = jammed_s = 0.0

    def step(name: str, attributes: Attributes) -> None:
        if name == "step":
            (rows if float(attributes["time"]) >= begin_s else warm_up).append(attributes)

    def edge(name: str, attributes: Attributes) -> None:
        nonlocal spent_s, jammed_s
        if name != "edge":
            return
        here_s = float(attributes["sampledSeconds"])
        spent_s += here_s
        name = attributes["id"]
        speed_mps = float(attributes.get("speed", 0.0))
        if here_s > _BUSY_S and speed_mps < JAMMED * free_mps.get(name, 0.0):
            jammed.append(name)
            jammed_s += here_s

    stream(work / "summary.xml", step)
    if (work / "edges.xml").is_file():
        stream(work / "edges.xml", edge)
    start = warm_up[-1] if warm_up else {}
    end = rows[-1] if rows else start

    def counted(name: str) -> int:  # SUMO counts from its begin
        return int(end.get(name, 0)) - int(start.get(name, 0))

    running = [float(row["running"]) for row in rows] or [0.0]
    speed_mps = [max(0.0, float(row["meanSpeed"])) for row in rows]
    driven = sum(n * mps for n, mps in zip(running, speed_mps, strict=False))
    return Flow(
        seconds=seconds,
        vehicles_mean=sum(running) / len(running),
        speed_kmh=3.6 * driven / max(sum(running), 1.0),
        trips=counted("ended"),
        teleports=counted("teleports"),
        waiting=int(rows[-1]["waiting"]) if rows else 0,
        collisions=counted("collisions"),
        jammed=tuple(sorted(jammed)),
        jammed_p=jammed_s / max(spent_s, 1.0),
    )


def _free_mps(net_path: Path) -> dict[str, float]:
    """Speed limit of each edge: its fastest lane's."""
    found: dict[str, float] = {}
    at = ""

    def start(name: str, attributes: Attributes) -> None:
        nonlocal at
        if name == "edge":
            at = attributes["id"] if attributes.get("function", "normal") == "normal" else ""
        elif name == "lane" and at:
            found[at] = max(found.get(at, -inf), float(attributes["speed"]))

    stream(net_path, start)
    return found
