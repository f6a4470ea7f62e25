# ruff: noqa: E501 (a table is wide)
"""Every metric by its identifier: label, unit, definition and bounds.

An identifier is `<topic>.<name>` or `<topic>.<name>.<statistic>` and never changes its meaning. A metric may be split by
role, message type or definition of an encounter. `measure` then has one row per group.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from results.metrics.radio import LOST


@dataclass(frozen=True, slots=True)
class Metric:
    """A number that summarizes a run."""

    label: str
    unit: str
    """Unit; "1" for shares and ratios, empty for counts."""
    definition: str
    group: str = ""
    """What the group of a value stands for; empty if the metric has no groups."""
    unit_of_chance: str = ""
    """Units by which the interval is clustered; empty if the metric has no interval."""
    range: tuple[float, float] | None = None
    """Smallest and largest possible value. None means that the unit determines them: 0 to 1 for shares, 0 to 100 for
    per cent, and 0 or more for other units."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest possible value."""
        return self.range or {"1": (0.0, 1.0), "%": (0.0, 100.0)}.get(self.unit, (0.0, math.inf))


def bounds_of(metric: str) -> tuple[float, float]:
    """Bounds of a metric; (-inf, inf) for an unknown metric, such as a user's own."""
    return METRICS[metric].bounds if metric in METRICS else (-math.inf, math.inf)


TOPICS: Mapping[str, str] = {
    "traffic": "Amount of traffic.",
    "encounters": "Which actors were near each other, and for how long. There is one group per definition of an encounter (`encounters` of the config).",
    "trust": "Trust in pseudonyms while they are in use. The values are the rows of the table `trust` of the run's variant whose `step` is at most `to_step` of the subject in `pseudonyms`. If that table is empty (no server), the value of a step and subject is the mean of `trust` over the rows of `trust_lookups` with source `own` and `n_evaluations` above 0, at no more than 600 evenly spaced steps with lookups. No vehicle has this mean, so compare hosts by `misbehaviour.at_lookup.*` instead.",
    "misbehaviour": "How well and how soon trust distinguishes attackers from honest vehicles. A pseudonym of an attacker is watched from `attack_start_step` of its vehicle on, or from its own `from_step` if that is later. A pseudonym of an honest vehicle is watched from the first attack of any vehicle on. Both are watched until `to_step`. Earlier values are left out. A value is evaluated if `n_evaluations` is above 0. Values are pooled over subjects and steps. The threshold is `trust.suspect_below` of the run by default. A subject is suspected if its value is below the threshold and its `n_evaluations` is at least `trust.suspect_from`; without a server, the mean of `n_evaluations` over receivers. The `at_lookup` metrics use the values that vehicles look up (table `trust_lookups`) and mean the same for central and local trust. The other metrics use the values described under `trust`.",
    "security": "Trust as a classifier of attackers: confusion matrix, false exclusions, trust error. Subjects are watched as under `misbehaviour`; attackers are all whose role is not honest. A subject is excluded at a step if its `n_evaluations` is at least `trust.suspect_from` and its value is below the threshold (`trust.suspect_below`), or, for `_relative` metrics, below half of the median of the evaluated values of all watched subjects at that step.",
    "evidence": "The evidence behind trust values: how often one look counts more than once, and how often evaluations are correct. A look is one observation of one object by one vehicle in one step. Rates count evaluations of transmitted detections that honest vehicles make with visibility above 0 and without a lie. So a vehicle that finds no match but knows nothing is not counted: with `trust.denials = recall` the visibility is 0 if it would more likely than not find no match although the object is there. In a run with more than 5 million evaluations, only every n-th step counts.",
    "freshness": "The evidence behind a trust value when it is looked up, and its age (results/FRESHNESS.md). The metrics use the table `trust_lookups`, or `lookup_totals` if the run did not keep single lookups. Ages are stored to 1/1024 s.",
    "radio": "What the radio delivers, and the assumptions of the radio model.",
    "detection": "Detections and fused objects compared with ground truth. The metrics use evenly spaced steps with about 4,000 frames in total. A frame is one equipped vehicle in one step.",
    "attack": "Effects of attacks. The metrics use the rows of the table `attack_outcomes` with effect inserted, or with effect removed and not `ego_detected`, and only receivers whose role is honest. The group `received` means all pairs, and `intended` means the pairs whose receiver is a target of the attack.",
    "safety": "Traffic safety, and the reactions of drivers to objects that their vehicles believe in. The metrics use the table `actors` without pedestrians. Conflicts are defined in `results/metrics/conflicts.py` and verified against SUMO's SSM device.",
}

