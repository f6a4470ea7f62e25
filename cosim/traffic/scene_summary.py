"""What was loaded as streets and buildings of a scenario, in one line each, and notes on what looks like a mistake."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely

from cosim.traffic.scenario import Scenario
from sumo_nets.footprints import Footprint, OtherPolygons, read_polygons
from sumo_nets.ground import covered_m, segments, standing_on
from sumo_nets.levels import crossings
from sumo_nets.network import Lane, is_left_hand, lanes, n_jumps, stretch
from sumo_nets.xml import version_of

MOST_COVERED_P = 0.01
"""If buildings cover more of the length of the lanes, the scenario gets a note. A tunnel may lie below a building."""
MOST_CROSSING_P = 0.1
"""If more of the lanes cross another one at the same height outside junctions, the scenario gets a note. A city without
heights of its bridges has 5 %."""
STEEP, MOST_STEEP_P = 0.02, 0.25
"""If a larger share of the length of the lanes is steeper than the first, the scenario gets a note."""
MOST_STRETCHED = 1.1
"""If a network is more times as long as on Earth, the scenario gets a note. UTM's are 1.001 at most."""
NEAR_M = 1000.0
"""Buildings farther from the network hide nobody [m]."""
_NO_BUILDINGS = frozenset(
    (
        "landuse",
        "natural",
        "water",
        "waterway",
        "leisure",
        "park",
        "forest",
        "grass",
        "railway",
        "highway",
        "barrier",
        "power",
        "amenity",
        "tourism",
        "historic",
        "aeroway",
        "boundary",
        "sport",
        "place",
        "man_made",
        "route",
        "parking",
    )
)
"""First words of types of polygons that are no buildings and are often in polygon files."""
_RULE = 'A polygon is a building if its type begins with "building" or it has a parameter "building".'


@dataclass(frozen=True, slots=True)
class SceneSummary:
    """Lines on a scenario's streets and buildings."""

    streets: str
    buildings: str
    n_buildings: int = 0
    notes: tuple[str, ...] = ()
    """What looks like a mistake, each in one line."""

    @property
    def lines(self) -> dict[str, str]:
        """The lines by topic."""
        return {"streets": self.streets, "buildings": self.buildings}


def scene_summary(scenario: Scenario) -> SceneSummary:
    """Read the network and the polygons of a scenario, and tell what is in them. A large city takes seconds."""
    files = (scenario.net, scenario.sumocfg, *scenario.buildings)
    return _summary(scenario, tuple(version_of(path) for path in files if path is not None))


@lru_cache(maxsize=1)
def _summary(scenario: Scenario, versions: tuple[tuple[int, ...], ...]) -> SceneSummary:
    """As `scene_summary`, of these versions of the files."""
    if scenario.net is None:
        return SceneSummary("none: a trace without a network", "none: everybody sees everybody")
    found = lanes(scenario.net)
    polygons = {path: read_polygons(path, scenario.net) for path in scenario.buildings}
    footprints = [footprint for of_file, _ in polygons.values() for footprint in of_file]
    standing = standing_on(footprints, found)
    streets, notes = _streets(scenario, found)
    others_of = {path: others for path, (_, others) in polygons.items()}
    notes += _polygon_notes(others_of, len(footprints))
    notes += _place_notes(scenario, found, standing)
    said = tuple(f"note: {note}" for note in notes)
    return SceneSummary(streets, _buildings(footprints), len(footprints), said)


def _streets(scenario: Scenario, found: Sequence[Lane]) -> tuple[str, list[str]]:
    assert scenario.net is not None
    driven = [lane for lane in found if lane.for_cars and not lane.across]
    begin_m, end_m = segments(driven)
    dx_m, dy_m, rise_m = (end_m - begin_m).T
    length_m = np.hypot(dx_m, dy_m)
    length_km = float(length_m.sum()) / 1000
    z_m = np.concatenate([begin_m[:, 2], end_m[:, 2]])
    over = crossings(found)
    level = over.lane[over.on_one_level]
    parts = [
        f"{length_km:,.1f} km of lanes in {len({lane.edge for lane in driven}):,} streets",
        "left-hand traffic" if is_left_hand(scenario.net) else "right-hand traffic",
        f"heights from {z_m.min():.0f} to {z_m.max():.0f} m" if z_m.any() else "all at height 0",
    ]
    if len(level):
        parts.append(f"lanes cross at one height outside junctions in {len(level):,} places")
    notes = []
    if (share := len(np.unique(level)) / max(len(driven), 1)) > MOST_CROSSING_P:
        notes.append(
            f"{scenario.net}: lanes cross at one height outside junctions in {len(level):,} places ({share:.0%} of the "
            "lanes): vehicles drive through one another there. Bridges and tunnels need heights: build the network "
            "with netconvert --osm.layer-elevation 5, or give its nodes a z."
        )
    if (times := stretch(scenario.net) or 0.0) > MOST_STRETCHED:
        notes.append(
            f"{scenario.net}: everything is {times:.2g} times as long as on Earth, by its bounds in degrees: is it in "
            "feet, or in web Mercator? Build it with netconvert --proj.utm."
        )
    is_steep = np.abs(rise_m) > STEEP * length_m
    share = float(length_m[is_steep].sum()) / 1000 / max(length_km, 1e-9)
    if share > MOST_STEEP_P:
        notes.append(
            f"{scenario.net}: {share:.0%} of the length of the lanes is steeper than {STEEP:.0%}. For each sensor the "
            "ground is level and hides who drives lower: on a street that falls by 5 %, vehicles have 44 % fewer "
            "detections. netconvert --flatten removes the heights."
        )
    notes += _jump_notes(scenario, found)
    return ", ".join(parts), notes


