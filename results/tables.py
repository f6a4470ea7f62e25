# ruff: noqa: E501 (a table is wide)
"""Every table and every column of a run. The Parquet schemas and the documentation are derived from this file."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Literal

import pyarrow as pa

from cosim.base.codes import (
    BASE_VARIANT,
    DISTANCE_BIN_M,
    AttackEffect,
    DetectionFault,
    EncounterPairs,
    EvaluationKind,
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
from results.columns import LEVELS, Column, Layout, Level, Of, Table

SCHEMA_VERSION = 8
"""Raised whenever a table or column changes its name, type, unit or meaning."""


def _key(meaning: str, type: Literal["int32", "int16"] = "int32", layout: Layout | None = None, of: Of = "") -> Column:
    return Column(type, meaning=meaning, key=True, layout=layout, of=of)


def _count(meaning: str) -> Column:
    return Column("int32", meaning=meaning)


# fmt: off
_STEP = _key("Time step; seconds are step * dt_s of the manifest.", of="steps")
_VARIANT = Column("category", key=True, categories=(BASE_VARIANT,), labels_of_run="variants", meaning="Trust variant of the run; `base` is the one that acts in the simulation.")
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
_TRUTH_ACTOR = Column("int32", of="vehicles", null=True, truth=True, meaning="Actor that the box really belongs to; null if it belongs to none (false positive of the detector, or fabricated).")
_TRUTH_IOU = Column("float32", unit="1", null=True, truth=True, bits=10, meaning="3D intersection over union with that actor's true box.")



def _moved(meaning: str, unit: str = "m", bits: int = 7) -> Column:
    """By how much a fused box differs from that of its source."""
    return Column("float32", unit=unit, absent="zero", bits=bits, meaning=meaning)


def _trust_at_contact(one: str, other: str) -> dict[str, Column]:
    return {
        f"trust_{one}{other}": Column("float32", unit="1", null=True, meaning=f"Trust in {other} that {one} would look up at first contact; null if {one} is not equipped and cannot look up trust."),
        f"source_{one}{other}": Column("category", null=True, categories=labels(TrustSource), meaning="Where that trust came from."),
        f"state_{one}{other}": Column("category", null=True, categories=labels(LookupState), meaning="What the trust rested on: an evaluation within the window (evaluated), only older evaluations (stale), a value without any evaluation (unevaluated), or no value (no_value)."),
        f"age_{one}{other}_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of that trust; null for the default."),
        f"trusted_after_{one}{other}_s": Column("float32", unit="s", null=True, meaning=f"Time from the start until {one} first looked up a value for {other} that rests on an evaluation; null if it never did."),
    }


_EVALUATIONS = {
    "n_evaluations": _count("Number of evaluations that the value rests on, by vehicles other than the subject that could see (visibility above 0)."),
    "n_evaluators": Column("int32", null=True, meaning="Number of different vehicles that made these evaluations; null if the trust model does not count them."),
    "newest_evaluation_age_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of the newest of these evaluations: time since the sweep in which it was made; null if there is none."),
    "oldest_evaluation_age_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of the oldest of these evaluations; null if there is none."),
}
_MESSAGE_TYPE = Column("category", key=True, categories=labels(MessageType), meaning="Round of messages: collective perception messages with own detections (cpm), or evaluations of the detections of others (evaluation). Roadside units broadcast trust values in the second round.")
_IN_RANGE = _count("(Frame, receiver) pairs within communication range, forwarded frames included. Each of them could have been received.")
_DELIVERED = _count("Number of these pairs in which the frame was received.")
_LOST = {
    "n_lost_propagation": _count("Lost to distance, obstacles, shadowing or fading."),
    "n_lost_collision": _count("Lost to interference of other senders."),
    "n_lost_receiver_busy": _count("Lost because the receiver was sending or locked to another frame."),
    "n_lost_expired": _count("Never sent, because the lifetime of the message ended in the sender's queue."),
    "n_lost_late": _count("Received after the time-out of the round and therefore dropped."),
}

_KIND = Column("category", key=True, categories=labels(EvaluationKind), absent="zero", meaning="What the evaluation is about: the detection itself; that the message does not withhold an object that the evaluator detects (missing; `detection_index` is then that of the evaluator's own detection, and 0 for the evaluator itself); or that the velocity of the detection is right (speed). The column exists if `trust.evidence` names more than detections.")
_DETECTION_STEP = Column("int32", of="steps", absent="step", meaning="Step of the detection; before `step` if it was in an earlier message. The column exists if not all vehicles sense at the same time.")

TABLES: Mapping[str, Table] = {
    "vehicles": Table(
        "summary",
        "Every actor of the run, one row each. The table is written at the end of the run.",
        {
            "vehicle": _key("Actor number, the true identity of the actor; unique in the run and never reused.", of="vehicles"),
            "sumo_id": Column("string", meaning="Name in SUMO."),
            "vehicle_class": Column("category", meaning="Class of vehicle, pedestrian, or unit of `[[roadside]]`, which is no traffic.", categories=labels(VehicleClass)),
            "length_m": Column("float32", unit="m", meaning="Extent along the heading."),
            "width_m": Column("float32", unit="m", meaning="Extent across the heading."),
            "height_m": Column("float32", unit="m", meaning="Vertical extent."),
            "equipped": Column("bool", meaning="A vehicle that carries a LiDAR and a radio; false for roadside units, which carry them too."),
            "role": Column("category", meaning="How an equipped vehicle behaves; null if not equipped.", categories=labels(Role), labels_of_run="roles", null=True),
            "attack": Column("int16", null=True, meaning="Section of `attacks` in the config, counted from 0, that the vehicle belongs to; null if honest or not equipped."),
            "first_step": Column("int32", of="steps", meaning="First step on the road."),
            "last_step": Column("int32", of="steps", meaning="Last step on the road."),
            "sensing_interval_steps": Column("int32", null=True, absent="null", meaning="Steps from one sweep of the vehicle to the next; null if not equipped. The column exists if not all vehicles sense at the same time."),
            "sensing_phase_steps": Column("int32", null=True, absent="null", meaning="First step in which the vehicle would sense; later ones follow after every interval. Null if not equipped."),
            "attack_start_step": Column("int32", of="steps", null=True, meaning="First step in which the vehicle lied in a detection or an evaluation, or attacked the channel or the server; null if it never did."),
        },
    ),
    "pseudonyms": Table(
        "summary",
        "Which vehicle used which pseudonym, and when. The table is written at the end of the run.",
        {
            "pseudonym": _key("Identity that messages carry. Receivers, trust models and the trust server know a sender only by it. One pseudonym is used by one vehicle only. With pseudonyms.policy = \"none\" it is the vehicle's actor number."),
            "vehicle": Column("int32", of="vehicles", truth=True, meaning="Vehicle that used it, as in `vehicles`."),
            "identity": Column("int16", truth=True, meaning="0 for the vehicle's own identity; 1 and above for the additional identities of a Sybil attacker."),
            "from_step": Column("int32", of="steps", truth=True, meaning="First step in use."),
            "to_step": Column("int32", of="steps", truth=True, meaning="Last step in use."),
            "refused_step": Column("int32", of="steps", null=True, truth=True, meaning="First step in which receivers dropped messages with this pseudonym because it was revoked; null if they never did."),
        },
    ),
    "actors": Table(
        "standard",
        "Poses of all actors, pedestrians included. They suffice to replay the traffic without SUMO.",
        {
            "step": _STEP,
            "actor": _key("Actor number, as `vehicle` in `vehicles`.", of="vehicles"),
            **{name: replace(_BOX[name], bits=bits) for name, bits in (("x_m", 8), ("y_m", 8), ("z_m", 8), ("yaw_rad", 9))},
            "speed_mps": Column("float32", unit="m/s", meaning="Speed along the heading.", bits=8, layout="bytes"),
        },
    ),
    "encounters": Table(
        "summary",
        "Encounters of two actors: periods in which they are within a radius of each other.",
        {
            "a": _key("The smaller of the two actor numbers.", of="vehicles"),
            "b": _key("The larger of the two actor numbers.", of="vehicles"),
            "start_step": _key("First step in contact.", of="steps"),
            "radius_m": Column("float32", unit="m", key=True, meaning="Largest distance that counts as contact."),
            "pairs": Column("category", key=True, categories=labels(EncounterPairs), meaning="Which pairs count: all, pairs of equipped vehicles, equipped pairs with line of sight (los), or all with line of sight (all_los)."),
            "hysteresis_s": Column("float32", unit="s", key=True, meaning="A break in contact shorter than this does not end the encounter."),
            "los": Column("category", key=True, categories=labels(LosBlockers), meaning="What cuts a line of sight, from 0.23 m (lidar.mount_above_roof_m) above one roof to the other: buildings, or the bodies of other actors too."),
            "pedestrians": Column("bool", key=True, meaning="Whether pedestrians count as actors; vehicles alone do otherwise."),
            "end_step": Column("int32", of="steps", meaning="First step no longer in contact."),
            "duration_s": Column("float32", unit="s", meaning="(end_step - start_step) * dt_s, bridged breaks included."),
            "censored_left": Column("bool", meaning="The two were in contact when recording began, so the encounter lasted longer than recorded."),
            "censored_right": Column("bool", meaning="The encounter had not ended when recording ended, so it lasted longer than recorded."),
            "entered": Column("bool", meaning="The encounter began because one of the two entered the simulation."),
            "departed": Column("bool", meaning="The encounter ended because one of the two left the simulation."),
            "gap_s": Column("float32", unit="s", null=True, meaning="Time since the last encounter of the two ended; null at their first encounter."),
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
        "The trust columns of `encounters` for the trust variants that do not act in the simulation; one row per encounter and variant.",
        {
            "variant": _VARIANT,
            "a": _key("The smaller of the two actor numbers.", of="vehicles"),
            "b": _key("The larger of the two actor numbers.", of="vehicles"),
            "start_step": _key("First step in contact.", of="steps"),
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
        "Actors that each LiDAR could have detected: one row per actor that at least one ray would hit if nothing stood in between.",
        {
            "step": _STEP,
            "observer": _key("Vehicle that carries the LiDAR (actor number).", of="vehicles"),
            "actor": _key("Actor in its field of view.", of="vehicles"),
            "n_points": Column("int32", truth=True, meaning="Returns from this actor."),
            "n_unoccluded": Column("int32", truth=True, meaning="Returns that the actor would have if nothing stood in between."),
        },
    ),
    "detections": Table(
        "standard",
        "Boxes in the vehicles' detection lists before they are sent. In all tables, (step, observer, detection_index) identifies a detection.",
        {
            "step": _STEP,
            "observer": _key("Pseudonym of the vehicle that made the detection.", of="pseudonyms"),
            "detection_index": _key("Number in the observer's list; 0 is the self report.", "int16"),
            "class": _CLASS,
            **_BOX,
            "score": _SCORE,
            "n_points": _count("Returns of the observer's own sweep inside the box."),
            "speed_mps": Column("float32", unit="m/s", null=True, bits=7, meaning="Speed, in self reports; null elsewhere."),
            "acceleration_mps2": Column("float32", unit="m/s2", null=True, bits=7, meaning="Acceleration along the heading, in self reports; null elsewhere."),
            "origin": Column("category", categories=labels(Origin), truth=True, meaning="Made by the detector, the vehicle's self report, or fabricated by an attack."),
            "transmitted": Column("bool", truth=True, meaning="The detection is in the message that was sent. An attack may withhold detections."),
            "lied": Column("bool", truth=True, meaning="The detection is a lie: it is fabricated, withheld by a malicious vehicle, or sent with values that differ from the perceived ones by more than noise (0.5 m, 10 degrees, 20 % of the size, 0.1 of the score, another class, 0.5 m/s or m/s2)."),
            "withheld": Column("bool", truth=True, meaning="An attack removed the detection from the message."),
            "target": Column("int32", of="vehicles", null=True, truth=True, meaning="Vehicle that an attack aims at with this detection (actor number); null if there is no target."),
            "truth_actor": _TRUTH_ACTOR,
            "truth_iou": _TRUTH_IOU,
            "truth_occlusion": Column("float32", unit="1", null=True, truth=True, bits=8, meaning="Share of that actor hidden from the observer."),
        },
    ),
    "cpm_content": Table(
        "standard",
        "What detection messages (collective perception messages) contain, and why they leave out other objects. One row per pseudonym that may send a message. Self reports are not counted as objects.",
        {
            "step": _STEP,
            "sender": _key("Pseudonym that the message carries.", of="pseudonyms"),
            "length_bytes": Column("int32", unit="B", meaning="Length of the message with all headers; 0 if it was not sent."),
            "n_objects": _count("Objects that the vehicle would report: those in its list that no attack or fault withholds."),
            "n_included": _count("Number of these objects in the message."),
            "n_waiting": _count("Number of them left out because the vehicle did not generate a message yet (`cpm.interval_s`, `radio.dcc`)."),
            "n_not_due": _count("Number of them left out because the generation rules do not ask for them yet (`cpm.rules`)."),
            "n_redundant": _count("Number of them left out because others reported them (`cpm.redundancy`)."),
            "n_over_limit": _count("Number of them left out because other objects came first (`cpm.max_objects`)."),
            "self_report": Column("bool", meaning="The message contains the self report."),
            "sensors": Column("bool", meaning="The message describes the sensors. With `cpm.length = \"linear\"` every message does."),
        },
    ),
    "dropped_detections": Table(
        "summary",
        "Detections that attacks made up or changed, that do not fit into a message and are therefore dropped before sending; counted by cause.",
        {
            "step": _STEP,
            "cause": Column("category", key=True, categories=labels(DetectionFault), meaning="First cause that applies: a value that is not finite; a place more than 10 km from the observer, or a heading of more than a full turn; a size of 0 or less, or above 1 km; a score outside [0, 1]; a class that does not exist; a detection number of more than 15 bits, or a number of returns of more than 31 bits; a detection number that is already in the list; more than 255 objects; a speed or an acceleration above 1,000."),
            "n": _count("Detections dropped."),
        },
    ),
    "position_errors": Table(
        "standard",
        "Errors of the estimated poses of equipped vehicles, if the config has [gnss]. They displace and turn all boxes of a vehicle's detections, its self report included, and of its fused objects.",
        {
            "step": _STEP,
            "vehicle": _key("Vehicle (actor number).", of="vehicles"),
            "error_x_m": Column("float32", unit="m", truth=True, bits=10, meaning="Position error, east: estimated minus true position."),
            "error_y_m": Column("float32", unit="m", truth=True, bits=10, meaning="Position error, north: estimated minus true position."),
            "error_yaw_rad": Column("float32", unit="rad", truth=True, bits=18, absent="zero", meaning="Error of the heading, counter-clockwise: estimated minus true heading."),
        },
    ),
    "tracks": Table(
        "standard",
        "What vehicles know about the motion of the objects in their detection lists, if the config has [tracking]: one row per detection of the detector, and per fabricated one with a velocity.",
        {
            "step": _STEP,
            "observer": _key("Pseudonym of the vehicle that made the detection, as in `detections`.", of="pseudonyms"),
            "detection_index": _key("Number in the observer's list, as in `detections`.", "int16"),
            "object_id": Column("int32", null=True, meaning="Number of the object among those that the vehicle has tracked, from 0. It stays the same as long as the vehicle tracks the object, also when the vehicle changes its pseudonym; null if an attack fabricated the detection."),
            "age_s": Column("float32", unit="s", null=True, bits=10, meaning="Time since the vehicle first detected the object; null as for `object_id`."),
            "velocity_x_mps": Column("float32", unit="m/s", null=True, bits=7, meaning="Velocity of the object, east, as it is sent; null until it has been detected tracking.confirm_hits times."),
            "velocity_y_mps": Column("float32", unit="m/s", null=True, bits=7, meaning="Velocity of the object, north; null as for `velocity_x_mps`."),
            "existence_p": Column("float32", unit="1", null=True, bits=12, meaning="Probability that the object exists, as the vehicle's tracking estimates it; null as for `object_id`."),
        },
    ),
    "receptions": Table(
        "full",
        "Messages that were received.",
        {
            "step": _key("Step in which the message was received.", of="steps"),
            "message_step": Column("int32", absent="step", of="steps", meaning="Step in which the message was sent; before `step` if its frames waited for the channel. The column exists if not all vehicles sense at the same time."),
            "message_type": _MESSAGE_TYPE,
            "sender": _key("Pseudonym that the message carries.", of="pseudonyms"),
            "receiver": _key("Vehicle that received it (actor number).", of="vehicles"),
            "hops": Column("uint8", meaning="Number of radio hops; 1 means received directly."),
            "generation_offset_s": Column("float32", layout="plain", unit="s", bits=20, meaning="Time from the beginning of the round to the generation of the message."),
            "access_delay_s": Column("float32", layout="plain", unit="s", bits=20, meaning="Time from generation until the (last) frame of the message's author was on the air."),
            "latency_s": Column("float32", layout="plain", unit="s", bits=20, meaning="Time from generation to reception."),
            "distance_m": Column("float32", unit="m", bits=5, meaning="Distance between author and receiver when the message was sent."),
        },
    ),
    "evidence": Table(
        "summary",
        "How often one look (one observation of one object by one vehicle in one step) counts more than once in trust values.",
        {
            "step": _STEP,
            "n_copies": _count("Copies of messages that their receivers already had. They are not used."),
            "n_evaluations": _count("Evaluations of others' detections with visibility above 0, as sent. They are the evidence for trust values."),
            "n_looks": replace(_count("Distinct looks behind these evaluations; a look is an evaluator, an observer and an actual object."), truth=True),
            "n_echoes": replace(_count("Number of these evaluations by which an attacker confirms what another attacker fabricated."), truth=True),
        },
    ),
    "fused_evidence": Table(
        "summary",
        "How often one evaluator counts more than once in the score of a fused object, for the trust variants whose fused objects are computed.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "n_evaluations": _count("Evaluations behind the fused objects: pairs of a detection and an evaluator."),
            "n_evaluators": _count("Pairs of a fused object and an evaluator behind it."),
        },
    ),
    "radio": Table(
        "summary",
        "The radio channel, summed over all stations.",
        {
            "step": _STEP,
            "message_type": _MESSAGE_TYPE,
            "n_sent": _count("Frames sent, forwarded copies included."),
            "n_relayed": _count("Number of these frames that are forwarded copies."),
            "n_in_range": _IN_RANGE,
            "n_delivered": _DELIVERED,
            "n_duplicate": _count("Number of received frames with a message that the receiver already had."),
            **_LOST,
            "sent_bytes": Column("float32", unit="B", meaning="Bytes sent on the air, forwarded copies and, with detection messages, point clouds included."),
            "cbr": Column("float32", unit="1", null=True, meaning="Channel busy ratio: share of the time in which a vehicle senses the channel busy, mean over vehicles; null if the medium does not model it."),
        },
    ),
    "pdr_by_distance": Table(
        "summary",
        "The radio channel by distance between the two ends of a hop. The packet delivery ratio is n_delivered / n_in_range.",
        {
            "step": _STEP,
            "message_type": _MESSAGE_TYPE,
            "distance_bin_m": Column("int16", unit="m", key=True, meaning=f"Lower edge of the distance bin; bins are {DISTANCE_BIN_M} m wide."),
            "los_state": Column("category", key=True, categories=labels(LosState), meaning="Line of sight between the two ends: no building (los), a building (nlos), or not modelled (unknown)."),
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
            "latency_s": Column("float32", unit="s", key=True, meaning="Lower edge of the bin. Its upper edge is larger by a factor of the square root of 2."),
            "n_delivered": _count("Messages received; each counts once per receiver."),
        },
    ),
    "packet_inter_reception": Table(
        "summary",
        "Packet inter-reception time: time between successive messages of one vehicle at another, while the two are within communication range of each other. Long times show several losses in a row.",
        {
            "step": _key("Time step in which the interval ended; seconds are step * dt_s of the manifest.", of="steps"),
            "message_type": _MESSAGE_TYPE,
            "pir_steps": _key("Steps from one reception to the next, or to the last step within range. It is one sensing interval if nothing was lost."),
            "n_received": _count("Intervals that ended with a reception."),
            "n_censored": _count("Intervals that had not ended when the two got out of range or one left. They would have lasted longer. 0 steps means out of range right after a reception."),
        },
    ),
    "vehicle_channel": Table(
        "standard",
        "The radio channel at each equipped vehicle, for both rounds of messages together.",
        {
            "step": _STEP,
            "vehicle": _key("Vehicle that receives (actor number).", of="vehicles"),
            "cbr": Column("float32", unit="1", null=True, bits=8, meaning="Channel busy ratio: share of the time in which the vehicle senses the channel busy; null if the medium does not model it."),
            "n_in_range": Column("int16", meaning="Messages sent by vehicles within communication range."),
            "n_received": Column("int16", meaning="Messages of vehicles that this vehicle received, forwarded ones included."),
        },
    ),
    "server": Table(
        "summary",
        "Links between vehicles and the trust server. The table is empty if there is no server.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "n_reports": _count("Reports with evaluations that vehicles wanted to send to the server."),
            "n_reached": _count("Number of these reports that reach the server, in this step or later."),
            "n_lost": _count("Number of these reports lost on the way, or received by no roadside unit in this step."),
            "n_late": _count("Reports of earlier steps, counted as lost there, that a roadside unit receives in this step."),
            "n_over_capacity": _count("Number of these reports dropped because the capacity of their cell was exceeded."),
            "n_outage": _count("Number of these reports lost because the server was out of service."),
            "uplink_bytes": Column("float32", unit="B", meaning="Bytes of all reports that use the cellular network, headers included."),
            "n_addressed": _count("Vehicles on the road when trust values were broadcast; 0 if there was no broadcast."),
            "n_informed": _count("Number of these vehicles that the broadcast reaches, in this step or later."),
        },
    ),
    "evaluations": Table(
        "standard",
        "Evaluations that vehicles make of each other's detections, each once.",
        {
            "step": _key("Step of the evaluation.", of="steps"),
            "evaluator": _key("Pseudonym of the vehicle that evaluates.", of="pseudonyms"),
            "observer": _key("Pseudonym of the vehicle that made the detection.", layout="plain", of="pseudonyms"),
            "detection_index": _key("Number of the detection in its list.", "int16"),
            "kind": _KIND,
            "detection_step": _DETECTION_STEP,
            "evaluation": Column("float32", unit="1", bits=12, meaning="Score of the evaluator's matching detection; negative if the evaluator denies the detection."),
            "visibility": Column("float32", unit="1", bits=12, meaning="How well the evaluator could have seen the object, in [0, 1]: the weight of the evaluation."),
            "n_points": _count("Returns of the evaluator's own sweep inside the box."),
            "plausible": Column("bool", null=True, meaning="Result of the free-space test in the evaluator's own sweep; null if the test was not made."),
            "matched": Column("bool", meaning="The detection matched a detection of the evaluator's own; false if `kind` is not detection."),
            "lied": Column("bool", truth=True, meaning="The evaluation is a lie: evaluation times visibility, as sent, differs by more than 0.1 from what the evaluator found."),
        },
    ),
    "transmitted_evaluations": Table(
        "full",
        "Evaluations from which trust is computed: as they were transmitted, and as the evaluator keeps them for itself, both without rounding.",
        {
            "step": _key("Step of the evaluation.", of="steps"),
            "evaluator": _key("Pseudonym of the vehicle that evaluates.", of="pseudonyms"),
            "observer": _key("Pseudonym of the vehicle that made the detection.", of="pseudonyms"),
            "detection_index": _key("Number of the detection in its list.", "int16"),
            "kind": _KIND,
            "detection_step": _DETECTION_STEP,
            "evaluation": Column("float64", layout="plain", unit="1", meaning="As in `evaluations`, as transmitted."),
            "visibility": Column("float64", unit="1", meaning="As in `evaluations`, as transmitted."),
            "own_evaluation": Column("float64", layout="plain", unit="1", meaning="The evaluation as the evaluator keeps it, not changed by an attack."),
            "own_visibility": Column("float64", unit="1", meaning="The visibility as the evaluator keeps it, not changed by an attack."),
        },
    ),
    "transmitted_scores": Table(
        "full",
        "Scores of the detections that were transmitted, without rounding.",
        {
            "step": _STEP,
            "observer": _key("Pseudonym of the vehicle that made the detection.", of="pseudonyms"),
            "detection_index": _key("Number of the detection in its list.", "int16"),
            "score": Column("float64", unit="1", meaning="Confidence in [0, 1].", layout="bytes"),
        },
    ),
    "trust": Table(
        "summary",
        "Trust in each pseudonym, at every step in which the trust server computes it.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "subject": _key("Pseudonym that the trust is in.", of="pseudonyms"),
            "trust": Column("float32", unit="1", meaning="Trust in [0, 1], an expected value.", layout="bytes"),
            "uncertainty": Column("float32", unit="1", null=True, meaning="Uncertainty of the trust in [0, 1]; null if the trust model has none."),
            "weight": Column("float32", unit="1", meaning="Sum of the weights of the detections that the trust rests on.", layout="bytes"),
            "state": Column("category", categories=labels(LookupState), meaning="Whether the trust rests on an evaluation (evaluated) or not (unevaluated)."),
            **_EVALUATIONS,
        },
    ),
    "trust_lookups": Table(
        "standard",
        "Trust values that vehicles look up before fusion: one row per receiver and sender of a received message.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "subject": _key("Pseudonym that the value is about. Rows are sorted by it before the receiver, because receivers have nearly the same values.", of="pseudonyms"),
            "receiver": _key("Vehicle that looks the value up (actor number).", of="vehicles"),
            "trust": Column("float32", layout="bytes", unit="1", meaning="Value that is used, in [0, 1]."),
            "source": Column("category", categories=labels(TrustSource), meaning="Source of the value: the server, own evidence, or the default. The default also replaces an unevaluated value if trust.unevaluated = \"default\"."),
            "state": Column("category", categories=labels(LookupState), meaning="What the value rests on: an evaluation within the window (evaluated), only older evaluations (stale), a value without any evaluation (unevaluated), or no value (no_value)."),
            "age_s": Column("float32", unit="s", null=True, bits=10, meaning="Time since the value was computed. It is 0 for own values, which are computed when they are looked up, and null if the source is the default."),
            **_EVALUATIONS,
        },
    ),
    "lookup_totals": Table(
        "summary",
        "Lookups of trust values, counted by state, with sums of ages from which mean ages follow.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "state": Column("category", key=True, categories=labels(LookupState), meaning="As in `trust_lookups`."),
            "n": _count("Lookups in this state."),
            "n_valued": _count("Number of these lookups with a value of the server or an own value, not the default."),
            "age_sum_s": Column("float32", unit="s", meaning="Sum of the ages of these values (`age_s`)."),
            "newest_evaluation_age_sum_s": Column("float32", unit="s", meaning="Sum of the ages of the newest evaluations in the states evaluated and stale; 0 in other states."),
            "oldest_evaluation_age_sum_s": Column("float32", unit="s", meaning="Sum of the ages of the oldest evaluations, likewise."),
        },
    ),
    "attack_outcomes": Table(
        "summary",
        "Effects of attacks. There is one row for each pair of a fabricated detection and another vehicle that received it. There is also one row for each pair of a withheld detection of a real actor and a vehicle that received the message without it. Only trust variants whose fused objects are computed have rows.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "effect": Column("category", key=True, categories=labels(AttackEffect), truth=True, meaning="Fabricated (inserted) or withheld (removed)."),
            "observer": _key("Pseudonym of the attacker: with detection_index it names the detection.", of="pseudonyms"),
            "detection_index": _key("Number of the detection in the attacker's list.", "int16"),
            "detection_step": _DETECTION_STEP,
            "receiver": _key("Vehicle that received the message (actor number), never the attacker itself.", of="vehicles"),
            "intended": Column("bool", truth=True, meaning="The receiver is a target of the attack."),
            "in_path": Column("bool", truth=True, meaning="The box is in the receiver's path: the straight strip of its width, 50 m ahead of its centre."),
            "ego_detected": Column("bool", truth=True, meaning="The receiver detected the withheld actor itself."),
            "score": Column("float32", unit="1", null=True, truth=True, bits=12, meaning="Score of the object among the receiver's fused objects. For a fabricated detection, it is the fused object that contains it, if the box of that object is fabricated. For a withheld detection, it is the fused object of that actor with the highest score. Null if there is none with a score of at least trust.min_score."),
        },
    ),
    "fused": Table(
        "standard",
        "Fused objects of each vehicle: its own detections and those of others that it accepts.",
        {
            "step": _STEP,
            "variant": _VARIANT,
            "observer": _key("Vehicle whose list it is (actor number).", of="vehicles"),
            "fused_index": _key("Number in its list.", "int16"),
            "class": replace(_CLASS, via="source"),
            **{name: replace(column, via="pose" if name in _POSE else "source") for name, column in _BOX.items()},
            "score": _SCORE,
            "n_sources": Column("int16", meaning="Number of vehicles with a detection of the object, the observer included."),
            "ego_detected": Column("bool", meaning="The observer itself detected the object."),
            "source": Column("int32", of="pseudonyms", meaning="Pseudonym of the vehicle whose detection gave the box."),
            "source_index": Column("int16", meaning="Number of that detection in its list."),
            "source_step": replace(_DETECTION_STEP, meaning="Step of that detection; before `step` if it was in an earlier message."),
            "pose": Column("int32", of="pseudonyms", null=True, meaning="Pseudonym of the vehicle whose detection gave position and heading, if it is not the source."),
            "pose_index": Column("int16", null=True, meaning="Number of that detection in its list."),
            "pose_step": replace(_DETECTION_STEP, meaning="Step of the detection that gave position and heading."),
            "moved_x_m": Column("float32", unit="m", absent="zero", bits=7, meaning="How far the observer moved the box east since it was sent: by its velocity (extrapolate = true), and to where all detections of the object say (trust.fused_boxes). The columns exist with one of them."),
            "moved_y_m": Column("float32", unit="m", absent="zero", bits=7, meaning="How far the observer moved the box north."),
            "moved_z_m": _moved("How far it moved the box up. This and the next exist unless fused_boxes is best."),
            "moved_length_m": _moved("By how much the box is longer than the source's."),
            "moved_width_m": _moved("By how much the box is wider than the source's."),
            "moved_height_m": _moved("By how much the box is higher than the source's."),
            "moved_yaw_rad": _moved("By how much the box is turned from the source's, counter-clockwise.", "rad", 9),
            "fabricated": Column("bool", truth=True, meaning="The box was fabricated by an attack."),
            "truth_actor": replace(_TRUTH_ACTOR, via="source"),
            "truth_iou": replace(_TRUTH_IOU, via="source", meaning="3D intersection over union of the source's box with that actor's true box."),
        },
    ),
    "early_fused": Table(
        "standard",
        "What each vehicle detects in its own point cloud merged with those of its partners, if the config has [early_fusion]; beside `detections` (own sweep alone) and `fused` (lists).",
        {
            "step": _STEP,
            "observer": _key("Vehicle whose list it is (actor number).", of="vehicles"),
            "early_index": _key("Number in its list.", "int16"),
            "class": _CLASS,
            **_BOX,
            "score": _SCORE,
            "n_points": _count("Returns of all merged sweeps from the object; returns of the own sweep inside the box if it belongs to no actor."),
            "n_sweeps": Column("int16", meaning="Number of merged sweeps with a return from the object, the own one included."),
            "truth_actor": replace(_TRUTH_ACTOR, meaning="Actor that the box really belongs to; null if it belongs to none (false positive of the own sweep)."),
            "truth_iou": _TRUTH_IOU,
        },
    ),
    "clouds": Table(
        "standard",
        "Point clouds that vehicles broadcast for early fusion, if the config has [early_fusion]. One row per sweep.",
        {
            "step": _STEP,
            "sender": _key("Vehicle that broadcasts it (actor number), roadside units included.", of="vehicles"),
            "n_points": _count("Returns in it."),
            "length_bytes": Column("int32", unit="B", meaning="Length with headers, before it is cut into frames; 0 without returns."),
            "n_sent": Column("int32", null=True, meaning="Frames of it that were on the air; null with early_fusion.medium = \"unlimited\"."),
            "n_in_range": _count("Other equipped vehicles within early_fusion.range_m."),
            "n_received": _count("Number of these that received all its frames before the round ended."),
        },
    ),
    "reactions": Table(
        "standard",
        "Speeds that drivers command because of objects that their vehicles believe in, in the step before the speeds are driven. The table is empty without such a driver.",
        {
            "step": _STEP,
            "vehicle": _key("Vehicle that reacts (actor number).", of="vehicles"),
            "source_step": Column("int32", of="steps", meaning="Step of the detection that it reacts to."),
            "source": Column("int32", of="pseudonyms", meaning="Pseudonym of the vehicle whose detection it is."),
            "source_index": Column("int16", meaning="Number of that detection in its list."),
            "gap_m": Column("float32", unit="m", bits=7, meaning="Distance from the front bumper to the object along the lane."),
            "speed_mps": Column("float32", unit="m/s", bits=8, meaning="Speed commanded for the next step; SUMO's own rules may keep the vehicle slower."),
            "deceleration_mps2": Column("float32", unit="m/s2", bits=8, meaning="Deceleration from the present speed to the commanded one within a step; negative if the vehicle may accelerate."),
            "fabricated": Column("bool", truth=True, meaning="The object was fabricated by an attack."),
            "truth_actor": replace(_TRUTH_ACTOR, meaning="Actor that the object really is; null if it is no actor (false positive of a detector, or fabricated)."),
        },
    ),
}
# fmt: on


def kept(level: Level) -> tuple[str, ...]:
    """Names of the tables that a run of this record level contains."""
    return tuple(name for name, table in TABLES.items() if LEVELS.index(table.level) <= LEVELS.index(level))


def schema(name: str, whole: bool = False, there: Collection[str] | None = None) -> pa.Schema:
    """Arrow schema of a table, with unit and meaning as field metadata.

    Parameters
    ----------
    name
        Name of the table.
    whole
        False gives the columns that are stored on disk, True gives all columns.
    there
        Columns that a run has. Those that not every run has are left out if they are not among these.
    """
    table = TABLES[name]
    fields = [
        pa.field(
            label,
            column.arrow_type,
            nullable=column.null,
            metadata={"unit": column.unit, "meaning": column.meaning, "key": str(column.key).lower()},
        )
        for label, column in (table.columns if whole else table.stored).items()
        if there is None or not column.absent or label in there
    ]
    return pa.schema(fields, {"table": name, "schema_version": str(SCHEMA_VERSION), "meaning": table.meaning})


def axis_label(table: str, column: str, text: str | None = None) -> str:
    """Axis label with the column's unit: `axis_label("trust", "newest_age_s", "Age")` is `Age [s]`."""
    found = TABLES[table].columns[column]
    name = text or column.replace("_", " ")
    return f"{name} [{found.unit}]" if found.unit not in ("", "1") else name
