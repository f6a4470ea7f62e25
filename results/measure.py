"""The numbers of a run in one tidy table."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from inspect import isfunction, signature
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from results.metrics import contact_graph, detection, encounters, freshness, misbehaviour, radio, trust
from results.metrics.kitti import FEWEST
from results.run import Run

if TYPE_CHECKING:
    from results.figures.style import Figure

TOPICS: Mapping[str, ModuleType] = {
    "encounters": encounters,
    "trust": trust,
    "liars": liars,
    "freshness": freshness,
    "radio": radio,
    "detection": detection,
    "contacts": contacts,
}

Line = tuple[str, str, float, str]
"""Figure, of what, value, unit."""


def measure(
    run: Run, threshold: float = 0.25, fresh_s: float = 10.0, false_positives: float = 0.05, max_frames: int = 4000
) -> pd.DataFrame:
    """Every figure that the run's record level allows.

    Parameters
    ----------
    threshold
        Trust below which a vehicle is suspected.
    fresh_s
        Oldest age at which trust counts as fresh.
    false_positives
        Share of honest trust values that a threshold on trust may wrongly suspect, see `results.metrics.misbehaviour`.
    max_frames
        Sample for detection quality, see `results.metrics.detection.precision`.

    Returns
    -------
    topic, figure, of, value, unit. A topic that the run cannot answer has the reason in `of` and no value; a single
    figure that is not defined (a median that was not reached) has no line.
    """
    topics: dict[str, Callable[[], Iterator[Line]]] = {
        "traffic": lambda: _traffic(run),
        "encounters": lambda: _encounters(run),
        "trust": lambda: _trust(run),
        "liars": lambda: _liars(run, threshold, false_positives),
        "freshness": lambda: _freshness(run, fresh_s),
        "radio": lambda: _radio(run),
        "detection": lambda: _detection(run, max_frames),
        "attack": lambda: _attack(run),
    }
    rows: list[tuple[str, str, str, float, str]] = []
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


def _lines(frame: pd.DataFrame, of: str, figures: Mapping[str, tuple[str, str]]) -> Iterator[Line]:
    """Figure and unit by column, for every row where it has a value; `of` is filled in from the row."""
    for row in frame.to_dict("records"):
        for column, (figure, unit) in figures.items():
            if pd.notna(row[column]):
                yield figure, of.format_map(row), float(row[column]), unit


def _traffic(run: Run) -> Iterator[Line]:
    vehicles = run.vehicles
    time_s = run.manifest["steps"] * run.dt_s
    on_road = (vehicles.last_step - vehicles.first_step + 1) * run.dt_s / time_s
    yield "duration", "", time_s, "s"
    yield "actors on the road, mean", "all", float(on_road.sum()), ""
    yield "actors on the road, mean", "equipped", float(on_road[vehicles.equipped].sum()), ""
    for role, n in run.roles.value_counts().sort_index().items():
        yield "equipped vehicles", str(role), float(n), ""


def _encounters(run: Run) -> Iterator[Line]:
    frame = encounters.summary(run)
    frame = frame.assign(start_unseen=frame.n_start_unseen / frame.n, end_unseen=frame.n_end_unseen / frame.n)
    yield from _lines(frame, "{pairs}, {radius_m:g} m", {
        "n": ("encounters", ""), "start_unseen": ("start not seen", "1"), "end_unseen": ("end not seen", "1"),
        "mean_s": ("duration, mean", "s"), "median_s": ("duration, median", "s"),
        "km_mean_s": ("duration, mean by Kaplan-Meier", "s"), "km_median_s": ("duration, median by Kaplan-Meier", "s"),
        "again_share": ("pairs that meet again", "1"),
    })  # fmt: skip


def _trust(run: Run) -> Iterator[Line]:
    figures = {"median": ("final trust, median", "1"), "mean": ("final trust, mean", "1")}
    yield from _lines(trust.final(run), "{role}", figures)
    yield from _lines(trust.mean(run), "{role}", {"mean": ("trust, mean over the run", "1")})


def _liars(run: Run, threshold: float, false_positives: float) -> Iterator[Line]:
    low = f"trust below {threshold:g}, share of "
    yield from _lines(misbehaviour.below(run, threshold), "{role}", {
        "share": (low + "values", "1"), "judged_share": (low + "judged values", "1"),
    })  # fmt: skip
    frame = misbehaviour.separability(run, false_positives)
    few = f"at {100 * false_positives:g}% false positives"
    yield from _lines(frame[:1], "honest", {"judged_honest": ("judged, share of the time", "1")})
    yield from _lines(frame, "{role}", {
        "judged": ("judged, share of the time", "1"), "n": ("liars", ""),
        "auc": ("honest above liars (AUC)", "1"),
        "auc_unjudged": ("honest above liars, unjudged values included", "1"),
        "true_positives": (f"true positives {few}", "1"), "caught": (f"suspected, share of the time, {few}", "1"),
    })  # fmt: skip
    yield from _lines(frame[:1], "", {"threshold": (f"threshold {few}", "1")})
    if not np.isnan(apart := misbehaviour.separation(run)):
        yield "honest above malicious at the end", "", apart, "1"
    limit, kept = float(frame.threshold.iloc[0]), trust.kept_at(run)
    asked: list[tuple[str, float, trust.At]] = [(f"below {threshold:g}", threshold, kept), (few, limit, kept)]
    if kept == "server" and "trust_lookups" in run.tables:
        asked.insert(1, (f"below {threshold:g}", threshold, "vehicles"))
    for name, value, at in asked if not np.isnan(limit) else ():
        of = "{role}, at the server" if at == "server" else "{role}, at a vehicle"
        yield from _lines(misbehaviour.detection_summary(run, value, at), of, {
            "share": (f"ever suspected, {name}", "1"), "half_after_s": (f"half are suspected after, {name}", "s"),
        })  # fmt: skip


def _freshness(run: Run, fresh_s: float) -> Iterator[Line]:
    newest = {"newest_age_s": ("newest evidence at the server, median age", "s")}
    yield from _lines(freshness.evidence(run), "{role}", newest)
    yield from _lines(freshness.without_trust(run), "{pairs}, {radius_m:g} m", {
        "share": ("encounters over before trust was known", "1"),
        "wait_median_s": ("wait for trust in an encounter, median", "s"),
    })  # fmt: skip
    state = {"share": (f"trust at use (fresh: at most {fresh_s:g} s)", "1")}
    yield from _lines(freshness.shares(run, fresh_s), "{state}", state)
    about = {"share": ("use of trust, by whom it is about", "1")}
    yield from _lines(freshness.shares_by_role(run, fresh_s), "{state}, {role}", about)
    known = freshness.at_use(run).query("source != 'default'")
    ages = {"mean_s": ("age at use, mean", "s"), "peak_s": ("age at use, peak", "s")}
    yield from _lines(known, "{source}", ages)
    if len(known):
        yield from _lines(freshness.evidence_at_use(run), "{role}", {
            "newest_s": ("newest evidence at use, mean age", "s"),
            "oldest_s": ("oldest evidence at use, mean age", "s"),
        })  # fmt: skip


def _radio(run: Run) -> Iterator[Line]:
    for condition in radio.conditions(run).to_dict("records"):
        yield condition["condition"], condition["is"], condition["value"], condition["unit"]
    frame = radio.overall(run)
    yield from _lines(frame, "", {"n_sent": ("messages sent", ""), "delivery_ratio": ("delivery ratio", "1")})
    for name in radio.LOST:
        cause = name.removeprefix("n_lost_")
        yield from _lines(frame, cause.replace("_", " "), {f"lost_{cause}": ("lost", "1")})
    for view, part in radio.by_distance(run, by_view=True).groupby("view", observed=True):
        yield "delivery ratio by view", str(view), float(np.average(part.delivery_ratio, weights=part.n_in_range)), "1"
    yield from _lines(frame, "mean over vehicles", {"cbr": ("busy ratio", "1")})
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
        way = radio.to_server(run)
        for name in ("reached", "lost", "over_capacity", "outage"):
            yield from _lines(way, name.replace("_", " "), {name: ("reports to the server", "1")})
        yield from _lines(way, "reached", {"informed": ("broadcasts of the server", "1")})


def _detection(run: Run, max_frames: int) -> Iterator[Line]:
    frame = detection.precision(run, max_frames=max_frames)
    for boxes, some in frame[frame.n_truth >= FEWEST].groupby("boxes", sort=False):
        yield from _lines(some, "{class}, {level}", {"ap40": (f"AP 3D, 40 points, {boxes}", "%")})
    known = detection.awareness(run, max_frames=max_frames).groupby("boxes")[["n_known", "n_present"]].sum()
    for which, share in (known.n_known / known.n_present).items():
        yield "awareness within 70 m", str(which), share, "1"


def _attack(run: Run) -> Iterator[Line]:
    yield from _lines(detection.attack_success(run), "", {
        "n_fabricated": ("boxes made up", ""), "share": ("made-up boxes believed by someone", "1"),
    })  # fmt: skip
