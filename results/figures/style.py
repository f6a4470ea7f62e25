"""The style of all pictures: legible in print, in greyscale, and side by side."""

import base64
import io
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Any, BinaryIO, Literal, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from results import durable
from results.codes import BASE_VARIANT
from results.metrics import compare
from results.run import Run

TIME = "Time [s]"
INKS = ("#16325c", "#c4502e", "#63b0a2", "#ecb938", "#8c6bb1", "#1a1a1a")
"""Colours of what is compared within a run. The first four go from dark to light, so that grey tells them apart too.
All differ for people who lack a cone."""
MARKERS = ("o", "^", "s", "D", "v", "P")
ROLE_INKS: Mapping[str, str] = {"honest": INKS[0], "unreliable": INKS[3], "malicious": "#c1272d"}
"""One colour per role in every picture; malicious is red."""
_MORE_ROLES = (INKS[4], INKS[2], INKS[5])
"""Colours of roles of a user's own."""
DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)), (0, (8, 2)), (0, (3, 1, 1, 1, 1, 1)))
"""Line styles, one per run."""
HATCHES = ("", "///", "...", "xx", "\\\\", "++")
PALE = "#b4bac4"
FORMATS = (".png", ".svg", ".pdf")

_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.edgecolor": "#444444",
    "axes.linewidth": 0.8,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.8,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "hatch.linewidth": 0.6,
    "svg.hashsalt": "cosim",  # the same picture is the same file
    "svg.fonttype": "path",
    "pdf.fonttype": 42,
}


PAPER_WIDTH = 3.45
"""Width of a column of a two-column page [inches]."""
_TALLEST, _LOWEST = 3.1, 2.4
"""Limits of the height of a panel in such a column [inches]."""

_LETTERS = 46
"""Letters of a title that fit into its width."""

_PAPER: dict[Any, Any] = _STYLE | {
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.5,
    "axes.linewidth": 0.6,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.2,
    "legend.fontsize": 7,
    "legend.handlelength": 2.4,
    "legend.columnspacing": 1.2,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
}
"""For one column of a paper: panels stand below one another."""

_for_paper: ContextVar[bool] = ContextVar("for_paper", default=False)


@contextmanager
def chosen(name: Literal["screen", "paper"]) -> Iterator[None]:
    """Draw and save pictures in this style inside: `screen`, or `paper` for a column of a two-column page."""
    before = _for_paper.set(name == "paper")
    try:
        yield
    finally:
        _for_paper.reset(before)


def is_for_paper() -> bool:
    """Whether pictures are for a column of a paper: what belongs in a caption is left out."""
    return _for_paper.get()


def _rc() -> dict[Any, Any]:
    return _PAPER if _for_paper.get() else _STYLE


P = ParamSpec("P")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """In this style, whatever the user's own Matplotlib settings are."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(_rc()):
            figure = draw(*args, **kwargs)
            figure.canvas.draw()  # settles the layout while the style holds
        return figure

    return drawn


def sheet(columns: int = 1, width: float = 7.2, height: float = 3.6, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """An empty figure (inches) and its panels, row by row. For a paper, the panels stand below one another."""
    if _for_paper.get():
        aspect = (width / columns) / (height / rows)
        columns, rows = 1, rows * columns
        width, height = PAPER_WIDTH, rows * min(max(PAPER_WIDTH / aspect, _LOWEST), _TALLEST)
    figure = Figure(figsize=(width, height), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def leads(i: int) -> bool:
    """Whether panel `i` of a row has the labels that the row shares: the first, or each where they are stacked."""
    return i == 0 or _for_paper.get()


def panel(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(fitted(title))
    axes.set_xlabel(fitted(x))
    axes.set_ylabel(y)


def fitted(text: str) -> str:
    """Text in lines that are no longer than a column of a paper is wide; unchanged on a screen."""
    if not _for_paper.get():
        return text
    return "\n".join(part for line in text.split("\n") for part in textwrap.wrap(line, _LETTERS))


def share_axis(axes: Axes, top: float = 1.0) -> None:
    """A vertical axis from 0 to `top`, or to 1 where that is next to nothing, with room for the line width."""
    top = top if top > 1e-6 else 1.0
    axes.set_ylim(-0.02 * top, 1.03 * top)


def shares_bar(axes: Axes, at: float, shares: Sequence[float], fills: Sequence[str]) -> None:
    """A horizontal bar of shares that add up to 1, with the larger ones written in."""
    left = 0.0
    for code, share in enumerate(shares):
        axes.barh(at, share, 0.6, left, color=fills[code], hatch=HATCHES[code], edgecolor="#333333", linewidth=0.6)
        if share > 0.08:
            axes.text(
                left + share / 2, at, f"{100 * share:.0f} %", ha="center", va="center",
                fontsize=_rc()["legend.fontsize"],
                color="white" if code == 0 else "black",
                bbox={"facecolor": fills[code], "edgecolor": "none", "pad": 1.2},
            )  # fmt: skip
        left += share


def bars_axis(axes: Axes, labels: Sequence[str]) -> None:
    """Axes for such bars."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.2, -0.8)
    axes.set_xlim(0, 1)
    axes.grid(visible=False, axis="y")


