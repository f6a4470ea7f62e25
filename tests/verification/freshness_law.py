"""The law of freshness against simulation: `python -m tests.verification.freshness_law`.

assumptions [CONFIG] [KEY=VALUE ...]: simulates a config in memory and prints each assumption of the page
`models/freshness-law` beside what happened.

points FOLDER STUDY...: for each study in `tests/verification/law`, the predictions that were written before its
simulation beside the study that `cosim sweep` left in FOLDER/sweep-STUDY: by point, how many are within the bounds, and
how many intervals hold what was simulated, up to 1 %.

errors OUT FOLDER STUDY...: draws the errors of these points by the number of evaluators.

picture OUT RUN PREDICTIONS FOLDER STUDY...: draws the points, and the ages that a run measured beside those that
`cosim predict freshness --out PREDICTIONS` predicted for its config.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cosim import Simulation
from cosim.addons.law import figure as law
from cosim.addons.law.comparison import measured_by
from cosim.addons.law.delivery import Delivery, Load
from cosim.addons.law.opportunities import Sensing, chances
from cosim.addons.law.prediction import METRICS
from cosim.config.config import Config, load
from cosim.messages.content import cpm_bytes, evaluation_bytes
from cosim.radio.message_round import RoundKind
from results.figures import style
from results.study import open_study
from sensors.line_of_sight import LosOfPlaces

LAW = Path(__file__).parent / "law"
OTHERS = {
    "evaluated": "freshness.lookup_state.share:evaluated",
    "no_value": "freshness.lookup_state.share:no value",
    "evaluators": "freshness.evaluators.mean",
    "without": "freshness.encounters_without_trust.share",
}
"""Further metrics of a point, by the name of their column."""
MEDIAN, P90 = (f"freshness.newest_evaluation_age.{name}" for name in ("median_s", "p90_s"))


def assumptions(config: Config) -> pd.DataFrame:
    """Predicted and simulated counts of one run, by what they check."""
    sums: dict[str, np.ndarray] = {}

    def add(name: str, predicted: float, simulated: float) -> None:
        sums[name] = sums.get(name, np.zeros(2)) + (predicted, simulated)

    silent: dict[int, list[tuple[int, float, bool]]] = {}
    with Simulation(config) as simulation:
        parts = simulation._parts
        assert parts is not None
        walls = parts.near_pairs.walls
        sensing, delivery = (
            Sensing.of(config, parts.perception.detector, walls),
            Delivery.of(config, LosOfPlaces(walls)),
        )
        heavy = Load(parts.medium, parts.medium.start())
        for result in simulation:
            world, sensed = result.world, result.result.sensed
            if sensed is None:
                continue
            row = np.flatnonzero(world.equipped)
            views, links = sensing.views(world, row), delivery.links(world, row)
            n, begin_s = len(row), result.step * config.traffic.step_s
            lengths = cpm_bytes(1 + views.n_listed)
            told_p = heavy.delivered_p(RoundKind.CPM, result.step, begin_s, links, lengths)
            found = chances(views, links.sender, links.receiver, config.trust.self_reports)
            listed = 1 + views.n_listed + np.bincount(links.receiver, told_p * found.n_listed, n)
            lengths = evaluation_bytes(listed)
            heard_p = heavy.delivered_p(RoundKind.EVALUATION, result.step, begin_s + config.round_s, links, lengths)

            seen = sensed.positioned.observed.observability
            key = np.repeat(np.arange(n), np.diff(views.ptr)) * np.int64(len(world)) + views.body
            at = np.minimum(np.searchsorted(key, seen.observer * np.int64(len(world)) + seen.actor), len(key) - 1)
            there = (key[at] == seen.observer * np.int64(len(world)) + seen.actor) & views.inside[at]
            add("2 bodies seen in the area", views.seen_p.sum(), (seen.n_returns[there] > 0).sum())
            add("2 of these, predicted as not seen", (1 - views.seen_p[at][there & (seen.n_returns > 0)]).sum(), 0)
            add("3 detections", (1 + views.n_listed).sum(), len(sensed.listed.detections.message))
            add("4 CPMs received", told_p.sum(), len(sensed.rounds[0].accepted.vehicles.message))
            add("4 evaluation messages received", heard_p.sum(), len(sensed.rounds[1].accepted.vehicles.message))

            lists, detections = sensed.evaluated.lists, sensed.listed.detections
            evaluator, subject = lists.of_member(), detections.message[lists.member]
            counts = (sensed.evaluated.own.visibility > 0) & (evaluator != subject)
            pair = np.unique(evaluator[counts].astype(np.int64) << 32 | subject[counts])
            none_p = told_p * (1 - found.none_p)
            add("5 pairs of evaluator and subject", none_p.sum(), len(pair))
            add("5 evaluations", (told_p * found.n).sum(), counts.sum())
            actor, of_evidence = world.actor[row], np.zeros(n, bool)
            of_evidence[np.unique(subject[counts])] = True
            real = counts & sensed.listed.truth.is_real[lists.member]
            without = np.zeros(n, bool)
            without[np.unique(subject[real])] = True
            add("3 vehicle-steps evaluated by false positives alone", 0, (of_evidence & ~without).sum())
            log_none = np.bincount(links.sender, np.log1p(-np.minimum(none_p, 1 - 1e-12)), n)
            add("6 vehicle-steps evaluated", -np.expm1(log_none).sum(), of_evidence.sum())
            of_lookup = sensed.rounds[1].accepted.vehicles.message  # one message per vehicle: its row is the sender's
            for name, chosen in (("evaluated", of_evidence), ("not evaluated", ~of_evidence)):
                add(f"8 lookups of subjects that were {name} in the step", heard_p[chosen[links.sender]].sum(),
                    chosen[of_lookup].sum())  # fmt: skip
            for one, u, got in zip(actor.tolist(), np.exp(log_none).tolist(), of_evidence.tolist(), strict=True):
                silent.setdefault(one, []).append((result.step, u, got))
    for length in (2, 3, 5, 10):
        for steps in silent.values():
            u, got = np.array([x[1] for x in steps]), np.array([x[2] for x in steps])
            for first in range(len(steps) - length + 1):
                add(f"6 stretches of {length} steps without evaluation", u[first : first + length].prod(),
                    not got[first : first + length].any())  # fmt: skip
    rows = [
        {"what": name, "law": p, "simulation": s, "error_p": p / s - 1 if s else np.nan}
        for name, (p, s) in sums.items()
    ]
    return pd.DataFrame(rows).sort_values("what")


def points(folder: Path, names: list[str]) -> Iterator[dict]:
    """Errors by point, for studies whose predictions are in `LAW`."""
    for name in names:
        kept = json.loads((LAW / f"{name}.json").read_text())
        measures = open_study(folder / f"sweep-{name}").measures
        for p in kept["predictions"]:
            rows = np.logical_and.reduce([measures[key] == value for key, value in p["keys"].items()])
            got = measured_by(measures[rows])
            if MEDIAN not in got:
                continue
            row = {"study": name, **p["keys"]}
            for label, metric in (("median", MEDIAN), ("p90", P90)):
                row |= {
                    label: p["metrics"][metric],
                    f"{label}_sim": got[metric],
                    f"{label}_closed": p["closed_form"][metric],
                }
            row["within"] = (
                abs(row["median"] / row["median_sim"] - 1) <= 0.1 and abs(row["p90"] / row["p90_sim"] - 1) <= 0.2
            )
            for label, metric in OTHERS.items():
                row |= {label: p["metrics"][metric], f"{label}_sim": got.get(metric, np.nan)}
            held = {
                m: p["low"][m] * 0.99 <= got[m] <= p["high"][m] * 1.01 for m in METRICS if m in p["low"] and m in got
            }
            yield row | {f"held {metric}": is_held for metric, is_held in held.items()}


@style.styled
def errors_picture(studies: Sequence[tuple[str, pd.DataFrame]]) -> Figure:
    """Errors of the law by the number of evaluators behind a value.

    Parameters
    ----------
    studies
        Name and points: evaluators_sim, and each of median, p90 and no_value as predicted and with `_sim`.
    """
    figure, panels = style.sheet(3, 2.0)
    for axes, column, title, within in (
        (panels[0], "median", "Median age", 0.1),
        (panels[1], "p90", "90th percentile of the age", 0.2),
        (panels[2], "no_value", "Lookups without a value", None),
    ):
        for i, (name, part) in enumerate(studies):
            predicted, simulated = part[column], part[f"{column}_sim"]
            error = 100 * (predicted - simulated if within is None else predicted / simulated - 1)
            axes.plot(part.evaluators_sim, error, linestyle="none", marker=style.marker(i), color=style.ink(i),
                      markerfacecolor="none", label=name)  # fmt: skip
        for bound in (0.0,) if within is None else (-within, 0.0, within):
            axes.axhline(100 * bound, color=style.PALE, linewidth=0.9, linestyle=style.dash(1) if bound else "-")
        axes.set_xscale("log")
        unit = "points of per cent" if within is None else "%"
        style.panel(axes, title, "Evaluators behind a value", f"Law minus simulation [{unit}]")
    style.legend(figure, panels[0].get_legend_handles_labels()[0])
    return figure


def picture(out: Path, run: Path, predictions: Path, folder: Path, names: list[str]) -> None:
    """Draw distributions of a run and points of studies, law and simulation over each other."""
    kept = json.loads(predictions.read_text())["predictions"]
    names_of = {one["variant"]: f"server period {one['server_period_s']:g} s" for one in kept}
    curves = []
    for one in kept:
        ages = one["newest_evaluation_age"]
        curves.append(law.Curve(names_of[one["variant"]], np.array(ages["age_s"]), np.array(ages["share"])))
    simulated = [curve._replace(name=names_of[curve.name]) for curve in law.measured(run, list(names_of))]
    frame = pd.DataFrame(points(folder, names))
    groups = [
        law.Points(name, part[["median", "p90"]].to_numpy(), part[["median_sim", "p90_sim"]].to_numpy())
        for name, part in frame.groupby("study", sort=False)
    ]
    style.save(law.draw(curves, simulated, groups), out)


def main(words: list[str]) -> None:
    """As the module says."""
    pd.set_option("display.width", 250, "display.max_columns", 40, "display.max_rows", 500)
    if words[0] == "assumptions":
        path = Path(words[1]) if len(words) > 1 and "=" not in words[1] else None
        print(assumptions(load(path, [word for word in words[1:] if "=" in word])).to_string(index=False))
        return
    if words[0] == "errors":
        frame = pd.DataFrame(points(Path(words[2]), words[3:]))
        style.save(errors_picture([(name, part) for name, part in frame.groupby("study", sort=False)]), Path(words[1]))
        return
    if words[0] == "picture":
        picture(*(Path(word) for word in words[1:5]), words[5:])
        return
    frame = pd.DataFrame(points(Path(words[1]), words[2:]))
    print(frame[[column for column in frame if not column.startswith("held ")]].round(3).to_string(index=False))
    for name, part in frame.groupby("study", sort=False):
        errors = [(part[x] / part[f"{x}_sim"] - 1).abs().mean() for x in ("median", "p90", "evaluators")]
        errors += [(part[x] - part[f"{x}_sim"]).abs().mean() for x in ("no_value", "without")]
        print(
            f"{name}: {part.within.sum()} of {len(part)} points within 10 % (median) and 20 % (90th percentile). Mean"
        )
        print("  errors of median, p90, evaluators, no value, encounters: " + ", ".join(f"{e:.3f}" for e in errors))
        for metric in [column for column in part if column.startswith("held ")]:
            print(f"  interval of {metric[5:]}: {part[metric].sum():g} of {part[metric].count()}")
    print(f"all: {frame.within.sum()} of {len(frame)}")


if __name__ == "__main__":
    main(sys.argv[1:])
