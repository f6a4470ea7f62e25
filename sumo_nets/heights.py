"""How tall a building is, from its OpenStreetMap tags."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal, NamedTuple

STOREY_M = 3.5
"""Floor to floor in an old city centre, roof included in the top one's [m]."""
CLEARANCE_M = 4.5
"""Under roofs and passages that name no height of their own [m]."""

TALLEST_M = 900.0
"""Larger heights are taken for typing errors; the tallest building is 828 m tall."""

_BY_KIND_M: dict[str, float] = {
    "church": 25.0,
    "cathedral": 40.0,
    "chapel": 12.0,
    "mosque": 15.0,
    "synagogue": 15.0,
    "temple": 12.0,
    "tower": 25.0,
    "water_tower": 30.0,
    "silo": 15.0,
    "storage_tank": 10.0,
    "transformer_tower": 8.0,
    "kiosk": 3.0,
    "shed": 3.0,
    "hut": 3.0,
    "garage": 3.0,
    "garages": 3.0,
    "toilets": 3.0,
    "service": 3.5,
    "carport": 3.0,
    "cabin": 3.5,
    "static_caravan": 3.0,
    "allotment_house": 3.0,
    "container": 3.0,
    "tent": 3.0,
    "outbuilding": 3.0,
    "conservatory": 3.0,
    "bunker": 3.0,
    "ruins": 3.0,
    "underpass_entrance": 3.0,
    "subway_entrance": 3.0,
    "pavilion": 5.0,
    "greenhouse": 4.0,
    "glasshouse": 4.0,
    "ship": 6.0,
    "houseboat": 4.0,
    "roof": 5.5,
    "canopy": 5.5,
    "bridge": 7.0,
    "house": 7.0,
    "detached": 7.0,
    "terrace": 8.0,
    "semidetached_house": 7.0,
    "bungalow": 4.5,
    "farm": 7.0,
    "barn": 7.0,
    "farm_auxiliary": 6.0,
    "stable": 5.0,
    "cowshed": 6.0,
    "sty": 4.0,
    "industrial": 9.0,
    "warehouse": 9.0,
    "manufacture": 9.0,
    "hangar": 10.0,
    "supermarket": 6.0,
    "sports_hall": 9.0,
    "grandstand": 10.0,
    "stadium": 20.0,
    "kindergarten": 5.0,
    "fire_station": 7.0,
    "parking": 10.5,
    "train_station": 10.5,
    "atrium": 14.0,
    "apartments": 21.0,
    "residential": 21.0,
    "office": 21.0,
    "commercial": 17.5,
    "retail": 14.0,
    "hotel": 24.5,
    "university": 17.5,
    "school": 14.0,
    "public": 17.5,
    "civic": 17.5,
    "block": 21.0,
}
OPEN_BELOW = frozenset(("roof", "canopy", "carport", "bridge"))
"""Kinds that stand on posts."""
_UNIT_M = {**dict.fromkeys(("ft", "feet", "foot", "'", "′", "’"), 0.3048), "cm": 0.01, "km": 1000.0}
_NUMBER = re.compile(
    r"""\s*(?P<value>\d+(?:[.,]\d+)?)\s*(?P<unit>[a-z]+|['′’]|)(?:\s*(?P<inches>\d+(?:\.\d+)?)\s*(?:["″”]|in|''))?""",
    re.IGNORECASE,
)
"""A number of a tag, such as `12.5 m` or `7'6"`."""
_NO_MORE = frozenset(("no", "demolished", "razed", "proposed", "planned"))


class Height(NamedTuple):
    """Vertical extent above the ground, and where it comes from."""

    base_z_m: float
    top_z_m: float
    source: Literal["measured", "storeys", "default"]


def height_of(tags: Mapping[str, str], area_m2: float) -> Height:
    """Vertical extent of a building or building part.

    In this order: `height`; `building:levels` and `roof:levels` times 3.5 m; a default by kind; else by floor
    area (under 40 m²: a kiosk, 3 m; under 150 m²: 7 m; larger: a five-storey block, 17.5 m). Roofs stand on posts.
    """
    kind = tags.get("building", "yes")
    if kind == "yes":
        kind = tags.get("building:part", "yes")
    source: Literal["measured", "storeys", "default"]
    metres = number(tags.get("height") or tags.get("building:height"))
    storeys = _storeys(tags)
    if metres is not None and 0.0 < metres <= TALLEST_M:
        top, source = metres, "measured"
    elif 0.0 < storeys <= TALLEST_M / STOREY_M:
        top, source = STOREY_M * storeys, "storeys"
    else:
        by_area = 3.0 if area_m2 < 40.0 else 7.0 if area_m2 < 150.0 else 5 * STOREY_M
        top, source = _BY_KIND_M.get(kind, by_area), "default"
    base = number(tags.get("min_height"))
    if base is None:
        base = STOREY_M * (number(tags.get("building:min_level")) or 0.0)
    if base == 0.0 and kind in OPEN_BELOW:
        base = min(CLEARANCE_M, top - 1.0)
    base = max(base, 0.0)
    return Height(base, max(top, base + 1.0), source)


def stands(tags: Mapping[str, str]) -> bool:
    """Whether the tags are those of a building, or of a part of one, that exists and is above the ground."""
    if tags.get("location") == "underground" or tags.get("layer", "0").startswith("-"):
        return False
    is_above = not {"height", "building:height", "roof:levels"}.isdisjoint(tags) or tags.get("building") in OPEN_BELOW
    if tags.get("building:levels") == "0" and not is_above:
        return False  # entirely below ground
    return not {tags.get("building", "no"), tags.get("building:part", "no")} <= _NO_MORE


def _storeys(tags: Mapping[str, str]) -> float:
    """Storeys with those of the roof; 0 where the tags do not say how many there are below it."""
    levels = number(tags.get("building:levels"))
    return 0.0 if levels is None else levels + (number(tags.get("roof:levels")) or 0.0)


def number(text: str | None) -> float | None:
    """The number that a tag starts with, other units turned into metres; None where there is none."""
    match = _NUMBER.match(text or "")
    if match is None:
        return None
    value = float(match["value"].replace(",", "."))
    unit_m = _UNIT_M.get(match["unit"].lower(), 1.0)
    return value * unit_m + float(match["inches"] or 0) * 0.0254
