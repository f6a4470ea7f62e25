"""Measure tracks of recorded detections: against the true motion, and against Stone Soup.

    python -m tests.calibration.measure_tracking runs/a runs/b --rates 10 2 1 --library-s 30 --picture tracking.png

reads runs that exist, in which vehicles sense in every step. A lower rate is every n-th sweep. It prints tables in
Markdown: velocity errors by rate and class, the comparison with the library, and how often objects exist whose
probability of existence is said to be so. Squared errors of velocities along and across the heading are also given in
units of the stated variance: their median, and their mean without the largest 3 % of a class, over those of a normal
distribution.
"""

import argparse
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.stats import chi2

from cosim.world import LABELS
from results.archive import open_run
from results.figures import style
from sensors.tracking.motion import places_m
from sensors.tracking.params import TrackingParams
from sensors.tracking.track import track
from sensors.tracking.tracks import Found, Observers, TrackMemory
from tests.sensors.one_track_at_a_time import StoneSoup

PARAMS = TrackingParams(model="constant_velocity")
ONE_MOTION = replace(
    PARAMS, accelerating_p=0.0, steady_noise=(1.5, 0.2, 0.7, 1.5), position_sigma_m=(0.15, 0.06, 0.1, 0.3)
)
"""For the library, which has no interacting models."""
KEPT = 0.97
CORE_MEAN = chi2.expect(lambda x: x, (1,), ub=chi2.ppf(KEPT, 1), conditional=True)
"""Mean of this share of the smallest squares of a standard normal number."""
BINS = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.99, 1.0])
COLUMNS = ["step", "observer", "detection_index", "class", "x_m", "y_m", "yaw_rad", "score", "origin", "truth_actor"]


@dataclass(frozen=True)
class Recorded:
    """Detections of a run with the true positions and velocities, and the speeds of the observers by step."""

    rows: pd.DataFrame
    speeds: dict[int, tuple[np.ndarray, np.ndarray]]
    dt_s: float


def recorded(folder: Path) -> Recorded:
    """The detections of a run without pseudonym changes."""
    run = open_run(folder)
    found, actors = run.table("detections", COLUMNS), run.table("actors")
    observers = np.unique(found.observer)
    found = found[found.origin == "sensed"].drop(columns="origin")
    truth = pd.DataFrame({
        "step": actors.step, "truth_actor": actors.actor, "true_x_m": actors.x_m, "true_y_m": actors.y_m,
        "true_vx": actors.speed_mps * np.cos(actors.yaw_rad), "true_vy": actors.speed_mps * np.sin(actors.yaw_rad),
    })  # fmt: skip
    rows = found.merge(truth, on=["step", "truth_actor"], how="left")
    rows = rows.sort_values(["step", "observer", "detection_index"], ignore_index=True)
    rows["label"] = rows["class"].astype(str).map({name: k for k, name in enumerate(LABELS)}).astype(np.uint8)
    own = actors[actors.actor.isin(observers)].sort_values(["step", "actor"])
    speeds = {
        int(step): (g.actor.to_numpy(np.int64), g.speed_mps.to_numpy(float)) for step, g in own.groupby("step")
    }  # fmt: skip
    return Recorded(rows, speeds, run.manifest["dt_s"])


def tracked(data: Recorded, every: int, params: TrackingParams = PARAMS, until_s: float = np.inf) -> pd.DataFrame:
    """The detections of every n-th step with what tracking says, and the processor time per observer and step."""
    rows = data.rows[(data.rows.step % every == 0) & (data.rows.step * data.dt_s < until_s)].reset_index(drop=True)
    memory, states, xy_m, n_hits = TrackMemory(), [], [], []
    took_s, n_sweeps = 0.0, 0
    for step, found, observers in moments(data, rows):
        begin = time.process_time()
        memory, state = track(memory, observers, found, params)
        took_s, n_sweeps = took_s + time.process_time() - begin, n_sweeps + len(observers.number)
        own = memory.tracks
        own = own.take(np.lexsort((own.object_id, own.observer)))
        at = np.searchsorted(own.observer << 32 | own.object_id, found.observer << 32 | state.object_id)
        states.append(state)
        xy_m.append(places_m(own)[at])
        n_hits.append(own.n_hits[at])
        assert (own.last_s[at] == step * data.dt_s).all()
    rows["object_id"] = np.concatenate([s.object_id for s in states])
    rows["existence_p"] = np.concatenate([s.existence_p for s in states])
    rows[["vx", "vy"]] = np.concatenate([s.velocity_mps for s in states])
    rows[["cos", "sin"]] = np.concatenate([s.axis for s in states])
    rows[["along_m2", "across_m2"]] = np.concatenate([s.variance for s in states])
    rows[["track_x_m", "track_y_m"]] = np.concatenate(xy_m)
    rows["n_hits"] = np.concatenate(n_hits)
    rows.attrs["us"] = 1e6 * took_s / max(n_sweeps, 1)
    return with_errors(rows)


