"""The commands for cities: list, show, build, and fit to counts."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Column, Table
from rich.text import Text

from cosim.cli.console import AsJson, notes, print_done, print_json, screen

if TYPE_CHECKING:
    from numpy import ndarray

    from cosim.traffic.scenario import Scenario
    from sumo_nets.catalogue import Net
    from sumo_nets.footprints import Footprint
    from sumo_nets.sumo_package_nets import PackageNet

nets = typer.Typer(no_args_is_help=True, help="List, show and build cities.")

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
    """List the shipped cities, the cities of SUMO's package, and the cities in a folder and its subfolders."""
    from sumo_nets import catalogue, sumo_package_nets

    rows = [_summary(catalogue.find(name)) | {"where": "cosim"} for name in catalogue.shipped()]
    for name, package_net in sorted(sumo_package_nets.NETS.items()):
        made = sumo_package_nets.made(name)
        rows.append(_summary(catalogue.open_folder(made) if made else package_net) | {"where": "SUMO"})
    for parent in folders or [Path()]:
        if not parent.is_dir():
            raise ValueError(f"{parent} is not a folder. Give a folder in which cities were built.")
        for recipe in sorted({*parent.glob("recipe.toml"), *parent.glob("*/recipe.toml")}):
            try:
                rows.append(_summary(catalogue.open_folder(recipe.parent)) | {"where": str(recipe.parent)})
            except ValueError as error:
                notes.print(f"note: left out: {error}", highlight=False, markup=False, soft_wrap=True)
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
            f"{row['km2']:.1f}", f"{row['vehicles_per_hour']:,}",
            f"{row['MB']:.1f} MB" if row["on_disk"] else "when used", row["licence"],
        )  # fmt: skip
    screen.print(table)
    screen.print("`cosim nets show CITY` draws a city, `--set traffic.scenario=CITY` drives it.", highlight=False)


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
        raise ValueError(f"{city} is a trace: there is no network to show. Give a city or a .sumocfg.")
    facts: dict[str, Any] = {"name": found.name}
    if city in catalogue.names():
        facts |= _summary(catalogue.find(city))
    elif (Path(city) / "recipe.toml").is_file():
        facts |= _summary(catalogue.open_folder(Path(city)))
    else:
        files = [p for p in (found.sumocfg, found.net, *found.buildings, *found.types) if p is not None]
        x0, y0, x1, y1 = catalogue.bounds_m(found.net)
        facts |= {
            "licence": found.licence,
            "attribution": found.attribution,
            "km2": round((x1 - x0) * (y1 - y0) / 1e6, 2),
            "MB": round(sum(path.stat().st_size for path in set(files)) / 1e6, 2),
            "on_disk": found.net.parent,
        }
    driven = [lane for lane in lanes(found.net) if lane.for_cars and not lane.across]
    facts["lanes"] = len(driven)
    facts["lane_km"] = round(sum(_length_m(lane.line_m) for lane in driven) / 1000, 1)
    facts["buildings"] = len(_footprints(found))
    facts["picture"] = str(_draw(found, out or Path(f"{found.name}.png")))
    _print_facts(facts, as_json)


