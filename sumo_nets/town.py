"""A town that nobody has looked at before: from an OpenStreetMap file to a network with demand."""

from __future__ import annotations

import gzip
import hashlib
import logging
import re
import shutil
import tempfile
import tomllib
from dataclasses import dataclass
from math import dist, hypot
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le

from sumo_nets import build, demand, osm, overpass
from sumo_nets.xml import check_prolog

_HERE = Path(__file__).parent
_LOG = logging.getLogger("sumo_nets.town")

BY_HOUR = (
    0.12, 0.07, 0.05, 0.06, 0.12, 0.35, 0.70, 0.98, 0.92, 0.75, 0.70, 0.74,
    0.76, 0.78, 0.82, 0.93, 1.00, 0.99, 0.82, 0.60, 0.44, 0.35, 0.28, 0.20,
)  # fmt: skip
"""Traffic of each hour of a working day, as a share of the busiest; the shape that counts in towns usually have."""
SHARES = {"car": 0.80, "van": 0.08, "truck": 0.03, "bicycle": 0.09}
"""Kinds of vehicle among those that set out."""
WALKS = 0.4
"""Pedestrians that set out, per vehicle."""
DETOUR = 1.35
"""Length of a drive, over the distance as the crow flies."""
DRIVE_MPS = 9.0
"""Speed of a drive through a town, stops included."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Density:
    """How much traffic."""

    per_km: Annotated[float, Gt(0)] = 2.0
    """Vehicles on the road at the busiest hour, per km of street and direction."""
    hour: Annotated[int, Ge(0), Le(23)] = 16
    """Hour of a working day."""
    seed: Annotated[int, Ge(0)] = 1
    """Of the trips that are drawn."""


def from_osm(path: Path, out: Path, density: Density, name: str | None = None, left_hand: bool = False) -> None:
    """Build streets, buildings and demand from an OpenStreetMap file into the folder `out`.

    On which side traffic keeps, `left_hand`, is not in an extract.

    Raises
    ------
    ValueError
        One line: the file, and why no town can be made of it.
    """
    if not path.is_file():
        raise ValueError(f"--osm {path}: no such file. Give an extract: .osm, .osm.gz, .osm.xml.gz or .osm.pbf.")
    if not path.name.endswith(".pbf"):
        _refuse_doctype(path)
    if name is None:
        name = re.sub(r"[^\w-]+", "-", out.resolve().name).strip("-") or "town"
    elif not re.fullmatch(r"[\w-]+", name):
        raise ValueError(f"--name {name}: files are called so. Letters, digits, - and _ are wanted.")
    extract = osm.read(path)
    about = {
        "name": name,
        "description": f"{name}, from {path.name}",
        "licence": "ODbL-1.0",
        "attribution": "© OpenStreetMap contributors",
        "file": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "left_hand": str(left_hand).lower(),
    }
    template = (_HERE / "common" / "town.toml").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as folder:
        work = Path(folder)
        recipe = tomllib.loads(_filled(template, about, density, {}))
        try:
            gates = build.network(recipe, extract, work)
        except ValueError as error:
            raise ValueError(f"--osm {path}: {error}") from None
        _LOG.info("network made")
        figures = _trips_of(work / "net.net.xml", gates, density)
        text = _filled(template, about, density, figures)
        recipe = tomllib.loads(text)
        build.furnish(recipe, extract, gates, work)
        build.pack(recipe, text, work, out)


def from_box(
    box: str, out: Path, density: Density, name: str | None = None, left_hand: bool = False, server: str | None = None
) -> None:
    """The same of the box "west,south,east,north" [degrees], fetched from OpenStreetMap's Overpass service.

    What was fetched is kept in `out`, so that the recipe can be followed again; see `overpass.fetch`.
    """
    edges = overpass.degrees(box)
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as folder:
        extract = Path(folder) / "box_{:g}_{:g}_{:g}_{:g}.osm.xml.gz".format(*edges)
        try:
            extract.write_bytes(gzip.compress(overpass.fetch(edges, server), mtime=0))
            from_osm(extract, out, density, name, left_hand)
        except ValueError as error:
            said = str(error).removeprefix("--osm ").replace(str(extract), "what the Overpass service sent")
            raise ValueError(
                f"--bbox {box}: {said.rstrip('. ')}. Or fetch an extract elsewhere (download.geofabrik.de, "
                "www.openstreetmap.org/export) and give it with --osm FILE."
            ) from None
        shutil.copyfile(extract, out / extract.name)
    build.write_checksums(out)


def _refuse_doctype(path: Path) -> None:
    if not path.name.endswith(".bz2"):
        check_prolog(path)


def _filled(template: str, about: dict[str, str], density: Density, figures: dict[str, float]) -> str:
    """The recipe of a town: its template with the blanks filled in."""
    values: dict[str, Any] = {
        **about, "density": f"{density.per_km:g}", "hour": density.hour, "at_least": 300.0,
        **dict.fromkeys((*demand.KINDS, "pedestrian"), 0), **figures,
    }  # fmt: skip
    text = re.sub(r"@(\w+)@", lambda match: escaped(values[match[1]]), template)
    return text.replace("\nseed = 1\n", f"\nseed = {density.seed}\n")


def escaped(value: object) -> str:
    """Text that cannot break out of a TOML string."""
    return re.sub(r'["\\]|[\x00-\x1f\x7f]', "_", str(value))


def _trips_of(net_path: Path, gates: frozenset[str], density: Density) -> dict[str, float]:
    """Trips per hour of each kind, such that the wanted number is on the road."""
    import sumolib

    streets = demand.streets_of(sumolib.net.readNet(str(net_path)), gates)
    return scaled(streets, density)


def scaled(streets: list[demand.Street], density: Density) -> dict[str, float]:
    """Trips per hour of each kind, and their least length, for a density of vehicles (Little's law)."""
    km = sum(street.length_m for street in streets) / 1000.0
    xs, ys = zip(*(street.middle_m for street in streets), strict=True)
    across_m = hypot(max(xs) - min(xs), max(ys) - min(ys))
    at_least_m = round(min(600.0, 0.2 * across_m), -1)
    draw = demand.Draw(density.seed, "lengths")
    where = draw.chooser(streets, lambda street: street.length_m)
    drawn = [dist(where().middle_m, where().middle_m) for _ in range(2000)]
    far_m = [metres for metres in drawn if metres >= at_least_m]
    seconds = DETOUR * sum(far_m) / len(far_m) / DRIVE_MPS
    per_hour = BY_HOUR[density.hour] * density.per_km * km * 3600.0 / seconds
    trips = {kind: float(max(1, round(per_hour * share))) for kind, share in SHARES.items()}
    return {"at_least": at_least_m, **trips, "pedestrian": float(max(1, round(WALKS * per_hour)))}
