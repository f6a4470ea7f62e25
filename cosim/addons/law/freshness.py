"""Predicts freshness of trust: replays traffic, adds up chances of evaluation by fleet, and applies the law."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

from cosim.addons.law.draws import N_DRAWS
from cosim.addons.law.fleet import Fleet
from cosim.addons.law.prediction import Prediction, with_intervals
from cosim.addons.law.scope import Server, server_of, servers_of
from cosim.config.config import Config
from cosim.runs import run as running
from cosim.runs.check import check
from cosim.runs.drive import Advance, warm_up
from cosim.step.parts import Parts
from cosim.studies.study import Keys, Study, config_at
from cosim.traffic.source import TrafficEnded
from cosim.world import World
from trust.params import TrustParams


class Experiment(NamedTuple):
    """A config, and the trust servers that are asked about its evidence."""

    config: Config
    servers: tuple[Server, ...]


class Predicted(NamedTuple):
    """The predictions for one experiment."""

    predictions: list[Prediction]
    """One per server."""
    inputs: dict[str, float]
    """Measured inputs of the law, by name."""


def predict(config: Config, advance: Advance, n_fleets: int = 0) -> Predicted:
    """Predict freshness for every trust variant of a config.

    Parameters
    ----------
    config
        The experiment. It is not run: only its traffic is.
    advance
        Called with progress.
    n_fleets
        Number of further fleets, drawn with other seeds from the same traffic. The intervals are those of a run with
        another seed then, and otherwise of a run with this one.

    Raises
    ------
    ValueError
        In one line, if the config cannot run, or if the law does not cover it.
    """
    return predict_all([Experiment(config, tuple(servers_of(config)))], advance, n_fleets)[0]


def predict_study(study: Study, where: str, advance: Advance, n_fleets: int = 0) -> list[tuple[Keys, Prediction]]:
    """Predict freshness at every point of a study, replicate 0. Points with the same traffic share its replay.

    Parameters
    ----------
    study
        The study.
    where
        Name of its file, for messages.
    advance, n_fleets
        As for `predict`.

    Returns
    -------
    The swept keys and the prediction of each point, in the order of the study.
    """
    experiments: list[Experiment] = []
    places: list[tuple[int, int]] = []
    combinations = study.combinations()
    for number, keys in enumerate(combinations):
        config = config_at(study, keys, 0, where)
        servers_of(config)  # says what is not covered
        evidence = TrustParams(self_reports=config.trust.self_reports)
        server = server_of(f"point {number}", config.trust, config)
        config = replace(config, trust=evidence)
        configs = [of.config for of in experiments]
        if config not in configs:
            configs.append(config)
            experiments.append(Experiment(config, ()))
        found = configs.index(config)
        servers = experiments[found].servers
        places.append((found, len(servers)))
        experiments[found] = Experiment(config, (*servers, server))
    made = predict_all(experiments, advance, n_fleets)
    predictions = [made[i].predictions[k] for i, k in places]
    return list(zip(combinations, predictions, strict=True))


def predict_all(experiments: Sequence[Experiment], advance: Advance, n_fleets: int) -> list[Predicted]:
    """Predict freshness for several experiments; arguments as for `predict`. Equal traffic is replayed once."""
    found: dict[int, Predicted] = {}
    left = list(range(len(experiments)))
    while left:
        traffic = experiments[left[0]].config.traffic
        group = [k for k in left if experiments[k].config.traffic == traffic]
        left = [k for k in left if k not in group]
        made = _of_traffic([experiments[k] for k in group], advance, n_fleets)
        found |= dict(zip(group, made, strict=True))
    return [found[k] for k in range(len(experiments))]


def _of_traffic(experiments: Sequence[Experiment], advance: Advance, n_fleets: int) -> list[Predicted]:
    """Predictions for experiments with the same traffic."""
    first = experiments[0].config
    scenarios = [check(of.config) for of in experiments]
    parts, _, traffic = running.load_parts(first, scenarios[0])
    try:
        every = [parts]
        every += [parts.under(of.config) for of in experiments[1:]]
        fleets = []
        for of, own in zip(experiments, every, strict=True):
            numbers = range(1 + n_fleets)
            fleets.append([Fleet.of(of.config, of.servers, own, number) for number in numbers])
        for world in _worlds(first, parts, scenarios[0], traffic, advance):
            for fleet in chain.from_iterable(fleets):
                fleet.add(world)
    finally:
        traffic.close()
    return [_joined(of_experiment) for of_experiment in fleets]


def _joined(fleets: Sequence[Fleet]) -> Predicted:
    """The predictions of the first fleet, with intervals from runs of all fleets in turn."""
    found = []
    for k, fleet in enumerate(fleets):
        n_draws = len(range(k, N_DRAWS, len(fleets)))
        found.append(fleet.predictions(n_draws))
    made, _, inputs = found[0]
    by_server = zip(*(runs for _, runs, _ in found), strict=True)
    predictions = []
    for p, of_fleets in zip(made, by_server, strict=True):
        predictions.append(with_intervals(p, list(chain.from_iterable(of_fleets))))
    return Predicted(predictions, inputs)


def _worlds(config: Config, parts: Parts, scenario: Any, traffic: Any, advance: Advance) -> Iterator[World]:
    """The worlds of the recorded steps."""
    warm_up(scenario.warmup_of(config.traffic), traffic, parts.watch, advance)
    for number in range(config.n_steps):
        try:
            world = traffic.advance()
        except TrafficEnded:
            return
        yield world
        advance("predict", number + 1, config.n_steps, f"steps, {len(world)} actors")
