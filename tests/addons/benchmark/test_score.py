from dataclasses import replace

import numpy as np
import pytest

from cosim.addons.benchmark.evidence import EvidenceStream
from cosim.addons.benchmark.play import ModelAnswers, candidate
from cosim.addons.benchmark.score import counts, figures, score
from tests.addons.benchmark.worlds import RULES, tiny_set


def by_hand():
    """Vehicles 0 and 1 are honest, 2 attacks from step 4 on. Rows: step, receiver, sender, trust."""
    rows = np.array([
        (3, 0, 2, 0.0),  # before the attack: does not count
        (4, 0, 1, 0.9), (4, 0, 2, 0.5), (4, 1, 0, np.nan), (4, 1, 2, 0.2), (4, 2, 0, 0.1),  # the last: an attacker asks
        (6, 0, 1, 0.3), (6, 0, 2, 0.3), (6, 1, 0, 0.8), (6, 1, 2, np.nan),
    ])  # fmt: skip
    lookups = {c: rows[:, k].astype(np.int16) for k, c in enumerate(("step", "receiver", "sender"))}
    pseudonyms = {"pseudonym": np.arange(3), "vehicle": np.arange(3), "attacks": np.array([0, 0, 1])}
    of = EvidenceStream({}, {}, {}, lookups, pseudonyms)
    return of, ModelAnswers(rows[:, 3], np.where(np.isnan(rows[:, 3]), np.nan, 2.0), 0.0, 1)


def test_counts_by_hand():
    of, answers = by_hand()
    one = counts(of, answers, 0.4, RULES, of.lookups["step"] == 4)
    # honest values .9, .3, .8 against .5, .2, .3: 2 + 3 + 2.5 pairs in order
    assert (one.above, one.pairs) == (7.5, 9)
    # honest vehicle-steps: (4, 1), (4, 0), (6, 1), (6, 0); only the third is below .4
    assert (one.n_wrong, one.n_honest) == (1, 4)
    # messages of the attacker: .5 believed, .2 excluded, .3 excluded, unknown believed; false ones in step 4 only
    assert (one.messages, one.believed, one.lies_believed) == (4, 2, 1)
    # first look-up at 4 s, excluded in the same second
    assert one.delay_s.tolist() == [0] and one.found.tolist() == [True]
    assert (one.age_s, one.n_aged) == (12, 6)
    later = counts(of, answers, 0.15, RULES, of.lookups["step"] == 4)
    assert later.delay_s.tolist() == [2] and not later.found.any(), "never excluded: watched for two seconds"
    figure = figures([one, one])
    assert figure.auc.value == pytest.approx(7.5 / 9) and figure.wrong_p.value == 0.25
    assert figure.believed_p.value == 0.5 and figure.age_s.value == 2
    assert figure.harm.value == pytest.approx((1 / 4 + 1 / 4) / 2)


def test_intervals_are_over_worlds():
    of, answers = by_hand()
    one = counts(of, answers, 0.4, RULES, of.lookups["step"] >= 4)
    other = replace(one, n_wrong=4.0, above=0.0)
    found = figures([one, one, one, other, other, other])
    assert found.auc.n_units == 6 and found.auc.low < found.auc.value < found.auc.high
    assert found.auc.value == pytest.approx(7.5 / 18)
    assert found.wrong_p.low == pytest.approx(0.25) and found.wrong_p.high == pytest.approx(1.0)


def test_the_threshold_is_that_of_the_worlds_without_attack():
    found = score(tiny_set(), candidate("beta", [], RULES), lambda *_: None)
    assert set(found.attacks) == set(RULES.cases[1:])
    auc = [of.auc.value for of in found.attacks.values()]
    assert auc == sorted(auc), "worst first"
    assert found.attacks["ghost_insertion"].auc.value > 0.7 > found.attacks["bad_mouthing"].auc.value
    assert found.quiet_p <= 0.05 + 1e-9, "all look-ups have the same weight here"
    assert found.attacks["bad_mouthing"].wrong_p.value > found.quiet_p
    assert found.cost_us > 0
    again = score(tiny_set(), candidate("beta", [], RULES), lambda *_: None)
    assert repr(again.attacks) == repr(found.attacks) and again.threshold == found.threshold
