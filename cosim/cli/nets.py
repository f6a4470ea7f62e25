"""The commands for cities: list, show, build, and fit to counts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Column, Table
from rich.text import Text

from cosim.cli.console import AsJson, print_done, print_json, print_note, screen
from cosim.cli.help import Commands

if TYPE_CHECKING:
    from numpy import ndarray

    from cosim.traffic.scenario import Scenario
    from sumo_nets.catalogue import Net
    from sumo_nets.footprints import Footprint
    from sumo_nets.sumo_package_nets import PackageNet

nets = Commands(help="List, show and build cities.")

PICTURE = "city.png"
"""Name of the map in the folder of a built city."""


@nets.command()
def example(
    out: Annotated[Path, typer.Argument(help="File to write (.osm.pbf).")] = Path("kotka.osm.pbf"),
    as_json: AsJson = False,
) -> None:
    """Write a small extract of OpenStreetMap, a part of Kotka in Finland, to try `nets build` without a download."""
    from sumo_nets.catalogue import EXAMPLE_OSM

    if not out.name.endswith(".osm.pbf"):
        raise ValueError(f"{out}: a map in this format ends in .osm.pbf.")
    if out.exists():
        raise ValueError(f"{out} exists. Give the name of a new file.")
    try:
        out.write_bytes(EXAMPLE_OSM.read_bytes())
    except OSError as error:
        raise ValueError(f"{out} cannot be written: {error.strerror or error}.") from None
    print_done({"out": str(out)}, f"wrote {out} (© OpenStreetMap contributors, ODbL 1.0)", as_json)


@nets.command("list")
def list_(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(help="Folders in which you built cities. The default is the current folder."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the shipped cities, the cities of SUMO's package, and the cities in a folder and in the folders in it."""
    from sumo_nets import catalogue, sumo_package_nets

    rows = [summary(catalogue.find(name)) | {"where": "cosim"} for name in catalogue.shipped()]
    for name, package_net in sorted(sumo_package_nets.NETS.items()):
        made = sumo_package_nets.made(name)
        rows.append(summary(catalogue.open_folder(made) if made else package_net) | {"where": "SUMO"})
    for parent in folders or [Path()]:
        if not parent.is_dir():
            raise ValueError(f"{parent} is not a folder. Give a folder in which cities were built.")
        for recipe in sorted({*parent.glob("recipe.toml"), *parent.glob("*/recipe.toml")}):
            try:
                rows.append(summary(catalogue.open_folder(recipe.parent)) | {"where": str(recipe.parent)})
            except ValueError as error:
                print_note(f"note: left out: {error}")
    if as_json:
        print_json([{"description": row["what"], **row} for row in rows])
        return
    sides: list[Column | str] = [Column(head, justify="right") for head in ("km²", "vehicles/h", "on disk")]
    table = Table("city", *sides, "licence", box=SIMPLE, leading=1)
    for row in rows:
        built = row["where"] not in ("cosim", "SUMO")
        what = row["what"].partition(":")[0].removeprefix(f"{row['name']}, ")
        table.add_row(
            Text(row["where"] if built else row["name"], "bold").append(f"\n{what}", "not bold"),
            f"{row['km2']:.1f}",
            f"{row['vehicles_per_hour']:,}",
            f"{row['MB']:.1f} MB" if row["on_disk"] else "when used",
            row["licence"],
        )
    screen.print(table)
    screen.print("`cosim nets show CITY` draws a city, `--set traffic.scenario=CITY` drives it.")


@nets.command()
def show(
    city: Annotated[str, typer.Argument(help="Name of a city, folder of a built city, or a .sumocfg.")],
    out: Annotated[Path | None, typer.Option(help="Picture to write: .png, .svg or .pdf.")] = None,
    as_json: AsJson = False,
) -> None:
    """Print facts about a city, and draw its map."""
    from cosim.traffic.scenario import find
    from sumo_nets import catalogue
    from sumo_nets.network import lanes

    found = find(city)
    if found.net is None:
        raise ValueError(
            f"{city}: neither a city nor a .sumocfg, so that there is no network to show. Give one of them."
        )
    facts: dict[str, Any] = {"name": found.name}
    if city in catalogue.names():
        facts |= summary(catalogue.find(city))
    elif (Path(city) / "recipe.toml").is_file():
        facts |= summary(catalogue.open_folder(Path(city)))
    else:
        named = (found.sumocfg, found.net, *found.buildings, *found.types)
        files = {path for path in named if path is not None}
        x0, y0, x1, y1 = catalogue.bounds_m(found.net)
        facts |= {
            "licence": found.licence,
            "attribution": found.attribution,
            "km2": round((x1 - x0) * (y1 - y0) / 1e6, 2),
            "MB": round(sum(path.stat().st_size for path in files) / 1e6, 2),
            "on_disk": found.net.parent,
        }
    driven = [lane for lane in lanes(found.net) if lane.for_cars and not lane.across]
    facts["lanes"] = len(driven)
    facts["lane_km"] = round(sum(_length_m(lane.line_m) for lane in driven) / 1000, 1)
    facts["buildings"] = len(_footprints(found))
    facts["picture"] = str(draw(found, out or Path(f"{found.name}.png")))
    print_facts(facts, as_json)


