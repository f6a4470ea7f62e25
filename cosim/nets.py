"""The commands about cities: which there are, what they are like, and how to make one."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Column, Table

from cosim.screen import notes, print_json, screen

nets = typer.Typer(no_args_is_help=True, help="Cities: those that ship, and your own.")

AsJson = Annotated[bool, typer.Option("--json", help="Answer in JSON on standard output.")]


@nets.command("list")
def list_(
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Where to look for cities that were built; by default here.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the cities that ship, and those that were built."""
    from sumo_nets import catalogue, wheel

    rows: list[dict[str, Any]] = []
    for net in [catalogue.find(name) for name in catalogue.shipped()]:
        rows.append(_summary(net) | {"where": "cosim"})
    for name, inside in sorted(wheel.NETS.items()):
        rows.append({
            "name": name, "what": inside.description, "licence": "ODbL-1.0", "where": "SUMO",
        })  # fmt: skip
    for parent in folders or [Path()]:
        if not parent.is_dir():
            raise ValueError(f"{parent} is not a folder. Give a folder in which cities were built.")
        for recipe in sorted({*parent.glob("recipe.toml"), *parent.glob("*/recipe.toml")}):
            rows.append(_summary(catalogue.open_folder(recipe.parent)) | {"where": str(recipe.parent)})
    if as_json:
        print_json([{"description": row["what"], **row} for row in rows])
        return
    columns = ("name", "where", "km2", "vehicles_per_hour", "MB", "licence", "what")
    table = Table(*(Column(c.replace("_", " "), no_wrap=c == "name") for c in columns), box=SIMPLE)
    for row in rows:
        table.add_row(*(str(row.get(c, "")).partition(":")[0] for c in columns))
    screen.print(table)


@nets.command()
def show(
    city: Annotated[str, typer.Argument(help="Name of a city, folder of one that was built, or a .sumocfg.")],
    out: Annotated[Path | None, typer.Option(help="Picture to write: .png, .svg or .pdf.")] = None,
    as_json: AsJson = False,
) -> None:
    """Say what a city is like, and draw it."""
    from cosim.scenario import find
    from sumo_nets import catalogue
    from sumo_nets.network import lanes

    found = find(city)
    if found.net is None:
        raise ValueError(f"{city} is a trace: there is no network to show. Give a city or a .sumocfg.")
    facts: dict[str, Any] = {"name": found.name, "licence": found.licence, "attribution": found.attribution}
    if city in catalogue.names():
        facts |= _summary(catalogue.find(city))
    elif (Path(city) / "recipe.toml").is_file():
        facts |= _summary(catalogue.open_folder(Path(city)))
    else:
        files = [p for p in (found.sumocfg, found.net, *found.buildings, *found.types) if p is not None]
        facts["MB"] = round(sum(path.stat().st_size for path in set(files)) / 1e6, 2)
        x0, y0, x1, y1 = catalogue.bounds_m(found.net)
        facts["km2"] = round((x1 - x0) * (y1 - y0) / 1e6, 2)
    lines, _ = lanes(found.net)
    facts["lanes"] = len(lines)
    facts["lane_km"] = round(sum(_length_m(line) for line in lines) / 1000, 1)
    facts["buildings"] = len(_footprints(found.buildings))
    facts["files"] = str(found.net.parent)
    facts["picture"] = str(_draw(found, out or Path(f"{found.name}.png")))
    _tell(facts, found.name, as_json)


@nets.command()
def build(
    out: Annotated[Path, typer.Option(help="Folder to write; then `--set traffic.scenario=FOLDER` drives it.")],
    osm: Annotated[Path | None, typer.Option(help="OpenStreetMap file: .osm, .osm.gz, .osm.xml.gz, .osm.pbf.")] = None,
    bbox: Annotated[str | None, typer.Option(help="west,south,east,north [degrees], fetched from Overpass.")] = None,
    density: Annotated[float, typer.Option(help="Vehicles on the road per km of street and direction.")] = 2.0,
    hour: Annotated[int, typer.Option(help="Hour of a working day, 0 to 23: 16 is the busiest.")] = 16,
    seed: Annotated[int, typer.Option(help="Of the trips that are drawn.")] = 1,
    name: Annotated[str | None, typer.Option(help="Name of the city; by default the folder's.")] = None,
    check: Annotated[bool, typer.Option(help="Drive half an hour and report whether traffic flows.")] = True,
    as_json: AsJson = False,
) -> None:
    """Make a city from OpenStreetMap: streets, lights, pavements, buildings, demand, and a report on its traffic."""
    from cosim.scenario import find
    from sumo_nets import catalogue, flow, town

    if (osm is None) == (bbox is None):
        raise ValueError("cosim nets build wants one of --osm FILE and --bbox west,south,east,north.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"--out {out} is not empty. Give a folder that is empty or does not exist.")
    if not density > 0 or density > 100:
        raise ValueError(f"--density {density:g}: vehicles per km of street, more than 0 and at most 100.")
    if not 0 <= hour <= 23:
        raise ValueError(f"--hour {hour}: hours go from 0 to 23.")
    wanted = town.Density(per_km=density, hour=hour, seed=seed)
    with notes.status("building streets, buildings and demand ..."):
        if osm is not None:
            town.from_osm(osm, out, wanted, name)
        else:
            town.from_box(bbox or "", out, wanted, name)
    net = catalogue.open_folder(out)
    picture = _draw(find(str(out)), out / "city.png")
    facts = _summary(net) | {"buildings": len(net.footprints()), "picture": str(picture)}
    if check:
        with notes.status("driving it for half an hour ..."):
            flows = flow.measure(net)
        facts |= asdict(flows) | {"jammed": len(flows.jammed), "verdict": flows.verdict}
    _tell(facts, str(out), as_json)


def _summary(net: Any) -> dict[str, Any]:
    width, height = net.size_m
    return {
        "name": net.name,
        "what": net.description,
        "licence": net.licence,
        "attribution": net.attribution,
        "km2": round(width * height / 1e6, 2),
        "vehicles_per_hour": round(net.vehicles_per_hour),
        "pedestrians_per_hour": round(net.pedestrians_per_hour),
        "MB": round(sum(path.stat().st_size for path in net.folder.iterdir() if path.is_file()) / 1e6, 2),
    }


def _draw(found: Any, path: Path) -> Path:
    from results.figures import city, style
    from sumo_nets.network import lanes

    lines, widths = lanes(found.net)
    rings = [footprint.outer for footprint in _footprints(found.buildings)]
    return style.save(city.draw(lines, widths, rings, found.name, found.attribution), path)


def _footprints(paths: tuple[Path, ...]) -> list[Any]:
    from sumo_nets.footprints import read_footprints

    return [footprint for path in paths for footprint in read_footprints(path)]


def _length_m(line: Any) -> float:
    import numpy as np

    return float(np.hypot(*np.diff(line, axis=0).T).sum())


def _tell(facts: dict[str, Any], title: str, as_json: bool) -> None:
    if as_json:
        print_json(facts)
        return
    table = Table("", "", title=title, title_justify="left", box=SIMPLE, show_header=False)
    for key, value in facts.items():
        shown = f"{value:.3g}" if isinstance(value, float) and abs(value) < 1000 else str(value)
        table.add_row(key.replace("_", " "), shown)
    screen.print(table)
