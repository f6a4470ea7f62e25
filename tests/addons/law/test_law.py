"""The law by hand, against the enumeration of all outcomes, and in its limits."""

import itertools

import numpy as np
import pytest

from cosim.addons.law import law
from cosim.addons.law.closed_form import Company, closed_form


def looks(subject, step, publication, n, none=0.0):
    rows = len(subject)
    return law.ExpectedLookups(
        np.array(subject), np.array(step), np.array(publication).reshape(rows, -1),
        np.array(n, float).reshape(rows, -1), np.full(rows, none),
    )  # fmt: skip


def constant(q):
    """One chance of evaluation for all subjects and sweeps."""
    return Company((q, q), 1.0, (0.0, 0.0))


def test_gate_by_hand():
    # Sensing every 0.5 s, a period of 1.2 s: publications are 3 steps apart, because the third step is the first that
    # is 1.2 s or more after the last publication.
    gate = law.PublishingSteps(law.period_steps(1.2, 0.5))
    for step in (1, 2, 3, 4, 8, 9, 10, 11):  # no equipped vehicle is there in the steps 0 and 5 to 7
        gate.open(step)
    assert gate.steps.tolist() == [1, 4, 8, 11]
    assert gate.before(9, 3).tolist() == [8, 4, 1] and gate.before(3, 3).tolist() == [1, -1, -1]


def test_age_by_hand():
    # The subject is evaluated in every step with probability 1/2. Publication at step 4, lookup at step 5, window of 4
    # steps: evidence of ages 1, 2, 3 at the publication counts. Newest: 1/2, 1/4, 1/8, each one step older at lookup.
    # Oldest: 1/8, 1/4, 1/2. In 1/8 of the cases there is none.
    evidence = law.EvidenceChances(np.log(np.full((1, 1, 8), 0.5)))
    found = law.ages(evidence, looks([0], [5], [4], [8.0]), 4, np.zeros(1, int))
    assert found.newest[:6] == pytest.approx([0, 0, 4, 2, 1, 0])
    assert found.oldest[:6] == pytest.approx([0, 0, 1, 2, 4, 0])
    assert found.value[:3] == pytest.approx([0, 7, 0])


def test_evidence_before_the_first_step_does_not_exist():
    evidence = law.EvidenceChances(np.full((1, 1, 8), -50.0))
    found = law.ages(evidence, looks([0], [1], [0], [1.0]), 50, np.zeros(1, int))
    assert not found.value.any() and not found.newest.any()
    assert found.n_unseen == 0  # the subject came in step 0, whose detections are too late for this publication


@pytest.mark.parametrize("seed", range(3))
def test_ages_and_evaluators_as_by_enumeration(seed):
    """Every outcome of every pair and step in turn, with its probability."""
    rng = np.random.default_rng(seed)
    n_steps, n_pairs, window, step, b = 4, 3, 4, 5, 4
    p = rng.uniform(0, 1, (n_pairs, n_steps))  # chance that evaluator v evaluates the one subject in step k
    p[:, 0] = 0  # outside the window
    expected_age, evaluators, known = np.zeros(10), 0.0, 0.0
    for outcome in itertools.product((0, 1), repeat=n_pairs * n_steps):
        made = np.array(outcome).reshape(n_pairs, n_steps).astype(bool)
        weight = np.prod(np.where(made, p, 1 - p))
        steps = np.flatnonzero(made.any(axis=0))
        if len(steps):
            expected_age[step - steps[-1]] += weight
            evaluators += weight * made.any(axis=1).sum()
            known += weight
    log_none = np.log1p(-np.minimum(p, 1 - 1e-15))
    evidence = law.EvidenceChances(log_none.sum(axis=0)[None, None, :])
    asked = looks([0], [step], [b], [1.0])
    found = law.ages(evidence, asked, window, np.zeros(1, int))
    assert found.newest[:10] == pytest.approx(
        np.append(expected_age[: len(found.newest)], np.zeros(10))[: len(found.newest[:10])]
    )
    assert found.value.sum() == pytest.approx(known)
    pair, at = (x.ravel() for x in np.meshgrid(np.arange(n_pairs), np.arange(n_steps)))
    pairs = law.PairSteps(at, at, np.zeros(len(at), int), pair, log_none[pair, at])
    got = law.behind(pairs, np.zeros(n_pairs, int), asked, window, np.ones(1))
    assert got == pytest.approx(evaluators)
    assert got / found.newest.sum() == pytest.approx(evaluators / known)


