"""What the pictures of delivery, exclusion and stale trust show, by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from results.metrics import contact_delivery, exclusion, stale
from tests.results.tiny import fleet

POINT = st.tuples(st.integers(0, 5), st.integers(0, 5))


def test_delivery_by_age(tiny):
    """A contact from step 2 to 6 of 0 and 1; 0 is heard in the first two steps of it, 1 in none."""
    meeting = {"a": 0, "b": 1, "start_step": 2, "end_step": 6, "duration_s": 4, "radius_m": 50, "pairs": "equipped"}
    early = {"a": 0, "b": 1, "start_step": 0, "end_step": 1, "radius_m": 50, "pairs": "equipped", "censored_left": True}
    heard = [{"step": s, "message_type": "cpm", "sender": 0, "receiver": 1} for s in (0, 2, 3)]
    run = tiny(9, vehicles=fleet("honest", "honest"), encounters=[meeting, early], receptions=heard)
    found = contact_delivery.by_age(run, every_s=2.0)
    # two bins of two steps in two directions each
    assert found.age_s.tolist() == [1, 3] and found.n.tolist() == [4, 4] and found.share.tolist() == [0.5, 0]
    assert contact_delivery.contacts(run).duration_s.tolist() == [4]


def test_precision_and_recall_of_exclusion(tiny):
    rows = [(0, 0.1, 3), (1, 0.4, 3), (2, 0.6, 3), (3, 0.3, 3), (4, 0.2, 0)]
    trust = [
        {"step": 5, "variant": "base", "subject": s, "trust": t, "n_evaluations": n,
         "state": "evaluated" if n else "unevaluated"} for s, t, n in rows
    ]  # fmt: skip
    vehicles = fleet("malicious", "malicious", "honest", "honest", "malicious", attack_start_step=1)
    for honest in vehicles[2:4]:
        honest["attack_start_step"] = None
    found = exclusion.curve(tiny(9, vehicles=vehicles, trust=trust))
    # of three attackers one has no evaluation; below 0.35 are one attacker and one honest vehicle
    assert exclusion.at(found, 0.35) == (pytest.approx(1 / 3), 0.5)
    assert exclusion.at(found, 0.2) == (pytest.approx(1 / 3), 1)
    assert exclusion.at(found, 0.5) == (pytest.approx(2 / 3), pytest.approx(2 / 3))
    assert exclusion.at(found, 0.05) is None, "nobody is excluded"
    assert exclusion.at(found, 1.0) == (pytest.approx(2 / 3), 0.5)


@given(st.lists(POINT, min_size=1, max_size=12))
def test_the_front_is_what_no_other_beats(points):
    x, y = np.array(points, float).T
    front = exclusion.is_on_front(x, y)
    beaten = [any((a >= p and b >= q) and (a > p or b > q) for a, b in points) for p, q in points]
    assert {p for p, f in zip(points, front, strict=True) if f} == {
        p for p, b in zip(points, beaten, strict=True) if not b
    }


def test_stale_by_place(tiny):
    lookups = [
        {
            "step": 1,
            "variant": "base",
            "subject": s,
            "receiver": r,
            "newest_evaluation_age_s": age,
            "state": "evaluated",
        }
        for s, r, age in ((5, 0, 3.0), (6, 0, 10.0), (7, 0, 10.5), (5, 1, None))
    ]
    actors = [{"step": 1, "actor": a, "x_m": 10.0 * a, "y_m": 5.0} for a in (0, 1)]
    run = tiny(3, vehicles=fleet("honest", "honest"), trust_lookups=lookups, actors=actors)
    found = stale.placed(run, 10.0).sort_values("x_m")
    assert found[["x_m", "y_m", "n", "n_stale"]].to_numpy().tolist() == [[0, 5, 3, 1], [10, 5, 1, 1]]
