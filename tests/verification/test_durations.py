"""Renewal processes of known families, watched as a run watches them: parameters recovered, intervals that cover.

Every world is a set of pairs that are in contact and apart in turn. The encounter tracker watches them in steps, for a
while, so that contacts and gaps are cut off, begin before the watch, or are too short to be seen.
"""

import numpy as np
import pandas as pd
import pytest

from cosim.addons.durations.families import FAMILIES
from cosim.addons.durations.fit import fit
from cosim.addons.durations.samples import Durations
from results.encounters import EncounterParams, EncounterTracker

pytestmark = pytest.mark.verify

FREE = {
    "exponential": np.log([20.0]),
    "weibull": np.log([0.7, 25.0]),
    "log_normal": np.log([15.0, 1.1]),
    "generalised_pareto": np.array([0.3, np.log(15.0)]),
    "hyper_exponential": np.array([0.5, np.log(5.0), np.log(9.0)]),
}
GAP = FAMILIES["weibull"], np.log([3.0, 30.0])
"""Gaps of 27 s on average, of which 4 in 100,000 are shorter than a step: a shorter one is bridged unseen, and joins
two contacts to one encounter."""
BEFORE_S = 400.0
"""The processes run this long before they are watched, so that the watch begins anywhere in a contact or a gap."""


def changes(free, name, random, until_s):
    """Times at which contacts of one pair begin and end, in turn."""
    n = int(until_s / 4) + 50
    family = FAMILIES[name]
    on, off = family.draw(free, random.uniform(size=n)), GAP[0].draw(GAP[1], random.uniform(size=n))
    times = np.cumsum(np.ravel(np.column_stack([off, on])))
    return times[::2], times[1::2]


def watched(name, random, n_pairs, watch_s):
    """Encounters of independent pairs as the tracker tells them, and their durations and gaps for the fits."""
    until = BEFORE_S + watch_s
    pairs = [changes(FREE[name], name, random, until) for _ in range(n_pairs)]
    tracker = EncounterTracker(EncounterParams(pairs="all", hysteresis_s=1.0), 1.0)
    present = np.arange(2 * n_pairs)
    states = np.zeros((int(watch_s), n_pairs), bool)
    for pair, (begin, end) in enumerate(pairs):
        moments = BEFORE_S + np.arange(int(watch_s)) + random.uniform()
        states[:, pair] = np.searchsorted(begin, moments, "right") > np.searchsorted(end, moments, "right")
    rows = []
    for step, contact in enumerate(states):
        now = np.flatnonzero(contact)
        rows.append(tracker.update(step, 2 * now, 2 * now + 1, np.zeros(len(now)), np.ones(len(now), bool), present)[0])
    rows.append(tracker.close(len(states)))
    columns = ("a", "b", "start_step", "end_step", "censored_left", "censored_right")
    frame = pd.DataFrame({c: np.concatenate([r[c] for r in rows]) for c in columns})
    frame = frame[~frame.censored_left]
    n, ended = (frame.end_step - frame.start_step).to_numpy(float), ~frame.censored_right.to_numpy()
    entry = np.full(len(n), 0.5)
    return Durations(n - 0.5, np.where(ended, n + 0.5, np.inf), entry, frame.a.to_numpy(), frame.b.to_numpy(), 1.0)


@pytest.mark.parametrize("name", FREE)
def test_parameters_are_recovered_within_five_per_cent(name):
    found = fit(watched(name, np.random.default_rng(11), 2500, 600.0), name)
    truth = FAMILIES[name].natural(FREE[name])
    values = np.array([v for v, _, _ in found.parameters().values()])
    print(name, dict(zip(found.parameters(), np.round(values / truth - 1, 4), strict=True)))
    np.testing.assert_allclose(values, truth, rtol=0.05)


WORLDS = 400
"""The share has a standard error of 1.1 % then: one exact interval of eleven is outside of 93 to 97 % by chance in
about half of such tests. With this seed none is. In 1,000 worlds of it the shape of Weibull is covered in 92.8 %, and
in all 3,500 worlds that were drawn after the likelihood was mended in 94.5 %."""


@pytest.mark.parametrize("name", FREE)
def test_intervals_cover_in_93_to_97_of_100_worlds(name):
    """120 pairs are a world. The seed was fixed before anybody had looked at its worlds."""
    truth = FAMILIES[name].natural(FREE[name])
    every = watched(name, np.random.default_rng(34), 120 * WORLDS, 300.0)
    hits = []
    for world in range(WORLDS):
        found = fit(every.take(every.a // 240 == world), name)
        ends = np.array([(low, high) for _, low, high in found.parameters().values()])
        hits.append((ends[:, 0] <= truth) & (truth <= ends[:, 1]))
    share = np.mean(hits, axis=0)
    print(name, dict(zip(FAMILIES[name].parameters, share, strict=True)))
    assert (share >= 0.93).all() and (share <= 0.97).all(), share
