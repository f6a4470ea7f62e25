"""The style of all pictures: legible in a column of 8 cm, in greyscale, and side by side."""

import base64
import io
import os
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any, BinaryIO, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from cosim.base import durable
from cosim.base.codes import BASE_VARIANT
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
DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 2)),
    (0, (1, 1.2)),
    (0, (5, 1.5, 1, 1.5)),
    (0, (8, 2)),
    (0, (3, 1, 1, 1, 1, 1)),
)
"""Line styles, one per run."""
HATCHES = ("", "///", "...", "xx", "\\\\", "++")
PALE = "#b4bac4"
FORMATS = (".png", ".svg", ".pdf")

WIDTH = 3.45
"""Width of every picture [inches]: that of a column of a two-column page, 8.8 cm."""
SMALL, SMALLEST = 7.0, 6.6
"""Sizes of text beside the data, and of text that fits into a cell [points]. The second is 6 pt at a width of 8 cm."""
DPI = 200
SOFTWARE = "cosim"
"""What a PNG of this style says of itself."""

_STYLE = mpl.rc_params_from_file(Path(__file__).with_name("cosim.mplstyle"), use_default_template=False)

P = ParamSpec("P")


def forget_settings() -> None:
    """Let Matplotlib have its own defaults, and not what it has read from a file."""
    mpl.rcdefaults()


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """In this style, whatever the user's own Matplotlib settings are."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(_STYLE):
            figure = draw(*args, **kwargs)
            figure.canvas.draw()  # settles the layout while the style holds
        return figure

    return drawn


def sheet(panels: int = 1, height: float = 2.4, across: int = 1) -> tuple[Figure, list[Axes]]:
    """An empty figure and its panels of this height [inches], `across` of them beside one another."""
    rows = -(-panels // across)
    figure = Figure(figsize=(WIDTH, rows * height), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    axes = list(np.ravel(figure.subplots(rows, across)))
    for empty in axes[panels:]:
        empty.remove()
    return figure, axes[:panels]


def panel(axes: Axes, title: str, x: str, y: str) -> None:
    """Title and labels, in lines that are no longer than the panel."""
    grid = axes.get_gridspec()
    rows, columns = (grid.nrows, grid.ncols) if grid is not None else (1, 1)
    wide = int((WIDTH / columns - (0.45 if columns == 1 else 0.3)) * _LETTERS)
    axes.set_title(fitted(title, wide))
    axes.set_xlabel(fitted(x, wide))
    height_in = axes.figure.bbox.height / DPI / rows
    axes.set_ylabel(fitted(y, int((height_in - 0.3) * _LETTERS)))


_LETTERS = 15
"""Letters of a label per inch."""


def fitted(text: str, letters: int = 45) -> str:
    """Text in lines of so many letters; left out, as many as a whole width takes. Longer words lose their middle."""
    half = max(letters, _SHORTEST) // 2 - 1
    short = re.sub(rf"(\S{{{half}}})\S{{3,}}(\S{{{half}}})", r"\1…\2", text)
    return "\n".join(
        part
        for line in short.split("\n")
        for part in textwrap.wrap(line, letters, break_long_words=False, break_on_hyphens=False)
    )


_SHORTEST = 20
"""No word of fewer letters is shortened, however narrow the place."""


def share_axis(axes: Axes, top: float = 1.0) -> None:
    """A vertical axis from 0 to `top`, or to 1 where that is next to nothing, with room for the line width."""
    top = top if top > 1e-6 else 1.0
    axes.set_ylim(-0.02 * top, 1.03 * top)


def numbered(axis: Axis, most: float = 2000.0) -> None:
    """Plain numbers on a logarithmic axis: 1, 2 and 5 of each power of ten; of a very short axis, all digits.

    Over more than a factor of `most`, powers of ten are numbered. An axis that reaches below 0.001 stays as it is.
    """
    low, high = axis.get_view_interval()
    if low < 5e-4:
        return
    digits: Sequence[int] = (1,)
    if high <= 4 * low:
        digits = range(1, 10)
    elif high < most * low:
        digits = (1, 2, 5)
    axis.set_major_locator(LogLocator(subs=digits, numticks=99))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def shares_bar(axes: Axes, at: float, shares: Sequence[float], fills: Sequence[str]) -> None:
    """A horizontal bar of shares that add up to 1, with the larger ones written in."""
    left = 0.0
    for code, share in enumerate(shares):
        fill = fills[code]
        axes.barh(at, share, 0.6, left, color=fill, hatch=HATCHES[code], edgecolor="#333333", linewidth=0.6)
        if share > 0.08:
            axes.text(
                left + share / 2,
                at,
                f"{100 * share:.0f} %",
                ha="center",
                va="center",
                fontsize=SMALL,
                color="white" if code == 0 else "black",
                bbox={"facecolor": fill, "edgecolor": "none", "pad": 1.2},
            )
        left += share


def bars_axis(axes: Axes, labels: Sequence[str]) -> None:
    """Axes for such bars."""
    axes.set_yticks(range(len(labels)), [fitted(label, 20) for label in labels])
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
    """One legend in the free place beside the last panel, else below all of them.

    There it has as few rows as fit. Where it takes two, the runs have the second.
    """
    if not entries and not runs:
        return
    whole = [*entries, *runs]
    free = _free_place(figure)
    if free is not None and _fits(figure, free, whole):
        return
    tries = [(whole, len(whole))]
    if entries and runs:
        blank = entry(" ", linestyle="")
        columns_of_two = list(zip_longest(entries, runs, fillvalue=blank))
        two_rows = list(chain.from_iterable(columns_of_two))  # a legend is filled column by column
        tries.append((two_rows, len(columns_of_two)))
    for rows in range(2, len(whole) + 1):
        tries.append((whole, -(-len(whole) // rows)))
    for handles, columns in tries:
        made = figure.legend(handles=handles, loc="outside lower center", ncols=columns)
        extent = made.get_window_extent()
        if extent.width <= figure.bbox.width or columns == 1:
            if extent.height > _LEGEND_P * figure.bbox.height:
                figure.set_figheight(0.9 * figure.get_figheight() + extent.height / DPI)
            return
        made.remove()


_LEGEND_P = 0.35
"""Share of a sheet that a legend below its panels may take. Above a higher one, they keep nine tenths of the sheet."""


def _free_place(figure: Figure) -> SubplotSpec | None:
    """The place at the end of the grid, if no panel takes it."""
    grid = figure.axes[0].get_gridspec() if figure.axes else None
    if grid is None or len(figure.axes) >= grid.nrows * grid.ncols:
        return None
    return grid[-1]


def _fits(figure: Figure, place: SubplotSpec, entries: Sequence[Any]) -> bool:
    """Draw a legend that is as wide as a panel, unless it is higher than the place."""
    axes = figure.add_subplot(place)
    axes.axis("off")
    labels = [fitted(entry.get_label(), _LETTERS_BESIDE) for entry in entries]
    made = axes.legend(entries, labels, loc="center", handlelength=1.6)
    is_low = made.get_window_extent().height < figure.bbox.height / place.get_gridspec().nrows
    if not is_low:
        axes.remove()
    return bool(is_low)


_LETTERS_BESIDE = 18
"""Letters in a line of a legend that is as wide as one of two panels."""


def entry(label: str, **look: Any) -> Line2D:
    """Legend entry of a line or a marker that looks like this."""
    return Line2D([], [], label=label, **look)


def held_entry(keys: str) -> Line2D:
    """Legend entry that says at which values keys are held, in lines that the legend takes."""
    return entry(fitted(f"at {keys}", 40), linestyle="none")


def run_entries(runs: Sequence[Run]) -> list[Line2D]:
    """Legend entries that name the runs, needed only where there are several."""
    return dash_entries(names(runs))


def series_entries(runs: Sequence[Run], lines: bool = True) -> list[Line2D]:
    """Legend entries of runs, each of which has a colour and a marker of its own."""
    if len(runs) < 2:
        return []
    entries = []
    for i, (name, colour) in enumerate(zip(names(runs), inks(runs), strict=True)):
        line = dash(i) if lines else ""
        entries.append(entry(name, color=colour, marker=marker(i), linestyle=line))
    return entries


_CODE = re.compile("[0-9a-f]{16}")
"""Names of the folders of a study's runs."""


