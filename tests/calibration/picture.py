"""How a detector profile was fitted: its precision-recall curves beside the published figures, and its scores."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy import ndarray

from results.figures import style

BINS = np.linspace(0.0, 1.0, 26)


@style.styled
def draw(
    curves: Mapping[str, Mapping[str, ndarray]],
    scores: Mapping[str, tuple[ndarray, ndarray]],
    n_frames: int,
) -> Figure:
    """One column per class.

    Parameters
    ----------
    curves
        By class and level, the interpolated precision at recall 0, 1/40, ..., 1.
    scores
        By class, the scores of boxes that overlap their actor as KITTI asks, and of all others.
    n_frames
        Frames that the scores were counted in.
    """
    figure, panels = style.sheet(2 * len(curves), 1.7, across=len(curves))
    entries: list[Line2D | Patch] = []
    for column, (label, levels) in enumerate(curves.items()):
        top, bottom = panels[column], panels[len(curves) + column]
        for i, (level, precision) in enumerate(levels.items()):
            recall = np.arange(len(precision)) / (len(precision) - 1)
            reached = precision > 0
            look = {"color": style.ink(i), "linestyle": style.DASHES[i], "label": level}
            line = top.plot(recall[reached], precision[reached], **look)
            entries += line if column == 0 else []
        style.panel(top, label, "Recall", "Precision")
        top.set_xlim(0, 1)
        style.share_axis(top)
        right, wrong = scores[label]
        _steps(bottom, right, n_frames, 0)
        _steps(bottom, wrong, n_frames, 1)
        style.panel(bottom, "", "Score", "Boxes per frame")
    names: Sequence[str] = ("hits", "all other boxes")
    entries += [Patch(facecolor=style.ink(i), alpha=0.6, label=name) for i, name in enumerate(names)]
    style.legend(figure, entries)
    return figure


def _steps(axes, values: ndarray, n_frames: int, i: int) -> None:
    share, _ = np.histogram(values, BINS)
    axes.stairs(share / n_frames, BINS, fill=True, color=style.ink(i), alpha=0.6)