_ROLE, _DEFINITION, _LIST = (
    "role of the subject",
    "definition of an encounter",
    "own sensor (local), fused, or early (merged point clouds)",
)
_SAID = "Evaluations of kind detection count, with visibility above 0, of transmitted detections of other vehicles that have a `truth_actor`; in a run with more than 5 million evaluations, those whose `observer` is divisible by n."
_SHARED = "what the evaluations of a group share, beside the `observer`"
_KIND = "what is reacted to: ghost, false positive, real"
_ROLE_ALL = "role of the subject, or all"
_OBSERVER = "What an observer who knows how each role evaluates and is evaluated can tell, to stand beside `misbehaviour.auc`. It is no bound: it learns the shares from the few attackers of the run and takes clues for independent, so a trust model can exceed it. Clues are the rows of the table `evaluations` with `visibility` above 0 whose evaluator is not the observer. Each counts for both, if watched at its step (see `misbehaviour`). x is `evaluation` times `visibility`, with bins that end at -0.95, -0.5, -0.1, 0, 0.1, 0.5, 0.95 and 1 (ends included). The cell of a clue is, for its observer: received, `kind`, bin of x, role of the evaluator (honest or not). For its evaluator: made, `kind`, bin of x, role of the observer, and whether the mean x of the other rows about the same detection and kind in this step is below 0, 0 or above, or there is none. Only honest subjects and those of the group's role count. Each attacker is compared with each honest subject, by the sum over its clues of log(p / q). Here p is the share of the clue's cell in the clues of the attackers but this one plus m, and q that of the honest subjects but this one plus m; m, per cell that occurs, is the count over all subjects but this attacker (for q, this honest subject), plus 1/2, over their number. The value is the share of pairs in which the attacker's sum is above, ties counting half, or that of the means per clue, whichever is larger. There is no value with fewer than two subjects of either. In a run with more than 5 million evaluations, only every n-th step counts."
_RECEIVERS = "vehicles that look up"
_SUCCESS = "score threshold, among, role of the attacker"
_ATTACKERS = "attackers"
_IN_WORDS = "description in words"
_RATE = "what is evaluated: self report, true detection (a box of the detector that belongs to an actor), false positive (a box that belongs to no actor), fabricated; alone, or with the evaluator, class, visibility, distance, or role of the sender"
_KM = "Kaplan-Meier estimate: subjects without such a value are censored at the end of the time in which they are watched. The value is missing if the curve does not fall to one half"
_AGED = "over all lookups that have this age, pooled"
_CAPPED = "over all lookups, with W for each lookup whose `newest_evaluation_age_s` is null. W is the window `trust.freshness_s` of the run's variant, or `steps` of the manifest times `dt_s` if that is off. A value of W means at least W."
_EXACT = "Interpolated linearly between two order statistics, as numpy.quantile does; exact."

