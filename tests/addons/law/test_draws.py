"""Drawn runs against the chances that they are drawn from."""

import numpy as np
import pytest

from cosim.addons.law import law
from cosim.addons.law.closed_form import Company
from cosim.addons.law.draws import drawn
from cosim.addons.law.prediction import FleetFindings, counted
from cosim.addons.law.scope import Server

NOTHING = law.Encounters(*(np.zeros(0, np.int64),) * 7, np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 0), bool))
EVEN = Company((0.5, 0.5), 1.0, (0.0, 0.0))


def test_drawn_runs_have_the_chances_as_means():
    # Two evaluators of one subject, in every of 2,000 steps, the second one step late; half of the reports arrive after
    # one step and all after two.
    n_steps, p = 2000, np.array([0.3, 0.5])
    step, pair = (x.ravel() for x in np.meshgrid(np.arange(n_steps), np.arange(2)))
    pairs = law.PairSteps(step, step + pair, np.zeros(2 * n_steps, int), pair, np.log1p(-p[pair]))
    found = FleetFindings(
        law.EvidenceChances(np.zeros((3, 1, n_steps))),
        np.zeros(1, int),
        pairs,
        np.zeros(2, int),
        NOTHING,
        np.array([0.5, 1.0]),
        EVEN,
    )
    run = drawn(found, np.random.default_rng(3))
    share = 1 - np.exp(run.evidence.log_none).mean(axis=(1, 2))
    # After one step: the first evaluator's half. After two: all of it, and half of the second's. After three: all.
    assert share == pytest.approx([0.15, 1 - 0.7 * 0.75, 1 - 0.7 * 0.5], abs=0.03)
    assert np.bincount(run.pair_steps.pair) / n_steps == pytest.approx(p, abs=0.03)


def test_no_lookup_is_stale_where_all_ages_are_below_the_window():
    # Sums of the same ages in another order differ in the last digit, so a difference of sums is not 0.
    step = np.arange(1, 60)
    pairs = law.PairSteps(*(np.zeros(0, np.int64),) * 4, np.zeros(0))
    chances = np.random.default_rng(4).random((1, 1, 60))
    evidence = law.EvidenceChances(-0.1 * chances)
    found = FleetFindings(evidence, np.zeros(1, int), pairs, step[:0], NOTHING, np.ones(1), EVEN)
    looks = law.ExpectedLookups(0 * step, step, step[:, None], chances[0, :, 1:].T, 0.0 * step)
    server, gate = Server("base", 1.0, 50.0, 50, False), law.PublishingSteps(1, step.tolist())
    _, metrics = counted(server, found, gate, looks, np.arange(61.0), 0.0)
    assert metrics["freshness.lookup_state.share:stale"] == 0