def moments(data: Recorded, rows: pd.DataFrame):
    """(step, detections, observers) of each step."""
    for step, g in rows.groupby("step"):
        number, speed_mps = data.speeds[int(step)]
        found = Found(
            g.observer.to_numpy(np.int64), g.label.to_numpy(), g[["x_m", "y_m"]].to_numpy(float),
            g.yaw_rad.to_numpy(float), g.score.to_numpy(float),
            np.full(len(g), np.nan), np.zeros(len(g)),
        )  # fmt: skip
        yield step, found, Observers(number, np.full(len(number), step * data.dt_s), speed_mps)


def by_library(data: Recorded, every: int, until_s: float) -> pd.DataFrame:
    """As `tracked` with `ONE_MOTION`, by Stone Soup, one observer at a time."""
    rows = data.rows[(data.rows.step % every == 0) & (data.rows.step * data.dt_s < until_s)].reset_index(drop=True)
    trackers, said = {}, []
    for step, found, observers in moments(data, rows):
        speed = dict(zip(observers.number, observers.speed_mps, strict=True))
        for o in np.unique(found.observer):
            mine = [
                (int(found.label[k]), found.xy_m[k], found.yaw_rad[k], found.score[k], np.nan)
                for k in np.flatnonzero(found.observer == o)
            ]  # fmt: skip
            said += trackers.setdefault(o, StoneSoup(ONE_MOTION)).sense(step * data.dt_s, speed[o], mine)
    rows["object_id"] = [number for number, _, _, _ in said]
    rows[["track_x_m", "track_y_m"]] = np.array([xy for _, xy, _, _ in said])
    rows["n_hits"] = [hits for _, _, _, hits in said]
    confirmed = (rows.n_hits >= ONE_MOTION.confirm_hits).to_numpy()[:, None]
    rows[["vx", "vy"]] = np.where(confirmed, np.array([v for _, _, v, _ in said]), np.nan)
    return with_errors(rows)


