"""Demand that agrees with traffic counts: a city's own vehicles are added to and taken away until they do.

SUMO's `routeSampler` draws the routes. Pedestrians, bicycles and buses stay as they are. The city stands for one hour
of a day, so a place has one count: motor vehicles, with buses, in that hour.
"""

from __future__ import annotations

import csv
import gzip
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from math import cos, nan, radians, sin
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.netbuild import flow
from cosim.addons.netbuild.build import write_checksums
from sumo_nets import catalogue, demand, network, sumotools, vtypes
from sumo_nets.catalogue import Net
from sumo_nets.xml import Attributes, chunks, stream

Counts = dict[str, float]
"""Motor vehicles per hour by edge id."""
Lines = dict[str, Float[ndarray, "k 2"]]
"""Centre line of a street by edge id [m]."""

NEAR_M = 30.0
"""Distance from a street up to which a position belongs to it."""
ALONG_DEG = 45.0
"""Angle between a street and a heading up to which they are the same direction."""
GOOD_GEH = 5.0
"""GEH below which a modelled flow of one hour agrees with a count. 85 % of the counts should
(UK Department for Transport, TAG unit M3.1, Highway Assignment Modelling)."""
_NO_MOTOR = ("bicycle", "pedestrian")
_BOUNDS = {"per_hour": (0.0, 20_000.0), "lon": (-180.0, 180.0), "lat": (-90.0, 90.0), "heading_deg": (-360.0, 360.0)}
"""Of the columns of a file. Ten lanes of a motorway carry 20,000 vehicles per hour."""
_TIMES = ("hour", "begin", "end", "time", "date", "day", "interval")
"""Columns that say when a row was counted."""
_DRIVEN_S = 1200.0
"""Time after the warm-up for which the demand is simulated to count what it drives."""
_ELEMENT = re.compile(r"<(person|vehicle) .*?</\1>", re.DOTALL)
_KEPT = re.compile(r'<(person|vehicle) id="[^"]*" type="(pedestrian|bicycle)"')


@dataclass(frozen=True, slots=True)
class Agreement:
    """How many of some counts a demand agrees with."""

    places: int
    good_share: float | None = None
    """Share with a GEH below `GOOD_GEH`; like the others, None without places."""
    geh_median: float | None = None
    ratio: float | None = None
    """Vehicles of the model over vehicles counted; None where none was counted."""

    @property
    def text(self) -> str:
        """One line for a terminal."""
        if self.places == 0:
            return "no places"
        good = f"{self.good_share:.0%} of {self.places} places agree (GEH below {GOOD_GEH:g})"
        times = "" if self.ratio is None else f", {self.ratio:.2f} times the counted vehicles"
        return f"{good}, median GEH {self.geh_median:.1f}{times}"


def geh(
    model: Float[ndarray, "k"],
    counted: Float[ndarray, "k"],
) -> Float[ndarray, "k"]:
    """GEH statistic of flows in vehicles per hour: sqrt(2 (m - c)² / (m + c)), 0 where both are 0."""
    total = model + counted
    divisor = np.where(total > 0, total, 1.0)
    return np.sqrt(2.0 * (model - counted) ** 2 / divisor)


def agreement(model: Counts, counted: Counts) -> Agreement:
    """Summary over the places of `counted`."""
    if not counted:
        return Agreement(0)
    m = np.array([model[edge] for edge in counted])
    c = np.array([*counted.values()])
    found = geh(m, c)
    good_share = float((found < GOOD_GEH).mean())
    ratio = float(m.sum() / c.sum()) if c.sum() > 0 else None
    return Agreement(len(c), good_share, float(np.median(found)), ratio)