@nets.command()
def build(
    out: Annotated[Path, typer.Option(help="Folder to write. `--set traffic.scenario=FOLDER` then simulates it.")],
    osm: Annotated[
        Path | None, typer.Option(help="OpenStreetMap file: .osm, .osm.gz, .osm.xml.gz or .osm.pbf.")
    ] = None,
    bbox: Annotated[
        str | None,
        typer.Option(
            help="Bounding box west,south,east,north in degrees. With --osm, crop the file to it; otherwise download "
            "it from Overpass."
        ),
    ] = None,
    overpass: Annotated[
        str | None, typer.Option(help="Use another Overpass service, such as http://host/api/interpreter.")
    ] = None,
    density: Annotated[float, typer.Option(help="Vehicles on the road per km of street and direction.")] = 2.0,
    hour: Annotated[int, typer.Option(help="Hour of a working day, 0 to 23. Hour 16 is the busiest.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the demand.")] = 1,
    left_hand: Annotated[bool, typer.Option("--left-hand", help="Vehicles drive on the left.")] = False,
    name: Annotated[str | None, typer.Option(help="Name of the city. The default is the folder's name.")] = None,
    check: Annotated[bool, typer.Option(help="Simulate half an hour and report whether traffic flows.")] = True,
    as_json: AsJson = False,
) -> None:
    """Build a city from OpenStreetMap: streets, traffic lights, pavements, buildings, demand and a traffic report."""
    from cosim.addons.netbuild import build_from_osm, flow
    from cosim.addons.netbuild.overpass import degrees
    from cosim.traffic.scenario import find
    from sumo_nets import catalogue
    from sumo_nets.density import Density

    if osm is None and bbox is None:
        raise ValueError("cosim nets build needs --osm FILE, --bbox west,south,east,north, or both.")
    if overpass is not None and (bbox is None or osm is not None):
        raise ValueError("--overpass goes with --bbox west,south,east,north and without --osm. Leave it out.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"--out {out} is not empty. Give a folder that is empty or does not exist.")
    if not density > 0 or density > 100:
        raise ValueError(f"--density {density:g}: vehicles per km of street, more than 0 and at most 100.")
    if not 0 <= hour <= 23:
        raise ValueError(f"--hour {hour}: hours go from 0 to 23.")
    wanted = Density(per_km=density, hour=hour, seed=seed)
    with notes.status("building streets, buildings and demand ..."):
        if osm is not None:
            box = None if bbox is None else degrees(bbox)
            losses = build_from_osm.from_osm(osm, out, wanted, name, left_hand, box)
        else:
            losses = build_from_osm.from_box(bbox or "", out, wanted, name, left_hand, overpass)
    net = catalogue.open_folder(out)
    picture = _draw(find(str(out)), out / PICTURE)
    facts = _summary(net) | {"buildings": len(net.footprints()), "picture": str(picture)}
    in_json = {kind: asdict(of) for kind, of in losses.streets.items()} | {"incomplete_ways": losses.n_incomplete}
    facts["left_out"] = in_json if as_json else losses.text
    if check:
        with notes.status("driving it for half an hour ..."):
            flows = flow.measure(net)
        facts |= asdict(flows) | {"jammed": len(flows.jammed), "assessment": flows.assessment}
    _print_facts(facts, as_json)


@nets.command()
def counts(
    city: Annotated[str, typer.Argument(help="Name of a city, or folder that `nets build` wrote.")],
    file: Annotated[
        Path,
        typer.Argument(
            help="CSV file: per_hour, and edge or lon, lat, heading_deg. One hour of a day; lanes are added."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder to write. `--set traffic.scenario=FOLDER` then simulates it.")],
    hold_out: Annotated[
        float, typer.Option(min=0, max=0.9, help="Share of the places that are kept back, to judge the fit.")
    ] = 0.2,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the draw of routes and places.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Fit the demand of a city to traffic counts, and say how well it agrees, also where it was not fitted."""
    from cosim.addons.netbuild import counts
    from sumo_nets import catalogue

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"--out {out} is not empty. Give a folder that is empty or does not exist.")
    net = catalogue.find(city) if city in catalogue.names() else catalogue.open_folder(Path(city))
    counted = counts.read(file, net.net_path)
    back = counts.kept_back(counted, hold_out, seed)
    fitted = {edge: value for edge, value in counted.items() if edge not in back}
    with notes.status("drawing routes ..."):
        drawn = counts.fit(net, fitted, out, seed)
    with notes.status("driving the old and the new demand ..."):
        before, after = (counts.driven(one, counted) for one in (net, catalogue.open_folder(out)))
    groups = {
        "fitted_drawn": (drawn, fitted), "fitted_before": (before, fitted), "fitted_driven": (after, fitted),
        "kept_back_before": (before, back), "kept_back_driven": (after, back),
    }  # fmt: skip
    facts: dict[str, Any] = {"name": str(out), "vehicles_per_hour": catalogue.open_folder(out).vehicles_per_hour}
    for name, (model, of) in groups.items():
        found = counts.agreement(model, of)
        facts[name] = asdict(found) if as_json else found.text
    _print_facts(facts, as_json)


@nets.command()
def tile(
    city: Annotated[str, typer.Argument(help="Name of a city, its folder, or a .sumocfg.")],
    trace: Annotated[Path, typer.Option(help="Trace that SUMO wrote with --fcd-output in that city.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    tiles: Annotated[str, typer.Option(help="Copies from west to east x from south to north.")] = "2x2",
    as_json: AsJson = False,
) -> None:
    """Put copies of a city and of its recorded traffic side by side, to see what a metropolis takes."""
    from cosim.addons.netbuild.tiling import tile as tiled
    from cosim.traffic.scenario import find

    words = tiles.lower().split("x")
    if len(words) != 2 or not all(word.isdecimal() and len(word) < 4 for word in words):
        raise ValueError(f"--tiles {tiles}: give two numbers, for example 2x2.")
    with notes.status("copying streets, buildings and traffic ..."):
        n_most = tiled(find(city, str(trace)), int(words[0]), int(words[1]), out)
    text = (
        f"wrote {out}: at most {n_most:,} actors at one time. Run it with: cosim run --set traffic.scenario={out} "
        f"--set traffic.trace={out / 'fcd.parquet'}"
    )
    print_done({"out": str(out), "most_actors": n_most}, text, as_json)


def _summary(net: Net | PackageNet) -> dict[str, Any]:
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


def _draw(found: Scenario, path: Path) -> Path:
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
    import numpy as np

    return float(np.hypot(*np.diff(line_m[:, :2], axis=0).T).sum())


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


def _print_facts(facts: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(facts)
        return
    table = Table("", Column("", overflow="fold"), box=None, show_header=False, pad_edge=False)
    for key, (label, shape) in LABELS.items():
        if facts.get(key, "") != "":
            table.add_row(label, shape.format(facts[key]))
    screen.print(table)
