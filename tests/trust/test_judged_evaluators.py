"""Trust models that judge evaluators: equal to their literal transcriptions, and what liars do to them."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.addons.trust_models.false_discovery import critical, tail
from cosim.addons.trust_models.prbi import dealt
from tests.trust.histories import add, build, history, open_step, received_by, trust_of
from tests.verification import judged_evaluators as literal
from tests.verification.trust_models import spelled
from trust.claims import N_OBJECTS, SPEED
from trust.models import MODELS
from trust.params import KINDS
from trust.tables import SERVER, ReceivedEvaluations

SETTINGS = {
    "dawid_skene": [{}, {"window_s": 2.0, "n_iterations": 3}],
    "dawid_skene_online": [{}],
    "evaluator_trust": [{}, {"claim_weight": 2.0, "decay_per_s": 0.5}],
    "self_first": [{}],
    "median_groups": [{}],
    "miso_v": [{}, {"n_sources": 3}],
    "prbi": [
        {}, {"n_vehicles": 2, "least_agreement": 0.8, "memory": 1.0, "missed_p": 0.1},
        {"prior_benign": 0.6, "decay_per_s": 1.0},
    ],
    "false_discovery": [{}, {"level": 0.3, "correlation": 0.0}, {"present_per_s": 0.5, "decay_per_s": 1.0}],
    "belief_graph": [{}, {"evidence": KINDS}, {"n_sweeps": 3, "prior_honest": 0.6}],
}  # fmt: skip
"""Parameters by model."""
JUDGING = sorted(SETTINGS)


def given(model, step, rows, own):
    """The evaluations of a step; those of the vehicle `own` are the holder's."""
    received = received_by(step, rows)
    is_own = received.messages.evaluator == own
    for mine in (True, False):
        which = np.flatnonzero(is_own == mine)
        part = ReceivedEvaluations(received.messages, np.full(which.size, SERVER), which, is_own=mine)
        model.add_evaluations(part)


@pytest.mark.parametrize(("name", "settings"), [(name, one) for name, of in SETTINGS.items() for one in of])
def test_twin(name, settings):
    """Random streams, with and without evaluations of the holder's own."""
    for seed in range(24):
        frames, rows = history(seed, 1 + seed % 6, 2 + seed % 4)
        own = min(frames[0]) if seed % 2 else None
        dt_s = 1.0 if seed % 3 else 0.5
        grace_s = float(1 + seed % 5)
        model = build(name, dt_s, grace_s=grace_s, **settings)
        for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
            open_step(model, step, frame)
            given(model, step, evaluated, own)
        more = {"own": own} if name == "self_first" else {}
        if name == "belief_graph":
            sent = [{v: len(scores) for v, scores in frame.items()} for frame in frames]
            more = {"sent": sent, "grace": grace_s}
        steps = dict(enumerate(rows))
        expected = getattr(literal, name)(steps, len(rows) - 1, dt_s, **spelled(settings), **more)
        scores = model.scores()
        mine = dict(zip(scores.subject.tolist(), scores.trust.tolist(), strict=True))
        if name == "dawid_skene":  # what has left the window has no row
            expected = {i: x for i, x in expected.items() if i in mine}
        assert mine == pytest.approx(expected, abs=2e-6), (name, seed)


def town(name, liars, about, own=None, miss_p=0.25):
    """Trust by vehicle in a town of ten that all see one another; honest ones miss detections by chance.

    `about(liar, subject)` is what a liar says of each detection of a subject.
    """
    model = build(name)
    rng = np.random.default_rng(5)
    vehicles = range(1, 11)
    for step in range(12):
        open_step(model, step, {v: [1.0, 0.9, 0.8] for v in vehicles})
        rows = []
        for v in vehicles:
            for i in vehicles:
                for k in range(3 if v != i else 0):
                    honest = 0.9 if rng.random() >= miss_p else -1.0
                    rows.append((v, i, k, about(v, i) if v in liars else honest, 1.0))
        given(model, step, rows, own)
    return {v: trust_of(model, v) for v in vehicles}


