"""The bound of an ideal observer, against areas that are known in closed form."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom

from cosim.addons.evidence.auc_bound import _counts, _of_kinds, area
from tests.results.tiny import fleet, make

N = 500


def exact(kinds):
    """Area of the likelihood ratio of independent binomial counts: (n, p of attackers, p of honest) per kind."""
    grids = np.meshgrid(*(np.arange(n + 1) for n, *_ in kinds), indexing="ij")
    p = [
        np.prod([binom.pmf(k, n, of[role]) for k, (n, *of) in zip(grids, kinds, strict=True)], axis=0)
        for role in (0, 1)
    ]
    ratio = np.round(np.log(p[0]) - np.log(p[1]), 9).ravel()
    value, at = np.unique(ratio, return_inverse=True)
    attacker, honest = (np.bincount(at, one.ravel(), len(value)) for one in p)
    return float((attacker * (np.cumsum(honest) - honest / 2)).sum())


@pytest.mark.parametrize(
    "kinds",
    [
        [(20, 0.6, 0.4)],
        [(20, 0.4, 0.6)],  # what is denied more often may be the honest: the observer knows which
        [(10, 0.9, 0.85), (4, 0.2, 0.7)],  # the rare kind says more
        [(30, 0.5, 0.5)],
    ],
)
def test_the_area_is_that_of_neyman_and_pearson(kinds):
    rng = np.random.default_rng(5)
    attacks = np.arange(2 * N) < N
    columns = []
    for n, *p in kinds:
        k = rng.binomial(n, np.where(attacks, *p))
        columns += [k, n - k]
    found = area(np.column_stack(columns), attacks, np.arange(2 * N))
    assert found.value == pytest.approx(exact(kinds), abs=0.025)
    assert found.low < exact(kinds) < found.high or exact(kinds) == pytest.approx(0.5)


def test_areas_by_hand():
    """Attackers a: (4, 0), b: (3, 1); honest c: (0, 4), d: (0, 3): columns are two kinds of clues.

    Judging a and c: of the first kind, b has 1 and d has 0, so the first kind speaks for an attacker, and a has it. The
    same holds for all four pairs: whoever is left out, the other attacker has more of the first kind.
    """
    counts = np.array([[4, 0], [3, 1], [0, 4], [0, 3]])
    two, one = np.array([True, True, False, False]), np.array([True, False, False, False])
    assert area(counts, two, np.arange(4)).value == 1.0
    assert np.isnan(area(counts, one, np.arange(4)).value), "nothing is known of a lone attacker"
    assert np.isnan(area(counts, two, np.array([0, 0, 1, 2])).value), "nor of two pseudonyms of one"


def test_pseudonyms_of_a_vehicle_do_not_tell_of_each_other():
    """Each of 40 vehicles has four pseudonyms with clues of the same kinds, whatever its role."""
    found, apart = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        kinds, vehicle = rng.dirichlet(np.full(12, 0.3), 40), np.repeat(np.arange(40), 4)
        counts = np.array([rng.multinomial(20, kinds[v]) for v in vehicle])
        found.append(area(counts, vehicle < 10, vehicle))
        apart.append(area(counts, vehicle < 10, np.arange(160)))
    mean = np.mean([one.value for one in found])  # the larger of two statistics
    assert mean == pytest.approx(0.55, abs=0.05) and found[0].n_units == 10
    assert sum(one.low < 0.5 < one.high for one in found) >= 7
    assert min(one.value for one in apart) > 0.65, "as if each pseudonym were a vehicle"


def test_order_of_subjects_and_of_kinds_does_not_matter():
    rng = np.random.default_rng(8)
    counts, attacks = rng.poisson(3, (30, 6)), np.arange(30) % 3 == 0
    rows, columns = rng.permutation(30), rng.permutation(6)
    vehicle = np.arange(30) // 2
    whole, again = area(counts, attacks, vehicle), area(counts[rows][:, columns], attacks[rows], vehicle[rows])
    assert again == pytest.approx(whole, abs=1e-12)


def kinds(run, who):
    """Clues of the kinds that there are, for an observer who knows the roles of all."""
    return _of_kinds(_counts(run, who).reshape(len(who), -1))


def test_what_others_say_of_a_detection_counts_in_whichever_step(tmp_path):
    """Vehicles 1 and 2 evaluate a detection of vehicle 0, in one step or ten steps apart: in another block of rows."""

    def clues(name, later):
        said = {"observer": 0, "detection_step": 1, "visibility": 1.0}
        first = {**said, "step": 1, "evaluator": 1, "evaluation": 0.7}
        rows = [first, {**said, "step": later, "evaluator": 2, "evaluation": -1.0}]
        (tmp_path / name).mkdir()
        run = make(tmp_path / name, 20, vehicles=fleet("honest", "honest", "malicious"), evaluations=rows)
        return kinds(run, pd.DataFrame({"since": [0, 0, 0], "until": 19}))

    together = clues("together", 1)
    assert together.shape[1] == 4  # two received, two made
    assert np.array_equal(clues("apart", 12), together)


def test_a_roadside_unit_is_no_attacker(tmp_path):
    """A unit, number 2, and an honest vehicle say the same of two detections of vehicle 0: clues of one kind."""
    said = {"observer": 0, "step": 1, "detection_step": 1, "visibility": 1.0, "evaluation": 0.7}
    rows = [{**said, "detection_index": k, "evaluator": by} for k, by in enumerate((1, 2))]
    run = make(tmp_path, 20, vehicles=fleet("honest", "honest", None, "malicious"), evaluations=rows)
    who = pd.DataFrame({"since": 0, "until": 19}, [0, 1, 3])
    assert kinds(run, who).tolist() == [[2, 0], [0, 1], [0, 0]]


def test_clues_after_the_last_step_of_a_subject_do_not_count(tmp_path):
    """Vehicle 1 evaluates in step 6 what vehicle 0 sent in step 4, the last before it changed its pseudonym."""
    said = {"observer": 0, "evaluator": 1, "detection_step": 4, "visibility": 1.0, "evaluation": 0.7}
    run = make(tmp_path, 20, vehicles=fleet("honest", "honest"), evaluations=[{**said, "step": s} for s in (4, 6)])
    who = pd.DataFrame({"since": 0, "until": [4, 19]})
    assert kinds(run, who).tolist() == [[1, 0], [0, 2]]
