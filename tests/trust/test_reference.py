"""The published code's own answers, where they are free of its defects."""

from dataclasses import replace

import numpy as np
import pytest

from tests.trust.histories import add, values_of
from tests.trust.reference import LABELS, detections_of, load, one_view
from tests.verification import paper
from trust.evaluation import evaluate, visibility
from trust.fusion import SensorEvidence, fuse
from trust.matching import match
from trust.models.trupercept import TruPercept
from trust.open_steps import RejectReason
from trust.params import TrustParams
from trust.tables import (
    Evaluations,
    FusionInput,
    Groups,
    ObjectLists,
    SenderTrust,
    SentDetections,
)

METHODS = [
    "averaging",
    "additive",
    "trupercept_1",
    "any",
    "any_confirmed",
    "confirmed_or_local",
    "local_confirmed",
    "local",
    "half_additive",
    "trupercept_1_local_bias",
    "trupercept_2",
    "corrected",
    "trupercept_3",
    "trupercept_3_corrected",
]
"""By the published code's number."""


def test_matching():
    cases = load("b_matching")["cases"]
    for case in cases:
        objects = [o for one in case["lists"] for o in one]
        vehicles = list(dict.fromkeys(o["det_id"] for o in objects))
        table, at = detections_of(objects, {v: row for row, v in enumerate(vehicles)})
        row = {(o["det_id"], o["det_idx"]): r for o, r in zip(objects, at.tolist(), strict=True)}
        pairs = [[*sorted((row[a, i], row[b, j])), iou] for a, i, b, j, iou in case["pair_iou"]]
        i, j, iou = np.array(pairs).reshape(-1, 3).T
        n = len(table)
        lists = ObjectLists(np.array([0, n]), np.arange(n), np.array([0]))
        params = TrustParams(tau=case["threshold"])
        seed = match(lists, table, (i.astype(np.int32), j.astype(np.int32), iou), params).seed
        name = {r: list(k) for k, r in row.items()}
        ours = [
            [name[int(m)] for m in np.flatnonzero(seed == s)]
            for label in (LABELS["Car"], LABELS["Pedestrian"])
            for s in np.flatnonzero((seed == np.arange(n)) & (table.label == label))
        ]
        assert ours == case["groups"]
    print(f"matching: {len(cases)} cases")


def test_visibility():
    cases = load("c3_visibility")["cases"]
    for case in cases:
        limits = [(case["gamma_lower"], case["gamma_upper"])] * 4
        limits[LABELS["Pedestrian"]] = (case["gamma_lower_peds"], case["gamma_upper_peds"])
        lower, upper = (tuple(map(float, x)) for x in zip(*limits, strict=True))
        params = TrustParams(gamma_lower_points=lower, gamma_upper_points=upper)
        label = np.array([LABELS[case["type"]]], np.uint8)
        phi = visibility(np.array([case["points"]]), label, params)
        assert phi[0] == pytest.approx(case["visibility"], abs=1e-12)
    print(f"visibility: {len(cases)} cases")


def _evaluated(case: dict):
    """Our evaluations for one recorded evaluator: objects, evaluations, and which are free of the artefact.

    The published code lets a malicious evaluator certify its false detections, and, by mistake, an honest one those
    that it matches.
    """
    table, lists, groups, objects = one_view(
        case["groups"], case["evaluator"], [o["det_id"] for g in case["groups"] for o in g]
    )
    points = np.array([o["points"] for o in objects])
    plausible = np.array([o["plausible"] is not False for o in objects])
    evaluations = evaluate(lists, groups, table, points, plausible, TrustParams(eta=case["eta"]))
    theirs = np.array([o["det_id"] != case["evaluator"] for o in objects])
    false = np.array([o["false_det"] for o in objects])
    evaluations.evaluation[false & ~theirs] = evaluations.visibility[false & ~theirs] = 1.0
    return objects, evaluations, ~(false & theirs & groups.ego_detected)


