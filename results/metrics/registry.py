# ruff: noqa: E501 (a table is wide)
"""Every metric by its identifier: label, unit, definition and bounds, said once.

An identifier is `<topic>.<name>` or `<topic>.<name>.<statistic>` and never changes its meaning. What a metric is split
by (role, message type, definition of an encounter) stands beside it, as the group of a row of `measure`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from results.metrics.radio import LOST


@dataclass(frozen=True, slots=True)
class Metric:
    """A number that a run is summed up by."""

    label: str
    unit: str
    """Unit; "1" for shares and ratios, empty for counts."""
    definition: str
    group: str = ""
    """What its group names; empty where it has none."""
    unit_of_chance: str = ""
    """What its interval is clustered by; empty where it has none."""
    range: tuple[float, float] | None = None
    """Smallest and largest value it can have, where its unit does not say: 0 to 1 for shares, 0 to 100 for per cent,
    and 0 or more for all else."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest value that it can have."""
        return self.range or {"1": (0.0, 1.0), "%": (0.0, 100.0)}.get(self.unit, (0.0, math.inf))


def bounds_of(metric: str) -> tuple[float, float]:
    """Bounds of a metric; none for one that is not known, as a user's own."""
    return METRICS[metric].bounds if metric in METRICS else (-math.inf, math.inf)


TOPICS: Mapping[str, str] = {
    "traffic": "What was driven.",
    "encounters": "Who was near whom, and for how long. One group per definition of an encounter (`encounters` of the config).",
    "trust": "Trust in pseudonyms while they are in use: rows of the table `trust` of the run's variant whose `step` is at most `to_step` of the subject in `pseudonyms`. Where that table is empty (no server), the mean of `trust` over the rows of `trust_lookups` of a step and subject with source `own` and `n_evaluations` above 0, at 600 steps with lookups at most, evenly spread; no vehicle holds that mean, so compare hosts by `misbehaviour.at_lookup.*` instead.",
    "misbehaviour": "How well and how soon attackers are told from honest vehicles by trust. A pseudonym of an attacker is watched from `attack_start_step` of its vehicle on, or from its own `from_step` if that is later; pseudonyms of honest vehicles from the first attack of any vehicle on; both until `to_step`. Trust before is left out. A value is evaluated if `n_evaluations` is above 0. Values are pooled over subjects and steps. The threshold is 0.25 unless told otherwise. `at_lookup` metrics take what vehicles look up (table `trust_lookups`) and are the same for central and local trust; the others take the values described under `trust`.",
    "security": "Trust as a classifier of attackers: confusion matrix, false exclusions, trust error. Subjects are watched as under `misbehaviour`; attackers are all whose role is not honest. A subject is excluded at a step if its value is evaluated and below the threshold (0.25), or, for `_relative` metrics, below half of the median of the evaluated values of all watched subjects at that step.",
    "evidence": "What trust values are computed from: how often one look counts more than once, and how right evaluations are. Rates are of evaluations that honest vehicles make with visibility above 0 and without a lie, of detections that were sent; of a run with more than 5 million evaluations, those of every n-th step.",
    "freshness": "What stands behind trust when it is looked up, and how old it is (results/FRESHNESS.md): table `trust_lookups`, or `lookup_totals` where single lookups were not kept. Ages are stored to 1/1024 s.",
    "radio": "What the radio delivers, beside the assumptions that this rests on.",
    "detection": "Detections and fused objects against ground truth, on steps spread evenly so that there are about 4,000 frames (an equipped vehicle in a step).",
    "attack": "What attacks achieve: table `attack_outcomes`, rows with effect inserted, or with effect removed and not `ego_detected`; of receivers whose role is honest. A group says `received` for all pairs, `intended` for those with a receiver that the attack aims at.",
    "safety": "What drivers suffer, and what those brake for who react to what their vehicles believe. From table `actors`, pedestrians left out; definitions of conflicts in `results/metrics/conflicts.py`, verified against SUMO's SSM device.",
}

