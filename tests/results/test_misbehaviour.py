"""Telling attackers from honest vehicles: by hand, against SciPy's U test, and as laws."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from cosim.addons.attacks import effects as attack
from results.figures import misbehaviour as figure
from results.measure import measure
from results.metrics import intervals, misbehaviour, trust
from tests.results.tiny import fleet

trusts = st.lists(st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.9]), min_size=1, max_size=30).map(np.array)


def attacking(roles, attack_start_step):
    vehicles = fleet(*roles)
    for vehicle, step in attack_start_step.items():
        vehicles[vehicle]["attack_start_step"] = step
    return vehicles


def values(table, unrated=()):
    return [
        {"step": s, "subject": v, "trust": t, "n_evaluations": int((s, v) not in unrated)}
        for s, ts in table.items() for v, t in enumerate(ts) if t is not None
    ]  # fmt: skip


@pytest.fixture
def town(tiny):
    """Honest 0, 1, 2, malicious 3, 4 that attack from steps 3 and 5; 2 has no value at 3 and is not rated at 5.

    Rated from step 3 on: honest 0.6 0.8 | 0.6 0.4 | 0.2 0.4 0.9; attackers (3) 0.5 | 0.3 | 0.1, (4) 0.7 | 0.3.
    """
    table = {0: [0.1, 0.1, 0.1, 0.9, 0.9], 3: [0.6, 0.8, None, 0.5, 0.2], 5: [0.6, 0.4, 0.0, 0.3, 0.7],
             7: [0.2, 0.4, 0.9, 0.1, 0.3]}  # fmt: skip
    vehicles = attacking(["honest"] * 3 + ["malicious"] * 2, {3: 3, 4: 5})
    vehicles[4]["last_step"] = 8
    return tiny(20, vehicles=vehicles, trust=values(table, unrated={(5, 2)}))


def test_classification_by_hand(town):
    """Of 7 honest values, those above 0.5, 0.3, 0.1, 0.7 and 0.3: 4 + 6 + 7 + 2 + 6 = 25 of 35 pairs.

    With one false positive in seven the threshold is the second lowest honest value, 0.4: the attackers' 0.3, 0.1
    and 0.3 are below it, 3 of 5. With none it is the lowest, 0.2.
    """
    (row,) = misbehaviour.classification(town, 0.15).to_dict("records")
    assert row["auc"] == pytest.approx(25 / 35) and row["n"] == 2
    assert (row["evaluated"], row["evaluated_honest"]) == (1, 7 / 9)
    assert row["auc_unevaluated"] == pytest.approx(25 / 40)  # the 0.0 without a evaluation is above no attacker
    assert row["threshold"] == pytest.approx(0.4)
    assert (row["true_positives"], row["false_positives"], row["suspected"]) == (3 / 5, 1 / 7, 3 / 5)
    (row,) = misbehaviour.classification(town).to_dict("records")
    assert row["threshold"] == pytest.approx(0.2) and (row["true_positives"], row["false_positives"]) == (1 / 5, 0)
    assert misbehaviour.separation(town).value == 5 / 6  # last values: 0.2, 0.4, 0.9 above 0.1, and 0.4, 0.9 above 0.3


def test_pseudonyms_of_a_vehicle_are_one_unit(tiny):
    """Twelve vehicles that change their pseudonyms after ten steps say no more than twelve that keep them."""
    random = np.random.default_rng(2)
    labels = []
    vehicles = attacking(["honest"] * 7 + ["malicious"] * 5, dict.fromkeys(range(7, 12), 1))
    level = random.uniform(0.1, 0.8, 12)
    rows = [(s, v, level[v] + 0.2 * random.random()) for s in range(20) for v in range(12)]
    found = []
    for changes in (False, True):
        name = [[v, v + 12 * changes] for v in range(12)]
        pseudonyms = [
            {"pseudonym": name[v][half], "vehicle": v, "from_step": 10 * half, "to_step": 9 if half < changes else 19}
            for v in range(12) for half in range(1 + changes)
        ]  # fmt: skip
        known = [{"step": s, "subject": name[v][s // 10], "trust": t, "n_evaluations": 9} for s, v, t in rows]
        looked = [{**row, "receiver": 0, "newest_evaluation_age_s": 1.0} for row in known if row["subject"] % 12]
        tables = {"vehicles": vehicles, "pseudonyms": pseudonyms, "trust": known, "trust_lookups": looked}
        run = tiny(20, **tables)
        table = measure(run, topics=("trust", "misbehaviour", "security"))
        found.append(table.set_index(["metric", "group"]))
        labels.append(figure.draw([run]).axes[1].get_ylabel().split("\n")[0])
    assert [label.split()[2] for label in labels] == ["vehicles", "pseudonyms"]
    of_vehicles, of_pseudonyms = found
    same = of_vehicles.index.drop([("security.precision", "pseudonym")])  # it counts last values, of each pseudonym
    units = of_vehicles.n_units[same].dropna()
    assert len(units) > 25 and units.equals(of_pseudonyms.n_units[units.index])
    for name in ("auc", "recall_at_fpr", "below_threshold.share", "at_lookup.auc", "at_lookup.suspected.share"):
        place = f"misbehaviour.{name}", "malicious"
        one, other = (table.loc[place, ["value", "low", "high"]].tolist() for table in found)
        assert one == pytest.approx(other), name


def test_curve_by_hand(town):
    curve = misbehaviour.roc(town).set_index("threshold").round(6)
    assert curve.true_positives.tolist() == [0, 0.2, 0.2, 0.6, 0.6, 0.8, 0.8, 1, 1, 1]
    assert (curve.false_positives * 7).round(4).tolist() == [0, 0, 1, 1, 3, 3, 5, 5, 6, 7]


def test_delays_by_hand(town):
    """Below 0.35: 3 after 2 s, 4 after 2 s, honest 0 after 4 s (at 7), 1 and 2 never; unrated 0 does not count."""
    delay = misbehaviour.detection_delay(town, 0.35).set_index("subject")
    assert delay.delay_s.to_dict() == {0: 4, 1: 16, 2: 16, 3: 2, 4: 2}
    assert delay.found.to_dict() == {0: True, 1: False, 2: False, 3: True, 4: True}
    ever = misbehaviour.detection_summary(town, 0.35).set_index("role")
    assert ever.share.to_dict() == pytest.approx({"honest": 1 / 3, "malicious": 1})
    assert ever.median_s["malicious"] == 2 and np.isnan(ever.median_s["honest"])


def test_suspected_by_vehicles(tiny):
    """A server's value counts where an evaluation stands behind it: behind that of step 5 there is none."""
    lookups = [
        {"step": s, "receiver": 0, "subject": 1, "trust": t, "n_evaluations": n}
        for s, t, n in ((3, 0.5, 1), (5, 0, 0), (9, 0.1, 2))
    ]
    rows = [{"step": 4, "subject": 1}]
    run = tiny(20, vehicles=attacking(["honest", "malicious"], {1: 3}), trust_lookups=lookups, trust=rows)
    assert misbehaviour.detection_delay(run, 0.25, "vehicles").set_index("subject").delay_s.to_dict() == {0: 16, 1: 6}


