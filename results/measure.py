"""The metrics of a run in one tidy table."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from inspect import isfunction, signature
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from cosim.base.addons import Choices
from cosim.base.codes import BASE_VARIANT
from cosim.base.durable import Damaged
from results.metrics import (
    attack,
    auc_bound,
    contact_graph,
    detection,
    encounters,
    evaluations,
    evidence,
    freshness,
    misbehaviour,
    radio,
    registry,
    repeats,
    safety,
    security,
    trust,
)
from results.metrics.intervals import FEW
from results.metrics.kitti import FEWEST
from results.metrics.registry import METRICS
from results.own_metrics import COLUMNS
from results.run import Run

if TYPE_CHECKING:
    from results.figures.style import Figure

TOPICS: Mapping[str, ModuleType] = Choices(
    "topic",
    {
        "encounters": encounters,
        "trust": trust,
        "misbehaviour": misbehaviour,
        "security": security,
        "evidence": evidence,
        "evaluations": evaluations,
        "freshness": freshness,
        "radio": radio,
        "detection": detection,
        "attack": attack,
        "contacts": contact_graph,
        "safety": safety,
    },
)
"""Modules of metrics by topic, as `run.measure.<topic>`."""


class MeasuredRow(NamedTuple):
    """A metric's value; rows of a run without interval have none."""

    name: str
    """Identifier without its topic."""
    group: str
    value: float
    low: float = float("nan")
    high: float = float("nan")
    n_units: float = float("nan")
    """Number of vehicles (or other independent units) that the value rests on."""
    note: str = ""
    """What the reader must know about the value."""


def measure(
    run: Run,
    threshold: float | None = None,
    fresh_s: float = 10.0,
    false_positives: float = 0.05,
    max_frames: int = 4000,
    topics: tuple[str, ...] = tuple(registry.TOPICS),
) -> pd.DataFrame:
    """Every metric that the run's record level allows, for the run's `variant`.

    Parameters
    ----------
    run
        An opened run.
    threshold
        Trust below which a subject is suspected; by default `trust.suspect_below` of the run.
    fresh_s
        Largest age of an evaluation that counts as fresh [s].
    false_positives
        False positive rate at which recall is computed, see `results.metrics.misbehaviour`.
    max_frames
        Size of the sample for detection quality, see `results.metrics.detection.precision`.
    topics
        Topics to measure.

    Returns
    -------
    Columns metric (an identifier of `results.metrics.registry.METRICS`), group, value, low and high (95 % interval,
    null if the metric has none), n_units (number of units that the interval is clustered by), unit, label, note.
    A topic for which the run has no data has one row `<topic>.not_measured`, with the reason as group and without a
    value. A metric that is not defined, such as a median that was not reached, has no row.

    Raises
    ------
    ValueError
        If a topic does not exist.
    """
    ask: Mapping[str, Callable[[], Iterator[tuple]]] = {
        "traffic": lambda: _traffic(run),
        "encounters": lambda: _encounters(run),
        "trust": lambda: _trust(run),
        "misbehaviour": lambda: _misbehaviour(run, threshold, false_positives),
        "security": lambda: _security(run, threshold),
        "evidence": lambda: _evidence(run),
        "freshness": lambda: _freshness(run, fresh_s),
        "radio": lambda: _radio(run),
        "detection": lambda: _detection(run, max_frames),
        "attack": lambda: _attack(run),
        "safety": lambda: _safety(run),
    }
    rows: list[MeasuredRow] = []
    for topic in topics:
        if topic not in ask:
            raise ValueError(f"There is no topic {topic!r}. The topics are {', '.join(ask)}.")
        try:
            for row in ask[topic]():
                made = MeasuredRow(*row)
                rows.append(made._replace(name=f"{topic}.{made.name}"))
        except ValueError as reason:
            if isinstance(reason, Damaged) and str(reason) not in run.damage:
                run.damage.append(str(reason))
            rows.append(MeasuredRow(f"{topic}.not_measured", str(reason), np.nan))
    return pd.DataFrame(
        [(*row[:-1], METRICS[row.name].unit, METRICS[row.name].label, _note(row)) for row in rows],
        columns=COLUMNS,
    )


def _note(row: MeasuredRow) -> str:
    """The note on a value, with a warning if it rests on too few units."""
    few = ""
    if 0 < row.n_units < FEW:
        few = f"too few: {row.n_units:.0f} of {FEW} {METRICS[row.name].unit_of_chance or 'units'}"
    return "; ".join(filter(None, (row.note, few)))


