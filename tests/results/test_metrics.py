"""Figures of merit, derived by hand on runs of a few rows."""

import math
import re
from inspect import signature

import numpy as np
import pandas as pd
import pytest

from cosim.addons.attacks import effects as attack
from results import study_curves
from results.figures.catalogue import FIGURES
from results.measure import measure
from results.metrics import encounters, freshness, misbehaviour, radio, traffic, trust
from results.metrics.registry import METRICS
from tests.results.tiny import fleet


def encounter(a, b, start, end, **more):
    return {"a": a, "b": b, "start_step": start, "end_step": end, "duration_s": end - start, "radius_m": 50} | more


def test_a_definition_that_counts_pedestrians_says_so():
    """Beside "all, 30 m" of vehicles alone, "all, 50 m" was not the same with a larger radius."""
    kinds = [("all", 30.0, 3.0, "buildings", False), ("all", 50.0, 3.0, "buildings", True)]
    frame = pd.DataFrame(kinds, columns=[*encounters.DEFINITION])
    assert encounters.named(frame).tolist() == ["all, 30 m", "all, 50 m, pedestrians"]
    assert encounters.named(frame[1:]).tolist() == ["all, 50 m"]


def test_kaplan_meier_by_hand(tiny):
    """Durations 1, 2, 2+, 3, 4+ (+: end not seen, so longer than 1 and 3), and one whose start was not seen.

    S(1) = 4/5; S(2) = 4/5 * 2/3 = 8/15; S(3) = 8/15 * 1/2 = 4/15. Area to 3 s: 1 + 4/5 + 8/15 = 7/3.
    """
    ends = [(1, False), (2, False), (2, True), (3, False), (4, True)]
    rows = [encounter(0, i + 1, 10, 10 + d, censored_right=c) for i, (d, c) in enumerate(ends)]
    run = tiny(20, encounters=[*rows, encounter(0, 9, 0, 15, censored_left=True)])
    curve = encounters.survival(run)
    assert curve.duration_s.tolist() == [0, 1, 2, 3]
    assert curve.survival.tolist() == pytest.approx([1, 4 / 5, 8 / 15, 4 / 15])
    assert (curve.low <= curve.survival).all() and (curve.survival <= curve.high).all()
    (row,) = encounters.summary(run).itertuples()
    assert (row.n, row.n_start_unseen, row.n_end_unseen, row.km_median_s_units) == (6, 1, 2, 5)
    assert row.km_mean_s == pytest.approx(7 / 3) and row.km_median_s == 3
    assert row.mean_s == pytest.approx((1 + 2 + 2 + 3 + 4 + 15) / 6) and not row.km_mean_s_note


def test_a_mean_of_durations_that_mostly_outlast_the_run_says_so(tiny):
    """Of four encounters one ends: the curve stays at 3/4, and the mean counts each of the others as 5 s."""
    rows = [encounter(0, i + 1, 3, 3 + d, censored_right=d == 6) for i, d in enumerate((2, 6, 6, 6))]
    (row,) = encounters.summary(tiny(20, encounters=rows)).itertuples()
    assert row.km_median_s != row.km_median_s and row.km_mean_s == 4.25
    assert row.km_mean_s_note == "75% last longer than 5 s"


def test_encounters_are_followed_as_long_as_their_end_would_be_known(tiny):
    """20 steps, and breaks of 3 s are bridged: a contact that breaks off after step 17 may go on.

    From step 5 on: one ends after 4 s; three go on after step 17, in contact, in a break, or until one leaves. One that
    begins in step 17 says nothing.
    """
    ends = {9: {}, 20: {"censored_right": True}, 18: {"censored_right": True}, 19: {"departed": True}}
    rows = [encounter(0, end, 5, end, hysteresis_s=3, **more) for end, more in ends.items()]
    run = tiny(20, encounters=[*rows, encounter(0, 1, 17, 19, censored_right=True, hysteresis_s=3)])
    curve = encounters.survival(run)
    assert curve.duration_s.tolist() == [0, 4, 12] and curve.survival.tolist() == [1, 0.75, 0.75]
    assert encounters.summary(run).km_median_s_units.tolist() == [4]
    found = study_curves.counts(run)
    assert found[["value_s", "n", "n_open"]].to_numpy().tolist() == [[4, 1, 0], [12, 0, 3]]