def test_without_a_server(tiny):
    """Means over receivers: attacker 0.3 (0.2 and 0.4), vehicle 1 0.8, later 0.1; the first below 0.25 counts."""
    lookups = [
        {"step": s, "receiver": r, "subject": v, "trust": t, "source": "own", "n_evaluations": 1}
        for s, r, v, t in ((2, 0, 2, 0.2), (2, 1, 2, 0.4), (2, 0, 1, 0.8), (4, 0, 1, 0.1))
    ]
    run = tiny(20, vehicles=attacking(["honest", "honest", "malicious"], {2: 1}), trust_lookups=lookups)
    assert misbehaviour.classification(run).auc.item() == 0.5  # 0.8 above 0.3, 0.1 not
    assert misbehaviour.below(run).set_index("role").share.to_dict() == {"honest": 0.5, "malicious": 0}
    assert misbehaviour.compared_at_lookup(run, false_positives=1.0)["recall"].value == 1, "no threshold is too high"
    found = measure(run, topics=("misbehaviour",)).set_index(["metric", "group"]).value
    assert found["misbehaviour.time_to_detection.median_s", "malicious"] == 1
    assert "misbehaviour.time_to_detection_at_vehicle.median_s" not in found.index.get_level_values(0)


def test_against_the_u_test(run):
    """From the Parquet files alone, with SciPy's U statistic."""
    who = pq.read_table(run.path / "vehicles").to_pandas().set_index("vehicle")
    table = pq.read_table(run.path / "trust").to_pandas().astype({"trust": float}).join(who, "subject")
    table = table[(table.step <= table.last_step) & (table.n_evaluations > 0)]
    honest = table.trust[(table.role == "honest") & (table.step >= who.attack_start_step.min())]
    lies = table.trust[(table.role == "malicious") & (table.step >= table.attack_start_step)]
    u = mannwhitneyu(honest, lies).statistic
    row = misbehaviour.classification(run).set_index("role").loc["malicious"]
    assert row.auc == pytest.approx(u / len(honest) / len(lies), abs=1e-12)
    assert row.threshold == pytest.approx(np.quantile(honest, 0.05, method="higher"), abs=0.02)
    assert row.false_positives <= 0.05 < (honest <= row.threshold).mean() + 1e-9


