"""The commands that make cities: build, fit to counts, and tile."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from cosim.cli.console import AsJson, notes, print_done, print_note
from cosim.cli.nets import PICTURE, draw, print_facts, summary


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
    density: Annotated[
        float, typer.Option(help="Vehicles on the road per km of street and direction, through traffic aside.")
    ] = 2.0,
    hour: Annotated[int, typer.Option(help="Hour of a working day, 0 to 23. Hour 16 is the busiest.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the demand.")] = 1,
    left_hand: Annotated[bool, typer.Option("--left-hand", help="Vehicles drive on the left.")] = False,
    name: Annotated[str | None, typer.Option(help="Name of the city. The default is the folder's name.")] = None,
    check: Annotated[bool, typer.Option(help="Simulate half an hour and report whether traffic flows.")] = True,
    as_json: AsJson = False,
) -> None:
    """Build a city from OpenStreetMap: streets, traffic lights, pavements, buildings, demand and a traffic report."""
    from cosim.addons.netbuild import build_from_osm, flow
    from cosim.addons.netbuild.build import check_out
    from cosim.addons.netbuild.overpass import degrees
    from cosim.studies.density import note_vehicles
    from cosim.traffic.scenario import find
    from sumo_nets import catalogue
    from sumo_nets.density import Density

    if osm is None and bbox is None:
        raise ValueError("cosim nets build needs --osm FILE, --bbox west,south,east,north, or both.")
    if overpass is not None and (bbox is None or osm is not None):
        raise ValueError("--overpass goes with --bbox west,south,east,north and without --osm. Leave it out.")
    check_out(out)
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
    if losses.side:
        print_note(losses.side)
    net = catalogue.open_folder(out)
    picture = draw(find(str(out)), out / PICTURE)
    facts = summary(net) | {"buildings": len(net.footprints()), "picture": str(picture)}
    facts["left_out"] = losses.text
    if as_json:
        streets = {kind: asdict(of) for kind, of in losses.streets.items()}
        facts["left_out"] = streets | {"incomplete_ways": losses.n_incomplete}
    if check:
        with notes.status("driving it for half an hour ..."):
            flows = flow.measure(net)
        note_vehicles(find(str(out)), flows.vehicles_mean, None, net.warm_up_s)
        facts |= asdict(flows) | {"jammed": len(flows.jammed), "assessment": flows.assessment}
    print_facts(facts, as_json)


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
    from cosim.addons.netbuild.build import check_out
    from sumo_nets import catalogue

    check_out(out)
    net = catalogue.find(city) if city in catalogue.names() else catalogue.open_folder(Path(city))
    counted = counts.read(file, net.net_path)
    back = counts.kept_back(counted, hold_out, seed)
    fitted = {edge: value for edge, value in counted.items() if edge not in back}
    with notes.status("drawing routes ..."):
        drawn = counts.fit(net, fitted, out, seed)
    with notes.status("driving the old and the new demand ..."):
        made = catalogue.open_folder(out)
        before, after = counts.driven(net, counted), counts.driven(made, counted)
    groups = {
        "fitted_drawn": (drawn, fitted),
        "fitted_before": (before, fitted),
        "fitted_driven": (after, fitted),
        "kept_back_before": (before, back),
        "kept_back_driven": (after, back),
    }
    facts: dict[str, Any] = {"name": str(out), "vehicles_per_hour": made.vehicles_per_hour}
    for name, (model, of) in groups.items():
        found = counts.agreement(model, of)
        facts[name] = asdict(found) if as_json else found.text
    print_facts(facts, as_json)


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

    numbers = re.fullmatch("([0-9]{1,8})x([0-9]{1,8})", tiles.lower())
    if numbers is None:
        raise ValueError(f"--tiles {tiles}: give two numbers, for example 2x2.")
    across, up = map(int, numbers.groups())
    with notes.status("copying streets, buildings and traffic ..."):
        n_most = tiled(find(city, str(trace)), across, up, out)
    text = (
        f"wrote {out}: at most {n_most:,} actors at one time. Run it with: cosim run --set traffic.scenario={out} "
        f"--set traffic.trace={out / 'fcd.parquet'}"
    )
    print_done({"out": str(out), "most_actors": n_most}, text, as_json)
