"""Playing against a literal twin, and against the simulation that was recorded."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from cosim import Simulation
from cosim.addons.benchmark import record
from cosim.addons.benchmark.evidence import EvidencePlace
from cosim.addons.benchmark.play import Script, candidate, play
from tests.addons.benchmark.worlds import RULES, stream

PLACE = EvidencePlace("helsinki", 0.2, 77)


def literal_beta(of, host, decay_per_s=0.98):
    """Beta reputation from the rows of a stream, one evaluation at a time: trust at each look-up, NaN if unknown."""
    arrival = {(s, v): a for s, v, a in zip(*(of.reports[c].tolist() for c in of.reports), strict=True)}
    heard = set(zip(*(of.lookups[c].tolist() for c in ("step", "receiver", "sender")), strict=True))
    evaluations = list(zip(*(of.evaluations[c].tolist() for c in of.evaluations), strict=True))
    found = []
    for now, receiver, sender, _, broadcast in zip(*(of.lookups[c].tolist() for c in of.lookups), strict=True):
        r = s = 0.0
        known = False
        asked = broadcast if host == "central" else now
        for step, evaluator, _, observer, _, e, phi in evaluations:
            there = (
                0 <= arrival[step, evaluator] <= asked if host == "central"
                else step <= now and (evaluator == receiver or (step, receiver, evaluator) in heard)
            )  # fmt: skip
            if observer != sender or not there or asked < 0:
                continue
            weight = phi / 100 * decay_per_s ** (asked - step)
            known = True
            r, s = r + weight * max(e / 100, 0), s + weight * max(-e / 100, 0)
        found.append((r + 1) / (r + s + 2) if known else np.nan)
    return np.array(found)


@pytest.mark.parametrize("host", ["central", "local"])
def test_beta_equals_its_literal_twin(host):
    rules = replace(RULES, n_steps=9)
    whole = stream("ghost_insertion", 5)
    of = replace(whole, **{
        name: {c: v[rows["step"] < 9] for c, v in rows.items()}
        for name in ("detections", "reports", "evaluations", "lookups") for rows in [getattr(whole, name)]
    })  # fmt: skip
    answers = play(Script.of(of, rules), candidate("beta", [f"host={host}"], rules))
    np.testing.assert_allclose(answers.trust, literal_beta(of, host), atol=1e-9)
    assert answers.n_evaluations > 0
    known = ~np.isnan(answers.trust)
    assert not known.all() if host == "central" else known.all(), "a broadcast takes a step, own evaluations none"
    assert answers.age_s[known].min() == (2 if host == "central" else 0), "evidence of 2, broadcast at 3, used at 4"


def test_vehicles_know_their_own_evaluations():
    script = Script.of(stream("bad_mouthing", 1), RULES)
    parts = [part for of_step in script.received for part in of_step]
    for part in parts:
        assert (part.holder == part.messages.evaluator[part.message_row]).all() == part.is_own
    models = [candidate(name, ["host=local"], RULES) for name in ("self_first", "evaluator_trust")]
    first, others = (play(script, model).trust for model in models)
    assert np.nanmax(np.abs(first - others)) > 0.05, "what a vehicle sees itself counts more"


def test_parameters_reach_the_model_and_others_are_refused():
    script = Script.of(stream("none", 1), RULES)
    slow, fast = (play(script, candidate("beta", [f"decay_per_s={x}"], RULES)).trust for x in (0.99, 0.5))
    assert np.nanmax(np.abs(slow - fast)) > 0.05
    for wrong in ("tau=0.3", "server_period_s=2", "decay_per_s=2", "nonsense=1", "host=none"):
        with pytest.raises(ValueError, match=wrong.split("=")[0]):
            candidate("beta", [wrong], RULES)
    with pytest.raises(ValueError, match="--set evidence: this key has no effect"):
        candidate("belief_graph", ['evidence=["detections", "missing"]'], RULES)


def recorded(attack):
    """The evidence of a case."""
    rules = rules_of(attack)
    return record.recorded(PLACE, rules, lambda *_: None)[1]


def simulated(attack):
    """All look-ups of the same world."""
    config = record.config_of(PLACE, rules_of(attack), attack)
    with Simulation(replace(config, trust=replace(config.trust, model="beta"))) as simulation:
        found = pd.concat([step.trust_lookups for step in simulation if len(step.trust_lookups)])
    return found.sort_values(["step", "subject", "receiver"])


def rules_of(attack):
    return replace(record.RULES, n_steps=100, start_step=25, cases=("none", attack))


@pytest.mark.verify
@pytest.mark.parametrize("attack", ["sybil", "collusion"])
def test_a_played_recording_equals_the_simulation(attack):
    """Evidence is recorded in percent. All else is the simulation's: receptions, arrivals, broadcasts."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as processes:
        of, rows = (processes.submit(made, attack) for made in (recorded, simulated))
        of, rows = of.result(), rows.result()
    rules = rules_of(attack)
    answers = play(Script.of(of, rules), candidate("beta", [], rules))
    known = np.where(rows.state == "evaluated", rows.trust, np.nan)
    order = np.lexsort([of.lookups[column] for column in ("receiver", "sender", "step")])
    assert len(order) == len(known) > 1000
    np.testing.assert_allclose(answers.trust[order], known, atol=0.002)