def test_evaluations():
    cases, n, worst = load("c_evaluations")["cases"], 0, 0.0
    for case in cases:
        objects, evaluated, sound = _evaluated(case)
        e = np.array([o["eval"] for o in objects])
        phi = np.array([o["certainty"] for o in objects])
        worst = max(
            worst, np.abs(evaluated.evaluation - e)[sound].max(), np.abs(evaluated.visibility - phi)[sound].max()
        )
        n += int(sound.sum())
    print(f"evaluations: {n}, max error {worst:.1e}")
    assert worst < 1e-6


def test_aggregated_evaluations():
    cases, n, worst = load("c2_aggregated_evaluations")["cases"], 0, 0.0
    for case in cases:
        rows = [(r["det_idx"], r["eval"], r["certainty"]) for r in case["evals"]]
        value = paper.aggregated(rows, "mean" if case["agg_avg"] else "sum")
        assert set(value) == {int(k) for k in case["agg"]}
        for k, expected in case["agg"].items():
            worst = max(worst, abs(value[int(k)] - expected))
            n += 1
    print(f"aggregated evaluations: {n}, max error {worst:.1e}")
    assert worst < 1e-6  # the vectors have six decimals


def test_vehicle_trust():
    cases, n, worst, n_exact = load("d_vehicle_trust")["cases"], 0, 0.0, 0
    for case in cases:
        f = case["freshness"] or 1000
        ids = np.array(sorted(case["vehicles"]))
        model = TruPercept(TrustParams(unseen="zero", freshness_s=float(f)), dt_s=1.0)
        sound = case["freshness"] is None or case["score_mode"] == "ones"
        n_exact += not sound
        for t, frame in enumerate(case["frames"]):
            scores = [frame.get(str(v), {"scores": []})["scores"] for v in ids]
            model.open_step(
                t,
                ids,
                np.repeat(np.arange(ids.size), [len(s) for s in scores]),
                np.concatenate([np.arange(len(s)) for s in scores]),
                np.concatenate(scores).astype(float),
            )
            rows = [
                (r["evaluator"], int(v), r["det_idx"], r["eval"], r["certainty"])
                for v, entry in frame.items()
                for r in entry["evals"]
            ]
            add(model, t, rows)
            got = values_of(model.scores(t), ids)
            exact = case["reference_exact_window_val"][t]
            for v, trust in zip(ids, got, strict=True):
                expected = case["result"][t]["mem"][str(v)]["val"] if sound else exact[str(v)]
                worst = max(worst, abs(trust - max(0.0, expected)))
                n += 1
        assert model.rejected.sum() == 0
    print(f"vehicle trust: {n} values of {len(cases)} sequences ({n_exact} by the exact window), {worst:.1e}")
    assert worst < 1e-6


def _split(case: dict) -> list[list[tuple[float, float]]]:
    """Per member evaluations (e, Phi) whose sum is the recorded aggregated evaluation."""
    parts = [0 if m is None else max(1, int(np.ceil(abs(m)))) for m in case["agg_eval"]]
    return [[(m / n, 1.0)] * n if n else [] for m, n in zip(case["agg_eval"], parts, strict=True)]