def test_durations_of_a_short_run_are_those_of_a_long_one(tiny):
    """Exponential contacts of 20 s on average in a run of 40 s: 61 % last longer than 10 s, and not 63 %.

    Contacts that break off in the last 3 s of the run are not known to be over.
    """
    random, n_steps, h = np.random.default_rng(3), 40, 3
    begin_s = random.uniform(0, n_steps, 20_000)
    start = np.ceil(begin_s).astype(int)
    end = np.ceil(begin_s + random.exponential(20, len(start))).astype(int)
    rows = [
        encounter(0, i, s, min(e, n_steps), hysteresis_s=h, censored_right=bool(e > n_steps - h))
        for i, (s, e) in enumerate(zip(start, end, strict=True), 1) if s < min(e, n_steps)
    ]  # fmt: skip
    curve = encounters.survival(tiny(n_steps, encounters=rows)).set_index("duration_s").survival
    assert curve.loc[1:30].to_numpy() == pytest.approx(np.exp(-np.arange(1, 31) / 20), abs=0.012)


def test_departures_as_ends_or_as_censoring(tiny):
    run = tiny(20, encounters=[encounter(0, 1, 2, 4), encounter(0, 2, 2, 8, departed=True)])
    assert encounters.survival(run).survival.iloc[-1] == 0
    assert encounters.survival(run, "censors").survival.iloc[-1] == 0.5


def test_a_radius_is_found_as_it_was_written(tiny):
    """33.3 is 33.29999923706055 in the table."""
    run = tiny(20, encounters=[encounter(0, 1, 2, 4, radius_m=33.3), encounter(0, 1, 2, 4, radius_m=60.0)])
    assert len(encounters.begun(run, 33.3)) == 1
    with pytest.raises(ValueError, match=r"no encounters with radius_m = 33.4; it has 33.3, 60\."):
        encounters.begun(run, 33.4)


def test_freshness_on_a_timeline(tiny):
    """The server computes at 5, 10, 15, 20 s; a value takes 1 s to arrive; that of 15 s is lost.

    Vehicle 1 uses it every second from 0 to 22: six defaults, ages 1-5 (from 6 s), 1-5 (from 11 s), 6-10 (no
    news at 16 s), 1, 2 (from 21 s). Sum of the 17 ages 15 + 15 + 40 + 3 = 73; peaks 5 and 10. The evaluation behind
    a value is 1 s older than the value; within a window of 6 s (age below 6) are the values up to 4 s old.
    """
    ages = [None] * 6 + [1, 2, 3, 4, 5] * 2 + [6, 7, 8, 9, 10, 1, 2]
    lookups = [
        {"step": i, "receiver": 1, "subject": 2, "source": "default", "state": "no_value"} if age is None else
        {"step": i, "receiver": 1, "subject": 2, "source": "server", "state": "evaluated" if age < 5 else "stale",
         "age_s": age, "newest_evaluation_age_s": age + 1, "oldest_evaluation_age_s": age + 3, "n_evaluations": 2,
         "n_evaluators": 1}
        for i, age in enumerate(ages)
    ]  # fmt: skip
    run = tiny(23, vehicles=fleet(*["honest"] * 3), trust_lookups=lookups)
    counts = freshness.states(run).query("role == 'all'").set_index("state").n.to_dict()
    assert counts == {"evaluated": 10, "unevaluated": 0, "stale": 7, "no value": 6}
    found = freshness.ages(run).query("role == 'all'").set_index("what")
    assert found.mean_s.to_dict() == pytest.approx({
        "value": 73 / 17, "newest evaluation": 90 / 17, "oldest evaluation": 124 / 17
    })  # fmt: skip
    assert found.median_s["value"] == 4 and found.p90_s["value"] == 8.4 and found.n_units["value"] == 1
    assert freshness.peaks(run).set_index("what").mean_s.to_dict() == {"value": 7.5, "newest evaluation": 8.5}
    assert freshness.within(run, 5).share.tolist() == pytest.approx([10 / 23, 10 / 23])
    assert freshness.behind(run).set_index("what")["mean"].to_dict() == {"evaluations": 2, "evaluators": 1}
    over_time = freshness.over_time(run, 10)
    assert over_time["no value"].tolist() == pytest.approx([0.6, 0, 0])
    assert over_time.stale.tolist() == pytest.approx([0, 0.6, 1 / 3])


