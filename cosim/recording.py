"""From a step's arrays to the rows of the run's tables."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int
from numba import njit
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.config import Config
from cosim.cycle import FROM_NOWHERE, State, Turn, knowledge
from cosim.radio.message_round import LosState, MessageRound, Outcome
from cosim.roster import Roster
from cosim.v2x.messages import FABRICATED, Detections
from cosim.world import World
from results.encounters import EncounterLedger
from results.recorder import Recorder
from sensors.boxes import Boxes
from sensors.line_of_sight import los_between_actors
from sensors.scene import Scene, Shape

FATES = {
    "n_delivered": Outcome.RECEIVED,
    "n_lost_propagation": Outcome.PROPAGATION,
    "n_lost_collision": Outcome.COLLISION,
    "n_lost_receiver_busy": Outcome.RECEIVER_BUSY,
    "n_lost_expired": Outcome.EXPIRED,
    "n_lost_late": Outcome.LATE,
}
"""Columns of the tables `radio` and `links`, and the fate that each counts."""

RING_M = 25
"""Width of a ring of distance in the table `links` [m]."""

LATENCY_BINS_S = 1e-4 * 2.0 ** (np.arange(-2, 33) / 2)
"""Lower edges of the bins of the table `latencies` [s]."""


def actors(recorder: Recorder, world: World) -> None:
    """Poses of everybody."""
    xyz, yaw = world.boxes.xyz_m, world.boxes.yaw_rad
    recorder.append("actors", world.step, {
        "actor": world.actor, "x_m": xyz[:, 0], "y_m": xyz[:, 1], "z_m": xyz[:, 2], "yaw_rad": yaw,
        "speed_mps": world.speed_mps,
    })  # fmt: skip


@dataclass(slots=True)
class Meetings:
    """Encounters of all configured radii, told at every step, whether anybody senses in it or not."""

    config: Config
    ledgers: list[EncounterLedger] = field(init=False)

    def __post_init__(self) -> None:
        self.ledgers = [EncounterLedger(p, self.config.traffic.step_s) for p in self.config.encounters]

    def update(self, recorder: Recorder, world: World, city: Scene, state: State) -> None:
        """Who is near whom, and what they knew of each other when they met."""
        drives = world.shape != Shape.PEDESTRIAN
        if all(ledger.params.pairs != "all" for ledger in self.ledgers):
            drives &= world.equipped
        rows = np.flatnonzero(drives)
        xy = world.boxes.xyz_m[rows, :2]
        reach_m = max((ledger.params.radius_m for ledger in self.ledgers), default=0.0)
        pairs = cKDTree(xy).query_pairs(reach_m, output_type="ndarray") if len(rows) else np.zeros((0, 2), int)
        pair = np.sort((pairs[:, 0] << 32) | pairs[:, 1])
        a, b = rows[pair >> 32], rows[pair & 0xFFFFFFFF]
        east_m, north_m = (world.boxes.xyz_m[a, axis] - world.boxes.xyz_m[b, axis] for axis in (0, 1))
        distance_m = np.sqrt(east_m * east_m + north_m * north_m)
        sight = los_between_actors(state.los, world.boxes, world.shape, a, b, self.config.lidar.mount_above_roof_m)
        equipped = world.equipped[a] & world.equipped[b]
        for ledger in self.ledgers:
            closed, opened = ledger.update(
                world.step, world.actor[a], world.actor[b], distance_m, sight, world.actor[rows], equipped
            )
            recorder.append("encounters", world.step, closed)
            new = opened[equipped[opened]]
            one, other = world.actor[a[new]], world.actor[b[new]]
            receiver, subject = np.concatenate([one, other]), np.concatenate([other, one])
            known = knowledge(
                state, self.config, receiver, subject, world.actor[world.equipped],
                world.step * self.config.traffic.step_s,
            )  # fmt: skip
            ledger.first_contact(receiver, subject, known.trust, known.source, known.age_s)

    def count(self, turn: Turn) -> None:
        """Messages and verdicts of this turn, between those who are meeting."""
        ids = turn.world.actor[turn.observers]
        evaluator = turn.views.of_member()
        observer = turn.said.observer[turn.views.member]
        foreign = turn.observers[evaluator] != observer
        judged = evaluator[foreign] * len(turn.world) + observer[foreign]
        pair, n = np.unique(judged, return_counts=True)
        met, told = turn.met, turn.known.source != FROM_NOWHERE
        for ledger in self.ledgers:
            for links in turn.links:
                ledger.count_messages(ids[links.vehicles.message], ids[links.vehicles.receiver])
            ledger.note_trust(ids[met.receiver][told], ids[met.message][told])
            ledger.count_verdicts(ids[pair // len(turn.world)], turn.world.actor[pair % len(turn.world)], n)

    def close(self, recorder: Recorder, last_step: int) -> None:
        """What is still going on when recording ends."""
        for ledger in self.ledgers:
            recorder.append("encounters", last_step, ledger.close(last_step + 1))


def turn(recorder: Recorder, turn: Turn, silences: tuple["Silences", ...], dt_s: float) -> None:
    """Everything that a turn says; `silences` go with its exchanges."""
    world, step = turn.world, turn.world.step
    ids = world.actor[turn.observers]
    _detections(recorder, turn)
    _radio(recorder, turn)
    pairs = [_in_reach(exchange, len(ids)) for exchange in turn.rounds]
    _ears(recorder, turn, pairs)
    for message, silence in enumerate(silences):
        silence.update(recorder, turn, message, pairs[message])
    recorder.append("sightings", step, {
        "observer": ids[turn.sights.o], "actor": world.actor[turn.sights.actor],
        "n_points": turn.sights.n_returns, "n_unoccluded": turn.sights.n_unoccluded,
    })  # fmt: skip
    for message, links in enumerate(turn.links):
        heard = links.vehicles
        recorder.append("deliveries", step, {
            "message": np.full(len(heard.message), message),
            "sender": ids[heard.message], "receiver": ids[heard.receiver],
            "hops": heard.hops, "generated_s": heard.generation_offset_s, "access_s": heard.access_delay_s,
            "latency_s": heard.latency_s, "distance_m": heard.distance_m,
        })  # fmt: skip
    member = turn.views.member
    recorder.append("verdicts", step, {
        "judged_step": np.full(len(member), step),
        "evaluator": ids[turn.views.of_member()], "observer": world.actor[turn.said.observer[member]],
        "k": turn.said.k[member], "e": turn.verdicts.e, "visibility": turn.verdicts.phi,
        "n_points": turn.n_points, "plausible": turn.plausible, "plausible__valid": ~turn.matched,
        "matched": turn.matched,
    })  # fmt: skip
    standing = turn.standing
    if standing is not None:
        recorder.append("trust", step, {
            "vehicle": standing.subject, "trust": standing.trust, "weight": standing.weight,
            "n_evaluations": standing.n_verdicts, "newest_age_s": (step - standing.newest_step) * dt_s,
            "oldest_age_s": (step - standing.oldest_step) * dt_s,
        })  # fmt: skip
    if turn.to_server is not None:
        up, down = turn.to_server.up, turn.to_server
        recorder.append("server", step, {
            "n_reports": np.array([up.n_reports]), "n_reached": np.array([up.n_reached]),
            "n_lost": np.array([up.n_lost]), "n_over_capacity": np.array([up.n_over_capacity]),
            "n_outage": np.array([up.n_outage]), "up_bytes": np.array([up.uplink_bytes]),
            "n_addressed": np.array([down.n_addressed]), "n_informed": np.array([down.n_informed]),
        })  # fmt: skip
    met = turn.met
    recorder.append("uses", step, {
        "receiver": ids[met.receiver], "subject": ids[met.message], "trust": turn.known.trust,
        "source": turn.known.source, "age_s": turn.known.age_s, "age_s__valid": turn.known.source != FROM_NOWHERE,
    })  # fmt: skip
    _fused(recorder, turn)


def _box_columns(boxes: Boxes) -> dict[str, ndarray]:
    x, y, z = boxes.xyz_m.T
    length, width, height = boxes.lwh_m.T
    return {
        "x_m": x, "y_m": y, "z_m": z, "length_m": length, "width_m": width, "height_m": height,
        "yaw_rad": boxes.yaw_rad,
    }  # fmt: skip


def _detections(recorder: Recorder, turn: Turn) -> None:
    said: Detections = turn.said
    truth = turn.truth
    recorder.append("detections", turn.world.step, {
        "observer": turn.world.actor[said.observer], "k": said.k, "class": said.label, **_box_columns(said.boxes),
        "score": said.score, "n_points": said.n_points, "kind": said.origin, "said": said.said,
        "truth_actor": turn.world.actor[truth.actor_row], "truth_actor__valid": truth.is_real,
        "truth_iou": truth.iou, "truth_iou__valid": truth.is_real,
        "truth_occlusion": truth.occlusion, "truth_occlusion__valid": truth.is_sensed,
    })  # fmt: skip


def _fused(recorder: Recorder, turn: Turn) -> None:
    fused, said = turn.fused, turn.said
    view = fused.view
    recorder.append("fused", turn.world.step, {
        "observer": turn.world.actor[turn.observers[view]],
        "k": np.arange(len(view)) - np.searchsorted(view, view),
        "score": fused.score, "n_witnesses": fused.n_witnesses, "local": fused.local,
        "source": turn.world.actor[said.observer[fused.seed]], "source_k": said.k[fused.seed],
        "pose": turn.world.actor[said.observer[fused.pose]], "pose__valid": fused.pose != fused.seed,
        "pose_k": said.k[fused.pose], "pose_k__valid": fused.pose != fused.seed,
        "fabricated": said.origin[fused.seed] == FABRICATED,
    })  # fmt: skip


def _radio(recorder: Recorder, turn: Turn) -> None:
    step = turn.world.step
    for message, exchange in enumerate(turn.rounds):
        frames = exchange.frames
        ring = (frames.distance_m // RING_M).astype(np.int64)
        counted = np.bincount((ring * len(LosState) + frames.los_state) * len(Outcome) + frames.outcome)
        by_fate = np.append(counted, np.zeros(-len(counted) % len(Outcome), int)).reshape(-1, len(Outcome))
        total, rings = by_fate.sum(axis=0), np.flatnonzero(by_fate.any(axis=1))
        recorder.append("radio", step, {
            "message": np.array([message]), "n_sent": np.array([frames.n_transmissions.sum()]),
            "n_relayed": np.array([frames.n_relayed]),
            "n_in_reach": np.array([len(frames.outcome)]), "n_duplicate": np.array([frames.n_duplicate]),
            **{name: total[[fate]] for name, fate in FATES.items()},
            "bytes": np.array([frames.sent_bytes]),
            "busy_ratio": None if frames.cbr is None else np.array([frames.cbr[: len(turn.observers)].mean()]),
        })  # fmt: skip
        recorder.append("links", step, {
            "message": np.full(len(rings), message), "ring_m": rings // len(LosState) * RING_M,
            "view": rings % len(LosState), "n_in_reach": by_fate[rings].sum(axis=1),
            **{name: by_fate[rings, fate] for name, fate in FATES.items()},
        })  # fmt: skip
        n_delivered = np.bincount(np.searchsorted(LATENCY_BINS_S, turn.links[message].vehicles.latency_s, "right"))
        bins = np.flatnonzero(n_delivered)
        recorder.append("latencies", step, {
            "message": np.full(len(bins), message), "latency_s": np.append(0, LATENCY_BINS_S)[bins],
            "n_delivered": n_delivered[bins],
        })  # fmt: skip


def _ears(recorder: Recorder, turn: Turn, pairs: list[tuple[ndarray, ndarray]]) -> None:
    """What each vehicle's radio meets with, both rounds together; `pairs` within reach go with the exchanges."""
    n = len(turn.observers)
    n_in_reach, n_heard, busy = np.zeros(n, int), np.zeros(n, int), np.zeros(n)
    is_known = all(exchange.frames.cbr is not None for exchange in turn.rounds)
    for exchange, links, (_, receiver) in zip(turn.rounds, turn.links, pairs, strict=True):
        n_in_reach += np.bincount(receiver, minlength=n)
        n_heard += np.bincount(links.vehicles.receiver, minlength=n)
        if exchange.frames.cbr is not None:
            busy += exchange.frames.cbr[:n] / len(turn.rounds)
    recorder.append("ears", turn.world.step, {
        "vehicle": turn.world.actor[turn.observers], "busy_ratio": busy, "busy_ratio__valid": np.full(n, is_known),
        "n_in_reach": n_in_reach, "n_heard": n_heard,
    })  # fmt: skip