def _world(cases: list[dict], evaluations_of=_split):
    """All recorded groups at once: an ego and a group per case, vehicles and detections shared by no two.

    Evaluations (`evaluations_of` gives them per member) come from vehicles of which nothing else is known.
    """
    parts, n_vehicles, n_rows = [], 0, 0
    for case in cases:
        table, lists, groups, objects = one_view([case["group"]], case["ego_id"], [o["det_id"] for o in case["group"]])
        vehicle_ids = dict(zip(table.message[lists.member].tolist(), (o["det_id"] for o in objects), strict=True))
        known = {r: case["vehicle_trust"].get(str(v)) for r, v in sorted(vehicle_ids.items())}
        evaluations = evaluations_of(case)
        n_evaluations = [len(v) for v in evaluations]
        values = np.array([row for v in evaluations for row in v], float).reshape(-1, 2)
        first = n_vehicles + int(table.message.max()) + 1
        evaluators = first + np.arange(len(values))
        trusted = [r for r, t in known.items() if t is not None]
        distance = np.empty(len(table))
        distance[lists.member] = [o["detector_dist"] for o in objects]
        parts.append(
            {
                "message": table.message + n_vehicles,
                "table": table,
                "member": lists.member + n_rows,
                "seed": np.full(len(objects), n_rows),
                "ego_detected": groups.ego_detected,
                "owner": [n_vehicles],
                "size": [len(objects)],
                "evaluator": evaluators,
                "about": np.repeat(lists.member + n_rows, n_evaluations),
                "e": values[:, 0],
                "phi": values[:, 1],
                "received": np.concatenate([np.array(trusted, np.int64) + n_vehicles, evaluators]),
                "trust": np.array([known[r] for r in trusted] + [0.3] * evaluators.size, float),
                "n_received": [len(trusted) + evaluators.size],
                "distance": distance,
                "points": [objects[0]["evaluator_3d_points"]],
                "plausible": [case["seed_plausible"] is not False],
                "in_range": [float(np.linalg.norm(objects[0]["t"])) < 70],
            }
        )
        n_vehicles = first + evaluators.size
        n_rows += len(objects)

    def col(name):
        return np.concatenate([part[name] for part in parts])

    def ptr(name):
        return np.concatenate([[0], np.cumsum(col(name))])

    table = SentDetections(
        col("message"),
        *(
            np.concatenate([getattr(p["table"], f) for p in parts])
            for f in ("detection_index", "label", "score", "is_self")
        ),
    )
    lists = ObjectLists(ptr("size"), col("member"), col("owner"))
    evaluations = Evaluations(col("e"), col("phi"))
    evaluated = ObjectLists(np.arange(col("evaluator").size + 1), col("about"), col("evaluator"))
    groups = Groups(col("seed"), col("ego_detected"))
    return (
        FusionInput(lists, groups, table, evaluated, evaluations, evaluations),
        SenderTrust(ptr("n_received"), col("received"), col("trust")),
        SensorEvidence(col("points"), col("plausible"), col("in_range")),
        col("distance"),
    )


def _recorded(kind: str) -> list[dict]:
    """Recorded groups, without the ego's report of itself, which is no output."""
    return [
        case
        for case in load("e_aggregation")[kind]
        if not (case["group"][0]["det_id"] == case["ego_id"] and case["group"][0]["det_idx"] == 0)
    ]


@pytest.mark.parametrize("how", ["sum", "mean"])
def test_aggregation_of_verdicts(how):
    """From every evaluator's recorded evaluations, runs without colliding numbers, to the final scores."""
    evals = {(c["run"], c["frame"], c["vehicle"]): c["evals"] for c in load("c2_aggregated_evaluations")["cases"]}

    def evaluations_of(case):
        by_sender = {o["det_id"]: evals.get((case["run"], case["frame"], o["det_id"]), []) for o in case["group"]}
        return [
            [(r["eval"], r["certainty"]) for r in by_sender[o["det_id"]] if r["det_idx"] == o["det_idx"]]
            for o in case["group"]
        ]

    cases = [
        case
        for case in _recorded("pipeline")
        if case["agg_avg"] == (how == "mean")
        and not case["false_detections"]
        and all((m is None) == (not v) for m, v in zip(case["agg_eval"], evaluations_of(case), strict=True))
    ]
    world, n, worst = _world(cases, evaluations_of), 0, 0.0
    for number, method in enumerate(METHODS[2:], start=2):
        fused = fuse(*world, TrustParams(method=method, code_parity=True, code_aggregate=how))
        error = np.abs(fused.score - [case["score"][str(number)] for case in cases])
        worst, n = max(worst, error.max()), n + error.size
    print(f"aggregation of evaluations, {how}: {n} scores of {len(cases)} groups, max error {worst:.1e}")
    assert worst < 5e-6  # the vectors have six decimals


