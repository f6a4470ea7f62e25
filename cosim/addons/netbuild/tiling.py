"""A larger city from a city and its trace: copies of both side by side, each with names of its own."""

import gzip
import re
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.netbuild.build import check_out
from cosim.traffic.fcd import OBSERVED, Timestep, is_observed
from cosim.traffic.identity import TypeTable
from cosim.traffic.replay import opened
from cosim.traffic.scenario import Scenario
from sumo_nets import sumotools
from sumo_nets.footprints import Footprint, read_footprints, write_footprints

Columns = dict[str, ndarray | pa.Array]
LARGEST_M = 65_536.0
"""Positions are multiples of 1/256 m in single precision, which holds them exactly up to here."""


def tile(scenario: Scenario, n_east: int, n_north: int, out: Path) -> int:
    """Write a scenario of copies of a city, side by side, and of its trace, which `cosim run` replays.

    The streets of two copies do not meet, and each vehicle stays in its copy. Sensors and radio reach into the next
    copy. The scenario has no demand, so SUMO itself cannot simulate it.

    Parameters
    ----------
    scenario
        The city, with a trace of SUMO's.
    n_east, n_north
        Number of copies from west to east, and from south to north.
    out
        Folder to write.

    Returns
    -------
    Most actors at one time.

    Raises
    ------
    ValueError
        In one line, if the city cannot be copied. Nothing is written.
    """
    net, bounds_m, trace = scenario.net, scenario.bounds_m, scenario.trace
    if net is None or bounds_m is None or trace is None or trace.is_dir():
        raise ValueError(f"{scenario.name}: give a city with a network, and a trace of SUMO's (--trace fcd.parquet).")
    if min(n_east, n_north) < 1 or n_east * n_north < 2:
        raise ValueError(f"--tiles {n_east}x{n_north}: give 2 copies or more, for example 2x2.")
    check_out(out)
    west, south, east, north = bounds_m
    size_m = np.ceil([east - west, north - south])
    if (size_m * (n_east, n_north)).max() > LARGEST_M:
        wide, high = size_m * (n_east, n_north) / 1000
        raise ValueError(f"--tiles {n_east}x{n_north}: {wide:.0f} km x {high:.0f} km; positions reach up to 65 km.")
    shifts_m = size_m * np.array(list(product(range(n_east), range(n_north))), float)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as place:
        work = Path(place) / "city"
        work.mkdir()
        n_most = _trace(scenario, shifts_m, work)
        buildings = [f for path in scenario.buildings for f in read_footprints(path, net)]

        def moved() -> Iterator[tuple[str, Footprint]]:
            for copy, by_m in enumerate(shifts_m):
                for n, one in enumerate(buildings):
                    holes = [hole + by_m for hole in one.holes]
                    yield f"{copy}.{n}", one._replace(outer=one.outer + by_m, holes=holes)

        write_footprints(work / "buildings.poly.xml", moved())
        east, north = [west, south] + size_m * (n_east, n_north)
        _network(net, shifts_m, (west, south, east, north), work)
        (work / f"{out.name}.sumocfg").write_text(
            '<configuration>\n    <net-file value="net.net.xml.gz"/>\n'
            '    <additional-files value="vtypes.add.xml,buildings.poly.xml"/>\n</configuration>\n',
            encoding="utf-8",
        )
        if scenario.attribution:
            about = f"{scenario.attribution}\nLicence: {scenario.licence}\n"
            (work / "ATTRIBUTION.txt").write_text(about, encoding="utf-8")
        out.mkdir(exist_ok=True)
        for file in work.iterdir():
            file.rename(out / file.name)
    return n_most


