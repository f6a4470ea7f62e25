"""The numbers of a run in one tidy table."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from inspect import isfunction, signature
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from results.archive import Run
from results.metrics import contacts, detection, encounters, freshness, radio, trust
from results.metrics.kitti import FEWEST

if TYPE_CHECKING:
    from results.figures.style import Figure

TOPICS: Mapping[str, ModuleType] = {
    "encounters": encounters,
    "trust": trust,
    "freshness": freshness,
    "radio": radio,
    "detection": detection,
    "contacts": contacts,
}

Line = tuple[str, str, float, str]
"""Figure, of what, value, unit."""


def measure(run: Run, threshold: float = 0.25, fresh_s: float = 10.0, max_frames: int = 4000) -> pd.DataFrame:
    """Every figure that the run's record level allows.

    Parameters
    ----------
    threshold
        Trust below which a liar counts as found out.
    fresh_s
        Oldest age at which trust counts as fresh.
    max_frames
        Sample for detection quality, see `results.metrics.detection.precision`.

    Returns
    -------
    topic, figure, of, value, unit. What the run cannot answer has the reason in `of` and no value.
    """
    topics: dict[str, Callable[[], Iterator[Line]]] = {
        "traffic": lambda: _traffic(run),
        "encounters": lambda: _encounters(run),
        "trust": lambda: _trust(run, threshold),
        "freshness": lambda: _freshness(run, fresh_s),
        "radio": lambda: _radio(run),
        "detection": lambda: _detection(run, max_frames),
        "attack": lambda: _attack(run),
    }
    rows = []
    for topic, lines in topics.items():
        try:
            for line in lines():
                rows.append((topic, *line))
        except ValueError as reason:
            rows.append((topic, "not measured", str(reason), np.nan, ""))
    return pd.DataFrame(rows, columns=["topic", "figure", "of", "value", "unit"])


class Measures:
    """Everything that can be measured on one run: called, all of it; by topic, as tidy frames and a picture."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def __call__(self, **options: Any) -> pd.DataFrame:
        """What `measure` says of the run."""
        return measure(self._run, **options)

    def __getattr__(self, topic: str) -> "Topic":
        if topic not in TOPICS:
            raise AttributeError(f"There is nothing to measure called {topic!r}. The topics are {', '.join(TOPICS)}.")
        return Topic(self._run, topic)

    def __dir__(self) -> list[str]:
        return list(TOPICS)


class Topic:
    """The functions of one module of `results.metrics`, with the run filled in, and `plot`."""

    def __init__(self, run: Run, topic: str) -> None:
        self._run, self._topic = run, topic

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name not in dir(self):
            raise AttributeError(f"{self._topic} has no {name!r}. It has {', '.join(dir(self))}.")
        return partial(getattr(TOPICS[self._topic], name), self._run)

    def __dir__(self) -> list[str]:
        module = TOPICS[self._topic]
        own = [n for n, f in vars(module).items() if isfunction(f) and f.__module__ == module.__name__ and n[0] != "_"]
        return [*(n for n in own if next(iter(signature(getattr(module, n)).parameters), "") == "run"), "plot"]

    def plot(self, **options: Any) -> "Figure":
        """The picture of the topic."""
        from results.figures.catalogue import FIGURES  # here, because measuring needs no Matplotlib

        return FIGURES[self._topic]([self._run], **options)


def _traffic(run: Run) -> Iterator[Line]:
    vehicles = run.vehicles
    time_s = run.manifest["steps"] * run.dt_s
    on_road = (vehicles.last_step - vehicles.first_step + 1) * run.dt_s / time_s
    yield "duration", "", time_s, "s"
    yield "actors on the road, mean", "all", float(on_road.sum()), ""
    yield "actors on the road, mean", "equipped", float(on_road[vehicles.equipped].sum()), ""
    for behaviour, n in run.roles.value_counts().sort_index().items():
        yield "equipped vehicles", str(behaviour), float(n), ""


def _encounters(run: Run) -> Iterator[Line]:
    for row in encounters.summary(run).itertuples():
        of = f"{row.pairs}, {row.radius_m:g} m"
        yield "encounters", of, float(row.n), ""
        yield "start not seen", of, row.n_start_unseen / row.n, "1"
        yield "end not seen", of, row.n_end_unseen / row.n, "1"
        yield "duration, mean", of, row.mean_s, "s"
        yield "duration, median", of, row.median_s, "s"
        yield "duration, mean by Kaplan-Meier", of, row.km_mean_s, "s"
        yield "duration, median by Kaplan-Meier", of, row.km_median_s, "s"
        yield "pairs that meet again", of, row.again_share, "1"