def test_a_value_without_evaluation_is_no_knowledge(tiny):
    """Two lookups of unevaluated values, one evaluated: unevaluated ones have no age and count in no mean."""
    lookups = [
        {"step": s, "receiver": 0, "subject": 1, "source": "server", "state": "unevaluated", "age_s": 1} for s in (1, 2)
    ]
    lookups += [{"step": 3, "receiver": 0, "subject": 1, "source": "server", "state": "evaluated", "age_s": 2,
                 "newest_evaluation_age_s": 3, "oldest_evaluation_age_s": 3, "n_evaluations": 4}]  # fmt: skip
    run = tiny(5, vehicles=fleet("honest", "malicious"), trust_lookups=lookups)
    shares = freshness.states(run).query("role == 'malicious'").set_index("state").share
    assert shares.to_dict() == pytest.approx({"evaluated": 1 / 3, "unevaluated": 2 / 3, "stale": 0, "no value": 0})
    found = freshness.ages(run).query("role == 'all'").set_index("what")
    assert found.n.to_dict() == {"value": 3, "newest evaluation": 1, "oldest evaluation": 1}
    assert freshness.within(run, 10).share.iloc[0] == pytest.approx(1 / 3)


def test_each_step_of_0_1_s_has_a_window_of_0_1_s(tiny):
    """43 x 0.1 / 0.1 is below 43 in binary: the step is in the window of 4.3 s nevertheless."""
    lookups = [{"step": step, "receiver": 0, "subject": 1, "state": "no_value"} for step in (42, 43)]
    run = tiny(44, vehicles=fleet("honest", "honest"), trust_lookups=lookups)
    run.manifest["dt_s"] = 0.1
    assert freshness.over_time(run, 0.1).time_s.tolist() == pytest.approx([4.2, 4.3])


def test_encounters_without_trust(tiny):
    """Four directions: known at once, after 3 s, never, and not by the end of the run."""
    rows = [
        encounter(0, 1, 0, 6, trusted_after_ab_s=0.0),
        encounter(0, 1, 8, 20, trusted_after_ba_s=3.0, censored_right=True),
    ]
    (row,) = freshness.without_trust(tiny(20, vehicles=fleet("honest", "honest"), encounters=rows)).itertuples()
    assert (row.n, row.n_without, row.share, row.wait_median_s) == (4, 2, 0.5, 3)
    assert row.share_note == "1 of 2 are not over"


def test_evidence(tiny):
    newest, oldest = "newest_evaluation_age_s", "oldest_evaluation_age_s"
    rows = [
        {"step": 0, "subject": 0, "n_evaluations": 0, "state": "unevaluated"},
        {"step": 1, "subject": 0, "n_evaluations": 4, newest: 1, oldest: 9},
        {"step": 2, "subject": 0, "n_evaluations": 6, newest: 3, oldest: 11},
    ]
    (row,) = freshness.evidence(tiny(3, vehicles=fleet("honest"), trust=rows)).itertuples()
    assert (row.n, row.unevaluated_share, row.newest_s, row.oldest_s) == (3, pytest.approx(1 / 3), 2, 10)