def test_lookups_by_hand():
    # Three holders; the second came in step 4, the third was away in step 5. Publications of steps 5 and 3; who is on
    # the road has received them with probabilities 0.5 and 0.8. Of the first, 0.5 find 5, 0.4 find 3, 0.1 find none; of
    # the second, half find none; of the third, 0.8 find 3, 0.2 find none.
    held = np.array([[True, True], [True, False], [False, True]])
    found, none = law.expected_lookups(np.array([0, 0, 0]), held, np.ones(3), 1, np.array([5, 3]), np.array([0.5, 0.8]))
    assert found == pytest.approx(np.array([[1.0, 1.2]])) and none == pytest.approx([0.8])


def test_evaluations_that_arrive_late_are_behind_later_publications():
    # Half of the reports arrive after one step, all after two. The subject is evaluated in step 3 alone.
    log_none = np.zeros((2, 1, 8))
    log_none[0, 0, 3], log_none[1, 0, 3] = np.log(0.5), -50.0
    found = law.ages(law.EvidenceChances(log_none), looks([0, 0], [4, 5], [4, 5], [1.0, 1.0]), 10, np.zeros(1, int))
    assert found.newest[:4] == pytest.approx([0, 0.5, 1, 0])


@pytest.mark.parametrize(("window", "want"), [(10, 2 * (0.5 + 1)), (2, 2 * 0.5), (1, 0.0)])
def test_evaluators_whose_reports_arrive_late_are_behind_later_publications(window, want):
    """As above, of two evaluators. In a window of 2 steps, they are behind the publication of step 4 alone."""
    pairs = law.PairSteps(*(np.array([k, k]) for k in (3, 3, 0)), np.arange(2), np.full(2, -50.0))
    asked = looks([0, 0], [4, 5], [4, 5], [1.0, 1.0])
    assert law.behind(pairs, np.zeros(2, int), asked, window, np.array([0.5, 1.0])) == pytest.approx(want)


def meetings(start, end, steps, missed, away=(), began=0):
    return law.Encounters(
        np.array([0]), np.array([0]), np.array([start]), np.array([end]), np.array([0]), np.array([len(steps)]),
        np.array(steps, np.int64), np.log(np.array(missed, float)), np.array([began]),
        ~np.isin(np.arange(11), away)[None],
    )  # fmt: skip


