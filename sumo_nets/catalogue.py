"""The networks that ship with the package."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from sumo_nets.footprints import Footprint, read_footprints
from sumo_nets.xml import Attributes, Enough, stream

_HERE = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Net:
    """A shipped city: its files, and what one must know to use and to cite them."""

    name: str
    description: str
    licence: str
    """Of the data, as an SPDX name; its text is in `folder / "LICENSE"`."""
    attribution: str
    """To be shown wherever the data, or a picture made from them, are."""
    folder: Path
    sumocfg_path: Path
    net_path: Path
    buildings_path: Path
    warm_up_s: float
    """Time after which the traffic is stationary."""
    end_s: float
    """Time at which the demand ends."""
    vehicles_per_hour: float
    """Vehicles that the demand draws, bicycles included, buses not (they keep a timetable)."""
    pedestrians_per_hour: float
    bounds_m: tuple[float, float, float, float]
    """Least x, least y, greatest x, greatest y, in network coordinates."""

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent in x and y."""
        x0, y0, x1, y1 = self.bounds_m
        return x1 - x0, y1 - y0

    def footprints(self) -> list[Footprint]:
        """The buildings: (outer ring, holes, base, top), in network coordinates."""
        return read_footprints(self.buildings_path)


def names() -> list[str]:
    """Names of the shipped networks, sorted."""
    return sorted(path.parent.name for path in _HERE.glob("*/recipe.toml"))


def find(name: str) -> Net:
    """A shipped network by its name.

    Raises
    ------
    ValueError
        Where there is none of that name.
    """
    if name not in names():
        raise ValueError(f"network = {name!r} does not ship with cosim; there are: {', '.join(names())}")
    return open_folder(_HERE / name)


def open_folder(folder: Path) -> Net:
    """A network from the folder that `sumo_nets.build` made."""
    recipe = tomllib.loads((folder / "recipe.toml").read_text(encoding="utf-8"))
    demand = recipe["demand"]
    net_path = folder / "net.net.xml.gz"
    return Net(
        name=recipe["name"],
        description=recipe["description"],
        licence=recipe["licence"],
        attribution=recipe["attribution"],
        folder=folder,
        sumocfg_path=folder / f"{recipe['name']}.sumocfg",
        net_path=net_path,
        buildings_path=folder / "buildings.poly.xml.gz",
        warm_up_s=float(recipe["warm_up_s"]),
        end_s=float(demand["end_s"]),
        vehicles_per_hour=float(sum(demand[kind]["per_hour"] for kind in ("car", "van", "truck", "bicycle"))),
        pedestrians_per_hour=float(demand["pedestrian"]["per_hour"]),
        bounds_m=bounds_m(net_path),
    )


def bounds_m(net_path: Path | str) -> tuple[float, float, float, float]:
    """Least x, least y, greatest x, greatest y of a SUMO network, from its own header."""
    found: list[tuple[float, float, float, float]] = []

    def start(name: str, attributes: Attributes) -> None:
        if name == "location":
            x0, y0, x1, y1 = (float(value) for value in attributes["convBoundary"].split(","))
            found.append((x0, y0, x1, y1))
            raise Enough

    stream(net_path, start)
    if not found:
        raise ValueError(f"{net_path}: not a SUMO network: it has no <location>")
    return found[0]