def _trace(scenario: Scenario, shifts_m: Float[ndarray, "k 2"], out: Path) -> int:
    """Write the trace of all copies, and the vehicle types that occur in it; return the most actors at one time."""
    assert scenario.trace is not None
    ahead, read, convert, _ = opened(scenario.trace, scenario.location())
    about = {OBSERVED: b""} if is_observed(scenario.trace) else None
    types: set[str] = set()
    n_most, writer = 0, None
    try:
        for timestep in map(_typed, chain(ahead, read)):
            if convert is not None and timestep.names:
                timestep = convert(timestep)
            types.update(timestep.types)
            n_most = max(n_most, len(timestep.names) * len(shifts_m))
            table = pa.table(_columns(timestep, shifts_m)).replace_schema_metadata(about)
            writer = writer or pq.ParquetWriter(out / "fcd.parquet", table.schema, compression="zstd")
            writer.write_table(table)
    finally:
        if writer is not None:
            writer.close()
    look_up = TypeTable(scenario.types)
    lines = []
    for name in sorted(types):
        vclass, size_m = look_up(name)
        length, width, height = (quoteattr(f"{m:g}") for m in size_m)
        lines.append(
            f"    <vType id={quoteattr(name)} vClass={quoteattr(vclass)} length={length} width={width} "
            f"height={height}/>\n"
        )
    (out / "vtypes.add.xml").write_text("<additional>\n" + "".join(lines) + "</additional>\n", encoding="utf-8")
    return n_most


def _typed(timestep: Timestep) -> Timestep:
    """The timestep with a type for persons that have none: the columns that are written do not say who is a person."""
    types = [
        kind or ("DEFAULT_PEDTYPE" if is_person else "")
        for kind, is_person in zip(timestep.types, timestep.is_person.tolist(), strict=True)
    ]
    return replace(timestep, types=types)


def _columns(timestep: Timestep, shifts_m: Float[ndarray, "k 2"]) -> Columns:
    """The rows of all copies of a timestep, with the columns that SUMO writes."""
    n, k = len(timestep.names), len(shifts_m)
    copies = pa.array(np.repeat(np.arange(k), n)).cast(pa.string())
    front_m = timestep.front_m[:, :2]
    xy_m = (shifts_m[:, None] + front_m).reshape(-1, 2)
    names = pa.array(timestep.names * k, pa.string())
    stated: Columns = {}
    if timestep.vclasses is not None:
        stated["vehicle_vClass"] = pa.array(timestep.vclasses * k, pa.string())
    if timestep.lwh_m is not None:
        sizes = zip(("length", "width", "height"), timestep.lwh_m.T, strict=True)
        stated |= {f"vehicle_{what}": np.tile(values, k) for what, values in sizes}
    return stated | {
        "timestep_time": np.full(n * k, timestep.time_s),
        "vehicle_id": pc.binary_join_element_wise(copies, names, "."),
        "vehicle_x": xy_m[:, 0],
        "vehicle_y": xy_m[:, 1],
        "vehicle_z": np.tile(timestep.front_m[:, 2], k),
        "vehicle_angle": np.tile(timestep.compass_deg, k),
        "vehicle_type": pa.array(timestep.types * k, pa.string()).dictionary_encode(),
        "vehicle_speed": np.tile(timestep.speed_mps, k),
    }


def _network(net: Path, shifts_m: Float[ndarray, "k 2"], bounds_m: tuple[float, ...], out: Path) -> None:
    """Write the streets of all copies, by netconvert."""
    copies = []
    for copy, (east_m, north_m) in enumerate(shifts_m.tolist()):
        copies.append(f"{copy}.net.xml")
        options = {"sumo-net-file": net.name, "prefix": f"{copy}.", "output-file": (out / copies[-1]).resolve()}
        moved = {"offset.x": east_m, "offset.y": north_m, "offset.disable-normalization": True}
        sumotools.run("netconvert", options | moved, net.parent)
        text = sumotools.without_header(out / copies[-1])
        text = re.sub(r"<location [^>]*>", "", text, count=1)  # netconvert would move the copy back by its offset
        (out / copies[-1]).write_text(text, encoding="utf-8")
    joined = {"sumo-net-file": ",".join(copies), "output-file": "net.net.xml", "offset.disable-normalization": True}
    sumotools.run("netconvert", joined, out)
    text = sumotools.without_header(out / "net.net.xml")
    bounds = ",".join(f"{m:.2f}" for m in bounds_m)
    text = re.sub(r'convBoundary="[^"]*"', f'convBoundary="{bounds}"', text, count=1)
    with gzip.open(out / "net.net.xml.gz", "wt", encoding="utf-8", compresslevel=6) as file:
        file.write(text)
    for name in (*copies, "net.net.xml"):
        (out / name).unlink()
