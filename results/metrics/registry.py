# ruff: noqa: E501 (a table is wide)
"""Every metric by its identifier: label, unit and definition, said once.

An identifier is `<topic>.<name>` or `<topic>.<name>.<statistic>` and never changes its meaning. What a metric is split
by (role, message type, definition of an encounter) stands beside it, as the group of a row of `measure`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

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


TOPICS: Mapping[str, str] = {
    "traffic": "What was driven.",
    "encounters": "Who was near whom, and for how long.",
    "trust": "Trust in pseudonyms.",
    "misbehaviour": "How well and how soon attackers are told from honest vehicles by trust.",
    "security": "Trust as a classifier of attackers: confusion matrix, false exclusions, trust error.",
    "evidence": "How often one look counts more than once on its way into trust values and fused scores.",
    "freshness": "What stands behind trust when it is looked up, and how old it is (results/FRESHNESS.md).",
    "radio": "What the radio delivers, beside the assumptions that this rests on.",
    "detection": "Detections and fused objects against ground truth.",
    "attack": "What attacks achieve.",
    "safety": "What drivers suffer, and what those brake for who react to what their vehicles believe.",
}

_ROLE, _DEFINITION, _MESSAGE_TYPE, _LIST = (
    "role of the subject",
    "definition of an encounter",
    "message type",
    "own sensor or fused",
)
_KIND = "what is reacted to: ghost, false positive, real"
_ROLE_ALL = "role of the subject, or all"
_RECEIVERS = "vehicles that look up"
_SUCCESS = "score threshold, among, role of the attacker"
_ATTACKERS = "attackers"
_IN_WORDS = "what it is, in words"

# fmt: off
METRICS: Mapping[str, Metric] = {
    "traffic.duration_s": Metric("recorded time", "s", "Simulated time that was recorded, warm-up left out."),
    "traffic.actors.mean": Metric("actors on the road, mean", "", "Mean number of actors on the road, pedestrians included.", "all, or equipped vehicles"),
    "traffic.equipped.n": Metric("equipped vehicles", "", "Equipped vehicles that were on the road at any time.", "role"),
    "encounters.n": Metric("encounters", "", "Encounters, those under way at the beginning or at the end included.", _DEFINITION),
    "encounters.censored_left.share": Metric("start not observed", "1", "Share of encounters under way when recording began.", _DEFINITION),
    "encounters.censored_right.share": Metric("end not observed", "1", "Share of encounters not known to be over when recording ended.", _DEFINITION),
    "encounters.duration.mean_s": Metric("duration, mean as recorded", "s", "Mean of the durations as recorded; too short where many are censored.", _DEFINITION),
    "encounters.duration.median_s": Metric("duration, median as recorded", "s", "Median of the durations as recorded; too short where many are censored.", _DEFINITION),
    "encounters.duration.km_mean_s": Metric("duration, mean (Kaplan-Meier)", "s", "Mean duration up to the longest observed, by the Kaplan-Meier estimator; encounters whose start was not observed are left out.", _DEFINITION),
    "encounters.duration.km_median_s": Metric("duration, median (Kaplan-Meier)", "s", "Duration that half of the encounters outlast, by the Kaplan-Meier estimator; missing where more than half are censored.", _DEFINITION),
    "encounters.again.share": Metric("repeated encounters", "1", "Share of encounters that are not the first of their pair.", _DEFINITION),
    "trust.final.median": Metric("final trust, median", "1", "Median over pseudonyms of the last trust value of each while in use; without a server, of the mean of the values that receivers hold.", _ROLE),
    "trust.final.mean": Metric("final trust, mean", "1", "Mean over pseudonyms of the last trust value of each while in use.", _ROLE),
    "trust.run.mean": Metric("trust, mean over the run", "1", "Mean of all trust values of all pseudonyms while in use.", _ROLE),
    "misbehaviour.below_threshold.share": Metric("values below the threshold", "1", "Share of all trust values below the threshold, over the whole run.", _ROLE),
    "misbehaviour.below_threshold.rated_share": Metric("rated values below the threshold", "1", "The same share of the values that rest on at least one evaluation.", _ROLE),
    "misbehaviour.attackers.n": Metric("attackers", "", "Pseudonyms of vehicles that have attacked, watched from their first attack on.", _ROLE),
    "misbehaviour.rated.share": Metric("rated, share of the time", "1", "Share of the watched time in which trust rests on at least one evaluation.", _ROLE),
    "misbehaviour.auc": Metric("honest above attacker (AUC)", "1", "Probability that a rated trust value of an honest vehicle is above one of an attacker, ties counting half: the area under the ROC curve. 1 separates all, 0.5 none.", _ROLE),
    "misbehaviour.auc_unrated": Metric("AUC, unrated values included", "1", "The same with the values that rest on no evaluation.", _ROLE),
    "misbehaviour.auc_final": Metric("honest above malicious at the end", "1", "The same of the last rated value of each, honest against malicious."),
    "misbehaviour.fpr_threshold": Metric("threshold at the false positive rate", "1", "Largest threshold with at most the given false positive rate of rated honest values."),
    "misbehaviour.recall_at_fpr": Metric("recall at the false positive rate", "1", "Share of the attackers' rated values below that threshold.", _ROLE),
    "misbehaviour.suspected_at_fpr.share": Metric("suspected, share of the time", "1", "Share of the attackers' watched time in which they are suspected at that threshold, rated or not.", _ROLE),
    "misbehaviour.time_to_detection.median_s": Metric("time to detection, median", "s", "Time from the first attack until half are suspected at the threshold, where trust is kept (Kaplan-Meier; missing where fewer are); of honest ones, from the first attack of any.", _ROLE),
    "misbehaviour.time_to_detection.share": Metric("ever suspected", "1", "Share ever suspected at the threshold, where trust is kept.", _ROLE),
    "misbehaviour.time_to_detection_at_fpr.median_s": Metric("time to detection at the false positive rate, median", "s", "The same time at the threshold of the false positive rate.", _ROLE),
    "misbehaviour.time_to_detection_at_fpr.share": Metric("ever suspected at the false positive rate", "1", "Share ever suspected at that threshold.", _ROLE),
    "misbehaviour.time_to_detection_at_vehicle.median_s": Metric("time to detection at a vehicle, median", "s", "Time until the first vehicle looks up a server's value below the threshold; only where there is a server.", _ROLE),
    "misbehaviour.time_to_detection_at_vehicle.share": Metric("ever suspected at a vehicle", "1", "Share for which a vehicle ever looked up such a value.", _ROLE),
    **{
        f"security.{name}{suffix}": Metric(f"{label}{', relative threshold' if suffix else ''}", "1", f"{text} A subject is excluded while it is rated and below {'half of the median of the rated values of that moment' if suffix else 'the threshold'}.", "value (each moment), vehicle (the last), or message (lied)")
        for suffix in ("", "_relative")
        for name, label, text in (
            ("precision", "precision", "Share of the excluded that attack."),
            ("recall", "recall", "Share of the attackers that are excluded."),
            ("fpr", "false positive rate", "Share of the honest that are excluded."),
            ("f1", "F1", "Harmonic mean of precision and recall."),
            ("mcc", "Matthews correlation", "Correlation of attacking and being excluded: 0 is chance."),
            ("informedness", "informedness", "Recall less false positive rate: 0 is chance."),
        )
    },
    "security.average_precision": Metric("average precision", "1", "Area under the precision-recall curve of values; those that are not rated are never excluded."),
    "security.false_exclusions_per_h": Metric("false exclusions", "1/h", "Times that an honest vehicle becomes excluded at the threshold, per hour that honest vehicles are watched for."),
    "security.false_exclusions_per_h_relative": Metric("false exclusions, relative threshold", "1/h", "The same at half of the median of the rated values of that moment."),
    "security.time_to_exclusion.median_s": Metric("time to exclusion, median", "s", "Time from the first attack until receivers drop the messages of half of the vehicles because their pseudonyms are revoked (Kaplan-Meier; missing where fewer are); of honest ones, from the first attack of any. Only with pseudonyms.revocation.", _ROLE),
    "security.time_to_exclusion.share": Metric("ever revoked", "1", "Share of vehicles of which a pseudonym was revoked.", _ROLE),
    "security.trust_error": Metric("trust error", "1", "Mean distance of rated trust from 1 (honest) or 0 (attackers).", _ROLE),
    "evidence.trust.multiplicity": Metric("evaluations per look", "1", "Evaluations with visibility above 0 of others' detections, over the distinct looks (evaluator, observer, actual object) behind them: 1 if no look counts twice in a trust value."),
    "evidence.fused.multiplicity": Metric("evaluations per evaluator of a fused object", "1", "Evaluations behind a fused object, over the vehicles that made them: how often one look counts in a sum over members and evaluators. Models that score objects give each vehicle one vote."),
    "evidence.echoes.share": Metric("echoes", "1", "Share of the evaluations by which an attacker confirms what another attacker fabricated."),
    "evidence.copies_per_evaluation": Metric("copies set aside per evaluation", "1", "Copies of messages that receivers already had and that count nowhere, over the evaluations."),
    "freshness.server_unjudged.share": Metric("server's values without an evaluation", "1", "Share of the server's values, when they are computed, that rest on no evaluation by another vehicle that could see.", _ROLE),
    "freshness.server_newest_evaluation.median_s": Metric("newest evaluation at the server, median age", "s", "Median age of the newest such evaluation behind the server's values, when they are computed.", _ROLE),
    "freshness.encounters_without_trust.share": Metric("encounters over before trust was known", "1", "Share of encounters of equipped vehicles, both directions counted, in which one never looked up a value for the other that rests on an evaluation.", _DEFINITION, "vehicles that would know"),
    "freshness.wait_in_encounter.median_s": Metric("wait for trust in an encounter, median", "s", "Time from the start of an encounter to the first value that rests on an evaluation, of those that had none at its start.", _DEFINITION),
    "freshness.lookup_state.share": Metric("what stands behind a value looked up", "1", "Share of all lookups in each state: judged (an evaluation within the window, by another vehicle than the subject that could see), stale (such evaluations, all older than the window), unjudged (a value without any), default (no value).", "state, role of the subject", _RECEIVERS),
    "freshness.evaluation_within.share": Metric("evaluation at most fresh_s old", "1", "Share of all lookups whose value rests on such an evaluation at most fresh_s old (10 s unless told), whatever the window.", _ROLE_ALL, _RECEIVERS),
    "freshness.value_age.mean_s": Metric("age of the value at lookup, mean", "s", "Mean age of information of the value at use: time since it was computed; 0 for own values, which are computed when they are looked up; defaults left out.", _ROLE_ALL, _RECEIVERS),
    "freshness.value_age.median_s": Metric("age of the value at lookup, median", "s", "Median of the same age.", _ROLE_ALL),
    "freshness.value_age.p90_s": Metric("age of the value at lookup, 90th percentile", "s", "90th percentile of the same age.", _ROLE_ALL),
    "freshness.value_age.peak_s": Metric("age of the value at lookup, peak", "s", "Mean age of the value at the last lookup before it is renewed (peak age of information, sampled at lookups).", "", _RECEIVERS),
    "freshness.newest_evaluation_age.mean_s": Metric("newest evaluation at lookup, mean age", "s", "Mean age, at the lookup, of the newest evaluation behind the value, by another vehicle than the subject that could see; of lookups with such an evaluation.", _ROLE_ALL, _RECEIVERS),
    "freshness.newest_evaluation_age.median_s": Metric("newest evaluation at lookup, median age", "s", "Median of the same age.", _ROLE_ALL),
    "freshness.newest_evaluation_age.p90_s": Metric("newest evaluation at lookup, 90th percentile", "s", "90th percentile of the same age.", _ROLE_ALL),
    "freshness.newest_evaluation_age.peak_s": Metric("newest evaluation at lookup, peak age", "s", "Mean of the same age at the last lookup before a newer evaluation stands behind the value.", "", _RECEIVERS),
    "freshness.oldest_evaluation_age.mean_s": Metric("oldest evaluation at lookup, mean age", "s", "Mean age, at the lookup, of the oldest such evaluation behind the value.", _ROLE_ALL, _RECEIVERS),
    "freshness.oldest_evaluation_age.median_s": Metric("oldest evaluation at lookup, median age", "s", "Median of the same age.", _ROLE_ALL),
    "freshness.oldest_evaluation_age.p90_s": Metric("oldest evaluation at lookup, 90th percentile", "s", "90th percentile of the same age.", _ROLE_ALL),
    "freshness.evaluations.mean": Metric("evaluations behind a value, mean", "", "Mean number of such evaluations behind the values looked up that have any.", "", _RECEIVERS),
    "freshness.evaluators.mean": Metric("evaluators behind a value, mean", "", "Mean number of different vehicles that made them.", "", _RECEIVERS),
    "radio.condition.model": Metric("medium", "", "Model of the medium (radio.model).", _IN_WORDS),
    "radio.condition.range": Metric("communication range", "m", "Largest distance of one hop (radio.range_m)."),
    "radio.condition.max_hops": Metric("hops at most", "", "Hops that a message may travel (radio.relay.max_hops)."),
    "radio.condition.penetration": Metric("penetration", "1", "Share of the vehicles of these classes that are equipped (fleet.penetration_p).", "classes"),
    "radio.condition.loss_per_hop": Metric("flat loss per hop", "1", "Probability of loss of one hop, whatever the distance (unit disk)."),
    "radio.condition.path_loss": Metric("path loss", "", "Path loss model.", _IN_WORDS),
    "radio.condition.receiver_threshold": Metric("receiver threshold", "dBm", "Least power and SINR that a receiver decodes.", _IN_WORDS),
    "radio.condition.nlos": Metric("non-line-of-sight model", "", "Loss by buildings.", _IN_WORDS),
    "radio.condition.fading": Metric("fading", "", "Fading model.", _IN_WORDS),
    "radio.condition.dcc": Metric("congestion control", "", "Decentralized congestion control.", _IN_WORDS),
    "radio.sent.n": Metric("frames sent", "", "Frames sent, forwarded copies included."),
    "radio.pdr.all": Metric("packet delivery ratio", "1", "Share of (frame, receiver) pairs within communication range in which the frame was received."),
    "radio.pdr.cpm": Metric("packet delivery ratio, CPM", "1", "The same of collective perception messages."),
    "radio.pdr.evaluation": Metric("packet delivery ratio, evaluations", "1", "The same of the second round: evaluations, and broadcasts of roadside units."),
    "radio.pdr_by_los": Metric("packet delivery ratio by line of sight", "1", "The same by line of sight between the two ends: los, nlos, unknown.", "line of sight"),
    **{
        f"radio.lost.{name.removeprefix('n_lost_')}": Metric(f"lost: {name.removeprefix('n_lost_').replace('_', ' ')}", "1", f"Share of (frame, receiver) pairs within range that count in the column {name}.")
        for name in LOST
    },
    "radio.cbr.mean": Metric("channel busy ratio, mean", "1", "Share of the time that a vehicle senses the channel busy, mean over vehicles and rounds; missing where not modelled."),
    "radio.latency.median_s": Metric("latency, median", "s", "Upper edge of the histogram bin that holds the median latency from generation to reception."),
    "radio.latency.p95_s": Metric("latency, 95th percentile", "s", "Upper edge of the bin that holds the 95th percentile."),
    "radio.pir.mean_s": Metric("packet inter-reception time, mean", "s", "Mean time between successive CPMs of one vehicle at another while within range; intervals cut off are left out."),
    "radio.pir.after_loss.share": Metric("intervals with a loss", "1", "Share of these intervals in which at least one CPM was lost."),
    "radio.lost_in_a_row.mean": Metric("messages lost in a row, mean", "", "Mean number of CPMs lost in an interval with a loss."),
    "radio.server_reports.reached.share": Metric("reports that reach the server", "1", "Share of the vehicles' reports with evaluations that reach the trust server."),
    "radio.server_reports.lost.share": Metric("reports lost", "1", "Share lost on the way, or received by no roadside unit."),
    "radio.server_reports.over_capacity.share": Metric("reports over capacity", "1", "Share dropped because the capacity of their cell was used up."),
    "radio.server_reports.outage.share": Metric("reports lost in an outage", "1", "Share lost because the server was out of service."),
    "radio.server_broadcasts.reached.share": Metric("broadcasts that reach vehicles", "1", "Share of (broadcast of trust values, vehicle on the road) pairs in which it is received."),
    "detection.ap40": Metric("AP 3D, 40 recall points", "%", "Average precision by KITTI's rules at 40 recall points, ranked over all sampled frames together; levels with fewer than 41 objects are left out.", "list, class, level"),
    "detection.awareness_70m.share": Metric("environmental awareness within 70 m", "1", "Share of the actors within 70 m of an equipped vehicle for which it has a box with a score of at least 0.5.", _LIST),
    "safety.driven_km": Metric("vehicle-kilometres", "km", "Way driven by all vehicles, pedestrians left out."),
    "safety.travel_time.s_per_km": Metric("travel time per kilometre", "s/km", "Vehicle-seconds on the road per vehicle-kilometre; delay is the difference between two runs of the same traffic."),
    "safety.hard_braking.per_km": Metric("hard braking", "1/km", "Decelerations of 3 m/s2 or more per vehicle-kilometre; one ends below 1 m/s2."),
    "safety.emergency_braking.per_km": Metric("emergency braking", "1/km", "The same with 4.5 m/s2 or more."),
    "safety.ttc.per_km": Metric("conflicts by time to collision", "1/km", "Episodes of a vehicle and its leader with a time to collision below 3 s, per vehicle-kilometre."),
    "safety.drac.per_km": Metric("conflicts by deceleration to avoid a crash", "1/km", "Episodes of a vehicle and its leader in which more than 3 m/s2 would avoid a crash, per vehicle-kilometre."),
    "safety.pet.per_km": Metric("conflicts by post-encroachment time", "1/km", "Pairs of vehicles on crossing ways with a post-encroachment time below 2 s, per vehicle-kilometre."),
    "safety.near_misses.per_km": Metric("near misses", "1/km", "Conflicts with a time to collision or a post-encroachment time below 1 s, per vehicle-kilometre."),
    "safety.collisions.n": Metric("overlapping vehicles", "", "Pairs of vehicles whose footprints were in each other by more than 0.3 m while one moved; SUMO's own count of collisions is in the manifest."),
    "safety.stops.per_km": Metric("stops", "1/km", "Times that a vehicle became slower than 0.1 m/s after more than 2 m/s, per vehicle-kilometre."),
    "safety.reactions.n": Metric("reactions", "", "Episodes in which a driver was commanded because of what its vehicle believes; those to ghosts and false positives are false alarms.", _KIND),
    "safety.reactions.per_km": Metric("reactions per kilometre", "1/km", "The same per vehicle-kilometre of all vehicles.", _KIND),
    "safety.reactions_hard.per_km": Metric("hard reactions", "1/km", "Of these, with a commanded deceleration of 3 m/s2 or more.", _KIND),
    "safety.speed_taken.mean_mps": Metric("speed taken by a reaction", "m/s", "Mean over reactions of the speed that commands took away, summed: the cost of a false alarm, or the use of a warning.", _KIND),
    "safety.wave.vehicles.mean": Metric("braking wave, vehicles", "", "Mean number of drivers behind a reaction of 2 m/s2 or more who braked as hard within 20 s, one behind the other.", _KIND),
    "safety.wave.length.mean_m": Metric("braking wave, length", "m", "Mean distance from the vehicle that reacted to the last of them.", _KIND),
    "attack.believed.share": Metric("fabricated objects believed", "1", "Share of the pairs (fabricated detection, honest vehicle that received it) in which the vehicle's fused objects hold it with at least the threshold's score. Among intended: the vehicle that the attack aims at.", _SUCCESS, _ATTACKERS),
    "attack.believed.pairs.n": Metric("pairs behind it", "", "Number of these pairs: the denominator.", "among, role of the attacker"),
    "attack.believed_by_any.share": Metric("fabricated objects believed by any", "1", "Share of the fabricated detections that an honest vehicle received of which at least one of these believes; it grows with the number of receivers.", "score threshold, role of the attacker", _ATTACKERS),
    "attack.believed_duration.mean_s": Metric("believed for, mean", "s", "Mean length of the successive sensing steps in which an honest vehicle believes a fabricated detection of one attacker, at a score of 0.5.", "among, role of the attacker", _ATTACKERS),
    "attack.false_in_path.share": Metric("believed false box in the path", "1", "Share of the vehicle-steps, of honest vehicles that received a fabricated detection in them, with one in the vehicle's path (a straight strip of its width, 50 m ahead) that it believes with a score of at least 0.5.", "among", "vehicles"),
    "attack.false_in_path.boxes_mean": Metric("believed false boxes in the path, mean", "", "Mean number of these boxes per vehicle-step.", "among"),
    "attack.damage.total_s": Metric("damage", "s", "Believed ghosts x seconds x victims: every fabricated detection that an honest vehicle believes with a score of at least 0.5 counts for the time to the next sensing step.", "among, role of the attacker"),
    "attack.damage.per_attacker_s": Metric("damage per attacker", "s", "The same over the attackers with a lie that an honest vehicle received.", "among, role of the attacker", _ATTACKERS),
    "attack.missing.share": Metric("withheld objects missing", "1", "Share of the pairs (withheld detection of a real actor, honest vehicle that received the message without it and did not detect the actor itself) in which the vehicle's fused objects hold the actor with no score of at least the threshold.", _SUCCESS, _ATTACKERS),
    "attack.missing.pairs.n": Metric("pairs behind it", "", "Number of these pairs: the denominator.", "among, role of the attacker"),
    **{f"{topic}.not_measured": Metric("not measured", "", "The run cannot answer; the group says why.", "reason") for topic in TOPICS},
}
# fmt: on
