"""From the result of a step to the rows of the run's tables."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

import cosim.codes  # noqa: F401  the codes that are written are those that the tables render
from cosim.cycle import Turn
from cosim.roster import Roster
from cosim.trackers.channel_counts import latency_histogram, pdr_by_distance, vehicle_channel
from cosim.trackers.encounters import EncounterTrackers
from cosim.trackers.inter_reception import InterReceptionTracker, unique_pairs
from cosim.v2x.exchange import Exchange, Fate
from cosim.v2x.messages import FABRICATED, Detections
from cosim.world import World
from results.codes import MessageType, TrustSource
from results.encounters import Rows
from results.recorder import Recorder
from sensors.boxes import Boxes

OUTCOMES = {
    "n_delivered": Fate.RECEIVED,
    "n_lost_propagation": Fate.PROPAGATION,
    "n_lost_collision": Fate.COLLISION,
    "n_lost_receiver_busy": Fate.RECEIVER_BUSY,
    "n_lost_expired": Fate.EXPIRED,
    "n_lost_late": Fate.LATE,
}
"""Columns of the tables `radio` and `pdr_by_distance`, and the outcome that each counts."""

BASE = 0
"""Code of the trust variant that acts."""


def actors(recorder: Recorder, world: World) -> None:
    """Poses of all actors."""
    xyz, yaw = world.boxes.xyz_m, world.boxes.yaw_rad
    recorder.append("actors", world.step, {
        "actor": world.actor, "x_m": xyz[:, 0], "y_m": xyz[:, 1], "z_m": xyz[:, 2], "yaw_rad": yaw,
        "speed_mps": world.speed_mps,
    })  # fmt: skip


def encounters(recorder: Recorder, step: int, closed: Sequence[Rows]) -> None:
    """Encounters that ended in this step, by definition."""
    for rows in closed:
        recorder.append("encounters", step, rows)


def count_in_encounters(trackers: EncounterTrackers, turn: Turn) -> None:
    """Messages, evaluations and trust lookups of this step, for the encounters under way."""
    ids = turn.world.actor[turn.observers]
    evaluator = turn.views.of_member()
    observer = turn.said.observer[turn.views.member]
    foreign = turn.observers[evaluator] != observer
    pair, n = np.unique(evaluator[foreign] * len(turn.world) + observer[foreign], return_counts=True)
    looked_up = turn.known.source != TrustSource.DEFAULT
    for exchange in turn.exchanges:
        trackers.count_messages(ids[exchange.heard.sender], ids[exchange.heard.receiver])
    trackers.note_trust(ids[turn.met.receiver][looked_up], ids[turn.met.sender][looked_up])
    trackers.count_evaluations(ids[pair // len(turn.world)], turn.world.actor[pair % len(turn.world)], n)


def step(recorder: Recorder, turn: Turn, pir: Sequence[InterReceptionTracker], dt_s: float) -> None:
    """Everything that the result of a step says; `pir` goes with its rounds of messages."""
    _perception(recorder, turn)
    _channel(recorder, turn, pir)
    _receptions(recorder, turn)
    _evaluations(recorder, turn)
    _trust(recorder, turn, dt_s)
    _fused(recorder, turn)


def _box_columns(boxes: Boxes) -> Rows:
    x, y, z = boxes.xyz_m.T
    length, width, height = boxes.lwh_m.T
    return {
        "x_m": x, "y_m": y, "z_m": z, "length_m": length, "width_m": width, "height_m": height,
        "yaw_rad": boxes.yaw_rad,
    }  # fmt: skip


def _perception(recorder: Recorder, turn: Turn) -> None:
    said: Detections = turn.said
    truth = turn.truth
    recorder.append("detections", turn.world.step, {
        "observer": turn.world.actor[said.observer], "detection_index": said.k, "class": said.label,
        **_box_columns(said.boxes), "score": said.score, "n_points": said.n_points,
        "origin": said.origin, "transmitted": said.said,
        "truth_actor": turn.world.actor[truth.actor_row], "truth_actor__valid": truth.is_real,
        "truth_iou": truth.iou, "truth_iou__valid": truth.is_real,
        "truth_occlusion": truth.occlusion, "truth_occlusion__valid": truth.is_sensed,
    })  # fmt: skip
    recorder.append("observability", turn.world.step, {
        "observer": turn.world.actor[turn.observers[turn.sights.o]], "actor": turn.world.actor[turn.sights.actor],
        "n_points": turn.sights.n_returns, "n_unoccluded": turn.sights.n_unoccluded,
    })  # fmt: skip


def _channel(recorder: Recorder, turn: Turn, pir: Sequence[InterReceptionTracker]) -> None:
    at, ids = turn.world.step, turn.world.actor[turn.observers]
    n = len(ids)
    in_range = [_pairs_in_range(exchange, n) for exchange in turn.exchanges]
    for message_type, exchange in zip(MessageType, turn.exchanges, strict=True):
        frames = exchange.frames
        by_distance, total = pdr_by_distance(frames.distance_m, frames.view, frames.fate, OUTCOMES)
        recorder.append("radio", at, _of(message_type, {
            "n_sent": np.array([frames.n_transmissions.sum()]), "n_relayed": np.array([frames.n_relayed]),
            "n_duplicate": np.array([frames.n_duplicate]), "sent_bytes": np.array([frames.sent_bytes]), **total,
            "cbr": None if frames.busy is None else np.array([frames.busy[:n].mean()]),
        }))  # fmt: skip
        recorder.append("pdr_by_distance", at, _of(message_type, by_distance))
        recorder.append("latency_histogram", at, _of(message_type, latency_histogram(exchange.heard.latency_s)))
    recorder.append("vehicle_channel", at, {"vehicle": ids} | vehicle_channel(
        n, [receiver for _, receiver in in_range], [exchange.heard.receiver for exchange in turn.exchanges],
        [exchange.frames.busy for exchange in turn.exchanges],
    ))  # fmt: skip
    for message_type, exchange, tracker, (sender, receiver) in zip(
        MessageType, turn.exchanges, pir, in_range, strict=True
    ):
        received = np.isin(sender * n + receiver, exchange.heard.sender * n + exchange.heard.receiver)
        rows = tracker.update(at, ids[sender], ids[receiver], received)
        recorder.append("packet_inter_reception", at, _of(message_type, rows))


def _of(message_type: MessageType, rows: Mapping[str, ndarray | None]) -> dict[str, ndarray | None]:
    n = next(len(values) for values in rows.values() if values is not None)
    return {"message_type": np.full(n, message_type), **rows}


def _pairs_in_range(exchange: Exchange, n: int) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    """Authors of messages, and the other vehicles within range of them: each pair once, sorted."""
    frames = exchange.frames
    own = np.flatnonzero((frames.hop == 1) & (frames.origin < n) & (frames.receiver < n))
    return unique_pairs(frames.origin[own].astype(np.int64), frames.receiver[own].astype(np.int64), n)


def _receptions(recorder: Recorder, turn: Turn) -> None:
    ids = turn.world.actor[turn.observers]
    for message_type, exchange in zip(MessageType, turn.exchanges, strict=True):
        heard = exchange.heard
        recorder.append("receptions", turn.world.step, _of(message_type, {
            "sender": ids[heard.sender], "receiver": ids[heard.receiver], "hops": heard.hops,
            "generation_offset_s": heard.generated_s, "access_delay_s": heard.access_s,
            "latency_s": heard.latency_s, "distance_m": heard.distance_m,
        }))  # fmt: skip


def _evaluations(recorder: Recorder, turn: Turn) -> None:
    member, ids = turn.views.member, turn.world.actor[turn.observers]
    recorder.append("evaluations", turn.world.step, {
        "evaluator": ids[turn.views.of_member()], "observer": turn.world.actor[turn.said.observer[member]],
        "detection_index": turn.said.k[member], "evaluation": turn.verdicts.e, "visibility": turn.verdicts.phi,
        "n_points": turn.n_points, "plausible": turn.plausible, "plausible__valid": ~turn.matched,
        "matched": turn.matched,
    })  # fmt: skip


def _trust(recorder: Recorder, turn: Turn, dt_s: float) -> None:
    at, ids = turn.world.step, turn.world.actor[turn.observers]
    standing, met = turn.standing, turn.met
    if standing is not None:
        recorder.append("trust", at, {
            "variant": np.full(len(standing.subject), BASE), "subject": standing.subject,
            "trust": standing.trust, "uncertainty": None, "weight": standing.weight,
            "n_evaluations": standing.n_verdicts, "newest_age_s": (at - standing.newest_step) * dt_s,
            "oldest_age_s": (at - standing.oldest_step) * dt_s,
        })  # fmt: skip
    if turn.to_server is not None:
        up, down = turn.to_server.up, turn.to_server
        recorder.append("server", at, {
            "n_reports": np.array([up.n_reports]), "n_reached": np.array([up.n_reached]),
            "n_lost": np.array([up.n_lost]), "n_over_capacity": np.array([up.n_over_capacity]),
            "n_outage": np.array([up.n_outage]), "uplink_bytes": np.array([up.up_bytes]),
            "n_addressed": np.array([down.n_addressed]), "n_informed": np.array([down.n_informed]),
        })  # fmt: skip
    recorder.append("trust_lookups", at, {
        "variant": np.full(len(met.receiver), BASE), "receiver": ids[met.receiver], "subject": ids[met.sender],
        "trust": turn.known.trust, "source": turn.known.source,
        "age_s": turn.known.age_s, "age_s__valid": turn.known.source != TrustSource.DEFAULT,
    })  # fmt: skip


def _fused(recorder: Recorder, turn: Turn) -> None:
    fused, said = turn.fused, turn.said
    view = fused.view
    recorder.append("fused", turn.world.step, {
        "variant": np.full(len(view), BASE), "observer": turn.world.actor[turn.observers[view]],
        "fused_index": np.arange(len(view)) - np.searchsorted(view, view),
        "score": fused.score, "n_sources": fused.n_witnesses, "ego_detected": fused.local,
        "source": turn.world.actor[said.observer[fused.seed]], "source_index": said.k[fused.seed],
        "pose": turn.world.actor[said.observer[fused.pose]], "pose__valid": fused.pose != fused.seed,
        "pose_index": said.k[fused.pose], "pose_index__valid": fused.pose != fused.seed,
        "fabricated": said.origin[fused.seed] == FABRICATED,
    })  # fmt: skip


def attackers(turn: Turn) -> Int[ndarray, "k"]:
    """Actors with a fabricated detection in this step, once for each."""
    return turn.world.actor[turn.said.observer[turn.said.origin == FABRICATED]]


def vehicles(
    recorder: Recorder, roster: Roster, attack_start_step: Int[ndarray, "n"], attacked: Bool[ndarray, "n"],
    last_step: int,
) -> None:  # fmt: skip
    """All actors once, at the end, and the pseudonyms of the equipped: their actor numbers."""
    lwh = roster.lwh_m
    number = np.arange(len(roster), dtype=np.int32)
    recorder.append("vehicles", last_step, {
        "vehicle": number, "sumo_id": np.array(roster.names, object), "vehicle_class": roster.shape,
        "length_m": lwh[:, 0], "width_m": lwh[:, 1], "height_m": lwh[:, 2],
        "equipped": roster.equipped, "role": roster.behaviour, "role__valid": roster.equipped,
        "first_step": roster.first_step, "last_step": roster.last_step,
        "attack_start_step": attack_start_step, "attack_start_step__valid": attacked,
    })  # fmt: skip
    equipped = roster.equipped
    recorder.append("pseudonyms", last_step, {
        "pseudonym": number[equipped], "vehicle": number[equipped],
        "from_step": roster.first_step[equipped], "to_step": roster.last_step[equipped],
    })  # fmt: skip
