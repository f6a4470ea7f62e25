"""The law of freshness against simulation: `python -m tests.verification.freshness_law`.

assumptions [CONFIG] [KEY=VALUE ...]: simulates a config in memory and prints each assumption of the page
`models/freshness-law` beside what happened. Counts are by sweep of all vehicles, so these sense at the same time: a
config without a preset plays in the plain world of the tests.
intervals STUDY...: predicts the points of studies that have run, and prints by metric how many of their runs lie in the
intervals, how far the law is off, and the model error with which 95 % would lie inside.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from cosim import Simulation
from cosim.addons.law.comparison import measured_in, rows_of
from cosim.addons.law.delivery import Delivery, Load, expected_cpm_bytes
from cosim.addons.law.freshness import predict_study
from cosim.addons.law.opportunities import Sensing, chances
from cosim.addons.law.prediction import MODEL_ERROR
from cosim.config.config import Config, load
from cosim.messages.content import evaluation_bytes
from cosim.radio.message_round import RoundKind
from cosim.studies import study as studies
from sensors.line_of_sight import LosOfPlaces
from tests import plain_world


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
            lengths = expected_cpm_bytes(config.cpm, 1 + views.n_listed)
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


def intervals(folders: list[Path]) -> pd.DataFrame:
    """Coverage and errors by metric, over all points of all studies; replicate 0 of each."""
    rows: list[dict] = []
    for folder in folders:
        predictions = predict_study(studies.load(folder / "study.toml"), str(folder), lambda *_: None)
        rows += rows_of(predictions, measured_in(folder, predictions))
    of = pd.DataFrame(rows).dropna(subset=["low", "measured"])
    of["error"] = np.where(of.metric.str.contains("share"), 1.0, of.value) * of.metric.map(MODEL_ERROR)
    of["outside"] = np.maximum(0, np.maximum(of.low + of.error - of.measured, of.measured - (of.high - of.error)))
    of["needed"] = of.outside / np.where(of.metric.str.contains("share"), 1.0, of.value)
    slack = 1e-3  # ages in tables are stored in 1/1024 s
    of["covered"] = (of.low - slack <= of.measured) & (of.measured <= of.high + slack)
    of["by_chance"] = of.outside <= slack
    of["off"] = of.measured - of.value
    return of.groupby("metric").agg(
        points=("covered", "size"), covered=("covered", "mean"), by_chance_alone=("by_chance", "mean"),
        bias=("off", "mean"), largest=("off", lambda off: off.abs().max()),
        needed=("needed", lambda needed: needed.quantile(0.95)),
    )  # fmt: skip


def main(words: list[str]) -> None:
    """As the module says."""
    pd.set_option("display.width", 250, "display.max_columns", 40, "display.max_rows", 500)
    if words[:1] == ["intervals"]:
        print(intervals([Path(word) for word in words[1:]]).round(4).to_string())
        return
    plain_world.enter()
    path = Path(words[1]) if len(words) > 1 and "=" not in words[1] else None
    config = load(path, [word for word in words[1:] if "=" in word])
    if config.sensing_phase != "common":
        sys.exit('error: sensing_phase = "random": the counts need vehicles that sense at the same time ("common").')
    print(assumptions(config).to_string(index=False))


if __name__ == "__main__":
    main(sys.argv[1:])
