"""A short film of the map: who is trusted, who lies, and what one vehicle sees and believes.

Each picture shows what vehicles fabricated, detected and believed when they last sensed, less than an interval ago.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy import ndarray

from cosim.base import durable
from results.figures import style
from results.metrics.trust import in_vehicles
from results.moments import at_steps
from results.run import Run
from results.sensing import interval_steps

FORMATS = (".gif", ".mp4")
MOST_FRAMES = 120
HALF_WIDTH_M = 110.0
"""Of the square that is shown around a vehicle."""
PICTURES_PER_S = 6
DPI = 167
TRUST = colormaps["RdYlBu"].with_extremes(bad="white")
"""Colours of trust; white has no evaluation yet."""
SEEN, BELIEVED = style.INKS[2], style.INKS[4]
LIE = style.ROLE_INKS["malicious"]


def write(
    run: Run,
    out: Path,
    vehicle: int | None,
    streets: Sequence[Float[ndarray, "k 2"]],
    buildings: Sequence[Float[ndarray, "k 2"]],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Film a run, around a vehicle while it is on the road or of the whole city.

    Parameters
    ----------
    streets, buildings
        Lines and outlines, world frame.

    Raises
    ------
    ValueError
        In one line: no such form of file, no writer for it, a vehicle that was never there.
    """
    if out.suffix not in FORMATS:
        raise ValueError(f"--out {out}: a movie ends in {' or '.join(FORMATS)}.")
    if out.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise ValueError(f"--out {out}: there is no ffmpeg to write MP4. Install it, or write a .gif.")
    run.require("actors", "vehicles", "detections", "trust")
    spans = run.table("vehicles").set_index("vehicle")
    first, last = 0, int(run.manifest["steps"]) - 1
    if vehicle is not None:
        if vehicle not in spans.index or not spans.equipped[vehicle]:
            raise ValueError(f"--vehicle {vehicle} is none that carries a LiDAR in {run.path}.")
        first = int(spans.first_step[vehicle])
        last = int(spans.last_step[vehicle])
    steps = np.arange(first, last + 1)
    steps = steps[:: -(-len(steps) // MOST_FRAMES)]
    film = _Film(run, vehicle, steps, streets, buildings)
    partial = out.with_name(f"{out.stem}.partial{out.suffix}")
    writer = (FFMpegWriter if out.suffix == ".mp4" else PillowWriter)(fps=PICTURES_PER_S)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        os.close(durable.new_file(partial))
        with writer.saving(film.figure, str(partial), dpi=DPI):
            for number, step in enumerate(steps.tolist()):
                film.show(step)
                writer.grab_frame()
                progress(number + 1, len(steps))
        partial.replace(out)
    except OSError as error:
        with suppress(OSError):  # a file may stand where its folder should be
            partial.unlink()
        raise ValueError(f"--out {out} cannot be written: {error.strerror or error}.") from None
    return out


class _Film:
    """The picture that changes from step to step."""

    def __init__(  # type: ignore[no-untyped-def]
        self, run: Run, vehicle: int | None, steps: ndarray, streets, buildings
    ) -> None:
        self.vehicle, self._dt_s = vehicle, run.dt_s
        actors = run.table("actors", ["step", "actor", "x_m", "y_m"], at_steps(steps))
        self._actors = dict(iter(actors.groupby("step")))
        of = run.subjects.vehicle
        own = pc.field("observer").isin(of.index[of == vehicle].tolist())
        found = run.table(
            "detections", ["step", "observer", "x_m", "y_m", "origin"], own | (pc.field("origin") == "fabricated")
        )
        maker = found.observer.map(of)
        found["end_step"] = found.step + interval_steps(run, maker.to_numpy(int))
        self._lies = found[found.origin == "fabricated"]
        self._seen = found[(found.origin == "sensed") & (maker == vehicle)]
        self._believed = self._seen[:0]
        if vehicle is not None and "fused" in run.tables:
            fused = run.variant_table("fused", ["step", "x_m", "y_m"], pc.field("observer") == vehicle)
            (interval,) = interval_steps(run, np.array([vehicle]))
            self._believed = fused.assign(end_step=fused.step + interval)
        self._trust_at = partial(in_vehicles, run)
        self._roles = run.roles.astype(object)
        self._attack_starts = attack_starts(run)
        self._begin(streets, buildings)

    @style.styled
    def _begin(self, streets, buildings):  # type: ignore[no-untyped-def]
        self.figure, (self._axes,) = style.sheet(height=3.7)
        axes = self._axes
        axes.add_collection(PolyCollection(buildings, facecolor=style.PALE, edgecolor="none", zorder=1))
        axes.add_collection(LineCollection(streets, colors="#e2e5ea", linewidths=1.2, zorder=0))
        style.map_panel(axes, "")
        self._clock = axes.set_title(" ")
        if self.vehicle is None and len(streets):
            corner = np.concatenate(streets)
            axes.set_xlim(corner[:, 0].min(), corner[:, 0].max())
            axes.set_ylim(corner[:, 1].min(), corner[:, 1].max())
        none = np.zeros(0)
        size = 14 if self.vehicle is not None else 5
        self._others = axes.scatter(none, none, s=0.4 * size, color="#8a8f98", zorder=2)
        self._equipped = axes.scatter(
            none, none, c=[], s=size, cmap=TRUST, vmin=0, vmax=1, edgecolors="#333333", linewidths=0.4, zorder=4
        )
        self._liars = axes.scatter(
            none, none, s=3.2 * size, facecolors="none", edgecolors=LIE, linewidths=0.8, zorder=4
        )
        self._ghosts = axes.scatter(none, none, s=1.6 * size, marker="x", color=LIE, linewidths=1.0, zorder=5)
        squares: dict[str, Any] = {"marker": "s", "facecolors": "none", "zorder": 3}
        self._finds = axes.scatter(none, none, s=2.6 * size, edgecolors=SEEN, linewidths=0.9, **squares)
        self._beliefs = axes.scatter(none, none, s=5.0 * size, edgecolors=BELIEVED, linewidths=0.7, **squares)
        self._me = axes.scatter(none, none, s=5 * size, marker="*", color="black", zorder=6)
        self.figure.colorbar(self._equipped, ax=axes, shrink=0.6, label="Trust")
        marks = [
            ("o", "#8a8f98", "not equipped", True),
            ("o", "#333333", "no evaluation yet", False),
            ("o", LIE, "attacker", False),
            ("x", LIE, "fabricated", True),
        ]
        if self.vehicle is not None:
            marks += [
                ("*", "black", f"vehicle {self.vehicle}", True),
                ("s", SEEN, "it detects", False),
                ("s", BELIEVED, "it believes", False),
            ]
        entries = []
        for marker, colour, text, is_full in marks:
            fill = colour if is_full else "none"
            entries.append(style.entry(text, linestyle="", marker=marker, color=colour, markerfacecolor=fill))
        style.legend(self.figure, entries)
        layout = self.figure.get_layout_engine()
        assert isinstance(layout, ConstrainedLayoutEngine)
        layout.set(rect=(0.04, 0.0, 0.92, 1.0))  # room for coordinates that get longer as the picture moves
        return self.figure

    def show(self, step: int) -> None:
        """Draw the figure of this step."""
        rows = self._actors.get(step)
        number = np.zeros(0, int) if rows is None else rows.actor.to_numpy()
        xy = _places(rows)
        role = self._roles.reindex(number).to_numpy(object)
        equipped = np.array([isinstance(r, str) for r in role], bool)
        attacks = self._attack_starts.reindex(number).to_numpy() <= step
        rated = self._trust_at(step).reindex(number[equipped]).to_numpy(float)
        self._others.set_offsets(xy[~equipped])
        self._equipped.set_offsets(xy[equipped])
        self._equipped.set_array(np.ma.masked_invalid(rated))
        self._liars.set_offsets(xy[attacks])
        for marks, rows in (
            (self._ghosts, self._lies),
            (self._finds, self._seen),
            (self._beliefs, self._believed),
        ):
            is_shown = (rows.step <= step) & (step < rows.end_step)
            marks.set_offsets(_places(rows[is_shown]))
        if self.vehicle is not None and len(at := xy[number == self.vehicle]):
            self._me.set_offsets(at)
            east, north = at[0]
            self._axes.set_xlim(east - HALF_WIDTH_M, east + HALF_WIDTH_M)
            self._axes.set_ylim(north - HALF_WIDTH_M, north + HALF_WIDTH_M)
        self._clock.set_text(f"{step * self._dt_s:g} s")


def attack_starts(run: Run) -> pd.Series:
    """Step in which each malicious vehicle begins to attack, by its number; not a number if it never does."""
    vehicles = run.table("vehicles", ["vehicle", "role", "attack_start_step"]).set_index("vehicle")
    return vehicles[vehicles.role == "malicious"].attack_start_step.astype(float)


def _places(rows: pd.DataFrame | None) -> Float[ndarray, "n 2"]:
    """East and north of rows; of no rows, none."""
    return np.zeros((0, 2)) if rows is None else rows[["x_m", "y_m"]].to_numpy(float)