@pytest.mark.parametrize("name", JUDGING)
def test_who_denies_everybody_is_trusted_less_than_its_victims(name):
    found = town(name, {1, 2}, lambda liar, subject: -1.0)
    assert max(found[1], found[2]) < min(found[v] for v in range(3, 11))


@pytest.mark.parametrize("name", ["false_discovery", "prbi"])
def test_where_nobody_lies_nobody_is_accused(name):
    assert min(town(name, set(), None).values()) > 0.5


def test_groups_are_verified_by_hand():
    """Two vehicles, a group each. P = 0.8; nothing is known of other groups: a likelihood of 1/2 either way."""
    # denied: both contradict the reference. P = .5 .8 / (.5 .8 + .2) = 2/3, share passed 1.6 / 3: (2/3 + 1.6/3) / 2
    # confirmed: both agree. P = .5 .8 / (.5 .8 + .3 .2) = 20/23, share passed 2.6 / 3
    for evaluation, expected in ((-1.0, 0.6), (1.0, (20 / 23 + 2.6 / 3) / 2)):
        model = build("prbi")
        open_step(model, 0, {1: [1.0], 2: []})
        add(model, 0, [(2, 1, 0, evaluation, 1.0)])
        assert trust_of(model, 1) == pytest.approx(expected, abs=1e-9)


def test_vehicles_are_divided_into_the_suspicious_and_the_rest():
    """Seven vehicles of one holder and two of another: fives drawn by lot, and the three least benign of each five."""
    draw, benign = np.array([0.1, 0.9, 0.2, 0.3, 0.8, 0.4, 0.5, 0.6, 0.7]), np.linspace(0.9, 0.1, 9)
    group = dealt(np.repeat([0, 1], [7, 2]), draw, benign, np.full(9, 3), 5)
    # fives: {0, 2, 3, 5, 6} and {1, 4} of the first, {7, 8} of the second; of two, one is suspicious
    parts = {frozenset(np.flatnonzero(group == g).tolist()) for g in range(group.max() + 1)}
    assert parts == {frozenset(one) for one in ({3, 5, 6}, {0, 2}, {4}, {1}, {8}, {7})}


def test_tests_by_hand():
    # 2 or more of 3 at 1/2: 1/2; 1 or more of 4 at 0.1: 1 - 0.9^4; nothing denied: certain
    assert tail(np.array([2.0, 1.0, 0.0]), np.array([3.0, 4.0, 4.0]), np.array([0.5, 0.1, 0.1])) == pytest.approx(
        [0.5, 1 - 0.9**4, 1.0], abs=1e-12
    )
    # q = 0.05, m = 3: limits 0.0167, 0.0333, 0.05. The second smallest passes, so two are found; of two others none is
    p, holder = np.array([0.033, 0.02, 0.9, 0.03, 0.06]), np.array([0, 0, 0, 1, 1])
    assert critical(p, holder, 0.05) == pytest.approx([0.1 / 3] * 3 + [0.025] * 2, abs=1e-12)


@pytest.mark.parametrize("name", ["belief_graph", "evaluator_trust", "miso_v", "self_first"])
def test_a_ring_of_three_gains_nothing(name):
    """Truth inference fails here: a ring that never errs looks more reliable than honest vehicles that err."""
    found = town(name, {1, 2, 3}, lambda liar, subject: 1.0 if subject <= 3 else -1.0)
    assert max(found[v] for v in (1, 2, 3)) < min(found[v] for v in range(4, 11))


def test_an_own_sweep_bounds_what_a_colluding_majority_gains():
    """Six of ten collude. By the votes of others the three victims are liars; the holder's own eyes tell otherwise."""

    def about(liar, subject):
        return 0.9 if subject <= 6 else -1.0

    votes = town("evaluator_trust", set(range(1, 7)), about, own=10, miss_p=0.1)
    eyes = town("self_first", set(range(1, 7)), about, own=10, miss_p=0.1)
    assert max(votes[v] for v in (7, 8, 9)) < 0.2 and min(votes[v] for v in range(1, 7)) > 0.9
    assert min(eyes[v] for v in (7, 8, 9)) > 0.45 and max(eyes[v] for v in range(1, 7)) < 0.65
    assert town("self_first", set(range(1, 7)), about, miss_p=0.1) == votes, "a server has no sweep"