def test_encounters_without_trust_by_hand():
    # Publications every 4 steps, a window of 4; evaluations with probability 1/2 in each of the steps 1 to 7. The
    # encounter lasts steps 5 to 9; each lookup is missed with probability 1/2; no publication is lost.
    log_none = np.log(np.append(1.0, np.full(7, 0.5)))
    evidence = law.EvidenceChances(np.append(log_none, np.zeros(4))[None, None])
    gate = law.PublishingSteps(4, [0, 4, 8])
    steps = [5, 6, 7, 8, 9]
    # The publication of step 4 (steps 1 to 3) counts at the start: known with 7/8. That of step 8 adds steps 5 to 7: it
    # brings the first evidence with 1/8 (1 - 1/8); then the lookups of steps 8 and 9 are missed with 1/4.
    want = 1 / 8 * (1 - 1 / 8) / 4 + 1 / 8 / 8
    assert law.without_trust(evidence, meetings(5, 10, steps, [0.5] * 5), gate, 4, 0.0) == pytest.approx(want)
    # A holder that came in step 5, or was away in step 4 and has forgotten, has the publication of step 8 alone, with
    # steps 5 to 7.
    want = (1 - 1 / 8) / 4 + 1 / 8
    for away, began in (([0, 1, 2, 3, 4], -1), ([4], 5)):
        met = meetings(5, 10, steps, [0.5] * 5, away, began)
        assert law.without_trust(evidence, met, gate, 4, 0.0) == pytest.approx(want)
    # Half of the publications are lost. In an encounter of one step, between publications, the evidence of steps 1 to 3
    # is known if that of step 4 arrived; that of step 0 had none.
    want = 1 / 8 + 7 / 8 / 2
    assert law.without_trust(evidence, meetings(5, 6, steps[:1], [0.5]), gate, 4, 0.5) == pytest.approx(want)
    # So it is later for a holder that was away in step 8: it keeps that of step 4.
    assert law.without_trust(evidence, meetings(9, 10, [9], [0.5], [8]), gate, 4, 0.5) == pytest.approx(want)
    assert law.without_trust(evidence, meetings(9, 10, [9], [0.5], [8]), gate, 4, 0.0) == pytest.approx(1 / 8)
    assert law.without_trust(evidence, meetings(9, 10, [9], [0.5], [8], 9), gate, 4, 0.0) == 1
    # No publication in the encounter of a holder that came with it.
    assert law.without_trust(evidence, meetings(5, 8, steps[:3], [0.5] * 3, range(5)), gate, 4, 0.0) == 1


@pytest.mark.parametrize("window", [2, 3, 5])
def test_encounters_without_trust_as_by_enumeration(window):
    """Each step's evidence arrives after one step, after two, or never. With a window of 3, publications in the steps 3
    and 7 count the steps 1 and 2, and 5 and 6. What is of the steps 3 and 4 has left the window before either.
    """
    rng = np.random.default_rng(window)
    late_p, never_p = np.sort(rng.uniform(0.1, 0.9, (2, 7)), axis=0)[::-1]  # not there after one step; after any
    gate, want = (3, 7), 0.0
    for lags in itertools.product((1, 2, 99), repeat=7):
        weight, knows = 1.0, [False, False]
        for step, lag in enumerate(lags):
            weight *= {1: 1 - late_p[step], 2: late_p[step] - never_p[step], 99: never_p[step]}[lag]
            for k, publication in enumerate(gate):
                knows[k] |= lag <= publication - step < window
        missed = 0.0 if knows[0] else 0.5**3 if knows[1] else 1.0
        want += weight * missed
    log_none = np.log(np.stack([late_p, never_p]))[:, None]
    evidence = law.EvidenceChances(np.pad(log_none, ((0, 0), (0, 0), (0, 4))))
    met = meetings(4, 10, [4, 5, 6, 7, 8, 9], [0.5] * 6)
    assert law.without_trust(evidence, met, law.PublishingSteps(4, [*gate]), window, 0.0) == pytest.approx(want)


@pytest.mark.parametrize(("q", "period", "loss_p"), [(1.0, 5, 0.0), (0.6, 1, 0.0), (0.3, 7, 0.2)])
def test_closed_form_as_simulated(q, period, loss_p):
    """A literal server: one draw per step for evaluation and reception, far from the first step."""
    rng = np.random.default_rng(5)
    n, window = 200_000, 40
    made, received = rng.random(n) < q, rng.random(n) >= loss_p
    ages, held = [], -1
    last = np.maximum.accumulate(np.where(made, np.arange(n), -1))
    for step in range(n):
        if step % period == 0 and received[step] and step > window:
            held = step
        if held > 0 and held - last[held - 1] < window:
            ages.append(step - last[held - 1])
    want = np.bincount(ages, minlength=200)[:200] / len(ages)
    got = closed_form(constant(q), period, window, loss_p, 200)
    assert np.abs(np.cumsum(got) - np.cumsum(want)).max() < 0.01
    assert got.sum() == pytest.approx(1)


