"""Simulates the tiny scene step by step, and describes the results by the names of the actors."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.addons.tryout.scene import N_STEPS, STEP_S, TinyScene
from cosim.base import rng
from cosim.config.config import Config
from cosim.messages.content import SENSED, Detections
from cosim.runs import checkpoint
from cosim.runs.drive import STATE_VERSION, own_modules
from cosim.step.cycle import step
from cosim.step.parts import Parts
from cosim.step.result import StepResult
from cosim.step.state import State
from cosim.traffic.driver import Beliefs, Driver, SpeedCommands
from cosim.world import World
from sensors.boxes import Boxes

Row = dict[str, float]
Table = dict[str, Row]
"""Results of one step: numbers by column. The key of a row is the beginning of a sentence that names its owner."""

BASE = (
    "preset=paper",
    "fleet.equipped_kinds=['car', 'van']",
    "fleet.penetration_p=0.35",
    "radio.range_m=300",
    "radio.unit_disk.loss_p=0.05",
    "server.cellular.uplink_loss_p=0.01",
    "server.cellular.downlink_loss_p=0.01",
    "trust.freshness_s=50",
    "trust.unseen=skip",
    "trust.unevaluated=default",
    f"traffic.step_s={STEP_S}",
    f"traffic.duration_s={N_STEPS * STEP_S}",
    "sensing_interval_s=1.0",
    "seed=4",
    "lidar.n_azimuths=180",
    "radio.model=unit_disk",
    "server.cellular.delay_min_s=0.001",
    "server.cellular.delay_mean_s=0.002",
    "server.backhaul_s=0.005",
    "trust.server_period_s=1.0",
    "compute.threads=1",
    "attacks.0.start_s=2",
)
"""Config keys of all plays of the scene: the paper's sensing, so that results follow by hand, and losses."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A config, and a change of the parts that are built from it."""

    config: Config
    change: Callable[[Parts], Parts] = lambda parts: parts

    def parts(self, scene: TinyScene) -> Parts:
        """New parts."""
        return self.change(Parts.of(self.config, scene.city))

    def play(
        self,
        scene: TinyScene,
        tell: Callable[[StepResult, TinyScene], Table],
        n_steps: int = N_STEPS,
        interrupted_at: int | None = None,
    ) -> list[Table]:
        """Simulate the scene, and return the results of every step.

        Parameters
        ----------
        tell
            Makes the table of a step from its result.
        interrupted_at
            Before this step the state is written as bytes and read again, and the parts are rebuilt, as in a resumed
            run.
        """
        parts = self.parts(scene)
        state, tables = State.start(parts), []
        for number in range(n_steps):
            if number == interrupted_at:
                state, parts = self.resumed(state), self.parts(scene)
            state, happened = step(scene.world(number), state, parts)
            tables.append(tell(happened, scene))
        return tables

    def resumed(self, state: State) -> State:
        """The state as a resumed run reads it."""
        own = own_modules(self.config)
        kept = b"".join(checkpoint.encode((STATE_VERSION, state), own))
        return checkpoint.decode(kept, own)[1]


class Nothing:
    """An attack that changes nothing. Only ground truth tells which vehicles carry it out."""

    def detections(self, listed: Any, context: Any) -> Any:
        """The unchanged lists."""
        return listed


def with_harmless_attackers(parts: Parts) -> Parts:
    """The parts, with attacks that change nothing."""
    harmless: Any = tuple(Nothing() for _ in parts.adversary.attacks)  # an attack may leave any hook out
    return replace(parts, adversary=replace(parts.adversary, attacks=harmless))


@dataclass(frozen=True, slots=True)
class WithBeliefs:
    """A driver with given beliefs instead of fused objects, because fusion decides ties by the order of rows."""

    behind: Driver

    def commands(
        self, state: object, world: World, beliefs: Beliefs | None, dt_s: float
    ) -> tuple[object, SpeedCommands]:
        """The commands of the tested driver."""
        given = None if beliefs is None else _beliefs(world, beliefs.known_s, dt_s)
        return self.behind.commands(state, world, given, dt_s)


def _beliefs(world: World, known_s: float, dt_s: float) -> Beliefs:
    """Each equipped vehicle believes in all actors within 50 m, whether it sees them or not, and in a false car.

    The false car stands in its lane, 35 m ahead of the vehicle's first position.
    """
    xy, yaw = world.boxes.xyz_m[:, :2], world.boxes.yaw_rad
    between_m = xy[:, None] - xy[None]
    is_near = np.hypot(between_m[..., 0], between_m[..., 1]) <= 50.0
    is_other = ~np.eye(len(world), dtype=bool)
    ego, other = np.nonzero(world.equipped[:, None] & is_near & is_other)
    alone = np.flatnonzero(world.equipped)
    begun_m = world.speed_mps * world.step * dt_s
    direction = np.column_stack([np.cos(yaw), np.sin(yaw), 0 * yaw])
    ghost_xyz_m = world.boxes.xyz_m + direction * (35.0 - begun_m)[:, None]
    ghosts = replace(world.boxes, xyz_m=ghost_xyz_m).take(alone)
    key = rng.key(0, rng.Stream.DRIVER)
    drawn = rng.uniforms(key, world.name_key[ego], world.name_key[other])
    sees = drawn[:, 0] < 0.5
    by = np.concatenate([ego, alone])
    order = np.argsort(by, kind="stable")
    row = np.concatenate([other, alone])[order]
    is_false = order >= len(other)
    return Beliefs(
        known_s=known_s,
        ego=by[order],
        label=world.label[row],
        boxes=Boxes.concat([world.boxes.take(other), ghosts]).take(order),
        score=np.full(len(by), 0.9),
        ego_detected=np.concatenate([sees, np.zeros(len(alone), bool)])[order],
        source=world.actor[row].astype(np.int64),
        source_index=1 + is_false.astype(np.int64),
        source_step=np.full(len(by), world.step),
    )


