"""The networks that ship with this package or with SUMO's."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.base.addons import hook
from sumo_nets import sumo_package_nets
from sumo_nets.network import lane_bounds_m
from sumo_nets.xml import Attributes, Enough, stream

if TYPE_CHECKING:
    from sumo_nets.footprints import Footprint

_HERE = Path(__file__).parent

EXAMPLE_OSM = _HERE / "common" / "kotka.osm.pbf"
"""A square kilometre of OpenStreetMap; `README.md` says where it comes from."""


@dataclass(frozen=True, slots=True)
class Net:
    """A city: its files, licence and attribution."""

    name: str
    description: str
    licence: str
    """Of the data, as an SPDX name; its text is in `folder / "LICENSE"`."""
    attribution: str
    """To be shown with the data and with pictures made from them."""
    folder: Path
    sumocfg_path: Path
    net_path: Path
    buildings_path: Path
    warm_up_s: float
    """Time after which the traffic is stationary."""
    end_s: float
    """Time at which the demand ends."""
    vehicles_per_hour: float
    """Vehicles of the demand, with bicycles, without buses (they follow a timetable)."""
    pedestrians_per_hour: float
    bounds_m: tuple[float, float, float, float]
    """Least x, least y, greatest x, greatest y, in network coordinates."""

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent in x and y."""
        x0, y0, x1, y1 = self.bounds_m
        return x1 - x0, y1 - y0

    @property
    def km2(self) -> float:
        """Area of the extent."""
        width, height = self.size_m
        return width * height / 1e6

    def footprints(self) -> list[Footprint]:
        """The buildings: (outer ring, holes, base, top), in network coordinates."""
        from sumo_nets.footprints import read_footprints

        return read_footprints(self.buildings_path)


def shipped() -> list[str]:
    """Names of the networks in this folder, sorted."""
    return sorted(path.parent.name for path in _HERE.glob("*/recipe.toml"))


def names() -> list[str]:
    """Names of all networks, sorted: those shipped here, and those inside SUMO's package."""
    return sorted({*shipped(), *sumo_package_nets.NETS})


def find(name: str) -> Net:
    """A network by its name; demand of one of SUMO's package is generated on first use, within seconds.

    Raises
    ------
    ValueError
        If there is no network of that name.
    """
    if name not in names():
        raise ValueError(f"network = {name!r} does not ship with cosim; there are: {', '.join(names())}")
    if name in shipped():
        return open_folder(_HERE / name)
    return open_folder(hook("package_city", f"network {name!r}, which is built on first use,")(name))


def open_folder(folder: Path) -> Net:
    """A network from the folder that `cosim.addons.netbuild.build` wrote."""
    if not (folder / "recipe.toml").is_file():
        raise ValueError(f"{folder}: not a city by name, and no folder that `cosim nets build` made.")
    try:
        recipe = tomllib.loads((folder / "recipe.toml").read_text(encoding="utf-8"))
        return _opened(folder, recipe)
    except (OSError, KeyError, TypeError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(
            f"{folder}: not a city that `cosim nets build` made, or damaged ({type(error).__name__}: {error})"
        ) from None


def _opened(folder: Path, recipe: dict[str, Any]) -> Net:
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
        vehicles_per_hour=_vehicles_per_hour(recipe),
        pedestrians_per_hour=float(demand["pedestrian"]["per_hour"]),
        bounds_m=bounds_m(net_path),
    )


def _vehicles_per_hour(recipe: dict[str, Any]) -> float:
    if "counts" in recipe:  # written by `cosim nets counts`
        return float(recipe["counts"]["vehicles_per_hour"])
    kinds, demand = ("car", "van", "truck", "bicycle", "gates"), recipe["demand"]
    return float(sum(demand.get(kind, {"per_hour": 0})["per_hour"] for kind in kinds))


def bounds_m(net_path: Path | str) -> tuple[float, float, float, float]:
    """Least x, least y, greatest x, greatest y of a SUMO network: from its own header, else from its lanes."""
    found: list[tuple[float, float, float, float]] = []

    def start(name: str, attributes: Attributes) -> None:
        if name == "location":
            x0, y0, x1, y1 = (float(value) for value in attributes["convBoundary"].split(","))
            found.append((x0, y0, x1, y1))
            raise Enough

    stream(net_path, start)
    if not found or found[0][:2] == found[0][2:]:  # a network that was not written by SUMO's own tools
        return lane_bounds_m(net_path)
    return found[0]