def test_withheld_detections_are_a_contradiction():
    """Vehicle 1 confirms with detections of its own, and sends only its self report."""
    model = build("belief_graph")
    for step in range(10):
        open_step(model, step, {1: [1.0], 2: [1.0, 0.9], 3: [1.0, 0.9]})
        add(model, step, [(v, i, k, 0.9, 1.0) for v in (1, 2, 3) for i in (2, 3) for k in (0, 1) if v != i])
        add(model, step, [])
    # vehicle 1 has no evaluations about itself, hence no row; ask the state of the evaluators instead
    assert trust_of(model, 1) == 0.5
    open_step(model, 10, {1: [1.0], 2: [1.0, 0.9], 3: [1.0, 0.9]})
    add(model, 10, [(v, 1, 0, 0.9, 1.0) for v in (2, 3)])
    assert trust_of(model, 1) < 0.2 < 0.6 < trust_of(model, 2)


def test_an_evaluator_that_sends_in_other_steps_withholds_nothing():
    """Two groups of vehicles send in turns, as at random sensing phases, and evaluate the other group's detections."""
    model = build("belief_graph")
    groups = ({1: [1.0, 0.9], 2: [1.0, 0.9]}, {3: [1.0, 0.9], 4: [1.0, 0.9]})
    for step in range(10):
        senders, others = groups[step % 2], groups[1 - step % 2]
        open_step(model, step, {v: senders.get(v, []) for v in (1, 2, 3, 4)})
        add(model, step, [(v, i, k, 0.9, 1.0) for v in others for i in senders for k in (0, 1)])
    for v in (1, 2, 3, 4):
        assert trust_of(model, v) > 0.6


def test_an_honest_evaluator_may_be_almost_certain_of_a_velocity():
    """Liars are certain, Phi = 1. Tracks of cars that keep their speed support a true velocity with up to 0.993."""
    trust = []
    for visibility in (0.9, 0.999, 1.0):
        model = build("belief_graph", evidence=KINDS)
        for step in range(5):
            open_step(model, step, {v: [1.0] * (2 + N_OBJECTS) for v in (1, 2, 3)})
            own = [(v, i, SPEED, 1.0, visibility) for v in (1, 2, 3) for i in (1, 2, 3) if v != i]
            add(model, step, own)
        trust.append(trust_of(model, 1))
    assert trust[1] > trust[0] > trust[2]


@pytest.mark.parametrize(("name", "window"), [("dawid_skene", "window_s"), ("announcement", "validity_s")])
def test_evaluations_that_left_the_window_are_not_counted(name, window):
    model = build(name, **{window: 2.0})
    for step in range(5):
        open_step(model, step, {1: [1.0], 2: [1.0]})
        given(model, step, [(2, 1, 0, 1.0, 1.0)], None)
    scores = model.scores()
    assert (scores.n_evaluations[0], scores.newest_evaluation_step[0], scores.oldest_evaluation_step[0]) == (2, 4, 3)
    assert not len(model.scores(7).subject), "what has left the window has no row"


def test_the_holders_own_evaluations_are_marked_in_the_log():
    model = build("self_first")
    open_step(model, 0, {1: [1.0, 0.5], 2: [1.0], 3: [1.0]})
    given(model, 0, [(1, 2, 0, 1.0, 1.0), (3, 1, 0, 1.0, 1.0), (3, 1, 1, -1.0, 1.0)], own=1)
    rows = model.log.rows(0)
    named = dict(zip(rows.evaluator.tolist(), rows.is_own.tolist(), strict=True))
    assert sorted(named.values()) == [False, True]
    assert sorted(rows.n_sent.tolist()) == [1, 2]
    assert rows.is_self.tolist().count(True) == 2


def test_a_shape_that_is_none_is_refused():
    good = MODELS["belief_graph"].Params()
    with pytest.raises(ValueError, match=r"trust.share_shape = \[0.0, 1.0\]: the shapes"):
        replace(good, share_shape=(0.0, 1.0))
    with pytest.raises(ValueError, match=r"trust.missing_shapes = \[1.0\]: the shapes"):
        replace(good, missing_shapes=((1.0,), (1.0, 1.0), (1.0, 1.0)))
