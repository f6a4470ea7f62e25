"""Streets, buildings and demand: a city that ships, or a SUMO scenario of the user's own."""

from dataclasses import dataclass
from pathlib import Path

from cosim.manifest import sha256
from sensors.scene import Scene
from sumo_nets import catalogue
from sumo_nets.footprints import read_footprints
from sumo_nets.network import check_for_cars
from sumo_nets.xml import Attributes, stream


@dataclass(frozen=True, slots=True)
class Scenario:
    """What SUMO is to drive, and what stands beside the road."""

    name: str
    sumocfg: Path
    net: Path
    buildings: tuple[Path, ...]
    warmup_s: float
    licence: str
    attribution: str

    def city(self) -> Scene:
        """The buildings as walls for light."""
        footprints = [f for path in self.buildings for f in read_footprints(path)]
        rings = [[f.outer, *f.holes] for f in footprints]
        return Scene.from_footprints(rings, [f.base_z_m for f in footprints], [f.top_z_m for f in footprints])

    def certificate(self) -> dict[str, str]:
        """Where the network comes from, and checksums of its files."""
        files = {f"sha256 {p.name}": sha256(p) for p in (self.sumocfg, self.net, *self.buildings)}
        return {"name": self.name, "licence": self.licence, "attribution": self.attribution} | files


def find(scenario: str) -> Scenario:
    """The shipped city of that name, or the .sumocfg at that path; ValueError in one line for a mistake."""
    if scenario in catalogue.names():
        net = catalogue.find(scenario)
        return Scenario(
            net.name, net.sumocfg_path, net.net_path, (net.buildings_path,), net.warm_up_s, net.licence, net.attribution
        )
    path = Path(scenario)
    if path.suffix != ".sumocfg":
        raise ValueError(
            f"traffic.scenario = {scenario}: no city of that name ships, and it is no .sumocfg. "
            f"Set it to one of {', '.join(catalogue.names())}, or to the path of a .sumocfg."
        )
    if not path.is_file():
        raise ValueError(f"traffic.scenario = {scenario}: no such file. Give the path of a .sumocfg.")
    net_path, additional = _inputs(path)
    check_for_cars(net_path)
    buildings = tuple(p for p in additional if p.name.endswith((".poly.xml", ".poly.xml.gz")))
    return Scenario(path.stem, path, net_path, buildings, 0.0, "the user's own", "")


def _inputs(sumocfg: Path) -> tuple[Path, list[Path]]:
    """The network and the additional files that a .sumocfg names."""
    named: dict[str, list[Path]] = {"net": [], "additional": []}

    def start(name: str, attributes: Attributes) -> None:
        option = {"net-file": "net", "net": "net", "n": "net"}.get(name)
        option = option or {"additional-files": "additional", "additional": "additional", "a": "additional"}.get(name)
        if option:
            values = attributes.get("value", attributes.get("v", "")).replace(";", ",").split(",")
            named[option] += [sumocfg.parent / v.strip() for v in values if v.strip()]

    stream(sumocfg, start)
    if not named["net"]:
        raise ValueError(f"{sumocfg}: names no network. Add <net-file value=\"...\"/> to its <input>.")
    for path in named["net"] + named["additional"]:
        if not path.is_file():
            raise ValueError(f"{sumocfg}: names {path}, which does not exist. Correct the path in the .sumocfg.")
    return named["net"][0], named["additional"]