def summary(net: Net | PackageNet) -> dict[str, Any]:
    """Facts about a city, also about one that is generated when it is first used."""
    folder = getattr(net, "folder", None)
    files = [] if folder is None else [path for path in folder.iterdir() if path.is_file()]
    return {
        "name": net.name,
        "what": net.description,
        "licence": net.licence,
        "attribution": net.attribution,
        "km2": round(net.km2, 2),
        "vehicles_per_hour": round(net.vehicles_per_hour),
        "pedestrians_per_hour": round(net.pedestrians_per_hour),
        "MB": round(sum(path.stat().st_size for path in files) / 1e6, 2),
        "on_disk": folder,
        "picture": next((path for path in files if path.name == PICTURE), None),
    }


def draw(found: Scenario, path: Path) -> Path:
    """Draw the map of a city to a file."""
    from results.figures import city, style
    from sumo_nets.network import lanes

    assert found.net is not None
    drawn = lanes(found.net)
    rings = [footprint.outer for footprint in _footprints(found)]
    lines, widths_m = [lane.line_m for lane in drawn], [lane.width_m for lane in drawn]
    return style.save(city.draw(lines, widths_m, rings, found.name, found.attribution), path)


def _footprints(found: Scenario) -> list[Footprint]:
    from sumo_nets.footprints import read_footprints

    return [footprint for path in found.buildings for footprint in read_footprints(path, found.net)]


def _length_m(line_m: ndarray) -> float:
    """Length of a polyline of n points (n x 2, or n x 3 with heights that do not count)."""
    import numpy as np

    pieces_m = np.diff(line_m[:, :2], axis=0)
    return float(np.hypot(*pieces_m.T).sum())


LABELS = {
    "name": ("name", "{}"),
    "what": ("what", "{}"),
    "licence": ("licence", "{}"),
    "attribution": ("attribution", "{}"),
    "km2": ("area", "{:.2f} km²"),
    "lane_km": ("streets", "{:,.1f} km of lanes"),
    "left_out": ("left out", "{}"),
    "buildings": ("buildings", "{:,}"),
    "vehicles_per_hour": ("vehicles", "{:,.0f} per hour"),
    "pedestrians_per_hour": ("pedestrians", "{:,} per hour"),
    "MB": ("size", "{:.2f} MB"),
    "on_disk": ("files", "{}"),
    "picture": ("picture", "{}"),
    "seconds": ("driven", "{:,.0f} s after its warm-up"),
    "vehicles_mean": ("on the road", "{:,.0f} vehicles"),
    "speed_kmh": ("mean speed", "{:.1f} km/h"),
    "trips": ("trips ended", "{:,}"),
    "teleports": ("teleports", "{:,}"),
    "waiting": ("waiting to enter", "{:,}"),
    "collisions": ("collisions", "{:,}"),
    "jammed": ("jammed streets", "{:,}"),
    "jammed_p": ("time spent there", "{:.1%}"),
    "assessment": ("assessment", "{}"),
    "fitted_drawn": ("fitted counts, as drawn", "{}"),
    "fitted_before": ("fitted counts, old demand", "{}"),
    "fitted_driven": ("fitted counts, new demand", "{}"),
    "kept_back_before": ("other counts, old demand", "{}"),
    "kept_back_driven": ("other counts, new demand", "{}"),
}
"""Labels and formats of the facts, in the order of the terminal's table. JSON uses the keys."""


def print_facts(facts: dict[str, Any], as_json: bool) -> None:
    """Print facts as JSON, or as a table of those that have a label."""
    if as_json:
        print_json(facts)
        return
    table = Table("", Column("", overflow="fold"), box=None, show_header=False, pad_edge=False)
    for key, (label, shape) in LABELS.items():
        if facts.get(key, "") != "":
            table.add_row(label, shape.format(facts[key]))
    screen.print(table)