BOX = ("class", "x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad", "score")


def _box(listed: Detections, i: int) -> Row:
    boxes = listed.boxes
    values = (
        listed.label[i],
        *boxes.xyz_m[i],
        *boxes.lwh_m[i],
        boxes.yaw_rad[i],
        listed.score[i],
    )
    return dict(zip(BOX, map(float, values), strict=True))


def detections(happened: StepResult, scene: TinyScene) -> Table:
    """The detections of each vehicle's detector, highest score first."""
    if happened.sensed is None:
        return {}
    found, names = happened.sensed.positioned.observed.detections, scene.names
    told = {}
    for i in np.flatnonzero(found.origin == SENSED).tolist():
        name = names[found.observer[i]]
        told[f"detection {found.detection_index[i]} of {name}"] = _box(found, i)
    return told


def messages(happened: StepResult, scene: TinyScene) -> Table:
    """The messages of each vehicle, its detections and evaluations under each of its identities, and who gets them."""
    sensed, names = happened.sensed, scene.names
    if sensed is None:
        return {}
    listed, sent = sensed.listed.objects, sensed.evaluated.sent
    senders, actor = sensed.senders, sensed.vehicles.actor
    of = {}
    for pseudonym, vehicle, identity in zip(senders.pseudonym, senders.vehicle, senders.identity, strict=True):
        name = names[actor[vehicle]]
        of[int(pseudonym)] = f"{name} as identity {identity}" if identity else name
    told = {}
    for i in range(len(listed)):
        which = f"detection {listed.detection_index[i]} of {names[listed.observer[i]]}"
        told[f"{which} as identity {listed.identity[i]}"] = {
            **_box(listed, i),
            "speed_mps": float(listed.speed_mps[i]),
            "transmitted": float(listed.transmitted[i]),
        }
    evaluators = np.repeat(sent.evaluator, np.diff(sent.ptr))
    for i, evaluator in enumerate(evaluators.tolist()):
        sender = of[int(sent.observer[i])]
        which = f"detection {sent.detection_index[i]} of {sender}"
        told[f"evaluation by {of[evaluator]} of {which}"] = {
            "evaluation": float(sent.evaluation[i]),
            "visibility": float(sent.visibility[i]),
        }
    station, n = np.unique(sensed.rounds[0].round.station, return_counts=True)
    for row, k in zip(station.tolist(), n.tolist(), strict=True):
        told[names[actor[row]]] = {"messages": k}
    return told | receptions(happened, scene)


def receptions(happened: StepResult, scene: TinyScene) -> Table:
    """Received messages, with their hops and times."""
    sensed, names, told = happened.sensed, scene.names, {}
    if sensed is None:
        return {}
    actor = sensed.vehicles.actor
    for kind, one in zip(("detections", "evaluations"), sensed.rounds, strict=True):
        got, station = one.round.receptions, one.round.station
        sender = station[got.message]
        number = got.message - np.searchsorted(station, sender)
        for i in range(len(sender)):
            source = names[actor[sender[i]]]
            receiver = names[actor[got.receiver[i]]]
            told[f"{kind} message {number[i]} from {source} at {receiver}"] = {
                name: float(getattr(got, name)[i])
                for name in ("hops", "generation_offset_s", "access_delay_s", "latency_s")
            }
    return told


def trust(happened: StepResult, scene: TinyScene) -> Table:
    """Trust of each vehicle in the vehicles from which it received messages, if it is not the default."""
    sensed, names = happened.sensed, scene.names
    if sensed is None:
        return {}
    actor, used = sensed.vehicles.actor, sensed.looked_up.messages
    found = sensed.looked_up.lookups[0]
    has_value = np.flatnonzero(~found.is_default)
    sender = actor[sensed.senders.vehicle[used.message[has_value]]]
    holders, values = actor[used.receiver[has_value]], found.trust[has_value]
    rows = zip(holders, sender, values.tolist(), strict=True)
    told = {}
    for holder, subject, value in rows:
        told[f"{names[holder]} about {names[subject]}"] = {"trust": value}
    return told


def renewals(happened: StepResult, scene: TinyScene) -> Table:
    """Pseudonyms that ended."""
    ended = happened.ended_pseudonyms
    told = {}
    for v, begin, end in zip(ended.vehicle, ended.from_step, ended.to_step, strict=True):
        steps = {"first step": float(begin), "last step": float(end)}
        told[f"the pseudonym of {scene.names[v]} that ends"] = steps
    return told


def commands(happened: StepResult, scene: TinyScene) -> Table:
    """Commanded speeds of vehicles."""
    told = happened.commands
    return {
        f"the command to {scene.names[a]}": {"speed_mps": v}
        for a, v in zip(told.actor.tolist(), told.speed_mps.tolist(), strict=True)
    }