def _jump_notes(scenario: Scenario, found: Sequence[Lane]) -> list[str]:
    """Notes on vehicles that have no place between streets, or only one per segment of a street."""
    if scenario.trace is not None or scenario.sumocfg is None or scenario.net is None:
        return []
    notes = []
    if "mesosim" in scenario.switches:
        notes.append(
            f"{scenario.sumocfg} sets mesosim: SUMO knows the segment of a street in which a vehicle is, not its "
            "place. Vehicles stand on one another and jump, and encounters are not those of a road. Remove mesosim."
        )
    elif "no-internal-links" in scenario.switches:
        notes.append(
            f"{scenario.sumocfg} sets no-internal-links: vehicles jump across junctions, and nobody is ever on one. "
            "Remove the option."
        )
    elif not any(lane.across for lane in found) and (n := n_jumps(scenario.net)):
        notes.append(
            f"{scenario.net}: the network has no ways through its junctions (0 for {n:,} connections): vehicles jump "
            "across them, and nobody is ever on one. Build it again with netconvert, without --no-internal-links."
        )
    return notes


def _buildings(footprints: Sequence[Footprint]) -> str:
    if not footprints:
        return "none: everybody sees everybody"
    said = {
        "given": "in the file, measured or guessed",
        "measured": "from the tag height",
        "storeys": "from storeys",
        "default": "by kind and size",
    }
    count = Counter(footprint.height_from for footprint in footprints)
    heights = []
    for source, how in said.items():
        if n := count[source]:
            heights.append(f"{n:,} {how}")
    return f"{len(footprints):,}; heights: {', '.join(heights)}"


def _polygon_notes(files: dict[Path, dict[str, OtherPolygons]], n_buildings: int) -> list[str]:
    """Notes on polygons that are no buildings but look as if they should be."""
    notes = []
    for path, others in files.items():
        odd = {kind: of for kind, of in others.items() if _first_word(kind) not in _NO_BUILDINGS}
        high = {kind: of.n_high for kind, of in odd.items() if of.n_high}
        if odd and not n_buildings:
            n = sum(of.n for of in others.values())
            types = _types({kind: of.n for kind, of in odd.items()})
            notes.append(
                f"none of the {n:,} polygons of {path} is a building ({types}): everybody sees everybody. {_RULE}"
            )
        elif high:
            n = sum(high.values())
            notes.append(f"{n:,} polygons of {path} have a height but are no buildings ({_types(high)}). {_RULE}")
    return notes


def _types(n_of_kind: dict[str, int]) -> str:
    """The most frequent types of polygons, with numbers."""
    by_name = sorted(n_of_kind.items())
    most = sorted(by_name, key=lambda item: item[1], reverse=True)
    named = [f"{kind or 'without a type'} {n:,}" for kind, n in most[:4]]
    if len(most) > 4:
        named.append("...")
    return f"types: {', '.join(named)}"


def _first_word(kind: str) -> str:
    return kind.replace("=", ".").replace(":", ".").partition(".")[0].strip().lower()


def _place_notes(scenario: Scenario, found: Sequence[Lane], standing: Sequence[Footprint]) -> list[str]:
    """Notes on buildings that are nowhere near the streets, or on them."""
    if not standing:
        return []
    shapes = np.array([footprint.polygon for footprint in standing])
    x0, y0, x1, y1 = shapely.bounds(shapes).T
    line = segments(found)[0][:, :2]
    w, s = line.min(axis=0) - NEAR_M
    e, n = line.max(axis=0) + NEAR_M
    in_width = (x1 >= w) & (x0 <= e)
    is_near = in_width & (y1 >= s) & (y0 <= n)
    files = ", ".join(map(str, scenario.buildings))
    if not is_near.any():
        middle_m = np.array([x0 + x1, y0 + y1]).mean(axis=1) / 2
        dx_m, dy_m = middle_m - line.mean(axis=0)
        off_km = np.hypot(dx_m, dy_m) / 1000
        return [
            f"none of the {len(shapes):,} buildings of {files} is within {NEAR_M / 1000:g} km of the network: they are "
            f"{off_km:,.0f} km away. Make them with the network's own offset: polyconvert --net-file {scenario.net}."
        ]
    inside_m, all_m = covered_m(found, standing, shapes)
    if inside_m <= MOST_COVERED_P * all_m:
        return []
    return [
        f"{inside_m / all_m:.0%} of the length of the lanes ({inside_m / 1000:,.1f} km) lie inside buildings of "
        f"{files}: vehicles there see nobody. Do polygons and network have the same offset? Make the polygons with "
        f"polyconvert --net-file {scenario.net}."
    ]
