"""The audit of evidence: counted by hand, and again in plain pandas from the tables of a run."""

import numpy as np
import pytest

from cosim.addons.evidence.evaluations import SPLITS, boxes_of_no_actor, rates
from cosim.addons.evidence.repeats import repeats
from cosim.step.trackers.evidence_audit import AuditedDetections, AuditedEvaluations, audit, count_looks
from results.archive import open_run
from results.measure import measure
from tests.drive import drive
from tests.results.tiny import fleet
from tests.slow import slow


def test_by_hand():
    # vehicle 1 reports actor 7 twice (rows 1, 2) and fabricates row 3; vehicle 0 reports actor 7 once (row 0)
    message, actor = np.array([0, 1, 1, 1]), np.array([7, 7, 7, 0])
    real, fabricated = np.array([True, True, True, False]), np.array([False, False, False, True])
    # evaluator 0 sees all three of vehicle 1; evaluator 2, an attacker, confirms the fabricated one and row 0;
    # the own evaluation (1, 3) and the one without visibility (2, 1) are no evidence
    evaluator, detection = np.array([0, 0, 0, 1, 2, 2, 2]), np.array([1, 2, 3, 3, 0, 1, 3])
    e, phi = np.array([1, 1, -1, 1, 1, 1, 1.0]), np.array([1, 1, 1, 1, 1, 0, 0.5])
    detections = AuditedDetections(message, actor, real, fabricated)
    row = audit(AuditedEvaluations(evaluator, detection, e, phi), detections, np.array([0, 1, 1]) > 0, 4)
    assert {name: int(values[0]) for name, values in row.items()} == {
        "n_copies": 4, "n_evaluations": 5, "n_looks": 4, "n_echoes": 1,
    }  # fmt: skip
    assert count_looks(evaluator[:0], detection[:0], detections) == 0


def test_detections_of_roadside_units_are_not_those_of_vehicles(tiny):
    """Vehicle 0 confirms a detection of vehicle 1 and denies one of unit 2."""
    sent = {"step": 1, "origin": "sensed", "transmitted": True, "truth_actor": 0}
    said = {"step": 1, "detection_step": 1, "evaluator": 0, "visibility": 1.0}
    run = tiny(
        5,
        vehicles=fleet("honest", "honest", None),
        actors=[{"step": 1, "actor": number} for number in range(3)],
        detections=[sent | {"observer": number} for number in (1, 2)],
        evaluations=[said | {"observer": 1, "evaluation": 0.7}, said | {"observer": 2, "evaluation": -1.0}],
    )
    found = rates(run).set_index("by")
    assert found.n.to_dict() == dict.fromkeys(("all", *SPLITS), 1) and (found.denied == 0).all()


def test_what_a_roadside_unit_says_of_its_own_detections_is_repeated_by_nobody(tiny):
    """Unit 2 and vehicle 0 evaluate a detection of vehicle 1, and unit 2 its own twice."""
    sent = {"step": 1, "origin": "sensed", "transmitted": True, "truth_actor": 0}
    said = {"step": 1, "detection_step": 1, "visibility": 1.0, "evaluation": 0.7}
    by_and_of = ((0, 1, 1), (2, 1, 1), (2, 2, 1), (2, 2, 2))
    run = tiny(
        5,
        vehicles=fleet("honest", "honest", None),
        actors=[{"step": 1, "actor": number} for number in range(3)],
        detections=[sent | {"observer": number} for number in (1, 2)],
        evaluations=[said | {"evaluator": by, "observer": of, "step": at} for by, of, at in by_and_of],
    )
    assert (repeats(run).set_index("group").distinct.dropna() == 1).all()


def test_boxes_under_several_pseudonyms_are_of_one_vehicle(tiny):
    """Three vehicles with two pseudonyms each, and a box of no actor under the first one of each."""
    sent = {"step": 1, "origin": "sensed", "transmitted": True}
    run = tiny(
        5,
        vehicles=fleet("honest", "honest", "honest"),
        pseudonyms=[{"pseudonym": n, "vehicle": n % 3, "from_step": 0, "to_step": 4} for n in range(6)],
        detections=[sent | {"observer": n, "truth_actor": None if n < 3 else 0} for n in range(6)],
    )
    found = boxes_of_no_actor(run).set_index("class").loc["all"]
    assert (found.n, found.share, found.n_units) == (6, 0.5, 3)


@pytest.fixture(scope="module", params=[slow(1), 3], ids=["one hop", "relays"])
def run(request, tmp_path_factory):
    folder, hops = tmp_path_factory.mktemp("evidence") / "run", f"radio.relay.max_hops={request.param}"
    return open_run(drive(folder, "record.level=full", "traffic.duration_s=10", hops))


def test_against_the_tables(run):
    seen = run.evaluations.merge(
        run.detections[["step", "observer", "detection_index", "origin", "truth_actor"]],
        on=["step", "observer", "detection_index"],
    )
    seen = seen[(seen.visibility > 0) & (seen.evaluator != seen.observer)]
    n = seen.groupby("step").size()
    found = run.evidence.set_index("step")
    assert found.n_evaluations[found.n_evaluations > 0].to_dict() == n.to_dict()
    real = seen.dropna(subset="truth_actor")
    n_looks = len(real.drop_duplicates(["step", "evaluator", "observer", "truth_actor"]))
    n_looks += seen.truth_actor.isna().sum()
    assert found.n_looks.sum() == n_looks
    roles = run.vehicles.set_index("vehicle").role
    lying = (seen.origin == "fabricated") & (seen.evaluation > 0) & (seen.evaluator.map(roles) != "honest")
    assert found.n_echoes.sum() == lying.sum()
    assert found.n_copies.sum() == run.radio.n_duplicate.sum()
    assert (found.n_copies.sum() > 0) == (run.config["radio"]["relay"]["max_hops"] > 1)
    value = measure(run, topics=("evidence",)).set_index("metric").value
    assert value["evidence.trust.multiplicity"] == pytest.approx(n.sum() / n_looks)
    assert value["evidence.fused.multiplicity"] > 1.2  # every member of a group is evaluated with the same look
    behind = run.variant_table("fused_evidence")
    assert value["evidence.fused.multiplicity"] == pytest.approx(behind.n_evaluations.sum() / behind.n_evaluators.sum())