def test_trust_by_hand(tiny):
    values = {0: [0.6, 0.8, 0.5, 0.5], 3: [0.7, 0.9, 0.4, 0.5], 7: [0.7, 0.3, 0.2, 0.5]}
    rows = [{"step": s, "subject": v, "trust": t} for s, ts in values.items() for v, t in enumerate(ts)]
    run = tiny(20, vehicles=fleet("honest", "honest", "malicious", "malicious"), trust=rows)
    last = trust.final(run).set_index("role")
    assert last["mean"].to_dict() == pytest.approx({"honest": 0.5, "malicious": 0.35})
    assert last.n.to_dict() == {"honest": 2, "malicious": 2}
    assert trust.over_time(run).query("time_s == 3 and role == 'honest'")["median"].item() == pytest.approx(0.8)
    assert trust.mean(run)["mean"].tolist() == pytest.approx([4 / 6, 2.6 / 6])


def test_trust_in_a_vehicle_is_that_in_the_pseudonym_it_has(tiny):
    """Vehicle 0 has pseudonym 9 until step 4, and 5 from then on; 7 is a further identity of vehicle 1.

    In step 6 the server goes on rating pseudonym 9. It has an evaluation of 5 from step 8 on.
    """
    used = [
        {"pseudonym": p, "vehicle": v, "identity": i, "from_step": begin, "to_step": end}
        for p, v, i, begin, end in ((9, 0, 0, 0, 3), (5, 0, 0, 4, 9), (1, 1, 0, 2, 9), (7, 1, 1, 2, 9))
    ]
    values = ((2, 9, 0.9), (6, 9, 0.8), (6, 1, 0.4), (6, 7, 0.1), (8, 5, 0.6), (8, 7, 0.2))
    rows = [{"step": s, "subject": p, "trust": t, "n_evaluations": 1} for s, p, t in values]
    rows.append({"step": 6, "subject": 5, "trust": 0.5, "state": "unevaluated"})
    run = tiny(10, vehicles=fleet("honest", "malicious"), pseudonyms=used, trust=rows)
    for step, expected in ((1, [-1]), (3, [0.9, -1]), (5, [-1, -1]), (7, [-1, 0.4]), (9, [0.6, 0.4])):
        found = trust.in_vehicles(run, step).sort_index().fillna(-1)
        assert found.tolist() == pytest.approx(expected), step


def test_trust_without_a_server(tiny):
    """Means over hearers: of vehicle 2 0.3 (0.2 and 0.4; a default says nothing), of vehicle 1 0.8, later 0.1."""
    lookups = [
        {"step": 2, "receiver": r, "subject": s, "trust": t, "source": "own", "n_evaluations": 1}
        for r, s, t in ((0, 2, 0.2), (1, 2, 0.4), (0, 1, 0.8))
    ]
    lookups += [{"step": 2, "receiver": 2, "subject": 1, "trust": 0.1, "source": "default"}]
    lookups += [{"step": 4, "receiver": 0, "subject": 1, "trust": 0.1, "source": "own", "n_evaluations": 1}]
    lookups += [{"step": 4, "receiver": 1, "subject": 1, "trust": 0.9, "source": "own", "state": "unevaluated"}]
    frame = trust.values(tiny(20, vehicles=fleet("honest", "honest", "malicious"), trust_lookups=lookups))
    assert frame[["time_s", "vehicle"]].to_numpy().tolist() == [[2, 1], [2, 2], [4, 1]]
    assert frame.trust.tolist() == pytest.approx([0.8, 0.3, 0.1])