def test_closed_form_is_the_law_of_a_constant_chance():
    q, period, window, n_steps = 0.4, 5, 20, 400
    evidence = law.EvidenceChances(np.log(np.full((1, 1, n_steps), 1 - q)))
    steps = np.arange(200, 300)
    found = law.ages(
        evidence, looks(np.zeros(100, int), steps, steps - steps % period, np.ones(100)), window, np.zeros(1, int)
    )
    got = closed_form(constant(q), period, window, 0.0, n_steps + 1)
    assert found.newest / found.newest.sum() == pytest.approx(got, abs=1e-7)


def test_closed_form_of_company_and_solitude_as_simulated():
    """A literal chain: in company evaluated with 0.8 for 20 sweeps on average, alone hardly ever for 50."""
    rng = np.random.default_rng(6)
    n, window, period, p, ends = 400_000, 60, 5, (0.8, 0.02), (0.05, 0.02)
    change, alone, state = rng.random(n), np.zeros(n, bool), 0
    for step in range(n):
        state = 1 - state if change[step] < ends[state] else state
        alone[step] = state
    last = np.maximum.accumulate(np.where(rng.random(n) < np.where(alone, p[1], p[0]), np.arange(n), -1000))
    step = np.flatnonzero(~alone)[100:]  # lookups happen in company
    held = step - step % period
    age = step - last[held - 1]
    ages = age[held - last[held - 1] < window]
    want = np.bincount(ages, minlength=200)[:200] / len(ages)
    got = closed_form(Company(p, 1.0, ends), period, window, 0.0, 200)
    assert np.abs(np.cumsum(got) - np.cumsum(want)).max() < 0.015
    # One mean chance would have the tail far too short.
    one = closed_form(constant(0.8), period, window, 0.0, 200)
    tail = [law.quantile(np.arange(200.0), x, 0.97) for x in (got, want, one)]
    assert tail[0] == pytest.approx(tail[1], rel=0.1) and tail[2] < 0.6 * tail[1]


def test_closed_form_of_random_phases_as_simulated():
    """Many evaluators at phases of their own, each unlikely: the subject sends every n steps."""
    rng = np.random.default_rng(7)
    every, n_evaluators, q, window, n_sweeps = 5, 40, 0.6, 60, 20_000
    p = 1 - (1 - q) ** (1 / n_evaluators)
    late = np.arange(n_evaluators) % every  # steps from the subject's sweep to that of each evaluator
    arrival = np.where(rng.random((n_sweeps, n_evaluators)) < p, late, 10**6).min(axis=1)  # of its first evaluation
    ages = []
    for b in rng.integers(100, n_sweeps * every - 100, 20_000):
        newest = (b - 1) // every
        for sweep in range(newest, newest - window // every - 1, -1):
            if sweep * every + arrival[sweep] < b:
                if b - sweep * every < window:
                    ages.append(b - sweep * every)
                break
    want = np.bincount(ages, minlength=100)[:100] / len(ages)
    got = closed_form(constant(q), 1, window, 0.0, 100, every)
    assert np.abs(np.cumsum(got) - np.cumsum(want)).max() < 0.03


def test_company_by_hand():
    # Two subjects, four sweeps each: in company, in company, alone, alone; and alone, then in company thrice.
    p, subject = np.array([0.9, 0.7, 0.1, 0.1, 0.3, 0.5, 0.9, 0.9]), np.repeat([0, 1], 4)
    found = Company.measured(p, subject, np.array([1.0, 1, 1, 0, 0, 1, 1, 0]))
    # Lookups: four in company, with chances 0.9, 0.7, 0.5, 0.9; one alone, with 0.1.
    assert found.p == pytest.approx((0.75, 0.1)) and found.looked_up == pytest.approx(0.8)
    assert found.ends_p == pytest.approx((1 / 4, 1 / 2)) and found.mean_p == pytest.approx(0.62)
    assert found.in_company(0) == pytest.approx(0.8) and found.in_company(1e4) == pytest.approx(2 / 3)


def test_quantile_is_on_the_ages():
    age_s = np.array([1.8, 2.8, 3.8])
    assert law.quantile(age_s, np.array([1.0, 1.0, 2.0]), 0.5) == 2.8
    assert np.isnan(law.quantile(age_s, np.zeros(3), 0.5))