def with_errors(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with errors of velocity, speed and position of real objects."""
    return rows.assign(
        velocity_error=np.hypot(rows.vx - rows.true_vx, rows.vy - rows.true_vy),
        speed_error=(np.hypot(rows.vx, rows.vy) - np.hypot(rows.true_vx, rows.true_vy)).abs(),
        position_error=np.hypot(rows.track_x_m - rows.true_x_m, rows.track_y_m - rows.true_y_m),
        detection_error=np.hypot(rows.x_m - rows.true_x_m, rows.y_m - rows.true_y_m),
        is_real=rows.truth_actor.notna(),
    )


def consistency(rows: pd.DataFrame) -> dict[str, float]:
    """Squared errors of velocities in units of the stated variance, over those of a normal distribution."""
    east, north = rows.vx - rows.true_vx, rows.vy - rows.true_vy
    found = {}
    for name, error, variance in (
        ("along", rows.cos * east + rows.sin * north, rows.along_m2),
        ("across", rows.cos * north - rows.sin * east, rows.across_m2),
    ):
        square = np.sort(error**2 / variance)
        core = square[: int(KEPT * len(square))]
        found[f"{name}, median"] = np.median(square) / chi2.median(1)
        found[f"{name}, mean"] = core.mean() / CORE_MEAN
    return found


def switches(rows: pd.DataFrame, keep_steps: float) -> tuple[int, int]:
    """How often an actor that is detected again within `keep_steps` has another number, and of how many times."""
    real = rows[rows.is_real].sort_values(["observer", "truth_actor", "step"])
    real = real.drop_duplicates(["observer", "truth_actor", "step"])
    before = real.shift()
    again = (real.observer == before.observer) & (real.truth_actor == before.truth_actor)
    again &= real.step - before.step <= keep_steps
    return int((again & (real.object_id != before.object_id)).sum()), int(again.sum())


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def summary(rows: pd.DataFrame, keep_steps: float) -> dict[str, float]:
    """The figures of one run at one rate."""
    known = rows[rows.is_real & rows.velocity_error.notna()]
    n_switches, n_again = switches(rows, keep_steps)
    return {
        "with velocity": len(known) / rows.is_real.sum(),
        "speed, median": known.speed_error.median(), "speed, 90 %": known.speed_error.quantile(0.9),
        "velocity, median": known.velocity_error.median(), "velocity, 90 %": known.velocity_error.quantile(0.9),
        "velocity, 99 %": known.velocity_error.quantile(0.99), "velocity, RMS": rms(known.velocity_error),
        "position, RMS": rms(known.position_error), "detection, RMS": rms(known.detection_error),
        "switches": n_switches, "of": n_again,
    }  # fmt: skip


def reliability(rows: pd.DataFrame) -> pd.DataFrame:
    """Said and true shares of real objects, by what is said."""
    said = pd.cut(rows.existence_p, BINS, include_lowest=True)
    return rows.groupby(said, observed=True).agg(
        said=("existence_p", "mean"), real=("is_real", "mean"), detections=("is_real", "size")
    )


@style.styled
def draw(all_rows: Mapping[float, pd.DataFrame]) -> Figure:
    """Distribution of the velocity error by rate, and reliability of the probability of existence."""
    figure, (errors, existence) = style.sheet(2, 2.2)
    rates = sorted(all_rows, reverse=True)
    for i, rate_hz in enumerate(rates):
        look = {"color": style.ink(i), "linestyle": style.dash(i)}
        rows = all_rows[rate_hz]
        error = np.sort(rows.velocity_error[rows.is_real].dropna())
        errors.plot(error, np.arange(1, len(error) + 1) / len(error), **look)
        bins = reliability(rows)
        existence.plot(bins.said, bins.real, marker=style.marker(i), **look)
    style.panel(errors, "Error of the velocity", "Error at most [m/s]", "Share of objects")
    errors.set(xscale="log", xlim=(0.02, 20))
    style.share_axis(errors)
    existence.plot([0, 1], [0, 1], color="#777777", linewidth=0.8)
    style.panel(existence, "Probability of existence (grey: said is true)", "Probability said", "Share of real objects")
    existence.set_xlim(-0.02, 1.03)
    style.share_axis(existence)
    style.legend(figure, [
        Line2D([], [], color=style.ink(i), linestyle=style.dash(i), marker=style.marker(i), label=f"{rate_hz:g} Hz")
        for i, rate_hz in enumerate(rates)
    ])  # fmt: skip
    return figure


def table(title: str, rows: list[dict]) -> None:
    """Print rows as Markdown."""
    print(f"\n{title}\n\n| {' | '.join(rows[0])} |\n|{'---|' * len(rows[0])}")
    for row in rows:
        print("| " + " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--rates", nargs="+", type=float, default=[10.0, 2.0, 1.0], help="Hz")
    parser.add_argument("--library-s", type=float, default=0.0, help="seconds of each run for Stone Soup; 0: none")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--confirm-hits", type=int, default=PARAMS.confirm_hits)
    asked = parser.parse_args()
    params = replace(PARAMS, confirm_hits=asked.confirm_hits)
    figures, classes, libraries, pooled = [], [], [], {rate: [] for rate in asked.rates}
    for folder in asked.runs:
        data = recorded(folder)
        for rate in asked.rates:
            every = round(1 / (rate * data.dt_s))
            keep = params.keep_s / data.dt_s
            rows = tracked(data, every, params)
            pooled[rate].append(rows)
            figures.append({"run": folder.name, "rate [Hz]": rate, **summary(rows, keep)})
            if asked.library_s:
                theirs = by_library(data, every, asked.library_s)
                ours = tracked(data, every, ONE_MOTION, asked.library_s)
                for name, one in (("cosim", ours), ("Stone Soup", theirs)):
                    said = summary(one, keep)
                    kept = ("velocity, RMS", "position, RMS", "switches", "of")
                    libraries.append({"run": folder.name, "rate [Hz]": rate, "by": name} | {k: said[k] for k in kept})
                same = (ours.object_id == theirs.object_id).mean()
                apart = np.nanmax(np.abs(ours[["vx", "vy"]].to_numpy() - theirs[["vx", "vy"]].to_numpy()))
                print(f"{folder.name}, {rate:g} Hz: {same:.6f} equal numbers, velocities differ by {apart:.1e} m/s")
    for rate, parts in pooled.items():
        every = pd.concat(parts)
        for name, one in every[every.is_real & every.velocity_error.notna()].groupby("class", observed=True):
            classes.append({
                "rate [Hz]": rate, "class": name, "velocity, median": one.velocity_error.median(),
                "velocity, 90 %": one.velocity_error.quantile(0.9), "velocity, RMS": rms(one.velocity_error),
                **consistency(one), "n": len(one),
            })  # fmt: skip
    table("Errors [m/s, m]", figures)
    table("By class", classes)
    if libraries:
        table("Library", libraries)
    for rate, parts in pooled.items():
        bins = reliability(pd.concat(parts)).reset_index(names="bin")
        table(f"Existence at {rate:g} Hz", bins.to_dict("records"))
    if asked.picture:
        style.save(draw({rate: pd.concat(parts) for rate, parts in pooled.items()}), asked.picture)


if __name__ == "__main__":
    main()
