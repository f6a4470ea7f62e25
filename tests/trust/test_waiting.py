"""Evaluations wait until somebody reads the model. When they are added changes nothing."""

import numpy as np
import pytest
from hypothesis import given, settings

from tests.seeds import seeds
from tests.trust.histories import assert_same, histories, messages_from_rows, open_step
from trust.models import MODELS, params_of
from trust.models.trupercept import TruPercept
from trust.open_steps import LARGE, OpenStep
from trust.params import TrustParams
from trust.step_evidence import StepEvidence
from trust.tables import SERVER, EvaluationMessages, ReceivedEvaluations

WINDOWS = [TrustParams(freshness_s=2.0), TrustParams(freshness_s=5.0), TrustParams(freshness_s="off", grace_s=3.0)]


def models(name):
    if name == "trupercept":
        return TruPercept.build_shared(WINDOWS, 1.0)
    return [MODELS[name](params_of(MODELS[name], TrustParams(), {"grace_s": 3.0}), 1.0)]


@pytest.mark.parametrize("name", [name for name in MODELS if not name.startswith("raya_")])
@given(world=histories, seed=seeds)
@settings(max_examples=15)
def test_when_evaluations_are_added_changes_nothing(name, world, seed):
    """A model that is read after each batch, and so adds each batch alone, against one that is read now and then."""
    frames, rows = world
    rng = np.random.default_rng(seed)
    watched, idle = models(name), models(name)
    under_way = []
    for step, (frame, evaluated) in enumerate(zip(frames, rows, strict=True)):
        for model in (*watched, *idle):
            open_step(model, step, frame)
        strange = [(2000, 1, 0, 1.0, 1.0), *((row[0], row[1], 7, *row[3:]) for row in evaluated[:2])]
        messages = messages_from_rows(step, *np.array([*evaluated, *strange], float).T)
        for i in range(messages.evaluator.size):
            one = ReceivedEvaluations(
                messages, rng.integers(0, 3, 2), np.array([i, i]), is_own=bool(rng.random() < 0.3)
            )
            under_way += [(step + rng.integers(0, 7), one)] * (1 + (rng.random() < 0.3))
        for _, one in (x for x in under_way if x[0] <= step):
            for model in (*watched, *idle):
                model.add_evaluations(one)
            for model in watched:
                assert model.rejected.sum() >= 0
        under_way = [x for x in under_way if x[0] > step]
        if rng.random() < 0.2:
            for a, b in zip(watched, idle, strict=True):
                assert_same(a.scores(), b.scores())
    for a, b in zip(watched, idle, strict=True):
        assert_same(a.scores(len(rows)), b.scores(len(rows)))
        np.testing.assert_array_equal(a.rejected, b.rejected)


def test_large_batches_do_not_wait():
    """What waits is kept as it came, so that only small batches may wait."""
    model = models("trupercept")[0]
    open_step(model, 0, {1: [1.0], 2: [1.0]})
    for n, size in ((1, 0), (LARGE, 1)):
        ones = np.ones(n)
        by, ptr, subject = np.array([1 + size]), np.array([0, n]), np.full(n, 2 - size)
        many = EvaluationMessages(0, by, ptr, subject, np.zeros(n, np.int64), ones, ones)
        model.add_evaluations(ReceivedEvaluations(many, np.array([SERVER]), np.array([0])))
        assert model.store.steps[0].pairs.size == 2 * size, "the small one waits for the large one"


def test_a_message_about_another_step_is_not_the_one_about_this_step():
    """What a message says of each step comes as a message of its own, also where it says nothing."""
    opened = OpenStep(np.array([1, 2]), np.array([0]), np.array([0]), np.array([0.9]))
    holder, row = np.array([SERVER]), np.array([0])

    def accepted(n):
        columns = {"observer": [1] * n, "detection_index": [0] * n}
        values = {"evaluation": [1.0] * n, "visibility": [1.0] * n}
        messages = EvaluationMessages(
            step=0,
            evaluator=np.array([2]),
            ptr=np.array([0, n]),
            **{name: np.array(of, int) for name, of in columns.items()},
            **{name: np.array(of, float) for name, of in values.items()},
        )
        found = opened.accept(ReceivedEvaluations(messages, holder, row))
        return len(found.kept), int(found.n_rejected.sum())

    assert accepted(0) == (0, 0)
    assert accepted(1) == (1, 0)
    assert accepted(1)[1] == 1, "now the holder has a message of this evaluator"


@pytest.mark.parametrize(("n", "kind"), [(65_535, np.uint16), (65_536, np.uint32)])
def test_counts_of_a_step_have_room_for_all_its_evaluators(n, kind):
    """Each pseudonym evaluates a detection once."""
    none = np.zeros(0, np.int64)
    sent = OpenStep(np.arange(n), none, none, np.zeros(0))
    assert StepEvidence(sent).n_evaluations.dtype == kind