def test_trust_without_a_server_where_vehicles_look_up_in_turns(tiny):
    """A value is the mean over a sensing interval, four steps, and has its last step with lookups: 3, 7 and 11.

    Of vehicle 2 it is 0.3 (0.2 at step 1 and 0.4 at step 3), then 0.6, then 0.6 (0.5 and 0.7, in two blocks). In every
    interval it is evaluated, though only one vehicle looks it up in a step.
    """
    vehicles = [
        vehicle | {"sensing_interval_steps": 4, "sensing_phase_steps": phase}
        for phase, vehicle in zip((1, 3, 2), fleet("honest", "honest", "malicious"), strict=True)
    ]
    vehicles[2]["attack_start_step"] = 0
    lookups = [
        {"step": step, "receiver": r, "subject": s, "trust": t, "source": "own", "n_evaluations": 1}
        for step, r, s, t in (
            (1, 0, 2, 0.2), (3, 1, 2, 0.4), (5, 0, 2, 0.6), (7, 1, 0, 0.9), (9, 0, 2, 0.5), (11, 1, 0, 0.8),
            (11, 1, 2, 0.7),
        )
    ]  # fmt: skip
    run = tiny(20, vehicles=vehicles, trust_lookups=lookups)
    frame = trust.values(run)
    assert frame[["step", "subject"]].to_numpy().tolist() == [[3, 2], [7, 0], [7, 2], [11, 0], [11, 2]]
    assert frame.trust.tolist() == pytest.approx([0.3, 0.9, 0.6, 0.8, 0.6])
    shares = misbehaviour.evaluated(run).set_index("role").share
    assert shares["malicious"] == 1 and shares["honest"] == pytest.approx(2 / 6)  # vehicle 1 is never looked up


def test_radio_by_hand(tiny):
    rows = [
        {"step": s, "n_sent": 2, "n_in_range": 4, "n_delivered": d, "n_lost_propagation": 4 - d, "cbr": 0.1}
        for s, d in enumerate((4, 2))
    ]
    pdr = [
        {"step": s, "distance_bin_m": ring, "n_in_range": 2, "n_delivered": d, "n_lost_propagation": 2 - d}
        for s, ring, d in ((0, 0, 2), (0, 25, 2), (1, 0, 2), (1, 25, 0))
    ]
    run = tiny(2, radio=rows, pdr_by_distance=pdr)
    (row,) = radio.overall(run).itertuples()
    assert (row.n_sent, row.pdr, row.lost_propagation) == (4, 0.75, 0.25)
    assert radio.over_time(run, 1).pdr.tolist() == [1, 0.5]
    by_distance = radio.by_distance(run)
    assert by_distance.distance_m.tolist() == [12.5, 37.5]
    assert by_distance.pdr.tolist() == [1, 0.5]


def test_measure_is_tidy(run):
    numbers = measure(run)
    assert list(numbers.columns) == ["metric", "group", "value", "low", "high", "n_units", "unit", "label", "note"]
    assert not numbers.metric.str.endswith("not_measured").any()
    assert not numbers.duplicated(["metric", "group"]).any()
    assert set(numbers.metric) <= set(METRICS)
    final = run.measure.value("trust.final.median", "malicious"), run.measure.value("trust.final.median", "honest")
    assert final[0] < 0.1 < 0.6 < final[1]
    assert run.measure.value("trust.final.median:honest") == final[1]
    assert run.measure(topics="traffic").metric.str.startswith("traffic.").all()
    over_time = run.measure.freshness.over_time
    assert str(signature(over_time)).startswith("(every_s: float") and over_time.__doc__ == freshness.over_time.__doc__
    with pytest.raises(ValueError, match=r"no metric 'trust\.last'"):
        run.measure.value("trust.last")