def names(runs: Sequence[Run]) -> list[str]:
    """Names of runs: the values of the keys in which they differ, if these tell all apart.

    Runs of a study, whose folders have codes for names, are called by up to three keys, others by one alone. Else runs
    have their folders' names, with the folders above where two are called the same, and the trust variant.
    """
    found = compare.differing(runs)
    most = 3 if any(_CODE.fullmatch(run.name) for run in runs) else 1
    if len(runs) > 1 and 0 < len(found) <= most:
        keys = [key.rpartition(".")[2] for key in found]
        if len(keys) == 1 or len(set(keys)) < len(keys):
            keys = list(found)
        by_keys = []
        for values in zip(*found.values(), strict=True):
            said = map("{} = {}".format, keys, map(_plain, values))
            by_keys.append(", ".join(said))
        if len(set(by_keys)) == len(runs):
            return by_keys
    named = []
    for run in runs:
        variant = "" if run.variant == BASE_VARIANT else f", {run.variant}"
        named.append(run.name + variant)
    paths = [run.path.resolve() for run in runs]
    among = os.path.commonpath(paths)
    told_apart = []
    for path, name in zip(paths, named, strict=True):
        above = os.path.relpath(path.parent, among)
        told_apart.append(name if named.count(name) == 1 else f"{above}/{name}")
    return told_apart


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def arranged(runs: Sequence[Run], most: int = 12) -> list[Run]:
    """The runs in the order of the values in which they differ; ValueError for more than a picture can tell apart."""
    need(runs)
    if len(runs) > most:
        keys = ", ".join(compare.differing(runs)) or "their seeds alone"
        raise ValueError(
            f"{len(runs)} runs are more than one picture can tell apart ({most}); they differ in {keys}. Draw fewer, "
            "make them a study and draw it over a key, or compare figures with cosim measure --csv."
        )
    found = compare.differing(runs)

    def key_of(i: int) -> list[Any]:
        return [compare.sort_key(values[i]) for values in found.values()]

    return [runs[i] for i in sorted(range(len(runs)), key=key_of)]


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
    look = zip(names(runs), inks(runs), strict=True)
    return [entry(name, color=colour) for name, colour in look]