# fmt: off
METRICS: Mapping[str, Metric] = {
    "traffic.duration_s": Metric("recorded time", "s", "Steps of the run times `dt_s` of the manifest, without the warm-up."),
    "traffic.actors.mean": Metric("actors on the road, mean", "", "Sum over actors of (last_step - first_step + 1), divided by the number of steps of the run. Pedestrians are included.", "all, or equipped vehicles"),
    "traffic.equipped.n": Metric("equipped vehicles", "", "Equipped vehicles that were on the road at any time.", "role"),
    "encounters.n": Metric("encounters", "", "Rows of `encounters`, including encounters that had begun before recording or had not ended after it.", _DEFINITION),
    "encounters.censored_left.share": Metric("start not observed", "1", "Share of encounters with `censored_left`: they had begun when recording began.", _DEFINITION, "actors"),
    "encounters.censored_right.share": Metric("end not observed", "1", "Share of encounters with `censored_right`: their end was not observed before recording ended.", _DEFINITION, "actors"),
    "encounters.duration.mean_s": Metric("duration, mean as recorded", "s", "Mean of `duration_s`. It is too short if many encounters are censored.", _DEFINITION, "actors"),
    "encounters.duration.median_s": Metric("duration, median as recorded", "s", "Median of `duration_s`. It is too short if many encounters are censored.", _DEFINITION),
    "encounters.duration.km_mean_s": Metric("duration, mean (Kaplan-Meier)", "s", "Area under the Kaplan-Meier curve of `duration_s` up to the longest duration observed (restricted mean). Encounters with `censored_left` are left out, and encounters with `censored_right` are censored. A departure is an observed end.", _DEFINITION),
    "encounters.duration.km_median_s": Metric("duration, median (Kaplan-Meier)", "s", "First duration at which the same curve is one half or less. The value is missing if the curve stays above one half.", _DEFINITION, "encounters"),
    "encounters.per_vehicle_h": Metric(
        "encounters per vehicle and hour", "1/h",
        "2 n / T. n is the number of encounters without `censored_left`: those that begin while it is recorded. T is "
        "the time that vehicles which can have one are on the road [h]: sum of (`last_step` - `first_step` + 1) times "
        "`dt_s` over the rows of `vehicles` that are `equipped` (`pairs` equipped or los), else over all vehicles, and "
        "pedestrians too if the definition counts them. An encounter counts for both of its vehicles.", _DEFINITION,
    ),
    "encounters.again.share": Metric("repeated encounters", "1", "Share of encounters whose `gap_s` is not null. These are not the first encounter of their pair.", _DEFINITION, "actors"),
    "trust.final.median": Metric("final trust, median", "1", "Median over pseudonyms of the last trust value of each while it is in use.", _ROLE, "subjects"),
    "trust.final.mean": Metric("final trust, mean", "1", "Mean over pseudonyms of the same values.", _ROLE, "subjects"),
    "trust.run.mean": Metric("trust, mean over the run", "1", "Mean of all values of all pseudonyms while in use.", _ROLE, "subjects"),
    "misbehaviour.below_threshold.share": Metric("values below the threshold", "1", "Share of all values of pseudonyms in use that are below the threshold. It covers the whole run and includes values that are not watched or not evaluated.", _ROLE, "subjects"),
    "misbehaviour.below_threshold.evaluated_share": Metric("evaluated values below the threshold", "1", "The same share of the values that are evaluated.", _ROLE, "subjects"),
    "misbehaviour.attackers.n": Metric("attackers", "", "Pseudonyms of this role that are watched at a step with values. They need not have a value themselves.", _ROLE),
    "misbehaviour.evaluated.share": Metric("evaluated, share of the time", "1", "Share of all pairs (step with values, subject watched at this step) in which the subject has an evaluated value. Without a server, the steps are those with lookups; see `trust`.", _ROLE),
    "misbehaviour.auc": Metric("honest above attacker (AUC)", "1", "Probability that an evaluated value of a watched honest subject is above one of a watched subject of this role; ties count half. This is the area under the ROC curve. Honest values count from the first attack of any vehicle on. 1 means complete separation and 0.5 means chance. Without a server the values are means over receivers; see `misbehaviour.at_lookup.auc`.", _ROLE, "subjects"),
    "misbehaviour.auc_unevaluated": Metric("AUC, values without an evaluation included", "1", "The same probability for all values of watched subjects, evaluated or not.", _ROLE, "subjects"),
    "misbehaviour.auc_final": Metric("honest above malicious at the end", "1", "The same probability for the last evaluated value of each watched subject, honest against malicious.", "", "subjects"),
    "misbehaviour.fpr_threshold": Metric("threshold at the false positive rate", "1", "Sort the n evaluated values of watched honest subjects in ascending order and take the value number floor(p n) + 1, where p is the given false positive rate (0.05). At most the share p of the values is below it.", range=(0.0, math.inf)),
    "misbehaviour.recall_at_fpr": Metric("recall at the false positive rate", "1", "Share of the evaluated values of watched subjects of this role below that threshold.", _ROLE, "subjects"),
    "misbehaviour.suspected_at_fpr.share": Metric("suspected, share of the time", "1", "Share of all pairs (step with values, watched subject of this role) in which the subject is suspected at that threshold.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection.median_s": Metric("time to detection, median (Kaplan-Meier)", "s", f"Time from the first step in which a subject is watched to its first value by which it is suspected. With a server, its values count; without one, the first such value that any vehicle looks up. {_KM}.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection.share": Metric("ever suspected", "1", "Share of watched subjects that have such a value.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection_at_fpr.median_s": Metric("time to detection at the false positive rate, median (Kaplan-Meier)", "s", "The same time, with `misbehaviour.fpr_threshold` as the threshold.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection_at_fpr.share": Metric("ever suspected at the false positive rate", "1", "Share of watched subjects that are ever suspected at that threshold.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection_at_vehicle.median_s": Metric("time to detection at the first vehicle, median (Kaplan-Meier)", "s", "The same time, but until any vehicle first looks up a value by which the subject is suspected. Only with a server.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection_at_vehicle.share": Metric("ever suspected at a vehicle", "1", "Share of watched subjects for which a vehicle ever looked up such a value.", _ROLE, "subjects"),
    "misbehaviour.at_lookup.auc": Metric("honest above attacker at lookup (AUC)", "1", "Probability that an evaluated value of a watched honest subject, as a vehicle looks it up, is above one of a watched subject of this role; ties count half. All lookups of all vehicles count. The definition is the same for central and local trust. The result is exact unless there are more than 2 million different pairs of subject and value. Then values are rounded to 1/4096, and a note gives the largest possible error of the AUC.", _ROLE, "subjects"),
    "misbehaviour.at_lookup.evaluated.share": Metric("lookups with an evaluation", "1", "Share of the lookups of watched subjects with `n_evaluations` above 0.", _ROLE, "subjects"),
    "misbehaviour.at_lookup.suspected.share": Metric("suspected at lookup", "1", "Share of the lookups of watched subjects in which the subject is suspected.", _ROLE, "subjects"),
    "misbehaviour.at_lookup.time_to_detection.median_s": Metric("time to detection per receiver, median (Kaplan-Meier)", "s", "A pair is a vehicle and a subject that it looks up while the subject is watched. The time runs from the first such lookup to the first one in which the subject is suspected. Pairs without such a value are censored at their last lookup. The value is missing if the Kaplan-Meier curve does not fall to one half.", _ROLE),
    "misbehaviour.at_lookup.time_to_detection.share": Metric("pairs in which the receiver ever suspects", "1", "Share of these pairs in which the vehicle looks up such a value.", _ROLE, "subjects"),
    **{
        f"security.{name}{suffix}": Metric(f"{label}{', relative threshold' if suffix else ''}", "1", f"{text} In the group value, each pair (step with values, watched subject) counts. In the group vehicle, only the last such step of each subject counts. In the group message, each message with detections of a watched subject counts: it is positive if a detection in it has `lied`, and excluded if its sender was excluded at the last step with values up to the step of the message.", "value, vehicle, or message", "subjects" if name in ("precision", "recall", "fpr") else "", (-1.0, 1.0) if name in ("mcc", "informedness") else None)
        for suffix in ("", "_relative")
        for name, label, text in (
            ("precision", "precision", "Share of the excluded that are positive."),
            ("recall", "recall", "Share of the positive that are excluded."),
            ("fpr", "false positive rate", "Share of the negative that are excluded."),
            ("f1", "F1", "2 TP / (2 TP + FP + FN)."),
            ("mcc", "Matthews correlation", "(TP TN - FP FN) / sqrt((TP + FP)(TP + FN)(TN + FP)(TN + FN)): 0 is chance."),
            ("informedness", "informedness", "Recall minus false positive rate: 0 is chance."),
        )
    },
    "security.average_precision": Metric("average precision", "1", "Sum of precision times the increase of recall over all thresholds, which are the evaluated values of watched subjects in ascending order. A value is excluded if it is at or below the threshold, and positive if its subject attacks. The denominator of recall is all pairs (step with values, watched attacker), evaluated or not."),
    "security.false_exclusions_per_h": Metric("false exclusions", "1/h", "Number of times that a watched honest subject becomes excluded, divided by the total watched time of these subjects. A subject becomes excluded if it is excluded at a step with values and was not at the one before, or if it is excluded at the first. The watched time runs from the first to the last such step.", "", "subjects"),
    "security.false_exclusions_per_h_relative": Metric("false exclusions, relative threshold", "1/h", "The same at the relative threshold.", "", "subjects"),
    "security.time_to_exclusion.median_s": Metric("time to exclusion, median (Kaplan-Meier)", "s", "Time of a vehicle from the first step in which one of its pseudonyms is watched to the first `refused_step` of one of them, when receivers begin to drop its messages because it was revoked. It is 0 if that happened earlier. Vehicles without a `refused_step` are censored at the last step in which they are watched. Only with pseudonyms.revocation.", _ROLE, "vehicles"),
    "security.time_to_exclusion.share": Metric("ever revoked", "1", "Share of these vehicles that have a `refused_step`.", _ROLE, "vehicles"),
    "security.trust_error": Metric("trust error", "1", "Mean distance of the evaluated values of watched subjects from 1 (honest) or 0 (all others).", _ROLE, "subjects"),
    "evidence.trust.multiplicity": Metric("evaluations per look", "1", "Sum of `n_evaluations` over sum of `n_looks` of the table `evidence`: evaluations of others' detections with visibility above 0, divided by the number of distinct looks (evaluator, observer, actual object) behind them. It is 1 if no look counts twice in a trust value.", range=(0.0, math.inf)),
    "evidence.fused.multiplicity": Metric("evaluations per evaluator of a fused object", "1", "Sum of `n_evaluations` over sum of `n_evaluators` of the table `fused_evidence`: how often one look counts in a sum over members and evaluators. Models that score objects give each vehicle one vote.", range=(0.0, math.inf)),
    "evidence.echoes.share": Metric("echoes", "1", "Sum of `n_echoes` over sum of `n_evaluations` of the table `evidence`: evaluations by which an attacker confirms what another attacker fabricated."),
    "evidence.copies_per_evaluation": Metric("copies set aside per evaluation", "1", "Sum of `n_copies` over sum of `n_evaluations` of the table `evidence`: copies of messages that receivers already had and that count nowhere.", range=(0.0, math.inf)),
    "evidence.fused.evaluators.mean": Metric("evaluators behind a fused object, mean", "", "Sum of `n_evaluators` of the table `fused_evidence` over the number of rows of the table `fused`, of the run's variant."),
    "evidence.repeats.distinct.share": Metric("distinct observations per evaluation", "1", f"Number of distinct triples (vehicle of `evaluator`, `observer`, `truth_actor` of the detection), counted once in each step, in each span of 10 s, or in the run, over the number of evaluations. {_SAID}", "span of time: step, 10 s, run"),
    "evidence.repeats.agreement.kappa": Metric("agreement beyond chance", "1", f"A is the share of the ordered pairs of evaluations of one group that agree on whether they deny (`evaluation` below 0); C is the same share for two evaluations drawn from all these pairs: (A - C) / (1 - C). A group holds the evaluations with the same triple (same evaluator, object), with the same vehicle of `evaluator` and `observer` (same evaluator), or with the same `observer`, `truth_actor` and step, by different evaluators (same object, step). Of a triple in a step, the first row counts. It is 0 by chance, and 1 if a group is of one mind. {_SAID}", _SHARED, range=(-1.0, 1.0)),
    "evidence.repeats.effective.share": Metric("effective number per evaluation", "1", f"Sum over the groups of n / (1 + (n - 1) k), over the sum of n; n is the number of evaluations of a group and k its kappa, at least 0: n evaluations with correlation k are worth so many independent ones. {_SAID}", _SHARED),
    "evidence.denied.share": Metric("evaluations that deny", "1", "Share of the evaluations with `evaluation` below 0: the detection matches none of the evaluator's own. Only detections of other vehicles count, except in the groups that name the evaluator.", _RATE, "evaluators"),
    "evidence.confirmed.share": Metric("evaluations that confirm", "1", "Share of the same evaluations with `evaluation` above 0.", _RATE, "evaluators"),
    "evidence.denied_unseen.share": Metric("denials that are misses of the evaluator's detector", "1", "Share of the denials of self reports and true detections in which the evaluator's own list holds, in that step, no sensed detection of that actor (`truth_actor`). In the other denials it has one that is too far from the box to match.", "self report or true detection", "evaluators"),
    "evidence.no_actor.share": Metric("boxes that are no actor's", "1", "Share of boxes without an actor (`truth_actor` is null) among the boxes of the detector that honest vehicles send (origin sensed, transmitted, not lied).", "class, or all", "senders"),
    "evidence.auc_bound": Metric("attacker above honest for an observer that learns from the run (AUC)", "1", f"{_OBSERVER} The observer knows the roles of all vehicles but the one that it judges. It is at least `evidence.auc_bound_alone`.", _ROLE, "subjects"),
    "evidence.auc_bound_alone": Metric("the same, roles of the others unknown (AUC)", "1", "The same probability if `role` is left out of the cells.", _ROLE, "subjects"),
    "freshness.server_unevaluated.share": Metric("server's values without an evaluation", "1", "Share of the rows of `trust` whose `state` is not `judged`: values of the server that, when computed, have no evaluation by another vehicle that could see.", _ROLE),
    "freshness.server_newest_evaluation.median_s": Metric("newest evaluation at the server, median age", "s", "Median of `newest_evaluation_age_s` over the other rows of `trust`.", _ROLE),
    "freshness.encounters_without_trust.share": Metric("encounters over before trust was known", "1", "Share of encounters of equipped vehicles whose `trusted_after_ab_s` (or `_ba_s`) is null. One vehicle then never looked up a value for the other that rests on an evaluation. Both directions count separately.", _DEFINITION, "vehicles that would know"),
    "freshness.wait_in_encounter.median_s": Metric("wait for trust in an encounter, median", "s", "Median of the same columns over the directions in which they are above 0. In these directions there was no such value at the start of the encounter, and one came later.", _DEFINITION),
    "freshness.lookup_state.share": Metric("what stands behind a value looked up", "1", "Share of all lookups in each state. Evaluated: there is an evaluation within the window by a vehicle other than the subject that could see. Stale: there are such evaluations, but all are older than the window. Unevaluated: there is a value without such an evaluation. No value: none arrived or was computed, and the default is used.", "state, role of the subject or all", _RECEIVERS),
    "freshness.evaluation_within.share": Metric("evaluation at most fresh_s old", "1", "Share of all lookups with `newest_evaluation_age_s` not null and at most fresh_s (10 s by default), whatever the window.", _ROLE_ALL, _RECEIVERS),
    "freshness.capped_age.mean_s": Metric("age of trust over all lookups, mean", "s", f"Mean of min(`newest_evaluation_age_s`, W) {_CAPPED}", _ROLE_ALL),
    "freshness.capped_age.median_s": Metric("age of trust over all lookups, median", "s", f"Median of min(`newest_evaluation_age_s`, W) {_CAPPED} {_EXACT}", _ROLE_ALL),
    "freshness.capped_age.p90_s": Metric("age of trust over all lookups, 90th percentile", "s", f"90th percentile of min(`newest_evaluation_age_s`, W) {_CAPPED} {_EXACT}", _ROLE_ALL),
    "freshness.value_age.mean_s": Metric("age of the value at lookup, mean", "s", f"Mean of `age_s` {_AGED}: lookup time minus the time when the value was computed. It is 0 for own values, which are computed when they are looked up. Lookups without a value are left out.", _ROLE_ALL, _RECEIVERS),
    "freshness.value_age.median_s": Metric("age of the value at lookup, median", "s", f"Median of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.value_age.p90_s": Metric("age of the value at lookup, 90th percentile", "s", f"90th percentile of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.value_age.peak_s": Metric("age of the value at lookup, peak", "s", "Peak age at use. Take each two successive lookups of a subject by a vehicle that both find a server's value. The second finds it renewed if `step * dt_s - age_s` is larger than at the first by more than half a step. The metric is the mean of `age_s` at the first lookup of these pairs, over the whole run. Own values have no peak.", "", _RECEIVERS),
    "freshness.newest_evaluation_age.mean_s": Metric("newest evaluation at lookup, mean age", "s", f"Mean of `newest_evaluation_age_s` {_AGED}: lookup time minus the time of the sweep in which the newest evaluation was made, by a vehicle other than the subject that could see.", _ROLE_ALL, _RECEIVERS),
    "freshness.newest_evaluation_age.median_s": Metric("newest evaluation at lookup, median age", "s", f"Median of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.newest_evaluation_age.p90_s": Metric("newest evaluation at lookup, 90th percentile", "s", f"90th percentile of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.newest_evaluation_age.peak_s": Metric("newest evaluation at lookup, peak age", "s", "As `freshness.value_age.peak_s`, but of `newest_evaluation_age_s` and for all values.", "", _RECEIVERS),
    **{
        name: metric
        for what, column, kind in (
            ("value", "age_s", "a server's value"),
            ("newest_evaluation", "newest_evaluation_age_s", "any value with an evaluation"),
        )
        for name, metric in (
            (f"freshness.{what}_age_over_time.mean_s", Metric(f"age of the {what.replace('_', ' ')} over time, mean", "s", f"Time average of the age of what a vehicle knows of a subject (Kaul et al. 2012); over time this age is a sawtooth. Take each two successive lookups of a subject by a vehicle that are at most 3 s apart, or at most two sensing intervals if these are longer, and whose first finds {kind}. The metric is the sum of (a + d / 2) d divided by the sum of d, where a is `{column}` at the first lookup and d the time between both. A renewal counts from the lookup that finds it, so the metric is an upper bound and at most d too large.", "", _RECEIVERS)),
            (f"freshness.{what}_age_over_time.peak_s", Metric(f"age of the {what.replace('_', ' ')} over time, peak", "s", f"Mean peak of the same sawtooth (Costa et al. 2014): mean of a + d over those pairs whose second lookup finds a renewal, as in `freshness.{what}_age.peak_s`.", "", _RECEIVERS)),
        )
    },
    "freshness.oldest_evaluation_age.mean_s": Metric("oldest evaluation at lookup, mean age", "s", f"Mean of `oldest_evaluation_age_s` {_AGED}.", _ROLE_ALL, _RECEIVERS),
    "freshness.oldest_evaluation_age.median_s": Metric("oldest evaluation at lookup, median age", "s", f"Median of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.oldest_evaluation_age.p90_s": Metric("oldest evaluation at lookup, 90th percentile", "s", f"90th percentile of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.evaluations.mean": Metric("evaluations behind a value, mean", "", "Mean of `n_evaluations` over lookups with `newest_evaluation_age_s` not null.", "", _RECEIVERS),
    "freshness.evaluators.mean": Metric("evaluators behind a value, mean", "", "Mean of `n_evaluators` over the same lookups, where it is not null.", "", _RECEIVERS),
    "radio.condition.model": Metric("medium", "", "Model of the medium (radio.model).", _IN_WORDS),
    "radio.condition.range": Metric("communication range", "m", "Largest distance of one hop (radio.range_m)."),
    "radio.condition.max_hops": Metric("hops at most", "", "Hops that a message may travel (radio.relay.max_hops)."),
    "radio.condition.penetration": Metric("penetration", "1", "Share of the vehicles of these classes that are equipped (fleet.penetration_p).", "classes"),
    "radio.condition.loss_per_hop": Metric("flat loss per hop", "1", "Probability of loss of one hop, whatever the distance (unit disk)."),
    "radio.condition.path_loss": Metric("path loss", "", "Path loss model.", _IN_WORDS),
    "radio.condition.receiver_threshold": Metric("receiver threshold", "dBm", "Smallest power and SINR at which a receiver can decode a frame.", _IN_WORDS, range=(-math.inf, math.inf)),
    "radio.condition.nlos": Metric("non-line-of-sight model", "", "Model of the loss by buildings.", _IN_WORDS),
    "radio.condition.fading": Metric("fading", "", "Fading model.", _IN_WORDS),
    "radio.condition.dcc": Metric("congestion control", "", "Decentralized congestion control.", _IN_WORDS),
    "radio.sent.n": Metric("frames sent", "", "Sum of `n_sent` of the table `radio`: frames, forwarded copies included."),
    "radio.pdr.all": Metric("packet delivery ratio", "1", "Sum of `n_delivered` over sum of `n_in_range` of the table `radio`: share of (frame, receiver) pairs within communication range in which the frame was received."),
    "radio.pdr.cpm": Metric("packet delivery ratio, CPM", "1", "The same ratio for collective perception messages."),
    "radio.pdr.evaluation": Metric("packet delivery ratio, evaluations", "1", "The same ratio for the second round: evaluations and broadcasts of roadside units."),
    "radio.pdr_by_los": Metric("packet delivery ratio by line of sight", "1", "The same ratio of the table `pdr_by_distance`, by line of sight between the two ends: los, nlos, unknown.", "line of sight"),
    **{
        f"radio.lost.{name.removeprefix('n_lost_')}": Metric(f"lost: {name.removeprefix('n_lost_').replace('_', ' ')}", "1", f"Sum of `{name}` over sum of `n_in_range` of the table `radio`.")
        for name in LOST
    },
    "radio.cbr.mean": Metric("channel busy ratio, mean", "1", "Mean of `cbr` over the rows of the table `radio` (step and message type). Each row is a mean over vehicles. The value is missing if the medium does not model it."),
    "radio.latency.median_s": Metric("latency, median", "s", "Upper edge of the first bin of `latency_histogram`, both message types together, up to which at least half of the messages were received. Successive bin edges differ by a factor of sqrt(2), so the value is at most 41 % too large."),
    "radio.latency.p95_s": Metric("latency, 95th percentile", "s", "The same for 95 % of the messages."),
    "radio.pir.mean_s": Metric("packet inter-reception time, mean", "s", "Mean of `pir_steps` times `dt_s` over `n_received`, of CPMs in `packet_inter_reception`: time between successive CPMs of one vehicle at another while within range. Censored intervals (`n_censored`) are left out."),
    "radio.pir.after_loss.share": Metric("intervals with a loss", "1", "Share of the same intervals that are at least two sensing intervals long: at least one CPM was lost."),
    "radio.lost_in_a_row.mean": Metric("messages lost in a row, mean", "", "Mean, over the intervals with a loss, of their length in whole sensing intervals minus 1."),
    "radio.cpm_rate.mean_hz": Metric("detection messages, rate", "1/s", "Rows of `cpm_content` with `length_bytes` above 0, over the time that equipped vehicles are on the road: sum of (`last_step` - `first_step` + 1) times `dt_s` over the rows of `vehicles` with `equipped`."),
    "radio.cpm_objects.mean": Metric("objects per detection message, mean", "", "Mean of `n_included` over the rows of `cpm_content` with `length_bytes` above 0. Self reports are not counted."),
    "radio.cpm_length.mean_bytes": Metric("length of detection messages, mean", "B", "Mean of `length_bytes` over the same rows: with headers, and with evaluations where messages carry them."),
    "radio.cpm_left_out.share": Metric("objects left out of detection messages", "1", "Sum of `n_waiting`, `n_not_due`, `n_redundant` or `n_over_limit` over sum of `n_objects`, over all rows of `cpm_content`.", "reason: waiting, not due, redundant, over limit"),
    "radio.clouds_offered.mean_mbps": Metric("point clouds offered", "Mb/s", "Sum of `length_bytes` of the table `clouds` times 8e-6, over the time that equipped vehicles are on the road, as for `radio.cpm_rate.mean_hz`: what one vehicle would send. Only with [early_fusion]."),
    "radio.clouds_delivered.mean_mbps": Metric("point clouds delivered", "Mb/s", "Sum of `length_bytes` times `n_received` times 8e-6, over the same time: what one vehicle receives in whole sweeps from within `early_fusion.range_m`."),
    "radio.clouds_complete.share": Metric("sweeps that arrive whole", "1", "Sum of `n_received` over sum of `n_in_range` of the table `clouds`."),
    "radio.server_reports.reached.share": Metric("reports that reach the server", "1", "Sum of `n_reached` and `n_late` over sum of `n_reports` of the table `server`."),
    "radio.server_reports.lost.share": Metric("reports lost", "1", "Sum of `n_lost` without `n_late` over sum of `n_reports`: lost on the way, or received by no roadside unit."),
    "radio.server_reports.over_capacity.share": Metric("reports over capacity", "1", "Sum of `n_over_capacity` over sum of `n_reports`: dropped because the capacity of their cell was used up."),
    "radio.server_reports.outage.share": Metric("reports lost in an outage", "1", "Sum of `n_outage` over sum of `n_reports`: lost because the server was out of service."),
    "radio.server_broadcasts.reached.share": Metric("broadcasts that reach vehicles", "1", "Sum of `n_informed` over sum of `n_addressed` of the table `server`: share of (broadcast of trust values, vehicle on the road) pairs in which it is received."),
    "detection.ap40": Metric("AP 3D, 40 recall points", "%", "Average precision by KITTI's rules at 40 recall points (overlap of 0.7 in 3D for cars and trucks, 0.5 for others), ranked over all sampled frames together. A frame holds what is in the forward 90 degrees of the vehicle up to 140 m; occlusion above 20 % is level 1, above 50 % level 2. Levels with fewer than 41 objects are left out.", "list, class, level"),
    "detection.awareness_70m.share": Metric("environmental awareness within 70 m", "1", "Share of the pairs (equipped vehicle, other actor within 70 m of it) in the sampled sweeps of the vehicle after which its list has a box of this actor (`truth_actor`) with a score of at least 0.5. For the own sensor, only boxes of origin sensed count.", _LIST),
    "safety.driven_km": Metric("vehicle-kilometres", "km", "Sum of `speed_mps` times `dt_s` over all rows of `actors`, without pedestrians."),
    "safety.travel_time.s_per_km": Metric("travel time per kilometre", "s/km", "Vehicle-seconds on the road per vehicle-kilometre. The difference between two runs of the same traffic is the delay."),
    "safety.hard_braking.per_km": Metric("hard braking", "1/km", "Events per vehicle-kilometre. An event begins at a deceleration (difference of `speed_mps` of successive steps divided by `dt_s`) of at least 3 m/s2 minus the resolution of recorded speeds (1/256 m/s divided by `dt_s`). It ends below 1 m/s2."),
    "safety.emergency_braking.per_km": Metric("emergency braking", "1/km", "The same with 4.5 m/s2 or more."),
    "safety.ttc.per_km": Metric("conflicts by time to collision", "1/km", "Episodes of a vehicle and its leader (nearest ahead within 50 m, heading within 45 degrees, footprint in the straight extension of the own) with a time to collision (gap over closing speed) below 3 s, per vehicle-kilometre. Steps at most 1 s apart with a time to collision below 3 s or a deceleration to avoid a crash above 3 m/s2 are one episode."),
    "safety.drac.per_km": Metric("conflicts by deceleration to avoid a crash", "1/km", "Those of the same episodes in which a deceleration of more than 3 m/s2 is needed to avoid a crash (closing speed squared divided by twice the gap)."),
    "safety.pet.per_km": Metric("conflicts by post-encroachment time", "1/km", "Pairs of vehicles on crossing paths (more than 30 degrees apart) whose smallest post-encroachment time is below 2 s, per vehicle-kilometre."),
    "safety.near_misses.per_km": Metric("near misses", "1/km", "Episodes with a time to collision, and pairs with a post-encroachment time, below 1 s, per vehicle-kilometre."),
    "safety.collisions.n": Metric("overlapping vehicles", "", "Pairs of vehicles whose footprints overlapped by more than 0.3 m while one of them moved faster than 0.5 m/s. SUMO's own count of collisions is in the manifest."),
    "safety.stops.per_km": Metric("stops", "1/km", "Number of times that a vehicle became slower than 0.1 m/s after it was faster than 2 m/s, per vehicle-kilometre."),
    "safety.reactions.n": Metric("reactions", "", "Episodes in which a driver got a command because of an object that its vehicle believes in. Rows of `reactions` of one vehicle and kind that are at most 1 s apart are one episode. Reactions to ghosts and false positives are false alarms.", _KIND),
    "safety.reactions.per_km": Metric("reactions per kilometre", "1/km", "Number of these episodes per vehicle-kilometre of all vehicles.", _KIND),
    "safety.reactions_hard.per_km": Metric("hard reactions", "1/km", "Number of these episodes with a commanded deceleration of 3 m/s2 or more, per vehicle-kilometre.", _KIND),
    "safety.speed_taken.mean_mps": Metric("speed taken by a reaction", "m/s", "Mean over reactions of the sum of `deceleration_mps2` (where positive) times `dt_s`: the cost of a false alarm, or the benefit of a warning.", _KIND),
    "safety.wave.vehicles.mean": Metric("braking wave, vehicles", "", "Mean over reactions of 2 m/s2 or more of the number of vehicles behind, one after the other, that braked as hard within 20 s.", _KIND),
    "safety.wave.length.mean_m": Metric("braking wave, length", "m", "Mean distance from the vehicle that reacted to the last vehicle of the wave; 0 if no vehicle behind braked.", _KIND),
    "attack.believed.share": Metric("fabricated objects believed", "1", "Share of the pairs (fabricated detection, honest vehicle that received it) whose `score` is at least the threshold: the vehicle's fused objects contain it.", _SUCCESS, _ATTACKERS),
    "attack.believed.pairs.n": Metric("pairs behind it", "", "Number of these pairs: the denominator.", "among, role of the attacker"),
    "attack.believed_by_any.share": Metric("fabricated objects believed by any", "1", "Share of the fabricated detections (step, observer, detection_index) with at least one such pair for which at least one pair has a `score` of at least the threshold. It grows with the number of receivers.", "score threshold, role of the attacker", _ATTACKERS),
    "attack.believed_duration.mean_s": Metric("believed for, mean", "s", "Mean length of the periods of successive sensing steps in which an honest vehicle has a pair of one attacker with a `score` of at least 0.5. Each step counts as one sensing interval.", "among, role of the attacker", _ATTACKERS),
    "attack.false_in_path.share": Metric("believed false box in the path", "1", "Share of the (honest vehicle, step) with at least one pair in which a pair has `in_path` (a straight strip of the vehicle's width, 50 m ahead) and a `score` of at least 0.5.", "among", "vehicles"),
    "attack.false_in_path.boxes_mean": Metric("believed false boxes in the path, mean", "", "Mean number of these pairs per (honest vehicle, step) with a pair.", "among"),
    "attack.damage.total_s": Metric("damage", "s", "Believed ghosts x seconds x victims: pairs with a `score` of at least 0.5, times the sensing interval.", "among, role of the attacker"),
    "attack.damage.per_attacker_s": Metric("damage per attacker", "s", "The same, divided by the number of attackers with a pair.", "among, role of the attacker", _ATTACKERS),
    "attack.missing.share": Metric("withheld objects missing", "1", "Share of the pairs (withheld detection of a real actor, honest vehicle that received the message without it and did not detect the actor itself) whose `score` is null or below the threshold.", _SUCCESS, _ATTACKERS),
    "attack.missing.pairs.n": Metric("pairs behind it", "", "Number of these pairs: the denominator.", "among, role of the attacker"),
    **{f"{topic}.not_measured": Metric("not measured", "", "The run does not contain the data; the group gives the reason.", "reason") for topic in TOPICS},
}
# fmt: on

CORE: tuple[str, ...] = (
    "encounters.duration.km_median_s",
    "encounters.per_vehicle_h",
    "freshness.newest_evaluation_age.mean_s:all",
    "freshness.evaluation_within.share:all",
    "freshness.encounters_without_trust.share",
    "trust.final.median",
    "misbehaviour.at_lookup.auc:malicious",
    "radio.pdr.all",
)
"""The eight metrics to read first, each as `identifier` or `identifier:group`.

How long equipped vehicles meet, and how often. How old the trust is that they use, how often it is fresh, and how often
an encounter is over before there is any. What honest and malicious vehicles are trusted, and how well trust tells them
apart. How much of what is sent arrives. The age is a mean, because ages move in whole steps: the medians of replicates
are often equal, and leave no spread to judge by.
"""