@pytest.mark.parametrize("kind", ["pipeline", "random"])
def test_aggregation(kind):
    cases = _recorded(kind)
    world = _world(cases)
    lists, objects = world[0].lists, [o for case in cases for o in case["group"]]
    # methods 0 and 1 use a certainty that in the pipeline is always a placeholder, here made from `is_self`
    usual = np.array(
        [
            all(o["detector_certainty"] == (1 if o["det_idx"] == 0 and not o.get("false_det") else -1) for o in g)
            for g in (case["group"] for case in cases)
        ]
    )
    n, n_poses, worst = 0, 0, 0.0
    for number, method in enumerate(METHODS):
        params = TrustParams(method=method, code_parity=True, code_aggregate="sum")
        fused = fuse(*world, params)
        expected = np.array([case["score"][str(number)] for case in cases])
        error = np.abs(fused.score - expected)[usual if number < 2 else slice(None)]
        worst, n = max(worst, error.max()), n + error.size
        if method not in ("corrected", "trupercept_3_corrected"):
            continue
        np.testing.assert_array_equal(fused.pose, fused.seed)  # the better pose is never output there
        ours = fuse(*world, replace(params, code_parity=False))
        at = np.empty(lists.member.size, np.int64)
        at[lists.member] = np.arange(at.size)
        for case, pose, score in zip(cases, at[ours.pose], ours.score, strict=True):
            recorded = case["wrapper_pose"][str(number)]
            if recorded is not None and score > 0:
                assert objects[pose]["t"] == recorded["t"]
                assert objects[pose]["ry"] == recorded["ry"]
                n_poses += 1
    print(f"aggregation {kind}: {n} scores, max error {worst:.1e}, {n_poses} poses, {2 * (~usual).sum()} left out")
    assert worst < 1e-6


def test_pipeline_trust():
    """From the recorded groups, counts and plausibility to vehicle trust, frame by frame."""
    runs, n, worst = load("i_pipeline_runs")["runs"], 0, 0.0
    cases = {(c["run"], c["frame"], c["evaluator"]): c for c in load("c_evaluations")["cases"]}
    for name, run in runs.items():
        vehicles = sorted(run["perspectives_in_order"])
        if not any(key[0] == name for key in cases):
            continue
        ids = np.array(vehicles)
        model = TruPercept(TrustParams(unseen="zero", freshness_s=1e6), dt_s=1.0)
        tainted = set()
        for t, frame in enumerate(run["frames"]):
            of_frame = [cases[name, frame, v] for v in vehicles if (name, frame, v) in cases]
            rows, scores = [], {}
            for case in of_frame:
                objects, evaluations, _ = _evaluated(case)
                for o, e, phi in zip(objects, evaluations.evaluation, evaluations.visibility, strict=True):
                    if o["false_det"]:
                        tainted.add(o["det_id"])  # the false detection shares its number with a real one there
                        continue
                    rows.append((case["evaluator"], o["det_id"], o["det_idx"], e, phi))
                    scores[o["det_id"], o["det_idx"]] = o["score"]
            keys = sorted(scores)
            model.open_step(
                t,
                ids,
                np.searchsorted(ids, [v for v, _ in keys]),
                np.array([k for _, k in keys]),
                np.array([scores[key] for key in keys]),
            )
            add(model, t, rows)
            got = values_of(model.scores(t), ids)
            recorded = next(r for r in run["vehicle_trust"] if r["frame"] == frame)["mem"]
            for v, trust in zip(vehicles, got, strict=True):
                if str(v) in recorded and v not in tainted:
                    worst = max(worst, abs(trust - max(0.0, recorded[str(v)]["val"])))
                    n += 1
        assert model.rejected[RejectReason.DUPLICATE] == 0
    print(f"pipeline trust: {n} values, max error {worst:.1e}")
    assert n
    assert worst < 1e-5