@given(trusts, trusts)
def test_laws_of_the_area(honest, lies):
    def auc(high, low):
        return intervals.auc(high, np.arange(len(high)), low, np.arange(len(low))).value

    area = auc(honest, lies)
    assert area == pytest.approx(mannwhitneyu(honest, lies).statistic / len(honest) / len(lies))
    assert area + auc(lies, honest) == pytest.approx(1)
    assert area == pytest.approx(auc(honest**2, lies**2))


@given(trusts, st.floats(0, 1))
def test_threshold_is_the_largest(honest, allowed):
    limit = misbehaviour.threshold_at(honest, allowed)
    assert (honest < limit).mean() <= allowed + 1e-9
    assert limit == np.inf or (honest <= limit).mean() > allowed - 1e-9


def test_area_is_that_under_the_curve(run):
    area = misbehaviour.classification(run).set_index("role").auc
    for role, curve in misbehaviour.roc(run).groupby("role"):
        assert np.trapezoid(curve.true_positives, curve.false_positives) == pytest.approx(area[role])


def test_none_rated(tiny):
    vehicles = attacking(["honest", "malicious"], {1: 3})
    run = tiny(20, vehicles=vehicles, trust=values({5: [0.0, 0.0]}, unrated={(5, 0), (5, 1)}))
    (row,) = misbehaviour.classification(run).to_dict("records")
    assert row["evaluated"] == row["evaluated_honest"] == 0 and row["auc_unevaluated"] == 0.5
    assert all(np.isnan(row[name]) for name in ("auc", "threshold", "true_positives", "suspected"))
    with pytest.raises(ValueError, match="no evaluations of both attackers and honest vehicles"):
        misbehaviour.roc(run)
    found = measure(run, topics=("misbehaviour",))
    assert not found.value.isna().any() and len(found)


def test_where_all_attack_only_what_needs_honest_vehicles_is_missing(tiny):
    """No honest value, no threshold of 5 % false positives; times until `suspect_below` need none."""
    vehicles = attacking(["malicious", "malicious"], {0: 3, 1: 3})
    run = tiny(20, vehicles=vehicles, trust=values({3: [0.9, 0.9], 5: [0.1, 0.9], 7: [0.1, 0.1]}))
    found = measure(run, topics=("misbehaviour",)).set_index(["metric", "group"]).value
    assert found["misbehaviour.time_to_detection.share", "malicious"] == 1
    assert not any("at_fpr" in name for name in found.index.get_level_values(0))