def dash_entries(labels: Sequence[str]) -> list[Line2D]:
    """Legend entries of line styles, needed only where there are several."""
    if len(labels) < 2:
        return []
    return [entry(label, color="black", linestyle=dash(i)) for i, label in enumerate(labels)]


def dash(i: int) -> Any:
    """A line style; with the colour of `ink`, 36 lines differ."""
    return DASHES[(i + i // len(INKS)) % len(DASHES)]


def ink(i: int) -> str:
    return INKS[i % len(INKS)]


def look(i: int, are_joined: bool = True) -> dict[str, Any]:
    """Colour, marker and line of series `i`; no line if its values are not joined."""
    return {"color": ink(i), "marker": marker(i), "linestyle": dash(i) if are_joined else "none"}


def marker(i: int) -> str:
    """A marker; with the colour of `ink`, 36 differ."""
    return MARKERS[(i + i // len(INKS)) % len(MARKERS)]


def role_look(role: str, roles: Sequence[str]) -> dict[str, Any]:
    """Colour and marker of a role; `roles` are all of the run, in the order of their codes."""
    if role in ROLE_INKS:
        color = ROLE_INKS[role]
    else:
        own = [name for name in roles if name not in ROLE_INKS]
        color = _MORE_ROLES[own.index(role) % len(_MORE_ROLES)]
    return {"color": color, "marker": marker(list(roles).index(role))}


def role_entries(shown: Iterable[str], roles: Sequence[str]) -> list[Line2D]:
    """Legend entries of the roles shown, in the order of their codes."""
    return [entry(role, **role_look(role, roles)) for role in roles if role in set(shown)]


def roles_of(runs: Sequence[Run]) -> list[str]:
    """Roles of all runs, each once."""
    return list(dict.fromkeys(role for run in runs for role in run.role_labels))


def subjects_of(runs: Sequence[Run]) -> str:
    """What trust is in: vehicles, or pseudonyms if a vehicle used several."""
    several = [run.subjects.vehicle.duplicated().any() for run in runs]
    return "pseudonyms" if any(several) else "vehicles"


def sparse(n: int, about: int = 10) -> int:
    """Points per marker."""
    return max(1, n // about)


def variants_of(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Every run as each of its trust variants, each once, and what these are called.

    A run that was chosen as a variant other than its base stands for this one alone.
    """
    need(runs)
    found = {}
    for run in runs:
        for name in run.variants if run.variant == BASE_VARIANT else (run.variant,):
            found[run.path, name] = run.as_variant(name)
    variants = list(found.values())
    if len({run.path for run in runs}) == 1:
        return variants, [run.variant for run in variants]
    return variants, names(variants)


def draw_each(runs: Sequence[Run], draw: Callable[[int, Run], None]) -> list[int]:
    """Draw each run, by its number and itself, and return the numbers of those that cannot be drawn.

    One trust variant without values, such as one whose server computed none, takes away no figure of the others.
    ValueError of the first one if none can be drawn.
    """
    reasons = {}
    for i, run in enumerate(runs):
        try:
            draw(i, run)
        except ValueError as reason:
            reasons[i] = reason
    if len(reasons) == len(runs):
        raise reasons[0]
    return list(reasons)


FLATTEST = 0.3
"""Least ratio of the sides of a map: with equal scales, a narrower one would have no room for its labels."""


def map_panel(axes: Axes, title: str) -> None:
    """A panel that shows places from above, in metres; of a single street, more than the street."""
    panel(axes, fitted(title, 34), "East [m]", "North [m]")
    axes.set_aspect("equal")
    width_m, height_m = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
    axes.set_xlim(_widened(axes.get_xlim(), height_m))
    axes.set_ylim(_widened(axes.get_ylim(), width_m))
    axes.grid(visible=False)


def credit(axes: Axes, text: str) -> Annotation:
    """Whose data a map shows, in its lower right corner."""
    return axes.annotate(
        text,
        (1, 0),
        xycoords="axes fraction",
        xytext=(-3, 3),
        textcoords="offset points",
        ha="right",
        fontsize=SMALLEST,
        color="#444444",
    )


def _widened(side: tuple[float, float], other_m: float) -> tuple[float, float]:
    """Ends of a side of a map that is not too narrow beside the other side."""
    low, high = side
    more = max(0.0, (other_m * FLATTEST - (high - low)) / 2)
    return low - more, high + more


def need(runs: Sequence[Run]) -> None:
    if isinstance(runs, Run):
        raise ValueError(f"Figures take a list of runs: FIGURES[...]([run]), not {runs.name} alone.")
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
    metadata: Any = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {"Software": SOFTWARE}}
    with mpl.rc_context(_STYLE):
        figure.savefig(target, format=kind, metadata=metadata[kind])


def data_url(figure: Figure) -> str:
    """As an SVG image inside a page; an image of its own, so that names inside pictures do not clash."""
    buffer = io.BytesIO()
    write(figure, buffer, "svg")
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