class Measures:
    """The metrics of one run. A call gives all of them; each topic has functions that give tidy frames and a figure."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def __call__(self, **options: Any) -> pd.DataFrame:
        """As `measure`."""
        return measure(self._run, **options)

    def value(self, metric: str, group: str = "", **options: Any) -> float:
        """One metric: `run.measure.value("trust.final.median", "malicious")`; NaN if it is not defined."""
        if metric not in METRICS:
            raise ValueError(f"There is no metric {metric!r}. `cosim measure --explain` lists them.")
        found = measure(self._run, topics=(metric.split(".")[0],), **options)
        values = found.value[(found.metric == metric) & (found.group == group)]
        return float(values.iloc[0]) if len(values) else float("nan")

    def __getattr__(self, topic: str) -> "Topic":
        if topic not in TOPICS:
            raise AttributeError(f"There is nothing to measure called {topic!r}. The topics are {', '.join(TOPICS)}.")
        return Topic(self._run, topic)

    def __dir__(self) -> list[str]:
        return [*TOPICS, "value"]


class Topic:
    """The functions of one module of `results.metrics`, applied to the run, and `plot`."""

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
        """The figure of the topic."""
        from results.figures.catalogue import FIGURES  # here, because measuring needs no Matplotlib

        return FIGURES[self._topic]([self._run], **options)


def _rows(
    frame: pd.DataFrame, group: str, metrics: Mapping[str, str], interval: str | None = None
) -> Iterator[MeasuredRow]:
    """One `MeasuredRow` for each row and metric column with a value. `group` is a template that the row fills in.

    A column may have interval columns (`intervals.columns`). `interval` names the column to which the columns low, high
    and n_units belong.
    """
    names = list(frame.columns)
    rows = [dict(zip(names, values, strict=True)) for values in frame.to_numpy(dtype=object).tolist()]
    for column, metric in metrics.items():
        for row in rows:
            if pd.notna(row[column]):
                beside = (row.get(f"{column}_{end}", np.nan) for end in ("low", "high", "units"))
                found = MeasuredRow(metric, group.format_map(row), float(row[column]), *beside)
                if column == interval:
                    found = found._replace(low=row["low"], high=row["high"], n_units=row["n_units"])
                yield found


def _named(frame: pd.DataFrame) -> pd.DataFrame:
    """Add the column `definition`, a name for each definition of an encounter."""
    return frame.assign(definition=encounters.named(frame))


def _traffic(run: Run) -> Iterator[MeasuredRow]:
    vehicles = run.vehicles[run.vehicles.vehicle_class != "roadside_unit"]
    time_s = run.manifest["steps"] * run.dt_s
    on_road = (vehicles.last_step - vehicles.first_step + 1) * run.dt_s / time_s
    yield MeasuredRow("duration_s", "", time_s)
    yield MeasuredRow("actors.mean", "all", float(on_road.sum()))
    yield MeasuredRow("actors.mean", "equipped", float(on_road[vehicles.equipped].sum()))
    for role, n in run.roles.value_counts().sort_index().items():
        yield MeasuredRow("equipped.n", str(role), float(n))


def _encounters(run: Run) -> Iterator[MeasuredRow]:
    rates = encounters.rates(run)
    frame = _named(encounters.summary(run).merge(rates, on=[*encounters.DEFINITION]))
    yield from _rows(frame, "{definition}", {
        "n": "n", "censored_left": "censored_left.share", "censored_right": "censored_right.share",
        "mean_s": "duration.mean_s", "median_s": "duration.median_s",
        "km_mean_s": "duration.km_mean_s", "km_median_s": "duration.km_median_s", "again_share": "again.share",
        "per_vehicle_h": "per_vehicle_h",
    })  # fmt: skip


def _trust(run: Run) -> Iterator[MeasuredRow]:
    idle = _idle_roles(run)
    for row in (
        *_rows(trust.final(run), "{role}", {"median": "final.median", "mean": "final.mean"}),
        *_rows(trust.mean(run), "{role}", {"mean": "run.mean"}),
    ):
        yield row._replace(note="has not attacked" if row.group in idle else "")


def _idle_roles(run: Run) -> set[str]:
    """Roles whose vehicles behave as honest ones in this run, because none of them has attacked yet."""
    who = run.subjects
    return {str(role) for role, of in who.groupby("role", observed=True).attack_start_step if of.isna().all()} - {
        misbehaviour.HONEST
    }


def _misbehaviour(run: Run, threshold: float | None, false_positives: float) -> Iterator[MeasuredRow]:
    yield from _rows(misbehaviour.below(run, threshold), "{role}", {
        "share": "below_threshold.share", "evaluated_share": "below_threshold.evaluated_share",
    })  # fmt: skip
    if "trust_lookups" in run.tables and run.n_rows("trust_lookups"):
        yield from _at_lookup(run, threshold)
    frame = misbehaviour.classification(run, false_positives)
    yield from _rows(frame[:1], misbehaviour.HONEST, {"evaluated_honest": "evaluated.share"})
    yield from _rows(frame, "{role}", {
        "evaluated": "evaluated.share", "n": "attackers.n", "auc": "auc", "auc_unevaluated": "auc_unevaluated",
        "true_positives": "recall_at_fpr", "suspected": "suspected_at_fpr.share",
    })  # fmt: skip
    yield from _rows(frame[:1], "", {"threshold": "fpr_threshold"})
    if not np.isnan((final := misbehaviour.separation(run)).value):
        yield MeasuredRow("auc_final", "", *final)
    limit, kept = float(frame.threshold.iloc[0]), trust.kept_at(run)
    if np.isnan(limit):
        return
    asked: list[tuple[str, float | None, trust.At]] = [("", threshold, kept), ("_at_fpr", limit, kept)]
    if kept == "server" and "trust_lookups" in run.tables:
        asked.insert(1, ("_at_vehicle", threshold, "vehicles"))
    for which, value, at in asked:
        yield from _rows(misbehaviour.detection_summary(run, value, at), "{role}", {
            "share": f"time_to_detection{which}.share", "median_s": f"time_to_detection{which}.median_s",
        })  # fmt: skip


def _at_lookup(run: Run, threshold: float | None) -> Iterator[MeasuredRow]:
    frame = misbehaviour.at_lookup(run, threshold)
    off_by = frame.auc_error.max()
    for row in _rows(frame, "{role}", {
        "auc": "at_lookup.auc", "evaluated": "at_lookup.evaluated.share", "suspected": "at_lookup.suspected.share",
    }):  # fmt: skip
        is_rounded = row.name == "at_lookup.auc" and off_by > 0
        yield row._replace(note=f"off by {off_by:.2g} at most" if is_rounded else "")
    yield from _rows(misbehaviour.detection_per_receiver(run, threshold), "{role}", {
        "share": "at_lookup.time_to_detection.share", "median_s": "at_lookup.time_to_detection.median_s",
    })  # fmt: skip


def _security(run: Run, threshold: float | None) -> Iterator[MeasuredRow]:
    for suffix, relative in (("", None), ("_relative", 0.5)):
        yield from _rows(security.confusion(run, threshold, relative), "{unit}", {
            name: name + suffix for name in ("precision", "recall", "fpr", "f1", "mcc", "informedness")
        })  # fmt: skip
        yield MeasuredRow(f"false_exclusions_per_h{suffix}", "", *security.false_exclusions(run, threshold, relative))
    if run.variant == BASE_VARIANT and run.config.get("pseudonyms", {}).get("revocation", "none") != "none":
        yield from _rows(misbehaviour.summary_of(security.exclusion_delay(run)), "{role}", {
            "share": "time_to_exclusion.share", "median_s": "time_to_exclusion.median_s",
        })  # fmt: skip
    yield MeasuredRow("average_precision", "", security.average_precision(run))
    yield from _rows(security.trust_error(run), "{role}", {"error": "trust_error"})


def _evidence(run: Run) -> Iterator[MeasuredRow]:
    yield from _rows(evidence.multiplicity(run), "", {
        "trust": "trust.multiplicity", "fused": "fused.multiplicity", "echoes": "echoes.share",
        "copies": "copies_per_evaluation",
    })  # fmt: skip
    if "fused" in run.tables:
        yield MeasuredRow("fused.evaluators.mean", "", evidence.evaluators_per_object(run))
    if "evaluations" not in run.tables or "actors" not in run.tables or not run.n_rows("evaluations"):
        return
    if run.subjects.attack_start_step.notna().any():
        yield from _rows(auc_bound.bounds(run), "{role}", {"known": "auc_bound", "alone": "auc_bound_alone"})
    yield from _rows(repeats.repeats(run), "{group}", {
        "distinct": "repeats.distinct.share", "kappa": "repeats.agreement.kappa",
        "effective": "repeats.effective.share",
    })  # fmt: skip
    found = evaluations.rates(run)
    found["group"] = [
        kind if by == "all" else f"{kind}, {by} {value}"
        for kind, by, value in found[["kind", "by", "value"]].itertuples(index=False)
    ]
    usual = found.by.isin(["all", "evaluator"])
    split = found.kind != evaluations.KINDS[-1]
    yield from _rows(found[usual | split], "{group}", {"denied": "denied.share"})
    yield from _rows(found[usual], "{group}", {"confirmed": "confirmed.share"})
    real = found.kind.isin(evaluations.KINDS[:2]) & (found.by == "all")
    yield from _rows(found[real], "{group}", {"missed": "denied_unseen.share"})
    yield from _rows(evaluations.boxes_of_no_actor(run), "{class}", {"share": "no_actor.share"})


def _freshness(run: Run, fresh_s: float) -> Iterator[MeasuredRow]:
    yield from _rows(freshness.evidence(run), "{role}", {
        "unevaluated_share": "server_unevaluated.share", "newest_s": "server_newest_evaluation.median_s",
    })  # fmt: skip
    yield from _rows(_named(freshness.without_trust(run)), "{definition}", {
        "share": "encounters_without_trust.share", "wait_median_s": "wait_in_encounter.median_s",
    }, "share")  # fmt: skip
    yield from _rows(freshness.states(run), "{state}, {role}", {"share": "lookup_state.share"}, "share")
    found = freshness.ages(run)
    for what, ages in found.groupby("what", sort=False):
        name = str(what).replace(" ", "_")
        yield from _rows(ages, "{role}", {
            "mean_s": f"{name}_age.mean_s", "median_s": f"{name}_age.median_s", "p90_s": f"{name}_age.p90_s",
        }, "mean_s")  # fmt: skip
    if "trust_lookups" not in run.tables:
        return
    yield from _rows(freshness.within(run, fresh_s), "{role}", {"share": "evaluation_within.share"}, "share")
    yield from _rows(freshness.capped_ages(run), "{role}", {
        name: f"capped_age.{name}" for name in ("mean_s", "median_s", "p90_s")
    })  # fmt: skip
    for peak in freshness.peaks(run).to_dict("records"):
        name = peak["what"].replace(" ", "_")
        yield MeasuredRow(f"{name}_age.peak_s", "", peak["mean_s"], peak["low"], peak["high"], peak["n_units"])
    for one in freshness.age_over_time(run).to_dict("records"):
        name = f"{one['what'].replace(' ', '_')}_age_over_time"
        yield MeasuredRow(f"{name}.mean_s", "", one["mean_s"], one["low"], one["high"], one["n_units"])
        if one["n_peaks"] > 0:
            ends = (one[f"peak_s_{end}"] for end in ("low", "high", "units"))
            yield MeasuredRow(f"{name}.peak_s", "", one["peak_s"], *ends)
    for one in freshness.behind(run).to_dict("records"):
        yield MeasuredRow(f"{one['what']}.mean", "", one["mean"], one["low"], one["high"], one["n_units"])


def _radio(run: Run) -> Iterator[MeasuredRow]:
    for condition in radio.conditions(run).to_dict("records"):
        yield MeasuredRow(f"condition.{condition['condition']}", condition["is"], condition["value"])
    frame = radio.overall(run)
    yield from _rows(frame, "", {"n_sent": "sent.n", "pdr": "pdr.all"})
    yield from _rows(radio.overall(run, "cpm"), "", {"pdr": "pdr.cpm"})
    yield from _rows(radio.overall(run, "evaluation"), "", {"pdr": "pdr.evaluation"})
    yield from _rows(frame, "", {name[2:]: name[2:].replace("_", ".", 1) for name in radio.LOST})
    for los_state, part in radio.by_distance(run, by_los=True).groupby("los_state", observed=True):
        yield MeasuredRow("pdr_by_los", str(los_state), float(np.average(part.pdr, weights=part.n_in_range)))
    yield from _rows(frame, "", {"cbr": "cbr.mean"})
    late = radio.latency(run).groupby("latency_s").n_delivered.sum().cumsum()
    for share, name in ((0.5, "median_s"), (0.95, "p95_s")):
        yield MeasuredRow(f"latency.{name}", "", float(late.index[late >= share * late.iloc[-1]][0]))
    pir = radio.inter_reception(run)
    yield MeasuredRow("pir.mean_s", "", float(np.average(pir.pir_s, weights=pir.n_received)))
    lost = pir[pir.n_lost > 0]
    yield MeasuredRow("pir.after_loss.share", "", lost.n_received.sum() / pir.n_received.sum())
    if lost.n_received.sum():
        yield MeasuredRow("lost_in_a_row.mean", "", float(np.average(lost.n_lost, weights=lost.n_received)))
    if "cpm_content" in run.tables and run.n_rows("cpm_content"):
        cpm = radio.cpm(run)
        yield from _rows(cpm, "", {"rate_hz": "cpm_rate.mean_hz", "objects": "cpm_objects.mean"})
        yield from _rows(cpm, "", {"length_bytes": "cpm_length.mean_bytes"})
        for name in radio.LEFT_OUT:
            yield from _rows(cpm, name.removeprefix("n_").replace("_", " "), {name: "cpm_left_out.share"})
    if "clouds" in run.tables and run.n_rows("clouds"):
        yield from _rows(radio.clouds(run), "", {
            "offered_mbps": "clouds_offered.mean_mbps", "delivered_mbps": "clouds_delivered.mean_mbps",
            "complete": "clouds_complete.share",
        })  # fmt: skip
    if "server" in run.tables and len(run.variant_table("server", ["step"])):
        links = radio.to_server(run)
        for name in ("reached", "lost", "over_capacity", "outage"):
            yield from _rows(links, "", {name: f"server_reports.{name}.share"})
        yield from _rows(links, "", {"informed": "server_broadcasts.reached.share"})


def _detection(run: Run, max_frames: int) -> Iterator[MeasuredRow]:
    frame = detection.precision(run, max_frames=max_frames)
    for boxes, some in frame[frame.n_truth >= FEWEST].groupby("boxes", sort=False):
        yield from _rows(some, f"{boxes}, {{class}}, {{level}}", {"ap40": "ap40"})
    known = detection.awareness(run, max_frames=max_frames).groupby("boxes")[["n_known", "n_present"]].sum()
    for which, share in (known.n_known / known.n_present).items():
        yield MeasuredRow("awareness_70m.share", str(which), share)


def _attack(run: Run) -> Iterator[MeasuredRow]:
    for one in attack.success(run).to_dict("records"):
        if one["receivers"] == attack.HONEST:
            group = f"{one['threshold']:g}, {one['among']}, {one['role']}"
            name = "believed" if one["effect"] == "inserted" else "missing"
            yield MeasuredRow(f"{name}.share", group, one["share"], one["low"], one["high"], one["n_units"])
            if one["threshold"] == attack.THRESHOLDS[0]:
                yield MeasuredRow(f"{name}.pairs.n", f"{one['among']}, {one['role']}", one["n"])
    yield from _rows(attack.per_lie(run), "{threshold:g}, {role}", {"share": "believed_by_any.share"}, "share")
    yield from _rows(attack.believed_duration(run), "{among}, {role}", {"mean_s": "believed_duration.mean_s"}, "mean_s")
    harm = attack.damage(run)
    yield from _rows(harm, "{among}, {role}", {"per_attacker_s": "damage.per_attacker_s"}, "per_attacker_s")
    yield from _rows(harm.drop(columns=["low", "high"]), "{among}, {role}", {"total_s": "damage.total_s"})
    yield from _rows(attack.false_in_path(run), "{among}", {
        "share": "false_in_path.share", "boxes_mean": "false_in_path.boxes_mean",
    }, "share")  # fmt: skip


def _safety(run: Run) -> Iterator[MeasuredRow]:
    found = safety.summary(run)
    yield from (MeasuredRow(str(name), "", float(value)) for name, value in found.items())
    if "reactions" in run.tables and run.n_blocks("reactions"):
        yield from _rows(safety.by_kind(run), "{kind}", {
            "n": "reactions.n", "per_km": "reactions.per_km", "hard_per_km": "reactions_hard.per_km",
            "taken_mean_mps": "speed_taken.mean_mps", "wave_mean_n": "wave.vehicles.mean",
            "wave_mean_m": "wave.length.mean_m",
        })  # fmt: skip
