"""The city at one moment, seen obliquely from the south: buildings, point clouds, and trust in vehicles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy import ndarray

from results.figures import style

TILT = np.radians(50.0)
"""Elevation of the view over the horizon."""
HALF_WIDTH_M, HALF_DEPTH_M = 120.0, 95.0
"""Of the part of the city that is shown."""
TRUST = colormaps["RdYlBu"]
WALL, ROOF, ROAD, UNKNOWN, PLAIN = "#b9bec8", "#dcdfe5", "#eceef1", "#ffffff", "#8a8f98"
LIE = style.ROLE_INKS["malicious"]
MOST_POINTS = 120_000
CLOUDS = tuple(style.INKS[i] for i in (0, 2, 4, 1, 5))
"""A colour per point cloud."""


@dataclass(frozen=True, slots=True)
class SceneMoment:
    """What is where; world frame. A box is x, y, z of its centre, length, width, height and yaw."""

    centre_m: Float[ndarray, "2"]
    streets: Sequence[Float[ndarray, "k 2"]]
    buildings: Sequence[tuple[Float[ndarray, "k 2"], float, float]]
    """Outer ring counter-clockwise, base and top."""
    clouds: Mapping[int, Float[ndarray, "k 3"]]
    """By the number of the vehicle."""
    boxes: Float[ndarray, "n 7"]
    equipped: Bool[ndarray, "n"]
    trust: Float[ndarray, "n"]
    """nan where nothing is known."""
    attacks: Bool[ndarray, "n"]
    ghosts: Float[ndarray, "m 7"]


@style.styled
def draw(moment: SceneMoment, title: str) -> Figure:
    """The part of the city around the centre."""
    moment = _in_frame(moment)
    figure, (axes,) = style.sheet(height=2.5)
    figure.set_layout_engine("compressed")
    _ground(axes, moment)
    half_m = [HALF_WIDTH_M, HALF_DEPTH_M]
    low, high = moment.centre_m - half_m, moment.centre_m + half_m
    walls, fills = [], []

    def from_north(building: tuple[ndarray, float, float]) -> float:
        return -float(building[0][:, 1].mean())

    for ring, base, top in sorted(moment.buildings, key=from_north):
        is_before = ring.max(axis=0) <= low - 60
        is_beyond = ring.min(axis=0) >= high + 60
        if (is_before | is_beyond).any():
            continue
        faces, kinds = _prism(ring, base, top)
        walls += faces
        fills += [ROOF if roof else WALL for roof in kinds]
    axes.add_collection(
        PolyCollection(walls, facecolors=fills, edgecolors="#9aa0ab", linewidths=0.25, alpha=0.72, zorder=2)
    )
    for i, cloud in enumerate(moment.clouds.values()):
        thin = cloud[:: max(1, len(cloud) * len(moment.clouds) // MOST_POINTS)]
        x, y = _flat(thin).T
        axes.plot(x, y, ",", color=_cloud_ink(i), alpha=0.5, zorder=3, rasterized=True)
    _vehicles(axes, moment)
    corner = _flat(np.array([[*low, 0.0], [*high, 0.0]]))
    axes.set_xlim(corner[0, 0], corner[1, 0])
    axes.set_ylim(corner[0, 1], corner[1, 1])
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title)
    figure.colorbar(ScalarMappable(Normalize(0, 1), TRUST), ax=axes, shrink=0.6, label="Trust", pad=0.01)
    _scale(axes, corner)
    style.legend(figure, _entries(moment))
    return figure


def _in_frame(moment: SceneMoment) -> SceneMoment:
    """Without the vehicles and ghosts outside the part that is shown, so that the legend names only what is drawn."""
    half_m = [HALF_WIDTH_M, HALF_DEPTH_M]

    def is_shown(box: Float[ndarray, "n 7"]) -> Bool[ndarray, "n"]:
        return (np.abs(box[:, :2] - moment.centre_m) <= half_m).all(axis=1)

    here, lies = is_shown(moment.boxes), is_shown(moment.ghosts)
    return replace(
        moment,
        boxes=moment.boxes[here],
        equipped=moment.equipped[here],
        trust=moment.trust[here],
        attacks=moment.attacks[here],
        ghosts=moment.ghosts[lies],
    )


def _scale(axes, corner: Float[ndarray, "2 2"]) -> None:  # type: ignore[no-untyped-def]
    """A bar of 50 m, east to west: lengths to the north are shortened by the view."""
    x, y = corner[0] + 0.03 * (corner[1] - corner[0])
    axes.plot([x, x + 50], [y, y], color="black", linewidth=2.0, solid_capstyle="butt", zorder=7)
    axes.annotate(
        "50 m", (x + 25, y), xytext=(0, 3), textcoords="offset points", ha="center", fontsize=style.SMALL, zorder=7
    )


def _flat(xyz: Float[ndarray, "... 3"]) -> Float[ndarray, "... 2"]:
    """Where points are on the page [m]."""
    x, y, z = np.moveaxis(xyz, -1, 0)
    up = y * np.sin(TILT) + z * np.cos(TILT)
    return np.stack([x, up], axis=-1)


def _at_height(line: Float[ndarray, "k 2"], z: float) -> Float[ndarray, "k 2"]:
    """Where a line at one height is on the page [m]."""
    return _flat(np.column_stack([line, np.full(len(line), z)]))


def _cloud_ink(number: int) -> str:
    """Colour of a point cloud."""
    return CLOUDS[number % len(CLOUDS)]


def _ground(axes, moment: SceneMoment) -> None:  # type: ignore[no-untyped-def]
    streets = [_at_height(line, 0.0) for line in moment.streets]
    axes.add_collection(LineCollection(streets, colors=ROAD, linewidths=5.0, zorder=0))


def _prism(
    ring: Float[ndarray, "k 2"],
    base: float,
    top: float,
) -> tuple[list[Float[ndarray, "_ 2"]], list[bool]]:
    """Faces of an upright prism that are seen from the south, far ones first, and which is the roof."""
    x, y = ring.T
    following = np.roll(np.arange(len(ring)), -1)
    seen = np.flatnonzero(x < x[following])  # the outside is on the right of a counter-clockwise ring
    northing = y[seen] + y[following[seen]]
    seen = seen[np.argsort(-northing)]
    floor, roof = _at_height(ring, base), _at_height(ring, top)
    faces = []
    for a, b in zip(seen.tolist(), following[seen].tolist(), strict=True):
        lower, upper = floor[[a, b]], roof[[b, a]]
        faces.append(np.concatenate([lower, upper]))
    return [*faces, roof], [False] * len(faces) + [True]


def _vehicles(axes, moment: SceneMoment) -> None:  # type: ignore[no-untyped-def]
    order = np.argsort(-moment.boxes[:, 1])
    faces, fills, edges = [], [], []
    for i in order.tolist():
        trust = float(moment.trust[i])
        of_equipped = TRUST(trust) if np.isfinite(trust) else UNKNOWN
        fill = of_equipped if moment.equipped[i] else PLAIN
        made, kinds = _prism(*_outline(moment.boxes[i]))
        faces += made
        fills += [fill] * len(kinds)
        edges += [LIE if moment.attacks[i] else "#222222"] * len(kinds)
    if faces:
        axes.add_collection(PolyCollection(faces, facecolors=fills, edgecolors=edges, linewidths=0.35, zorder=4))
    for box in moment.ghosts:
        made, _ = _prism(*_outline(box))
        axes.add_collection(
            PolyCollection(made, facecolors=(0.76, 0.15, 0.18, 0.25), edgecolors=LIE, linewidths=0.6, zorder=5)
        )
    ring = _flat(moment.boxes[moment.attacks, :3])
    axes.scatter(*ring.T, s=50, facecolors="none", edgecolors=LIE, linewidths=1.0, zorder=6)


def _outline(box: Float[ndarray, "7"]) -> tuple[ndarray, float, float]:
    """Corners of a box seen from above, counter-clockwise, its underside and its top."""
    ahead, left = [-1, 1, 1, -1], [-1, -1, 1, 1]
    signs = np.column_stack([ahead, left])
    cos, sin = np.cos(box[6]), np.sin(box[6])
    turn = np.array([[cos, sin], [-sin, cos]])
    ring = 0.5 * box[3:5] * signs @ turn + box[:2]
    middle, half_height = box[2], 0.5 * box[5]
    return ring, float(middle - half_height), float(middle + half_height)


def _entries(moment: SceneMoment) -> list[Line2D]:
    """Legend: what the marks are, of those that occur."""
    unknown = moment.equipped & ~np.isfinite(moment.trust)
    marks = [
        ("s", PLAIN, "#222222", 4.5, "not equipped", not moment.equipped.all()),
        ("s", UNKNOWN, "#222222", 4.5, "equipped, no evaluation yet", unknown.any()),
        ("o", "none", LIE, 7.0, "ringed: attacker", moment.attacks.any()),
        ("s", "#efc9cb", LIE, 4.5, "fabricated", len(moment.ghosts) > 0),
    ]
    entries = []
    for marker, face, edge, size, text, is_there in marks:
        if is_there:
            look: dict[str, Any] = {
                "marker": marker,
                "markersize": size,
                "markerfacecolor": face,
                "markeredgecolor": edge,
            }
            entries.append(style.entry(text, linestyle="", **look))
    for i, vehicle in enumerate(moment.clouds):
        entries.append(style.entry(f"cloud of {vehicle}", linestyle="", marker=".", color=_cloud_ink(i)))
    return entries