def bar_entries(labels: Sequence[str], fills: Sequence[str]) -> list[Patch]:
    """Legend entries of their parts."""
    return [
        Patch(facecolor=fill, hatch=hatch, edgecolor="#333333", linewidth=0.6, label=label)
        for label, fill, hatch in zip(labels, fills, HATCHES, strict=False)
    ]


def legend(figure: Figure, entries: Sequence[Any], runs: Sequence[Any] = ()) -> None:
    """One legend below all panels, in as few rows as fit; where it takes two, the runs have the second."""
    if not entries and not runs:
        return
    whole, most = [*entries, *runs], max(len(entries), len(runs))
    if entries and runs:
        blank = [Line2D([], [], linestyle="", label=" ")] * most  # a legend is filled column by column
        two_rows = [
            entry for pair in zip([*entries, *blank][:most], [*runs, *blank][:most], strict=True) for entry in pair
        ]
        tries = [(whole, len(whole)), (two_rows, most)]
    else:
        tries = [(whole, len(whole))]
    tries += [(whole, -(-len(whole) // rows)) for rows in range(2, len(whole) + 1)]
    for handles, columns in tries:
        made = figure.legend(handles=handles, loc="outside lower center", ncols=columns)
        if made.get_window_extent().width <= figure.bbox.width or columns == 1:
            return
        made.remove()


def run_entries(runs: Sequence[Run]) -> list[Line2D]:
    """Legend entries that name the runs, needed only where there are several."""
    return dash_entries(names(runs))


def series_entries(runs: Sequence[Run], lines: bool = True) -> list[Line2D]:
    """The same where each run has a colour and a marker of its own."""
    if len(runs) < 2:
        return []
    return [
        Line2D([], [], color=inks(runs)[i], marker=marker(i), linestyle=dash(i) if lines else "", label=name)
        for i, name in enumerate(names(runs))
    ]


def names(runs: Sequence[Run]) -> list[str]:
    """Names of runs: the value of the key in which they differ, if it is one alone and tells all apart.

    Else their folders' names, with the parent folder where two are called the same, and the trust variant.
    """
    found = compare.differing(runs)
    if len(runs) > 1 and len(found) == 1:
        ((key, values),) = found.items()
        if len(set(map(str, values))) == len(runs):
            return [f"{key} = {_plain(value)}" for value in values]
    short = [run.name if run.variant == BASE_VARIANT else f"{run.name}, {run.variant}" for run in runs]
    return [
        name if short.count(name) == 1 else f"{run.path.parent.name}/{name}"
        for run, name in zip(runs, short, strict=True)
    ]


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def arranged(runs: Sequence[Run], most: int = 12) -> list[Run]:
    """The runs in the order of the values in which they differ; ValueError for more than a picture can tell apart."""
    need(runs)
    if len(runs) > most:
        keys = ", ".join(compare.differing(runs)) or "their seeds alone"
        raise ValueError(
            f"{len(runs)} runs are more than one picture can tell apart ({most}); they differ in {keys}. Draw fewer, "
            "draw them over a key with cosim plot freshness --over KEY, or compare figures with cosim measure --csv."
        )
    found = compare.differing(runs)
    order = sorted(range(len(runs)), key=lambda i: [compare.sort_key(values[i]) for values in found.values()])
    return [runs[i] for i in order]


def inks(runs: Sequence[Run]) -> list[str]:
    """A colour for each run: those of a ramp, light to dark, where the runs are many, by the key that differs."""
    if len(runs) <= len(INKS):
        return [ink(i) for i in range(len(runs))]
    ramp = mpl.colormaps["viridis_r"](np.linspace(0.08, 1, len(runs)))
    return [mpl.colors.to_hex(colour) for colour in ramp]


def colour_entries(runs: Sequence[Run]) -> list[Line2D]:
    """Legend entries of runs that have a colour each, needed only where there are several."""
    if len(runs) < 2:
        return []
    return [Line2D([], [], color=colour, label=name) for colour, name in zip(inks(runs), names(runs), strict=True)]


def dash_entries(labels: Sequence[str]) -> list[Line2D]:
    """Legend entries of line styles, needed only where there are several."""
    if len(labels) < 2:
        return []
    return [Line2D([], [], color="black", linestyle=dash(i), label=label) for i, label in enumerate(labels)]


def dash(i: int) -> Any:
    return DASHES[i % len(DASHES)]


def ink(i: int) -> str:
    return INKS[i % len(INKS)]


def marker(i: int) -> str:
    return MARKERS[i % len(MARKERS)]


def role_look(role: str, roles: Sequence[str]) -> dict[str, Any]:
    """Colour and marker of a role; `roles` are all of the run, in the order of their codes."""
    own = [name for name in roles if name not in ROLE_INKS]
    color = ROLE_INKS[role] if role in ROLE_INKS else _MORE_ROLES[own.index(role) % len(_MORE_ROLES)]
    return {"color": color, "marker": marker(list(roles).index(role))}


def role_entries(shown: Iterable[str], roles: Sequence[str]) -> list[Line2D]:
    """Legend entries of the roles shown, in the order of their codes."""
    return [Line2D([], [], **role_look(role, roles), label=role) for role in roles if role in set(shown)]


def roles_of(runs: Sequence[Run]) -> list[str]:
    """Roles of all runs, each once."""
    return list(dict.fromkeys(role for run in runs for role in run.role_labels))


def sparse(n: int, about: int = 10) -> int:
    """Points per marker."""
    return max(1, n // about)


def variants_of(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Every run as each of its trust variants, and what these are called."""
    need(runs)
    variants = [run.as_variant(name) for run in runs for name in run.variants]
    return variants, [run.variant if len(runs) == 1 else f"{run.path.name}, {run.variant}" for run in variants]


def map_panel(axes: Axes, title: str, y: str = "North [m]") -> None:
    """A panel that shows places from above, in metres."""
    panel(axes, title, "East [m]", y)
    axes.set_aspect("equal")
    axes.grid(visible=False)


def need(runs: Sequence[Run]) -> None:
    if not runs:
        raise ValueError("There is no run to draw. Name at least one run folder.")


def save(figure: Figure, path: str | Path) -> Path:
    """Write a picture, and make its folder; the suffix says the format."""
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path} has no picture format. End it in {', '.join(FORMATS)}.")
    content = io.BytesIO()
    write(figure, content, path.suffix.lower()[1:])
    durable.write_output(path, content.getvalue())
    return path


def write(figure: Figure, target: str | Path | BinaryIO, kind: str) -> None:
    """Write a picture as `png`, `svg` or `pdf`; the same picture gives the same bytes."""
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    with mpl.rc_context(_rc()):
        figure.savefig(target, format=kind, metadata=metadata)


def data_url(figure: Figure) -> str:
    """As an SVG image inside a page; an image of its own, so that names inside pictures do not clash."""
    buffer = io.BytesIO()
    write(figure, buffer, "svg")
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
