"""Average precision and environmental awareness."""

from collections.abc import Sequence
from itertools import pairwise, product
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from cosim.addons.perception import detection
from cosim.addons.perception.kitti import FEWEST, LEVELS
from results.figures import style
from results.run import Run

_LISTS: dict[str, tuple[str, str | None, Any]] = {
    "local": ("own sensor", "white", (0, (4, 2))),
    "fused": ("fused", None, style.dash(0)),
    "early": ("merged point clouds", "silver", (0, (1, 1.5))),
}
"""Name, fill of the markers (None: that of the run) and line of each list."""


@style.styled
def draw(runs: Sequence[Run], max_frames: int = 4000, range_m: float = 70.0) -> Figure:
    """Average precision by class and level, and the share of actors known, by distance, of each list.

    Levels with too few objects to rank are left out.
    """
    runs = style.arranged(runs)
    precisions = [_precision(run, max_frames) for run in runs]
    known = [detection.awareness(run, range_m, max_frames=max_frames) for run in runs]
    met = {row for frame in precisions for row in zip(frame["class"], frame.level, strict=True)}
    rows = [row for row in product(detection.CLASSES, LEVELS) if row in met]
    there = {which for aware in known for which in aware.boxes.unique()}
    lists = {which: kind for which, kind in _LISTS.items() if which in there}
    height = 0.8 + 0.15 * len(rows)
    figure, (left, right) = style.sheet(2, max(2.2, height))
    for i, (precision, aware) in enumerate(zip(precisions, known, strict=True)):
        offset = 0.0
        if len(runs) > 1:
            offset = 0.5 * (i / (len(runs) - 1) - 0.5)
        for which, (_, face, line) in lists.items():
            frame = precision[(precision.boxes == which)]
            shown = zip(frame["class"], frame.level, strict=True)
            y = [rows.index(row) + offset for row in shown]
            ink = style.inks(runs)[i]
            dots: dict[str, Any] = {
                "color": ink,
                "marker": style.marker(i),
                "markerfacecolor": face or ink,
            }
            left.plot(frame.ap40, y, linestyle="", **dots)
            curve = aware[aware.boxes == which]
            right.plot(curve.distance_m, curve.share, linestyle=line, **dots)
    style.panel(left, "Average precision", "AP 3D, 40 recall points [%]", "")
    left.set_yticks(range(len(rows)), [", ".join(row) for row in rows])
    left.set_ylim(len(rows) - 0.5, -0.5)
    left.set_xlim(-3, 103)
    for border, ((above, _), (below, _)) in enumerate(pairwise(rows)):
        if above != below:
            left.axhline(border + 0.5, color="#999999", linewidth=0.7)
    style.panel(right, "Awareness", "Distance [m]", "Share of actors known")
    style.share_axis(right)
    right.set_xlim(0, range_m)
    entries = [
        style.entry(name, color="black", marker="o", markerfacecolor=face or "black", linestyle=line)
        for name, face, line in lists.values()
    ]
    style.legend(figure, entries, style.series_entries(runs, lines=False))
    return figure


def _precision(run: Run, max_frames: int) -> pd.DataFrame:
    frame = detection.precision(run, max_frames=max_frames)
    frame = frame[frame.n_truth >= FEWEST]
    if frame.empty:
        raise ValueError(f"{run.path}: fewer than {FEWEST} objects of every class, too few for average precision.")
    return frame