def _in_reach(exchange: MessageRound, n: int) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    """Authors of messages, and the other vehicles within reach of them: each pair once, sorted."""
    frames = exchange.frames
    origin = exchange.station[frames.message]
    own = np.flatnonzero((frames.hop == 1) & (origin < n) & (frames.receiver < n))
    return _once(origin[own].astype(np.int64), frames.receiver[own].astype(np.int64), n)


@njit(cache=True)
def _once(one, other, n):
    """Pairs of numbers below n, sorted, each once: two passes of counting, and a look at the neighbour."""
    order = np.arange(len(one))
    for column in (other, one):
        start = np.zeros(n + 1, np.int64)
        for value in column:
            start[value + 1] += 1
        start = np.cumsum(start)
        placed = np.empty_like(order)
        for row in order:
            value = column[row]
            placed[start[value]] = row
            start[value] += 1
        order = placed
    kept = 0
    for row in order:
        last = order[kept - 1]
        if kept == 0 or one[row] != one[last] or other[row] != other[last]:
            order[kept] = row
            kept += 1
    return one[order[:kept]], other[order[:kept]]


@dataclass(slots=True)
class Silences:
    """Since when each pair of vehicles within reach has been without a message from the one to the other."""

    _key: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Sender and receiver in one number, ascending; all that were within reach in the last turn."""
    _since: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Step of the last reception; negative where there was none since they came within reach."""
    _step: int = 0
    """Of the last turn."""

    def update(self, recorder: Recorder, turn: Turn, message: int, pairs: tuple[ndarray, ndarray]) -> None:
        """Count the silences that a reception ends, and those that parting ends; `pairs` are those within reach."""
        step, n, heard_by = turn.world.step, len(turn.observers), turn.links[message].vehicles
        ids = turn.world.actor[turn.observers].astype(np.int64)
        sender, receiver = pairs
        key = (ids[sender] << 32) | ids[receiver]
        since = np.full(len(key), -1)
        at = np.minimum(np.searchsorted(self._key, key), max(len(self._key) - 1, 0))
        known = self._key[at] == key if len(self._key) else np.zeros(len(key), bool)
        since[known] = self._since[at[known]]
        gone = np.ones(len(self._key), bool)
        gone[at[known]] = False
        heard = np.isin(sender * n + receiver, heard_by.message * n + heard_by.receiver)
        ended = step - since[heard & (since >= 0)]
        parted = self._step - self._since[gone & (self._since >= 0)]
        lengths, which = np.unique(np.concatenate([ended, parted]), return_inverse=True)
        by_reception = np.arange(len(which)) < len(ended)
        recorder.append("silences", step, {
            "message": np.full(len(lengths), message), "gap_steps": lengths,
            "n_received": np.bincount(which[by_reception], minlength=len(lengths)),
            "n_parted": np.bincount(which[~by_reception], minlength=len(lengths)),
        })  # fmt: skip
        self._key, self._since, self._step = key, np.where(heard, step, since), step


def vehicles(recorder: Recorder, roster: Roster, first_lie_step: Int[ndarray, "n"], last_step: int) -> None:
    """Everybody, once, at the end; `first_lie_step` is negative for who never lied."""
    lwh = roster.lwh_m
    recorder.append("vehicles", last_step, {
        "vehicle": np.arange(len(roster), dtype=np.int32), "sumo_id": np.array(roster.names, object),
        "kind": roster.shape, "length_m": lwh[:, 0], "width_m": lwh[:, 1], "height_m": lwh[:, 2],
        "equipped": roster.equipped, "behaviour": roster.behaviour, "behaviour__valid": roster.equipped,
        "first_step": roster.first_step, "last_step": roster.last_step,
        "first_lie_step": first_lie_step, "first_lie_step__valid": first_lie_step >= 0,
    })  # fmt: skip
