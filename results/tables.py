# ruff: noqa: E501 (a table is wide)
"""Every table and every column of a run, said once: the schemas and the documentation are derived from it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import pyarrow as pa

from results.codes import (
    BASE_VARIANT,
    DISTANCE_BIN_M,
    AttackEffect,
    DetectionFault,
    EncounterPairs,
    LookupState,
    LosBlockers,
    LosState,
    MessageType,
    ObjectClass,
    Origin,
    Role,
    TrustSource,
    VehicleClass,
    labels,
)
from results.columns import LEVELS, Column, Layout, Level, Table

SCHEMA_VERSION = 8
"""Raised whenever a table or column changes its name, type, unit or meaning."""


def _key(meaning: str, type: Literal["int32", "int16"] = "int32", layout: Layout | None = None) -> Column:
    return Column(type, meaning=meaning, key=True, layout=layout)


def _count(meaning: str) -> Column:
    return Column("int32", meaning=meaning)


# fmt: off
_STEP = _key("Time step; seconds are step * dt_s of the manifest.")
_VARIANT = Column("category", key=True, categories=(BASE_VARIANT,), labels_of_run="variants", meaning="Trust variant of the run; `base` is the one that acts.")
_CLASS = Column("category", meaning="Class of the object.", categories=labels(ObjectClass))
_SCORE = Column("float32", meaning="Confidence in [0, 1].", unit="1", bits=12)
_BOX = {
    "x_m": Column("float32", unit="m", meaning="Centre of the box, east.", bits=7, layout="bytes"),
    "y_m": Column("float32", unit="m", meaning="Centre of the box, north.", bits=7, layout="bytes"),
    "z_m": Column("float32", unit="m", meaning="Centre of the box, up.", bits=7),
    "length_m": Column("float32", unit="m", meaning="Extent along the heading.", bits=7),
    "width_m": Column("float32", unit="m", meaning="Extent across the heading.", bits=7),
    "height_m": Column("float32", unit="m", meaning="Vertical extent.", bits=7),
    "yaw_rad": Column("float32", unit="rad", bits=9, meaning="Heading, counter-clockwise from +x (east), in (-pi, pi]."),
}
_POSE = ("x_m", "y_m", "z_m", "yaw_rad")
_TRUTH_ACTOR = Column("int32", null=True, truth=True, meaning="Actor whose box it really is; null where it is no actor's (false positive of the detector, fabricated).")
_TRUTH_IOU = Column("float32", unit="1", null=True, truth=True, bits=10, meaning="3D intersection over union with that actor's true box.")


def _trust_at_contact(one: str, other: str) -> dict[str, Column]:
    return {
        f"trust_{one}{other}": Column("float32", unit="1", null=True, meaning=f"Trust in {other} that {one} would look up at first contact; null where {one} could look up none (not equipped)."),
        f"source_{one}{other}": Column("category", null=True, categories=labels(TrustSource), meaning="Where that trust came from."),
        f"state_{one}{other}": Column("category", null=True, categories=labels(LookupState), meaning="What stood behind it: an evaluation within the window (judged), older ones (stale), a value without any (unjudged), or no value (default)."),
        f"age_{one}{other}_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of that trust; null for the default."),
        f"trusted_after_{one}{other}_s": Column("float32", unit="s", null=True, meaning=f"From the start until {one} first looked up a value for {other} that rests on an evaluation; null if it never did."),
    }


_EVALUATIONS = {
    "n_evaluations": _count("Evaluations behind the value, by other vehicles than the subject that could see (visibility above 0)."),
    "n_evaluators": Column("int32", null=True, meaning="Different vehicles that made them; null where the trust model does not count them."),
    "newest_evaluation_age_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of the newest of them: time since the sweep that it judges; null where there is none."),
    "oldest_evaluation_age_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of the oldest of them; null where there is none."),
}
_MESSAGE_TYPE = Column("category", key=True, categories=labels(MessageType), meaning="What the round of messages carries: collective perception messages with own detections (cpm), or evaluations of the detections of others; roadside units broadcast trust values in the second round.")
_IN_RANGE = _count("(Frame, receiver) pairs within communication range, forwarded frames included: what could have been received.")
_DELIVERED = _count("Of these, received.")
_LOST = {
    "n_lost_propagation": _count("Lost to distance, obstacles, shadowing or fading."),
    "n_lost_collision": _count("Lost to interference of other senders."),
    "n_lost_receiver_busy": _count("Lost because the receiver was sending or locked to another frame."),
    "n_lost_expired": _count("Never sent: lifetime over in the sender's queue."),
    "n_lost_late": _count("Received after the time-out of the round, and dropped."),
}

TABLES: Mapping[str, Table] = {
    "vehicles": Table(
        "summary",
        "Every actor of the run, one row each, written at its end.",
        {
            "vehicle": _key("Actor number: who it really is; unique in the run and never reused."),
            "sumo_id": Column("string", meaning="Name in SUMO."),
            "vehicle_class": Column("category", meaning="Class of vehicle, or pedestrian.", categories=labels(VehicleClass)),
            "length_m": Column("float32", unit="m", meaning="Extent along the heading."),
            "width_m": Column("float32", unit="m", meaning="Extent across the heading."),
            "height_m": Column("float32", unit="m", meaning="Vertical extent."),
            "equipped": Column("bool", meaning="Carries a LiDAR and a radio."),
            "role": Column("category", meaning="How an equipped vehicle behaves; null if not equipped.", categories=labels(Role), labels_of_run="roles", null=True),
            "attack": Column("int16", null=True, meaning="Section of `attacks` in the config, from 0, that its vehicle belongs to; null if honest or not equipped."),
            "first_step": Column("int32", meaning="First step on the road."),
            "last_step": Column("int32", meaning="Last step on the road."),
            "attack_start_step": Column("int32", null=True, meaning="First step in which it lied in a detection or an evaluation, or attacked the channel or the server; null if it never did."),
        },
    ),
    "pseudonyms": Table(
        "summary",
        "Which vehicle used which pseudonym, and when, written at the end of the run.",
        {
            "pseudonym": _key("Identity that messages carry, and all that receivers, trust and trust server know of a sender; used by one vehicle only. Under pseudonyms.policy = \"none\" it is the vehicle's actor number."),
            "vehicle": Column("int32", truth=True, meaning="Vehicle that used it, as in `vehicles`."),
            "identity": Column("int16", truth=True, meaning="0 for the vehicle's own; from 1 on for the further ones of a Sybil attacker."),
            "from_step": Column("int32", truth=True, meaning="First step in use."),
            "to_step": Column("int32", truth=True, meaning="Last step in use."),
            "refused_step": Column("int32", null=True, truth=True, meaning="First step in which receivers dropped its messages, because it was revoked; null where they never did."),
        },
    ),
    "actors": Table(
        "standard",
        "Poses of all actors, pedestrians included: enough to replay the traffic without SUMO.",
        {
            "step": _STEP,
            "actor": _key("Actor number, as `vehicle` in `vehicles`."),
            **{name: replace(_BOX[name], bits=bits) for name, bits in (("x_m", 8), ("y_m", 8), ("z_m", 8), ("yaw_rad", 9))},
            "speed_mps": Column("float32", unit="m/s", meaning="Speed along the heading.", bits=8, layout="bytes"),
        },
    ),
    "encounters": Table(
        "summary",
        "Encounters of two actors: an unbroken time within a radius of each other.",
        {
            "a": _key("The smaller of the two actor numbers."),
            "b": _key("The larger of the two actor numbers."),
            "start_step": _key("First step in contact."),
            "radius_m": Column("float32", unit="m", key=True, meaning="Largest distance that counts as contact."),
            "pairs": Column("category", key=True, categories=labels(EncounterPairs), meaning="Which pairs count: all, pairs of equipped vehicles, equipped pairs with line of sight (los), or all with line of sight (all_los)."),
            "hysteresis_s": Column("float32", unit="s", key=True, meaning="A break in contact shorter than this does not end the encounter."),
            "los": Column("category", key=True, categories=labels(LosBlockers), meaning="What cuts a line of sight, from 0.23 m (lidar.mount_above_roof_m) above one roof to the other: buildings, or the bodies of other actors too."),
            "pedestrians": Column("bool", key=True, meaning="Whether pedestrians count as actors; vehicles alone do otherwise."),
            "end_step": Column("int32", meaning="First step no longer in contact."),
            "duration_s": Column("float32", unit="s", meaning="(end_step - start_step) * dt_s, bridged breaks included."),
            "censored_left": Column("bool", meaning="In contact already when recording began: lasted longer."),
            "censored_right": Column("bool", meaning="Not over when recording ended: lasted longer."),
            "entered": Column("bool", meaning="Began because one of the two entered the simulation."),
            "departed": Column("bool", meaning="Ended because one of the two left the simulation."),
            "gap_s": Column("float32", unit="s", null=True, meaning="Time since the last encounter of the two ended; null at the first."),
            "min_distance_m": Column("float32", unit="m", meaning="Smallest distance in contact.", layout="bytes"),
            "mean_distance_m": Column("float32", unit="m", meaning="Mean distance over the steps in contact.", layout="bytes"),
            "los_share": Column("float32", unit="1", meaning="Share of the steps in contact with line of sight."),
            "n_messages_ab": _count("Messages of a that b received during the encounter."),
            "n_messages_ba": _count("Messages of b that a received during the encounter."),
            "n_evaluations_ab": _count("Evaluations by a of detections of b during the encounter."),
            "n_evaluations_ba": _count("Evaluations by b of detections of a during the encounter."),
            **_trust_at_contact("a", "b"),
            **_trust_at_contact("b", "a"),
        },
    ),
    "encounter_trust": Table(
        "summary",
        "The trust columns of `encounters` for the trust variants that do not act; one row per encounter and variant.",
        {
            "variant": _VARIANT,
            "a": _key("The smaller of the two actor numbers."),
            "b": _key("The larger of the two actor numbers."),
            "start_step": _key("First step in contact."),
            "radius_m": Column("float32", unit="m", key=True, meaning="Largest distance that counts as contact."),
            "pairs": Column("category", key=True, categories=labels(EncounterPairs), meaning="Which pairs count, as in `encounters`."),
            "hysteresis_s": Column("float32", unit="s", key=True, meaning="A break in contact shorter than this does not end the encounter."),
            "los": Column("category", key=True, categories=labels(LosBlockers), meaning="What cuts a line of sight, from 0.23 m (lidar.mount_above_roof_m) above one roof to the other: buildings, or the bodies of other actors too."),
            "pedestrians": Column("bool", key=True, meaning="Whether pedestrians count as actors; vehicles alone do otherwise."),
            **_trust_at_contact("a", "b"),
            **_trust_at_contact("b", "a"),
        },
    ),
    "observability": Table(
        "standard",
        "What every LiDAR could have detected: one row per actor that at least one beam would hit if nothing stood in between.",
        {
            "step": _STEP,
            "observer": _key("Vehicle that carries the LiDAR (actor number)."),
            "actor": _key("Actor in its field of view."),
            "n_points": Column("int32", truth=True, meaning="Returns from it."),
            "n_unoccluded": Column("int32", truth=True, meaning="Returns from it if nothing stood in between."),
        },
    ),
    "detections": Table(
        "standard",
        "Boxes in the vehicles' detection lists, before they are sent; (step, observer, detection_index) names a detection in all tables.",
        {
            "step": _STEP,
            "observer": _key("Pseudonym of the vehicle that made the detection."),
            "detection_index": _key("Number in its list; 0 is its self report.", "int16"),
            "class": _CLASS,
            **_BOX,
            "score": _SCORE,
            "n_points": _count("Returns of the observer's own sweep inside the box."),
            "speed_mps": Column("float32", unit="m/s", null=True, bits=7, meaning="Speed, in self reports; null elsewhere."),
            "acceleration_mps2": Column("float32", unit="m/s2", null=True, bits=7, meaning="Acceleration along the heading, in self reports; null elsewhere."),
            "origin": Column("category", categories=labels(Origin), truth=True, meaning="Made by the detector, the vehicle's self report, or fabricated by an attack."),
            "transmitted": Column("bool", truth=True, meaning="Is in the message that was sent (an attack may withhold what was detected)."),
            "lied": Column("bool", truth=True, meaning="A lie: fabricated; sent otherwise than perceived by more than noise (0.5 m, 10 degrees, 20 % of the size, 0.1 of the score, another class, 0.5 m/s or m/s2); or withheld by a malicious vehicle."),
            "withheld": Column("bool", truth=True, meaning="Kept from others by an attack."),
            "target": Column("int32", null=True, truth=True, meaning="Vehicle that an attack aims at with this detection (actor number); null where at none."),
            "truth_actor": _TRUTH_ACTOR,
            "truth_iou": _TRUTH_IOU,
            "truth_occlusion": Column("float32", unit="1", null=True, truth=True, bits=8, meaning="Share of that actor hidden from the observer."),
        },
    ),
    "dropped_detections": Table(
        "summary",
        "Detections in the lists that attacks make up or change that no message can hold, and that are dropped before they are sent, by cause.",
        {
            "step": _STEP,
            "cause": Column("category", key=True, categories=labels(DetectionFault), meaning="First cause that applies: not finite; more than 10 km from the observer, or a heading beyond a full turn; a size of 0 or less or above 1 km; a score outside [0, 1]; a class that does not exist; a number outside of 15 bits, or a count of returns outside of 31; a number that the list has already; more than 255 objects; a speed or an acceleration beyond 1,000."),
            "n": _count("Detections dropped."),
        },
    ),
    "position_errors": Table(
        "standard",
        "Errors of the positions that equipped vehicles believe in, where the config has [gnss]. All boxes of a vehicle's detections, its report of itself included, and of its fused objects are displaced by its own error.",
        {
            "step": _STEP,
            "vehicle": _key("Vehicle (actor number)."),
            "error_x_m": Column("float32", unit="m", truth=True, bits=10, meaning="Believed less true position, east."),
            "error_y_m": Column("float32", unit="m", truth=True, bits=10, meaning="The same, north."),
        },
    ),
    "receptions": Table(
        "full",
        "Messages that were received.",
        {
            "step": _key("Step in which the message was sent."),
            "message_type": _MESSAGE_TYPE,
            "sender": _key("Pseudonym that the message carries."),
            "receiver": _key("Vehicle that received it (actor number)."),
            "hops": Column("uint8", meaning="Radio hops taken; 1 is direct."),
            "generation_offset_s": Column("float32", unit="s", bits=20, meaning="From the beginning of the round to the generation of the message."),
            "access_delay_s": Column("float32", unit="s", bits=20, meaning="From generation until the (last) frame of its author was on the air."),
            "latency_s": Column("float32", unit="s", bits=20, meaning="From generation to reception."),
            "distance_m": Column("float32", unit="m", bits=5, meaning="Between author and receiver, when sent."),
        },
    ),
    "evidence": Table(
        "summary",
        "How often one look counts more than once on its way into trust values.",
        {
            "step": _STEP,
            "n_copies": _count("Copies of messages that their receivers already had, set aside."),
            "n_evaluations": _count("Evaluations of others' detections with visibility above 0, as sent: the evidence for trust values."),
            "n_looks": replace(_count("Distinct looks behind them: an evaluator, an observer and an actual object."), truth=True),
            "n_echoes": replace(_count("Of the evaluations, those by which an attacker confirms what another attacker fabricated."), truth=True),
        },
    ),
    "fused_evidence": Table(
        "summary",
        "How often one evaluator counts more than once behind a fused object; of trust variants whose fused objects are computed.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "n_evaluations": _count("Evaluations behind the fused objects: pairs of a detection and an evaluator."),
            "n_evaluators": _count("Pairs of a fused object and an evaluator behind it."),
        },
    ),
    "radio": Table(
        "summary",
        "The channel, all stations together.",
        {
            "step": _STEP,
            "message_type": _MESSAGE_TYPE,
            "n_sent": _count("Frames sent, forwarded copies included."),
            "n_relayed": _count("Of these, forwarded copies."),
            "n_in_range": _IN_RANGE,
            "n_delivered": _DELIVERED,
            "n_duplicate": _count("Of these, messages that the receiver already had."),
            **_LOST,
            "sent_bytes": Column("float32", unit="B", meaning="Sent on the air, forwarded copies included."),
            "cbr": Column("float32", unit="1", null=True, meaning="Channel busy ratio: share of the time that a vehicle senses the channel busy, mean over vehicles; null where not modelled."),
        },
    ),
    "pdr_by_distance": Table(
        "summary",
        "The channel by distance between the two ends of a hop: packet delivery ratio is n_delivered / n_in_range.",
        {
            "step": _STEP,
            "message_type": _MESSAGE_TYPE,
            "distance_bin_m": Column("int16", unit="m", key=True, meaning=f"Lower edge of the bin of distance; bins are {DISTANCE_BIN_M} m wide."),
            "los_state": Column("category", key=True, categories=labels(LosState), meaning="Between the two ends: no building (los), a building (nlos), or not modelled (unknown)."),
            "n_in_range": _IN_RANGE,
            "n_delivered": _DELIVERED,
            **_LOST,
        },
    ),
    "latency_histogram": Table(
        "summary",
        "Messages between vehicles by their latency, from generation to reception.",
        {
            "step": _STEP,
            "message_type": _MESSAGE_TYPE,
            "latency_s": Column("float32", unit="s", key=True, meaning="Lower edge of the bin; bins are a factor of the square root of 2 wide."),
            "n_delivered": _count("Messages received, each once per receiver."),
        },
    ),
    "packet_inter_reception": Table(
        "summary",
        "Packet inter-reception time: between successive messages of one vehicle at another, while the two stay within communication range of each other; shows losses in a row.",
        {
            "step": _key("Time step in which the interval ended; seconds are step * dt_s of the manifest."),
            "message_type": _MESSAGE_TYPE,
            "pir_steps": _key("Steps from the last reception to the next, or to the last step within range; one sensing interval where nothing was lost."),
            "n_received": _count("Intervals that a reception ended."),
            "n_censored": _count("Intervals that were not over when the two got out of range, or one left: they would have lasted longer (0 steps: out of range right after a reception)."),
        },
    ),
    "vehicle_channel": Table(
        "standard",
        "The channel at each equipped vehicle, both rounds of messages together.",
        {
            "step": _STEP,
            "vehicle": _key("Vehicle that receives (actor number)."),
            "cbr": Column("float32", unit="1", null=True, bits=8, meaning="Channel busy ratio: share of the time that it senses the channel busy; null where not modelled."),
            "n_in_range": Column("int16", meaning="Messages of vehicles within communication range of it."),
            "n_received": Column("int16", meaning="Messages of vehicles that it received, forwarded ones included."),
        },
    ),
    "server": Table(
        "summary",
        "Links to the trust server and back; empty where there is none.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "n_reports": _count("Reports with evaluations that vehicles had for the server."),
            "n_reached": _count("Of these, those that reach it, in this step or later."),
            "n_lost": _count("Of these, lost on the way, or received by no roadside unit."),
            "n_over_capacity": _count("Of these, dropped because the capacity of their cell was used up."),
            "n_outage": _count("Of these, lost because the server was out of service."),
            "uplink_bytes": Column("float32", unit="B", meaning="Length of all reports, headers included, where they go by cellular."),
            "n_addressed": _count("Vehicles on the road when trust values were broadcast; 0 where none were."),
            "n_informed": _count("Of these, those that the broadcast reaches, in this step or later."),
        },
    ),
    "evaluations": Table(
        "standard",
        "Evaluations of each other's detections, as each evaluator makes them in the step of the detection.",
        {
            "step": _key("Step of the detection and of the evaluation."),
            "evaluator": _key("Pseudonym of the vehicle that evaluates."),
            "observer": _key("Pseudonym of the vehicle that made the detection.", layout="plain"),
            "detection_index": _key("Number of the detection in its list.", "int16"),
            "evaluation": Column("float32", unit="1", bits=12, meaning="The score of the evaluator's match, negative where it denies the detection."),
            "visibility": Column("float32", unit="1", bits=12, meaning="How well the evaluator could have seen the object, in [0, 1]: the weight of the evaluation."),
            "n_points": _count("Returns of the evaluator's own sweep inside the box."),
            "plausible": Column("bool", null=True, meaning="Free-space test in its own sweep; null where not made."),
            "matched": Column("bool", meaning="Matched a detection of the evaluator's own."),
            "lied": Column("bool", truth=True, meaning="A lie: sent otherwise than made, by more than 0.1 of evaluation times visibility."),
        },
    ),
    "transmitted_evaluations": Table(
        "full",
        "Evaluations as they were transmitted, unrounded, beside those that the evaluator keeps for itself: what trust is computed from.",
        {
            "step": _key("Step of the detection and of the evaluation."),
            "evaluator": _key("Pseudonym of the vehicle that evaluates."),
            "observer": _key("Pseudonym of the vehicle that made the detection."),
            "detection_index": _key("Number of the detection in its list.", "int16"),
            "evaluation": Column("float64", unit="1", meaning="As in `evaluations`, as transmitted."),
            "visibility": Column("float64", unit="1", meaning="As in `evaluations`, as transmitted."),
            "own_evaluation": Column("float64", unit="1", meaning="The same as the evaluator keeps it, no attack."),
            "own_visibility": Column("float64", unit="1", meaning="The same as the evaluator keeps it, no attack."),
        },
    ),
    "transmitted_scores": Table(
        "full",
        "Scores of the detections that were transmitted, unrounded.",
        {
            "step": _STEP,
            "observer": _key("Pseudonym of the vehicle that made the detection."),
            "detection_index": _key("Number of the detection in its list.", "int16"),
            "score": Column("float64", unit="1", meaning="Confidence in [0, 1].", layout="bytes"),
        },
    ),
    "trust": Table(
        "summary",
        "Trust in each pseudonym as the trust server computes it, at every step in which it does.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "subject": _key("Pseudonym that the trust is in."),
            "trust": Column("float32", unit="1", meaning="Trust in [0, 1]: the expectation.", layout="bytes"),
            "uncertainty": Column("float32", unit="1", null=True, meaning="Uncertainty of it in [0, 1]; null where the trust model has none."),
            "weight": Column("float32", unit="1", meaning="Sum of the weights of the detections behind it.", layout="bytes"),
            "state": Column("category", categories=labels(LookupState), meaning="Whether an evaluation stands behind it (judged) or none (unjudged)."),
            **_EVALUATIONS,
        },
    ),
    "trust_lookups": Table(
        "standard",
        "Trust values as vehicles look them up before fusion: one row per receiver and sender of a message that it received.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "subject": _key("Pseudonym that the value is about; before the receiver, because receivers know much the same."),
            "receiver": _key("Vehicle that looks the value up (actor number)."),
            "trust": Column("float32", unit="1", meaning="Value that is used, in [0, 1]."),
            "source": Column("category", categories=labels(TrustSource), meaning="Where it comes from: the server, own evidence, or the default, which also stands in for an unjudged value under trust.unjudged = \"default\"."),
            "state": Column("category", categories=labels(LookupState), meaning="What is known: an evaluation within the window (judged), older ones only (stale), a value without any (unjudged), or no value (default)."),
            "age_s": Column("float32", unit="s", null=True, bits=10, meaning="Time since the value was computed: 0 for own values, which are computed when they are looked up; null where the source is the default."),
            **_EVALUATIONS,
        },
    ),
    "lookup_totals": Table(
        "summary",
        "Lookups of trust values added up, by what is known: numbers, and sums from which mean ages follow.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "state": Column("category", key=True, categories=labels(LookupState), meaning="As in `trust_lookups`."),
            "n": _count("Lookups in this state."),
            "n_valued": _count("Of these, with a value of the server's or of its own, no default."),
            "age_sum_s": Column("float32", unit="s", meaning="Sum of the ages of these values (`age_s`)."),
            "newest_evaluation_age_sum_s": Column("float32", unit="s", meaning="Sum of the ages of the newest evaluations, over lookups that are judged or stale; 0 in other states."),
            "oldest_evaluation_age_sum_s": Column("float32", unit="s", meaning="The same of the oldest evaluations."),
        },
    ),
    "attack_outcomes": Table(
        "summary",
        "What attacks achieve: a row for every fabricated detection and other vehicle that received it, and for every detection of a real actor that an attack withheld and vehicle that received the message without it; of trust variants whose fused objects are computed.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "effect": Column("category", key=True, categories=labels(AttackEffect), truth=True, meaning="Fabricated (inserted) or withheld (removed)."),
            "observer": _key("Pseudonym of the attacker: with detection_index it names the detection."),
            "detection_index": _key("Number of the detection in the attacker's list.", "int16"),
            "receiver": _key("Vehicle that received the message (actor number), never the attacker itself."),
            "intended": Column("bool", truth=True, meaning="The attack aims at this receiver."),
            "in_path": Column("bool", truth=True, meaning="The box is in the receiver's path: the straight strip of its width, 50 m ahead of its centre."),
            "ego_detected": Column("bool", truth=True, meaning="The receiver detected the withheld actor itself."),
            "score": Column("float32", unit="1", null=True, truth=True, bits=12, meaning="Score of the object among the receiver's fused objects: of the one that the fabricated detection is part of, if its box is a fabricated one; of the best one that really is the withheld actor. Null where there is none (of a score of at least trust.min_score)."),
        },
    ),
    "fused": Table(
        "standard",
        "Fused objects of each vehicle: its own detections and those of others that it accepts.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "observer": _key("Vehicle whose list it is (actor number)."),
            "fused_index": _key("Number in its list.", "int16"),
            "class": replace(_CLASS, via="source"),
            **{name: replace(column, via="pose" if name in _POSE else "source") for name, column in _BOX.items()},
            "score": _SCORE,
            "n_sources": Column("int16", meaning="Vehicles with a detection of it, the observer included."),
            "ego_detected": Column("bool", meaning="Detected by the observer itself."),
            "source": Column("int32", meaning="Pseudonym of the vehicle whose detection of this step gave the box."),
            "source_index": Column("int16", meaning="Number of that detection in its list."),
            "pose": Column("int32", null=True, meaning="Pseudonym of the vehicle whose detection gave position and heading, where that is another one than the source."),
            "pose_index": Column("int16", null=True, meaning="Number of that detection in its list."),
            "fabricated": Column("bool", truth=True, meaning="The box was fabricated by an attack."),
            "truth_actor": replace(_TRUTH_ACTOR, via="source"),
            "truth_iou": replace(_TRUTH_IOU, via="source", meaning="3D intersection over union of the box, as its source gave it, with that actor's true box."),
        },
    ),
    "reactions": Table(
        "standard",
        "Speeds that drivers command because of what their vehicles believe, in the step before they are driven; empty without such a driver.",
        {
            "step": _STEP,
            "vehicle": _key("Vehicle that reacts (actor number)."),
            "source_step": Column("int32", meaning="Step of the detection that it reacts to."),
            "source": Column("int32", meaning="Pseudonym of the vehicle whose detection it is."),
            "source_index": Column("int16", meaning="Number of that detection in its list."),
            "gap_m": Column("float32", unit="m", bits=7, meaning="From the front bumper to the object along the lane path."),
            "speed_mps": Column("float32", unit="m/s", bits=8, meaning="Speed commanded for the next step; SUMO's own rules may keep the vehicle slower."),
            "deceleration_mps2": Column("float32", unit="m/s2", bits=8, meaning="From the present speed to the commanded one within a step; negative where the vehicle may gain speed."),
            "fabricated": Column("bool", truth=True, meaning="The object was fabricated by an attack."),
            "truth_actor": replace(_TRUTH_ACTOR, meaning="Actor that it really is; null where it is no actor (false positive of a detector, fabricated)."),
        },
    ),
}
# fmt: on


def kept(level: Level) -> tuple[str, ...]:
    """Names of the tables that a run of this record level holds."""
    return tuple(name for name, table in TABLES.items() if LEVELS.index(table.level) <= LEVELS.index(level))


def schema(name: str, whole: bool = False) -> pa.Schema:
    """Arrow schema of a table on disk, with unit and meaning as field metadata; `whole`, of all its columns."""
    table = TABLES[name]
    fields = [
        pa.field(
            label,
            column.arrow_type,
            nullable=column.null,
            metadata={"unit": column.unit, "meaning": column.meaning, "key": str(column.key).lower()},
        )
        for label, column in (table.columns if whole else table.stored).items()
    ]
    return pa.schema(fields, {"table": name, "schema_version": str(SCHEMA_VERSION), "meaning": table.meaning})


def axis_label(table: str, column: str, text: str | None = None) -> str:
    """Axis label with the column's unit: `axis_label("trust", "newest_age_s", "Age")` is `Age [s]`."""
    found = TABLES[table].columns[column]
    name = text or column.replace("_", " ")
    return f"{name} [{found.unit}]" if found.unit not in ("", "1") else name