_ROLE, _DEFINITION, _LIST = "role of the subject", "definition of an encounter", "own sensor (local) or fused"
_KIND = "what is reacted to: ghost, false positive, real"
_ROLE_ALL = "role of the subject, or all"
_RECEIVERS = "vehicles that look up"
_SUCCESS = "score threshold, among, role of the attacker"
_ATTACKERS = "attackers"
_IN_WORDS = "what it is, in words"
_RATE = "what is evaluated: self report, true detection (a box of the detector that is an actor's), false positive (one that is no actor's), fabricated; alone, or with the evaluator, class, visibility, distance, or role of the sender"
_KM = "Kaplan-Meier: subjects that are not found count as long as they are watched, and the value is missing where the curve does not fall to one half"
_AGED = "of all lookups that have that age, pooled"
_EXACT = "Linear between the two order statistics around it, as numpy.quantile; exact."

# fmt: off
METRICS: Mapping[str, Metric] = {
    "traffic.duration_s": Metric("recorded time", "s", "Steps of the run times `dt_s` of the manifest; warm-up left out."),
    "traffic.actors.mean": Metric("actors on the road, mean", "", "Sum over actors of (last_step - first_step + 1), over the steps of the run; pedestrians included.", "all, or equipped vehicles"),
    "traffic.equipped.n": Metric("equipped vehicles", "", "Equipped vehicles that were on the road at any time.", "role"),
    "encounters.n": Metric("encounters", "", "Rows of `encounters`: those under way at the beginning or at the end included.", _DEFINITION),
    "encounters.censored_left.share": Metric("start not observed", "1", "Share of encounters with `censored_left`: under way when recording began.", _DEFINITION, "actors"),
    "encounters.censored_right.share": Metric("end not observed", "1", "Share of encounters with `censored_right`: not known to be over when recording ended.", _DEFINITION, "actors"),
    "encounters.duration.mean_s": Metric("duration, mean as recorded", "s", "Mean of `duration_s`; too short where many are censored.", _DEFINITION, "actors"),
    "encounters.duration.median_s": Metric("duration, median as recorded", "s", "Median of `duration_s`; too short where many are censored.", _DEFINITION),
    "encounters.duration.km_mean_s": Metric("duration, mean (Kaplan-Meier)", "s", "Area under the Kaplan-Meier curve of `duration_s` up to the longest duration observed (restricted mean). Encounters with `censored_left` are left out, those with `censored_right` are censored, departures are ends.", _DEFINITION),
    "encounters.duration.km_median_s": Metric("duration, median (Kaplan-Meier)", "s", "First duration at which the same curve is one half or less; missing where it stays above.", _DEFINITION, "encounters"),
    "encounters.again.share": Metric("repeated encounters", "1", "Share of encounters whose `gap_s` is not null: not the first of their pair.", _DEFINITION, "actors"),
    "trust.final.median": Metric("final trust, median", "1", "Median over pseudonyms of the last value of each while in use.", _ROLE, "subjects"),
    "trust.final.mean": Metric("final trust, mean", "1", "Mean over pseudonyms of the same values.", _ROLE, "subjects"),
    "trust.run.mean": Metric("trust, mean over the run", "1", "Mean of all values of all pseudonyms while in use.", _ROLE, "subjects"),
    "misbehaviour.below_threshold.share": Metric("values below the threshold", "1", "Share of all values while in use that are below the threshold, over the whole run, whether watched or not, evaluated or not.", _ROLE, "subjects"),
    "misbehaviour.below_threshold.evaluated_share": Metric("evaluated values below the threshold", "1", "The same share of the values that are evaluated.", _ROLE, "subjects"),
    "misbehaviour.attackers.n": Metric("attackers", "", "Pseudonyms of this role that are watched at a step with values, whether they have a value or not.", _ROLE),
    "misbehaviour.evaluated.share": Metric("evaluated, share of the time", "1", "Of all pairs (step with values, subject watched at it): the share in which the subject has an evaluated value. Without a server, steps with lookups; see `trust`.", _ROLE),
    "misbehaviour.auc": Metric("honest above attacker (AUC)", "1", "Probability that an evaluated value of a watched honest subject is above one of a watched subject of this role, ties counting half: the area under the ROC curve. Honest values count from the first attack of any vehicle on. 1 separates all, 0.5 none. Without a server these are means over receivers: see `misbehaviour.at_lookup.auc`.", _ROLE, "subjects"),
    "misbehaviour.auc_unevaluated": Metric("AUC, values without an evaluation included", "1", "The same of all values of watched subjects, evaluated or not.", _ROLE, "subjects"),
    "misbehaviour.auc_final": Metric("honest above malicious at the end", "1", "The same of the last evaluated value of each watched subject, honest against malicious.", "", "subjects"),
    "misbehaviour.fpr_threshold": Metric("threshold at the false positive rate", "1", "Of the n evaluated values of watched honest subjects in ascending order, that number floor(p n) + 1, where p is the given false positive rate (0.05): at most the share p is below it.", range=(0.0, math.inf)),
    "misbehaviour.recall_at_fpr": Metric("recall at the false positive rate", "1", "Share of the evaluated values of watched subjects of this role below that threshold.", _ROLE, "subjects"),
    "misbehaviour.suspected_at_fpr.share": Metric("suspected, share of the time", "1", "Of all pairs (step with values, watched subject of this role): the share in which it has an evaluated value below that threshold.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection.median_s": Metric("time to detection, median (Kaplan-Meier)", "s", f"Time from the step since which a subject is watched to its first evaluated value below the threshold: of the server's values; without a server, of the first vehicle that looks one up. {_KM}.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection.share": Metric("ever suspected", "1", "Share of watched subjects that have such a value.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection_at_fpr.median_s": Metric("time to detection at the false positive rate, median (Kaplan-Meier)", "s", "The same time with `misbehaviour.fpr_threshold` as threshold.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection_at_fpr.share": Metric("ever suspected at the false positive rate", "1", "Share of watched subjects that have a value below that threshold.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection_at_vehicle.median_s": Metric("time to detection at the first vehicle, median (Kaplan-Meier)", "s", "The same time to the first lookup, by any vehicle, of an evaluated value below the threshold; only where there is a server.", _ROLE, "subjects"),
    "misbehaviour.time_to_detection_at_vehicle.share": Metric("ever suspected at a vehicle", "1", "Share of watched subjects of which a vehicle ever looked up such a value.", _ROLE, "subjects"),
    "misbehaviour.at_lookup.auc": Metric("honest above attacker at lookup (AUC)", "1", "Probability that an evaluated value of a watched honest subject, as a vehicle looks it up, is above one of a watched subject of this role, ties counting half; over all lookups of all vehicles. The same for central and local trust. Exact, unless there are more than 2 million different pairs of subject and value: then values are rounded to 1/4096, and a note says by how much the AUC may be off.", _ROLE, "subjects"),
    "misbehaviour.at_lookup.evaluated.share": Metric("lookups with an evaluation", "1", "Share of the lookups of watched subjects with `n_evaluations` above 0.", _ROLE, "subjects"),
    "misbehaviour.at_lookup.suspected.share": Metric("suspected at lookup", "1", "Share of the lookups of watched subjects that are evaluated and below the threshold.", _ROLE, "subjects"),
    "misbehaviour.at_lookup.time_to_detection.median_s": Metric("time to detection per receiver, median (Kaplan-Meier)", "s", "Over pairs of a vehicle and a subject that it looks up while the subject is watched: time from the first such lookup to the first one that is evaluated and below the threshold. Pairs without count up to their last lookup (censored); missing where the Kaplan-Meier curve does not fall to one half.", _ROLE),
    "misbehaviour.at_lookup.time_to_detection.share": Metric("pairs in which the receiver ever suspects", "1", "Share of these pairs with such a lookup.", _ROLE, "subjects"),
    **{
        f"security.{name}{suffix}": Metric(f"{label}{', relative threshold' if suffix else ''}", "1", f"{text} Of group value, each pair (step with values, watched subject) counts; of vehicle, the last such step of each subject; of message, each message with detections of a watched subject: positive if a detection in it has `lied`, excluded if its sender was at the last step with values up to its own.", "value, vehicle, or message", "subjects" if name in ("precision", "recall", "fpr") else "", (-1.0, 1.0) if name in ("mcc", "informedness") else None)
        for suffix in ("", "_relative")
        for name, label, text in (
            ("precision", "precision", "Share of the excluded that are positive."),
            ("recall", "recall", "Share of the positive that are excluded."),
            ("fpr", "false positive rate", "Share of the others that are excluded."),
            ("f1", "F1", "2 TP / (2 TP + FP + FN)."),
            ("mcc", "Matthews correlation", "(TP TN - FP FN) / sqrt((TP + FP)(TP + FN)(TN + FP)(TN + FN)): 0 is chance."),
            ("informedness", "informedness", "Recall less false positive rate: 0 is chance."),
        )
    },
    "security.average_precision": Metric("average precision", "1", "Sum over thresholds (every evaluated value of a watched subject, ascending) of precision times the growth of recall: a value is excluded if it is at or below the threshold, positive if its subject attacks. Recall is over all pairs (step with values, watched attacker), evaluated or not."),
    "security.false_exclusions_per_h": Metric("false exclusions", "1/h", "Times that a watched honest subject becomes excluded (excluded at a step with values and not at the one before, or at the first), over the sum of their times from first to last such step.", "", "subjects"),
    "security.false_exclusions_per_h_relative": Metric("false exclusions, relative threshold", "1/h", "The same at the relative threshold.", "", "subjects"),
    "security.time_to_exclusion.median_s": Metric("time to exclusion, median (Kaplan-Meier)", "s", "Over vehicles: time from the step since which the first of its pseudonyms is watched to the first `refused_step` of one of them, when receivers drop its messages because it was revoked; 0 if it was before. Vehicles without one count until the last step in which they are watched (censored). Only with pseudonyms.revocation.", _ROLE, "vehicles"),
    "security.time_to_exclusion.share": Metric("ever revoked", "1", "Share of these vehicles that have one.", _ROLE, "vehicles"),
    "security.trust_error": Metric("trust error", "1", "Mean distance of the evaluated values of watched subjects from 1 (honest) or 0 (all others).", _ROLE, "subjects"),
    "evidence.trust.multiplicity": Metric("evaluations per look", "1", "Sum of `n_evaluations` over sum of `n_looks` of the table `evidence`: evaluations with visibility above 0 of others' detections, over the distinct looks (evaluator, observer, actual object) behind them. 1 if no look counts twice in a trust value.", range=(0.0, math.inf)),
    "evidence.fused.multiplicity": Metric("evaluations per evaluator of a fused object", "1", "Sum of `n_evaluations` over sum of `n_evaluators` of the table `fused_evidence`: how often one look counts in a sum over members and evaluators. Models that score objects give each vehicle one vote.", range=(0.0, math.inf)),
    "evidence.echoes.share": Metric("echoes", "1", "Sum of `n_echoes` over sum of `n_evaluations` of the table `evidence`: evaluations by which an attacker confirms what another attacker fabricated."),
    "evidence.copies_per_evaluation": Metric("copies set aside per evaluation", "1", "Sum of `n_copies` over sum of `n_evaluations` of the table `evidence`: copies of messages that receivers already had and that count nowhere.", range=(0.0, math.inf)),
    "evidence.denied.share": Metric("evaluations that deny", "1", "Share of the evaluations with `evaluation` below 0: the detection matches none of the evaluator's own. Of another vehicle's detections, but for the groups that name the evaluator.", _RATE, "evaluators"),
    "evidence.confirmed.share": Metric("evaluations that confirm", "1", "Share of the same evaluations with `evaluation` above 0.", _RATE, "evaluators"),
    "evidence.denied_unseen.share": Metric("denials that are misses of the evaluator's detector", "1", "Share of the denials of self reports and true detections in which the evaluator's own list holds, in that step, no sensed detection of that actor (`truth_actor`). In the others it has one that lies too far from the box to match.", "self report or true detection", "evaluators"),
    "evidence.no_actor.share": Metric("boxes that are no actor's", "1", "Share of the detector's boxes that honest vehicles send (origin sensed, transmitted, not lied) whose `truth_actor` is null.", "class, or all", "senders"),
    "freshness.server_unevaluated.share": Metric("server's values without an evaluation", "1", "Share of the rows of `trust` whose `state` is not judged: values of the server, when it computes them, without an evaluation by another vehicle that could see.", _ROLE),
    "freshness.server_newest_evaluation.median_s": Metric("newest evaluation at the server, median age", "s", "Median of `newest_evaluation_age_s` over the other rows of `trust`.", _ROLE),
    "freshness.encounters_without_trust.share": Metric("encounters over before trust was known", "1", "Share of encounters of equipped vehicles, both directions counted, whose `trusted_after_ab_s` (or `_ba_s`) is null: one never looked up a value for the other that rests on an evaluation.", _DEFINITION, "vehicles that would know"),
    "freshness.wait_in_encounter.median_s": Metric("wait for trust in an encounter, median", "s", "Median of the same columns over the directions in which they are above 0: of those that had no such value at the start and got one.", _DEFINITION),
    "freshness.lookup_state.share": Metric("what stands behind a value looked up", "1", "Share of all lookups in each state: evaluated (an evaluation within the window, by another vehicle than the subject that could see), stale (such evaluations, all older than the window), unevaluated (a value without any), no value (none arrived or was computed; the default is used).", "state, role of the subject or all", _RECEIVERS),
    "freshness.evaluation_within.share": Metric("evaluation at most fresh_s old", "1", "Share of all lookups with `newest_evaluation_age_s` not null and at most fresh_s (10 s unless told), whatever the window.", _ROLE_ALL, _RECEIVERS),
    "freshness.value_age.mean_s": Metric("age of the value at lookup, mean", "s", f"Mean of `age_s` {_AGED}: lookup time minus the time when the value was computed; 0 for own values, which are computed when they are looked up; lookups without a value are left out.", _ROLE_ALL, _RECEIVERS),
    "freshness.value_age.median_s": Metric("age of the value at lookup, median", "s", f"Median of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.value_age.p90_s": Metric("age of the value at lookup, 90th percentile", "s", f"90th percentile of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.value_age.peak_s": Metric("age of the value at lookup, peak", "s", "Peak age at use. Of each two successive lookups of a subject by a vehicle, both of a server's value, the second finds it renewed if `step * dt_s - age_s` is larger than at the first (by more than half a step). The mean of `age_s` at the first of each such two, over the whole run. Own values have none.", "", _RECEIVERS),
    "freshness.newest_evaluation_age.mean_s": Metric("newest evaluation at lookup, mean age", "s", f"Mean of `newest_evaluation_age_s` {_AGED}: lookup time minus the time of the sweep that the newest evaluation judges, by another vehicle than the subject that could see.", _ROLE_ALL, _RECEIVERS),
    "freshness.newest_evaluation_age.median_s": Metric("newest evaluation at lookup, median age", "s", f"Median of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.newest_evaluation_age.p90_s": Metric("newest evaluation at lookup, 90th percentile", "s", f"90th percentile of the same ages. {_EXACT}", _ROLE_ALL),
    "freshness.newest_evaluation_age.peak_s": Metric("newest evaluation at lookup, peak age", "s", "As `freshness.value_age.peak_s`, of `newest_evaluation_age_s` of any value.", "", _RECEIVERS),
    **{
        name: metric
        for what, column, kind in (
            ("value", "age_s", "a server's value"),
            ("newest_evaluation", "newest_evaluation_age_s", "any value with an evaluation"),
        )
        for name, metric in (
            (f"freshness.{what}_age_over_time.mean_s", Metric(f"age of the {what.replace('_', ' ')} over time, mean", "s", f"Time average of the sawtooth that the age of what a vehicle knows of a subject describes (Kaul et al. 2012). Over each two successive lookups of a subject by a vehicle that lie at most 3 s, or two sensing intervals where these are longer, apart, of which the first is of {kind}: sum of (a + d / 2) d over sum of d, where a is `{column}` at the first and d the time between them. A renewal counts from the lookup that finds it: an upper bound, by at most d.", "", _RECEIVERS)),
            (f"freshness.{what}_age_over_time.peak_s", Metric(f"age of the {what.replace('_', ' ')} over time, peak", "s", f"Mean peak of the same sawtooth (Costa et al. 2014): mean of a + d over those of these pairs of lookups at whose second one it is renewed, as of `freshness.{what}_age.peak_s`.", "", _RECEIVERS)),
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
    "radio.condition.receiver_threshold": Metric("receiver threshold", "dBm", "Least power and SINR that a receiver decodes.", _IN_WORDS, range=(-math.inf, math.inf)),
    "radio.condition.nlos": Metric("non-line-of-sight model", "", "Loss by buildings.", _IN_WORDS),
    "radio.condition.fading": Metric("fading", "", "Fading model.", _IN_WORDS),
    "radio.condition.dcc": Metric("congestion control", "", "Decentralized congestion control.", _IN_WORDS),
    "radio.sent.n": Metric("frames sent", "", "Sum of `n_sent` of the table `radio`: frames, forwarded copies included."),
    "radio.pdr.all": Metric("packet delivery ratio", "1", "Sum of `n_delivered` over sum of `n_in_range` of the table `radio`: share of (frame, receiver) pairs within communication range in which the frame was received."),
    "radio.pdr.cpm": Metric("packet delivery ratio, CPM", "1", "The same of collective perception messages."),
    "radio.pdr.evaluation": Metric("packet delivery ratio, evaluations", "1", "The same of the second round: evaluations, and broadcasts of roadside units."),
    "radio.pdr_by_los": Metric("packet delivery ratio by line of sight", "1", "The same ratio of the table `pdr_by_distance`, by line of sight between the two ends: los, nlos, unknown.", "line of sight"),
    **{
        f"radio.lost.{name.removeprefix('n_lost_')}": Metric(f"lost: {name.removeprefix('n_lost_').replace('_', ' ')}", "1", f"Sum of `{name}` over sum of `n_in_range` of the table `radio`.")
        for name in LOST
    },
    "radio.cbr.mean": Metric("channel busy ratio, mean", "1", "Mean of `cbr` over the rows of the table `radio` (step and message type), each a mean over vehicles; missing where not modelled."),
    "radio.latency.median_s": Metric("latency, median", "s", "Upper edge of the first bin of `latency_histogram`, both message types together, up to which at least half of the messages were received; the bins are sqrt(2) wide, so it is at most 41 % too large."),
    "radio.latency.p95_s": Metric("latency, 95th percentile", "s", "The same of 95 %."),
    "radio.pir.mean_s": Metric("packet inter-reception time, mean", "s", "Mean of `pir_steps` times `dt_s` over `n_received`, of CPMs in `packet_inter_reception`: time between successive CPMs of one vehicle at another while within range; intervals cut off (`n_censored`) are left out."),
    "radio.pir.after_loss.share": Metric("intervals with a loss", "1", "Share of the same intervals that are at least two sensing intervals long: at least one CPM was lost."),
    "radio.lost_in_a_row.mean": Metric("messages lost in a row, mean", "", "Mean over the intervals with a loss of their length in whole sensing intervals, less 1."),
    "radio.server_reports.reached.share": Metric("reports that reach the server", "1", "Sum of `n_reached` over sum of `n_reports` of the table `server`."),
    "radio.server_reports.lost.share": Metric("reports lost", "1", "Sum of `n_lost` over sum of `n_reports`: lost on the way, or received by no roadside unit."),
    "radio.server_reports.over_capacity.share": Metric("reports over capacity", "1", "Sum of `n_over_capacity` over sum of `n_reports`: dropped because the capacity of their cell was used up."),
    "radio.server_reports.outage.share": Metric("reports lost in an outage", "1", "Sum of `n_outage` over sum of `n_reports`: lost because the server was out of service."),
    "radio.server_broadcasts.reached.share": Metric("broadcasts that reach vehicles", "1", "Sum of `n_informed` over sum of `n_addressed` of the table `server`: share of (broadcast of trust values, vehicle on the road) pairs in which it is received."),
    "detection.ap40": Metric("AP 3D, 40 recall points", "%", "Average precision by KITTI's rules at 40 recall points (overlap of 0.7 in 3D for cars and trucks, 0.5 for others), ranked over all sampled frames together. A frame holds what is in the forward 90 degrees of the vehicle up to 140 m; occlusion above 20 % is level 1, above 50 % level 2. Levels with fewer than 41 objects are left out.", "list, class, level"),
    "detection.awareness_70m.share": Metric("environmental awareness within 70 m", "1", "Of pairs (equipped vehicle, other actor within 70 m of it) of the sampled steps: share in which the vehicle's list holds a box with `truth_actor` that actor and a score of at least 0.5; of the own sensor, of origin sensed.", _LIST),
    "safety.driven_km": Metric("vehicle-kilometres", "km", "Sum of `speed_mps` times `dt_s` over all rows of `actors`, pedestrians left out."),
    "safety.travel_time.s_per_km": Metric("travel time per kilometre", "s/km", "Vehicle-seconds on the road per vehicle-kilometre; delay is the difference between two runs of the same traffic."),
    "safety.hard_braking.per_km": Metric("hard braking", "1/km", "Events per vehicle-kilometre: one begins at a deceleration (difference of `speed_mps` of successive steps over `dt_s`) of 3 m/s2 or more, less the resolution of recorded speeds (1/256 m/s over `dt_s`), and ends below 1 m/s2."),
    "safety.emergency_braking.per_km": Metric("emergency braking", "1/km", "The same with 4.5 m/s2 or more."),
    "safety.ttc.per_km": Metric("conflicts by time to collision", "1/km", "Episodes of a vehicle and its leader (nearest ahead within 50 m, heading within 45 degrees, footprint in the straight extension of the own) with a time to collision (gap over closing speed) below 3 s, per vehicle-kilometre. Steps at most 1 s apart with a time to collision below 3 s or a deceleration to avoid a crash above 3 m/s2 are one episode."),
    "safety.drac.per_km": Metric("conflicts by deceleration to avoid a crash", "1/km", "Of the same episodes, those in which more than 3 m/s2 (closing speed squared over twice the gap) would avoid a crash."),
    "safety.pet.per_km": Metric("conflicts by post-encroachment time", "1/km", "Pairs of vehicles on crossing ways (more than 30 degrees apart) with a least post-encroachment time below 2 s, per vehicle-kilometre."),
    "safety.near_misses.per_km": Metric("near misses", "1/km", "Episodes with a time to collision, and pairs with a post-encroachment time, below 1 s, per vehicle-kilometre."),
    "safety.collisions.n": Metric("overlapping vehicles", "", "Pairs of vehicles whose footprints were in each other by more than 0.3 m while one moved faster than 0.5 m/s; SUMO's own count of collisions is in the manifest."),
    "safety.stops.per_km": Metric("stops", "1/km", "Times that a vehicle became slower than 0.1 m/s after more than 2 m/s, per vehicle-kilometre."),
    "safety.reactions.n": Metric("reactions", "", "Episodes in which a driver was commanded because of what its vehicle believes: rows of `reactions` of one vehicle and kind at most 1 s apart; those to ghosts and false positives are false alarms.", _KIND),
    "safety.reactions.per_km": Metric("reactions per kilometre", "1/km", "The same per vehicle-kilometre of all vehicles.", _KIND),
    "safety.reactions_hard.per_km": Metric("hard reactions", "1/km", "Of these, with a commanded deceleration of 3 m/s2 or more.", _KIND),
    "safety.speed_taken.mean_mps": Metric("speed taken by a reaction", "m/s", "Mean over reactions of the sum of `deceleration_mps2` (where positive) times `dt_s`: the cost of a false alarm, or the use of a warning.", _KIND),
    "safety.wave.vehicles.mean": Metric("braking wave, vehicles", "", "Mean over reactions of 2 m/s2 or more of the number of drivers behind them who braked as hard within 20 s, one behind the other.", _KIND),
    "safety.wave.length.mean_m": Metric("braking wave, length", "m", "Mean distance from the vehicle that reacted to the last of them, 0 where there is none.", _KIND),
    "attack.believed.share": Metric("fabricated objects believed", "1", "Share of the pairs (fabricated detection, honest vehicle that received it) whose `score` is at least the threshold: the vehicle's fused objects hold it.", _SUCCESS, _ATTACKERS),
    "attack.believed.pairs.n": Metric("pairs behind it", "", "Number of these pairs: the denominator.", "among, role of the attacker"),
    "attack.believed_by_any.share": Metric("fabricated objects believed by any", "1", "Share of the fabricated detections (step, observer, detection_index) with such a pair of which one has a `score` of at least the threshold; it grows with the number of receivers.", "score threshold, role of the attacker", _ATTACKERS),
    "attack.believed_duration.mean_s": Metric("believed for, mean", "s", "Mean length of the stretches of successive sensing steps in which an honest vehicle has a pair with a `score` of at least 0.5 of one attacker; each step counts for one sensing interval.", "among, role of the attacker", _ATTACKERS),
    "attack.false_in_path.share": Metric("believed false box in the path", "1", "Of (honest vehicle, step) with a pair: share in which one of them has `in_path` (a straight strip of the vehicle's width, 50 m ahead) and a `score` of at least 0.5.", "among", "vehicles"),
    "attack.false_in_path.boxes_mean": Metric("believed false boxes in the path, mean", "", "Mean number of these pairs per (honest vehicle, step) with a pair.", "among"),
    "attack.damage.total_s": Metric("damage", "s", "Believed ghosts x seconds x victims: pairs with a `score` of at least 0.5, times the sensing interval.", "among, role of the attacker"),
    "attack.damage.per_attacker_s": Metric("damage per attacker", "s", "The same over the attackers with a pair.", "among, role of the attacker", _ATTACKERS),
    "attack.missing.share": Metric("withheld objects missing", "1", "Share of the pairs (withheld detection of a real actor, honest vehicle that received the message without it and did not detect the actor itself) whose `score` is null or below the threshold.", _SUCCESS, _ATTACKERS),
    "attack.missing.pairs.n": Metric("pairs behind it", "", "Number of these pairs: the denominator.", "among, role of the attacker"),
    **{f"{topic}.not_measured": Metric("not measured", "", "The run cannot answer; the group says why.", "reason") for topic in TOPICS},
}
# fmt: on

RENAMED: Mapping[str, str] = {
    "misbehaviour.rated.share": "misbehaviour.evaluated.share",
    "misbehaviour.auc_unrated": "misbehaviour.auc_unevaluated",
    "misbehaviour.below_threshold.rated_share": "misbehaviour.below_threshold.evaluated_share",
    "freshness.server_unjudged.share": "freshness.server_unevaluated.share",
}
"""Metrics that had another identifier in studies of earlier versions, and their present one."""
RENAMED_STATES: Mapping[str, str] = {"judged": "evaluated", "unjudged": "unevaluated", "default": "no value"}
"""The same of the states in groups of `freshness.lookup_state.share`."""


def present_names(frame: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Measures with present names in place of earlier ones (columns metric and group), and what was renamed."""
    states = (frame.metric == "freshness.lookup_state.share") & frame.group.str.split(",").str[0].isin(RENAMED_STATES)
    old = sorted(set(frame.metric) & set(RENAMED)) + sorted(set(frame.group[states]))
    group = frame.group.copy()
    group[states] = [
        ",".join((RENAMED_STATES[first], *rest)) for first, *rest in frame.group[states].str.split(",")
    ]  # fmt: skip
    return frame.assign(metric=frame.metric.replace(dict(RENAMED)), group=group), old