def _trust(run: Run, threshold: float) -> Iterator[Line]:
    for row in trust.final(run).itertuples():
        yield "final trust, median", row.behaviour, row.median, "1"
        yield "final trust, mean", row.behaviour, row.mean, "1"
    for behaviour, values in trust.values(run).groupby("behaviour", observed=True).trust:
        yield "trust, mean over the run", str(behaviour), float(values.mean()), "1"
    if not np.isnan(apart := trust.separation(run)):
        yield "honest above malicious at the end", "", apart, "1"
    for row in trust.below(run, threshold).itertuples():
        yield f"trust below {threshold:g}, share of values", row.behaviour, row.share, "1"
    places: list[trust.At] = ["server"] if trust.kept_at(run) == "server" else []
    places += ["vehicles"] if "uses" in run.tables else []
    for at in places:
        for behaviour, delay in trust.detection_delay(run, threshold, at).groupby("behaviour", observed=True):
            of = f"{behaviour}, at the {at}" if at == "server" else f"{behaviour}, at a vehicle"
            yield f"found out below {threshold:g}", of, float(delay.found.mean()), "1"
            if delay.found.any():
                yield "time to be found out, median", of, float(delay.delay_s[delay.found].median()), "s"


def _freshness(run: Run, fresh_s: float) -> Iterator[Line]:
    for row in freshness.evidence(run).itertuples():
        yield "newest evidence at the server, median age", row.behaviour, row.newest_age_s, "s"
    for row in freshness.without_trust(run).itertuples():
        of = f"{row.pairs}, {row.radius_m:g} m"
        yield "encounters over before trust was known", of, row.share, "1"
        yield "wait for trust in an encounter, median", of, row.wait_median_s, "s"
    for row in freshness.shares(run, fresh_s).itertuples():
        yield f"trust at use (fresh: at most {fresh_s:g} s)", row.state, row.share, "1"
    for row in freshness.shares_by_behaviour(run, fresh_s).itertuples():
        yield "use of trust, by whom it is about", f"{row.state}, {row.behaviour}", row.share, "1"
    known = freshness.at_use(run)
    for row in known[known.source != "default"].itertuples():
        yield "age at use, mean", row.source, row.mean_s, "s"
        if not np.isnan(row.peak_s):
            yield "age at use, peak", row.source, row.peak_s, "s"
    if (known.source != "default").any():
        for row in freshness.evidence_at_use(run).itertuples():
            yield "newest evidence at use, mean age", row.behaviour, row.newest_s, "s"
            if not np.isnan(row.oldest_s):
                yield "oldest evidence at use, mean age", row.behaviour, row.oldest_s, "s"


def _radio(run: Run) -> Iterator[Line]:
    for condition in radio.conditions(run).to_dict("records"):
        yield condition["condition"], condition["is"], condition["value"], condition["unit"]
    (row,) = radio.overall(run).itertuples()
    yield "messages sent", "", float(row.n_sent), ""
    yield "delivery ratio", "", row.delivery_ratio, "1"
    for name in radio.LOST:
        yield "lost", name.removeprefix("n_lost_").replace("_", " "), getattr(row, name.replace("n_lost", "lost")), "1"
    for view, part in radio.by_distance(run, by_view=True).groupby("view", observed=True):
        yield "delivery ratio by view", str(view), float(np.average(part.delivery_ratio, weights=part.n_in_reach)), "1"
    if not np.isnan(row.busy_ratio):
        yield "busy ratio", "mean over vehicles", row.busy_ratio, "1"
    late = radio.latency(run).groupby("latency_s").n_delivered.sum().cumsum()
    for share in (0.5, 0.95):
        yield "latency at most", f"{share:.0%} of messages", float(late.index[late >= share * late.iloc[-1]][0]), "s"
    gaps = radio.inter_reception(run)
    yield "inter-reception time", "mean", float(np.average(gaps.gap_s, weights=gaps.n_received)), "s"
    lost = gaps[gaps.n_lost > 0]
    yield "inter-reception time", "share after a loss", lost.n_received.sum() / gaps.n_received.sum(), "1"
    if lost.n_received.sum():
        yield "messages lost in a row", "mean", float(np.average(lost.n_lost, weights=lost.n_received)), ""
    if "server" in run.tables and len(run.server):
        (way,) = radio.to_server(run).to_dict("records")
        for name in ("reached", "lost", "over_capacity", "outage"):
            yield "reports to the server", name.replace("_", " "), way[name], "1"
        yield "broadcasts of the server", "reached", way["informed"], "1"


def _detection(run: Run, max_frames: int) -> Iterator[Line]:
    for row in detection.precision(run, max_frames=max_frames).to_dict("records"):
        if row["n_truth"] >= FEWEST:
            yield f"AP 3D, 40 points, {row['boxes']}", f"{row['class']}, {row['level']}", row["ap40"], "%"
    known = detection.awareness(run, max_frames=max_frames).groupby("boxes")[["n_known", "n_present"]].sum()
    for which, row in known.iterrows():
        yield "awareness within 70 m", str(which), row.n_known / row.n_present, "1"


def _attack(run: Run) -> Iterator[Line]:
    (row,) = detection.attack_success(run).itertuples()
    yield "boxes made up", "", float(row.n_fabricated), ""
    yield "made-up boxes believed by someone", "", row.share, "1"
