"""The paper's scenarios: a scene from above, and trust over frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy import ndarray

from results.figures import style

REAL, FALSE, TRUTH = style.ROLE_INKS["honest"], style.ROLE_INKS["malicious"], style.ink(2)


@dataclass(frozen=True, slots=True)
class ScenarioPanel:
    """One view from above: returns of a sweep, and boxes with what is to be read beside them; world frame."""

    title: str
    points_m: Float[ndarray, "k 2"]
    footprints: Float[ndarray, "b 5"]
    """Of each box x, y, length, width [m] and heading [rad]."""
    is_false: Bool[ndarray, "b"]
    captions: Sequence[str]


@style.styled
def from_above(
    panels: Sequence[ScenarioPanel],
    truth: Float[ndarray, "t 5"],
    names: Sequence[str],
    window_m: tuple[float, float, float, float],
) -> Figure:
    """The scene side by side as different vehicles have it; `truth` are the footprints of what really stands there.

    Parameters
    ----------
    window_m
        What is shown: x min, x max, y min, y max.
    """
    figure, axes = style.sheet(len(panels), 3.2, across=2)
    for i, (axis, panel) in enumerate(zip(axes, panels, strict=True)):
        axis.plot(*panel.points_m.T, ".", color=style.PALE, markersize=1.3, markeredgewidth=0, zorder=0.5)
        for corners in _corners(truth):
            axis.add_patch(Polygon(corners, fill=False, edgecolor=TRUTH, linewidth=2.2))
        if i == 0:
            for corners, name in zip(_corners(truth), names, strict=True):
                _beside(axis, corners, name, TRUTH, left=True)
        for corners, false, caption in zip(_corners(panel.footprints), panel.is_false, panel.captions, strict=True):
            ink = FALSE if false else REAL
            hatch = style.HATCHES[1] if false else None
            axis.add_patch(Polygon(corners, fill=False, edgecolor=ink, linewidth=1.0, hatch=hatch))
            nose = corners[[0, 1]].mean(axis=0)
            axis.plot(*np.transpose([corners.mean(axis=0), nose]), color=ink, linewidth=1.0)
            _beside(axis, corners, caption, ink, left=false)
        style.map_panel(axis, panel.title, "North [m]" if i % 2 == 0 else "")
        axis.tick_params(labelleft=i % 2 == 0)
        axis.set(xlim=window_m[:2], ylim=window_m[2:])
    style.legend(figure, [
        Line2D([], [], color=TRUTH, linewidth=2.2, label="really there"),
        Line2D([], [], color=REAL, linewidth=1.0, label="reported (score)"),
        Line2D([], [], color=FALSE, marker="s", markerfacecolor="none", linestyle="", label="fabricated"),
        Line2D([], [], color=style.PALE, marker=".", linestyle="", label="LiDAR returns"),
    ])  # fmt: skip
    return figure


def _corners(footprints: Float[ndarray, "n 5"]) -> Float[ndarray, "n 4 2"]:
    """Front left, front right, rear right, rear left."""
    x, y, length, width, heading = footprints.T[:, :, None]
    ahead, left = length * np.array([0.5, 0.5, -0.5, -0.5]), width * np.array([0.5, -0.5, -0.5, 0.5])
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([x + c * ahead - s * left, y + s * ahead + c * left], axis=-1)


def _beside(axis: Axes, corners: Float[ndarray, "4 2"], text: str, ink: str, left: bool = False) -> None:
    x = corners[:, 0].min() if left else corners[:, 0].max()
    axis.annotate(
        text, (x, corners[:, 1].mean()), xytext=(-3 if left else 3, 0), textcoords="offset points",
        fontsize=style.SMALLEST, color=ink, ha="right" if left else "left", va="center",
        bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ScenarioCurve:
    """Trust in one vehicle after each frame, the first frame being number 1; beside it what a model expects."""

    trust: Float[ndarray, "f"]
    expected: Float[ndarray, "f"]
    is_malicious: bool = False


@style.styled
def trust_over_frames(
    curves: Mapping[str, ScenarioCurve], printed: Sequence[tuple[float, float]], attack_start: int, expected_from: str
) -> Figure:
    """Trust after each frame: obtained, expected, and the values that the paper prints (frame, trust)."""
    figure, (axis,) = style.sheet(height=2.8)
    axis.axvline(attack_start, color=style.PALE, linewidth=0.9)
    axis.annotate(
        "attack begins",
        (attack_start, 0.02),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        fontsize=style.SMALL,
    )
    entries = []
    for i, (name, curve) in enumerate(curves.items()):
        frames = 1 + np.arange(len(curve.trust))
        ink = style.ROLE_INKS["malicious"] if curve.is_malicious else style.ink(i)
        axis.plot(
            frames, curve.trust, color=ink, marker=style.marker(i),
            markevery=(2 * i, style.sparse(len(frames))),
        )  # fmt: skip
        axis.plot(frames, curve.expected, color=ink, linestyle=style.dash(1), linewidth=1.0)
        entries.append(Line2D([], [], color=ink, marker=style.marker(i), label=name))
    axis.plot(*np.transpose(printed), "x", color="black", markersize=6, markeredgewidth=1.4, clip_on=False, zorder=5)
    style.panel(axis, "Trust in the vehicles of scenario 2", "Frames evaluated", "Trust")
    style.share_axis(axis)
    axis.set_xlim(0, 1 + max(len(c.trust) for c in curves.values()))
    entries += [
        Line2D([], [], color="black", linestyle=style.dash(1), linewidth=1.0, label=expected_from),
        Line2D([], [], color="black", marker="x", linestyle="", label="printed in the paper"),
    ]
    style.legend(figure, entries)
    return figure