def test_an_attack_after_the_last_computation(tiny):
    run = tiny(20, vehicles=attacking(["honest", "malicious"], {1: 9}), trust=values({5: [0.5, 0.5]}))
    for ask in (misbehaviour.classification, misbehaviour.roc):
        with pytest.raises(ValueError, match="no evaluations of both attackers"):
            ask(run)


def test_an_attack_after_the_last_message_of_all(tiny):
    vehicles = attacking(["honest", "malicious"], {1: 9})
    out_of_use = [{"pseudonym": v, "vehicle": v, "to_step": 8} for v in (0, 1)]
    run = tiny(20, vehicles=vehicles, pseudonyms=out_of_use, trust=values({5: [0.5, 0.5]}))
    found = measure(run, topics=("misbehaviour",)).set_index("metric").group
    assert "it ends too soon after it. Run longer." in found["misbehaviour.not_measured"]


def test_no_attack(tiny):
    run = tiny(20, vehicles=fleet("honest", "honest"), trust=values({5: [0.3, 0.1]}))
    assert misbehaviour.below(run).share.tolist() == [0.5]
    with pytest.raises(ValueError, match=r"holds no attacks: no vehicle is an attacker. Add a section \[\[attacks"):
        misbehaviour.classification(run)


def test_no_attack_where_nobody_is_equipped(tiny):
    with pytest.raises(ValueError, match=r"holds no attacks: no vehicle is equipped. Raise fleet.penetration_p"):
        trust.watched(tiny(20, vehicles=fleet("honest", equipped=False)))


def test_a_vehicle_alone_has_no_trust(tiny):
    run = tiny(20, vehicles=fleet("honest"), server=[{"step": 3, "n_reports": 1, "n_reached": 1}])
    with pytest.raises(ValueError, match="there is one vehicle, which no other one evaluates"):
        trust.over_time(run)


@pytest.mark.parametrize(
    ("start_s", "why"),
    [(60.0, "the run ends at 20 s, and start_s = 60 s. Lower it, or run longer"), (5.0, "no victim was near")],
)
def test_attackers_that_never_attacked(tiny, start_s, why):
    run = tiny(20, vehicles=fleet("honest", "malicious"), trust=values({5: [0.3, 0.1]}))
    run.manifest["config"]["attacks"] = [{"start_s": start_s}]
    with pytest.raises(ValueError, match=why):
        misbehaviour.classification(run)


def open_run_without(run):
    """The same run, as if it revoked nothing."""
    return type(run)(run.path, run.manifest | {"config": {}})


def test_damage_by_hand(tiny):
    """Sweeps every 2 s. Attacker 2's ghosts: believed by 0 and 1 at step 4, by 0 at 6 with 0.4, by 3, an attacker.

    Two pairs of 2 s each; the pair with 0.4 counts at a threshold of 0.3. Attacker 3 lied, and nobody believed: half.
    """
    pairs = [(4, 2, 0, 0.9), (4, 2, 1, 0.6), (6, 2, 0, 0.4), (6, 2, 3, 0.9), (6, 3, 1, None)]
    rows = [
        {"step": s, "observer": o, "detection_index": 1, "receiver": r, "effect": "inserted", "score": x}
        for s, o, r, x in pairs
    ]
    vehicles = attacking(["honest", "honest", "malicious", "malicious"], {2: 3, 3: 3})
    run = tiny(20, config={"sensing_interval_s": 2.0}, vehicles=vehicles, attack_outcomes=rows)
    row = attack.damage(run).set_index("among").loc["received"]
    assert (row.n, row.total_s, row.per_attacker_s) == (2, 4, 2)
    assert attack.damage(run, 0.3).set_index("among").total_s["received"] == 6