@pytest.mark.parametrize(("ask", "says"), [
    (lambda run: run.measure.value("trust.final.median"), "no group ''. Its groups are honest; unreliable; malicious."),
    (lambda run: run.measure.value("trust.final.median", "Honest"), "no group 'Honest'. Its groups are honest"),
    (lambda run: run.measure.value("radio.pdr.all", "honest"), "no group 'honest'. Its groups are none."),
    (lambda run: run.measure(false_positives=5), "false_positives = 5 is not between 0 and 1."),
    (lambda run: run.measure.misbehaviour.classification(false_positives=5), "is not between 0 and 1."),
    (lambda run: run.measure.radio.over_time(every_s=0), "every_s = 0 is not between 0.001 and inf."),
    (lambda run: run.measure.radio.over_time(every_s=np.float32(-5)), "every_s = -5 is not between 0.001 and inf."),
    (lambda run: run.measure(fresh_s="3"), "fresh_s = '3' is no number. Give one between 0 and inf."),
    (lambda run: run.measure.detection.awareness(range_m=-70), "range_m = -70 is not between 0.001 and inf."),
    (lambda run: run.measure.detection.precision(lists="local"), "lists = 'local' should be a list of names"),
    (lambda run: run.measure.detection.precision(lists=["locl"]), "There are local, fused, early."),
    (lambda run: run.measure.freshness.distribution("newest"), "There are value, newest evaluation, oldest"),
    (lambda run: run.measure.trust.in_vehicles(10**6), "step = 1000000: "),
    (lambda run: FIGURES["trust"](run), "Figures take a list of runs"),
    (lambda run: run.measure.radio.overall("CPM"), "There are cpm, evaluation."),
    (lambda run: run.measure.encounters.survival(departure="censor"), "There are ends, censors."),
])  # fmt: skip
def test_a_misspelt_question_is_refused(run, ask, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        ask(run)


@pytest.mark.parametrize(
    "ask", [encounters.survival, freshness.states, freshness.over_time, radio.overall, radio.by_distance,
            misbehaviour.roc, trust.over_time, attack.success]
)  # fmt: skip
def test_nothing_to_measure_is_one_clear_line(tiny, ask):
    with pytest.raises(ValueError) as caught:
        ask(tiny(5, vehicles=fleet("honest")))
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


def test_a_run_without_a_vehicle_has_no_lookups(tiny):
    with pytest.raises(ValueError, match="holds no trust lookups"):
        freshness.states(tiny(5))


def test_where_no_vehicle_senses_no_encounter_ends_without_trust(tiny):
    met = {"vehicles": fleet("honest", "honest"), "encounters": [encounter(0, 1, 1, 3, pairs="equipped")]}
    run = tiny(5, {"sensing": False}, **met)
    assert math.isnan(run.measure.value("freshness.encounters_without_trust.share", "equipped, 50 m"))
    with pytest.raises(ValueError, match="sensing = false, so no vehicle senses"):
        freshness.without_trust(run)


def test_a_definition_has_one_name_whichever_others_have_encounters(tiny):
    """Two definitions differ in what cuts a line of sight, and by one of them nobody met: its name is no shorter."""
    asked = [
        {"radius_m": 50.0, "hysteresis_s": 3.0, "pairs": "los", "los": los, "pedestrians": False}
        for los in ("buildings", "buildings_and_vehicles")
    ]
    rows = [encounter(0, 1, 2, 8, pairs="los", los="buildings", hysteresis_s=3)]
    run = tiny(20, config={"encounters": asked}, encounters=rows, vehicles=fleet("honest", "honest"))
    name, _ = encounters.summary(run).definition
    assert name == "los, 50 m, buildings"
    assert freshness.without_trust(run).definition.tolist() == [name]
    assert study_curves.counts(run).group.tolist() == [name]


def test_frames_are_frames(run):
    for frame in (radio.by_distance(run), freshness.distribution(run), misbehaviour.detection_delay(run)):
        assert isinstance(frame, pd.DataFrame) and len(frame)


def test_nobody_met_is_no_encounter_and_not_unknown(tiny):
    """Two vehicles are on the road for 20 s and meet within 50 m, not within 20 m: 0 per hour there, not nothing.

    If both are away for 10 s of the 20 s, they meet twice as often in the time in which they are there.
    """
    asked = {"radius_m": 20.0, "hysteresis_s": 3.0, "pairs": "equipped", "los": "buildings", "pedestrians": False}
    here = encounter(0, 1, 2, 8, pairs="equipped")
    run = tiny(20, config={"encounters": [asked]}, encounters=[here], vehicles=fleet("honest", "honest"))
    nothing, one = encounters.summary(run).itertuples()
    assert (nothing.radius_m, nothing.n, one.n) == (20, 0, 1)
    assert math.isnan(nothing.mean_s)
    assert encounters.rates(run).per_vehicle_h.tolist() == pytest.approx([0, 180])
    away = tiny(20, encounters=[here], vehicles=fleet("honest", "honest", n_steps=10))
    assert encounters.rates(away).per_vehicle_h.tolist() == pytest.approx([360])
    assert traffic.on_road(away)["mean"].tolist() == [1, 1]
