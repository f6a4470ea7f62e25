"""How tall a building is, from its OpenStreetMap tags."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

STOREY_M = 3.5
"""Floor to floor in an old city centre, roof included in the top one's [m]."""
CLEARANCE_M = 4.5
"""Under roofs and passages that name no height of their own [m]."""

TALLEST_M = 900.0
"""Larger heights are taken for typing errors; the tallest building is 828 m tall."""

_TABLE = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
_BY_KIND_M: dict[str, float] = tomllib.loads(_TABLE)
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