def read(path: Path, net_path: Path) -> Counts:
    """Counts by street: vehicles per hour, sorted by edge id.

    Parameters
    ----------
    path
        CSV file with the column `per_hour`, and either `edge` or `lon`, `lat` and `heading_deg` (clockwise from north).
        Rows of the same street are added, because a detector counts one lane.

    Raises
    ------
    ValueError
        The file cannot be used; the message is one line.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, strict=True, skipinitialspace=True)
            rows = {f"{path}, line {reader.line_num}": row for row in reader}
            columns = list(reader.fieldnames or [])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: not a CSV file that can be read ({error}).") from None
    if not rows:
        raise ValueError(f"{path} has no rows below its header.")
    place = ["edge"] if "edge" in columns else ["lon", "lat", "heading_deg"]
    if missing := [name for name in ("per_hour", *place) if name not in columns]:
        head = ", ".join(columns)
        is_other = any(mark in head for mark in (";", "\t", "|"))
        cure = " Separate columns with commas." if is_other else ""
        raise ValueError(
            f"{path} has no column {missing[0]}. It needs per_hour, and edge or lon, lat, heading_deg. It has: "
            f"{head}.{cure}"
        )
    if twice := [name for name in ("per_hour", *place) if columns.count(name) > 1]:
        raise ValueError(f"{path} has two columns {twice[0]}. Keep that of the hour that the city stands for.")
    for where, row in rows.items():
        if any(row.get(None, ())):  # type: ignore[call-overload]
            raise ValueError(f"{where}: more values than the header has columns. Decimals follow a point, not a comma.")
    for name in columns:
        times = {row[name] for row in rows.values()}
        if name.lower() in _TIMES and len(times) > 1:
            raise ValueError(f"{path}: {name} differs between rows, which would be added. Keep the rows of one hour.")
    per_hour = _column(rows, "per_hour")
    edges = _edges(net_path)
    if place == ["edge"]:
        found = [row["edge"] or "" for row in rows.values()]
        for where, edge in zip(rows, found, strict=True):
            if edge not in edges:
                raise ValueError(f"{where}: the network has no street {edge!r} for motor vehicles.")
    else:
        places = np.column_stack([_column(rows, name) for name in place])
        found = _matched(dict(zip(rows, places, strict=True)), edges, net_path)
    total: dict[str, float] = dict.fromkeys(sorted(set(found)), 0.0)
    for edge, value in zip(found, per_hour.tolist(), strict=True):
        total[edge] += value
    return total


def kept_back(counted: Counts, share: float, seed: int) -> Counts:
    """The places that a fit does not use: `share` of them, drawn by the seed; at least one place is used."""
    order = np.random.default_rng(seed).permutation(len(counted)).tolist()
    n = min(round(share * len(counted)), len(counted) - 1)
    drawn = zip(counted, order, strict=True)
    return {edge: counted[edge] for edge, k in drawn if k < n}


def fit(net: Net, counted: Counts, out: Path, seed: int) -> Counts:
    """Write the city with a demand that agrees with the counts into the folder `out`.

    Returns
    -------
    Vehicles per hour that the new routes and the buses bring to each counted street.
    """
    elements = _elements(net.folder / "demand.rou.xml.gz")
    kept = [text for text in elements if _KEPT.match(text)]
    candidates = [text for text in elements if not _KEPT.match(text)]
    if not any(set(_route(text)) & counted.keys() for text in candidates):
        raise ValueError(f"no vehicle of {net.name} passes a street that was counted. Count other streets.")
    hours = net.end_s / 3600.0
    buses = _passed(_elements(net.folder / "buses.rou.xml.gz"))
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as name:
        work = Path(name)
        demand.write_trips(work / "candidates.rou.xml", candidates)
        rows = ""
        for edge, per_hour in counted.items():
            left = max(0, round(per_hour * hours) - buses[edge])
            rows += f'<edge id={quoteattr(edge)} entered="{left}"/>'
        interval = f'<interval id="counts" begin="0" end="{net.end_s:g}">{rows}</interval>'
        (work / "counts.xml").write_text(f"<data>{interval}</data>", encoding="utf-8")
        _sample(work, net.end_s, seed)
        sampled = _departing(_elements(work / "sampled.rou.xml"), candidates, net.end_s, seed)
        demand.write_trips(work / "all.rou.xml", [*kept, *sampled])
        city = work / "city"
        shutil.copytree(net.folder, city)
        (city / "demand.rou.xml.gz").write_bytes(gzip.compress((work / "all.rou.xml").read_bytes(), 9, mtime=0))
        n_bicycles = sum('type="bicycle"' in text for text in kept)
        _describe(net, city, (len(sampled) + n_bicycles) / hours)
        shutil.copytree(city, out, dirs_exist_ok=True)
    passed = _passed(sampled) + buses
    return {edge: passed[edge] / hours for edge in counted}


def driven(net: Net, edges: Iterable[str]) -> Counts:
    """Motor vehicles per hour that enter each of these streets when the demand is simulated, after the warm-up."""
    found = dict.fromkeys(edges, 0.0)
    types = vtypes.read([net.folder / "vtypes.add.xml"])
    motorised = sorted(name for name, of in types.items() if of.vclass not in _NO_MOTOR)

    def start(name: str, attributes: Attributes) -> None:
        if name == "edge" and attributes["id"] in found:
            entered = float(attributes["entered"]) + float(attributes.get("departed", 0.0))
            found[attributes["id"]] = entered * 3600.0 / _DRIVEN_S

    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as name:
        if (streets := flow.simulate(net, _DRIVEN_S, Path(name), motorised)).is_file():  # there is none without traffic
            stream(streets, start)
    return found


def _sample(work: Path, end_s: float, seed: int) -> None:
    words = [
        sys.executable,
        str(sumotools.home() / "tools" / "routeSampler.py"),
        "-r",
        "candidates.rou.xml",
        "-d",
        "counts.xml",
        "-o",
        "sampled.rou.xml",
        "--keep-attributes",
        "--init-input",
        "--init-input.remove-overflow",
        "--prefix",
        "v",
        "--begin",
        "0",
        "--end",
        f"{end_s:g}",
        "--seed",
        str(seed),
    ]
    done = subprocess.run(words, cwd=work, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ValueError(f"SUMO's routeSampler failed: {done.stderr.strip()[-500:]}")


def _departing(sampled: list[str], candidates: list[str], end_s: float, seed: int) -> list[str]:
    """The sampled vehicles, where those that were added depart at any time: `routeSampler` makes them depart late."""
    own = {_departure(text) for text in candidates}
    draw = demand.Draw(seed, "counts")

    def anew(text: str) -> str:
        return re.sub('depart="[^"]*"', f'depart="{draw.uniform() * end_s:.1f}"', text, count=1)

    return [text if _departure(text) in own else anew(text) for text in sampled]


def _departure(text: str) -> tuple[str, float]:
    """Name and time [s]."""
    found = re.search(r'id="([^"]*)"[^>]* depart="([^"]*)"', text)
    assert found is not None
    return found[1], float(found[2])


def _describe(net: Net, out: Path, per_hour: float) -> None:
    """Make the new folder a city of its own: its recipe, its configuration without rerouting, its checksums."""
    recipe = (out / "recipe.toml").read_text(encoding="utf-8")
    recipe = recipe.split("\n[counts]\n")[0].rstrip("\n") + f"\n\n[counts]\nvehicles_per_hour = {per_hour:.1f}\n"
    (out / "recipe.toml").write_text(recipe, encoding="utf-8", newline="\n")
    config = out / net.sumocfg_path.name
    text = re.sub(r'(<device\.rerouting\.probability value=)"[^"]*"', r'\1"0"', config.read_text(encoding="utf-8"))
    config.write_text(text, encoding="utf-8", newline="\n")  # rerouted vehicles would leave the streets they count on
    write_checksums(out)
    catalogue.open_folder(out)


def _elements(path: Path) -> list[str]:
    """The persons and vehicles of a route file, each as text."""
    return [match.group(0) for match in _ELEMENT.finditer(b"".join(chunks(path)).decode())]


def _passed(elements: Iterable[str]) -> Counter[str]:
    """How many of these vehicles each street is on the route of."""
    return Counter(edge for text in elements for edge in set(_route(text)))


def _route(text: str) -> list[str]:
    found = re.search(r'<route [^>]*edges="([^"]*)"', text)
    return found.group(1).split() if found else []


def _edges(net_path: Path) -> Lines:
    """The line of each street on which motor vehicles may drive: that of its last such lane."""
    found: Lines = {}
    for lane in network.lanes(net_path):
        if lane.for_cars and not lane.across:
            found[lane.edge] = lane.line_m[:, :2]
    return found


def _column(
    rows: dict[str, dict[str, str]],
    name: str,
) -> Float[ndarray, "r"]:
    low, high = _BOUNDS[name]
    found = np.empty(len(rows))
    for number, (where, row) in enumerate(rows.items()):
        try:
            found[number] = float(row[name])
        except (TypeError, ValueError):
            found[number] = nan
        if not low <= found[number] <= high:  # also where it is no number
            said = row[name]
            raise ValueError(f"{where}: {name} = {said} is no number from {low:g} to {high:g}.")
    return found


def _matched(
    places: dict[str, Float[ndarray, "3"]],
    edges: Lines,
    net_path: Path,
) -> list[str]:
    """The street of each longitude, latitude and heading: the nearest that leads in that direction."""
    corners = np.array([[0.0, 0.0], [1e-4, 0.0], [0.0, 1e-4]])
    rings = [place[:2] + corners for place in places.values()]
    points = [ring[0] for ring in sumotools.projected(rings, net_path)]
    n_steps = [len(line) - 1 for line in edges.values()]
    names = np.array([*edges], object).repeat(n_steps)
    first = np.concatenate([line[:-1] for line in edges.values()])
    step = np.concatenate([np.diff(line, axis=0) for line in edges.values()])
    length = np.maximum(np.hypot(*step.T), 1e-9)
    found = []
    for point, (where, (lon, lat, heading_deg)) in zip(points, places.items(), strict=True):
        from_first = point - first
        share = np.clip((from_first * step).sum(axis=1) / length**2, 0.0, 1.0)
        aside = from_first - share[:, None] * step
        away = np.hypot(*aside.T)
        heading_rad = radians(heading_deg)
        along = (step @ np.array([sin(heading_rad), cos(heading_rad)])) / length
        fits = (along >= cos(radians(ALONG_DEG))) & (away <= NEAR_M)
        if not fits.any():
            raise ValueError(
                f"{where}: no street that leads to {heading_deg:g} degrees within {NEAR_M:g} m of {lon}, {lat}."
            )
        nearest = np.argmin(np.where(fits, away, np.inf))
        found.append(str(names[nearest]))
    return found
