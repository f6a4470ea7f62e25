"""Plays the tiny scene through the steps of the simulation, and tells what happened by the names of the actors."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.config.config import Config
from cosim.execution import checkpoint
from cosim.execution.drive import STATE_VERSION, own_modules
from cosim.step.cycle import step
from cosim.step.parts import Parts
from cosim.step.result import StepResult
from cosim.step.state import State
from cosim.tryout.scene import N_STEPS, STEP_S, TinyScene
from cosim.v2x.messages import SENSED

Table = dict[tuple[Any, ...], tuple[float, ...]]
"""What happened in one step: numbers by who and whom."""

BASE = (
    f"traffic.step_s={STEP_S}", f"traffic.duration_s={N_STEPS * STEP_S}", "sensing_interval_s=1.0", "seed=4",
    "lidar.n_azimuths=256", "radio.model=unit_disk", "server.cellular.delay_min_s=0.001",
    "server.cellular.delay_mean_s=0.002", "server.backhaul_s=0.005", "trust.server_period_s=1.0", "compute.threads=1",
    "attacks.0.start_s=2",
)  # fmt: skip
"""What every play of the scene has in common."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A config, and what is changed in the parts that it names."""

    config: Config
    change: Callable[[Parts], Parts] = lambda parts: parts

    def parts(self, scene: TinyScene) -> Parts:
        """New parts."""
        return self.change(Parts.of(self.config, scene.city))

    def play(
        self, scene: TinyScene, tell: Callable[[StepResult, TinyScene], Table], n_steps: int = N_STEPS,
        interrupted_at: int | None = None,
    ) -> list[Table]:  # fmt: skip
        """What happened in every step.

        Parameters
        ----------
        interrupted_at
            Before this step the state is kept as bytes and the parts are made anew, as in a run that is resumed.
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
        """The state as a run that is resumed reads it."""
        own = own_modules(self.config)
        kept = b"".join(checkpoint.encode((STATE_VERSION, state), own))
        return checkpoint.decode(kept, own)[1]


class Nothing:
    """An attack that changes nothing: who carries it out can only be known from the truth."""

    def detections(self, listed: Any, context: Any) -> Any:
        """As they are."""
        return listed


def with_harmless_attackers(parts: Parts) -> Parts:
    """Attackers are called so and do nothing."""
    return replace(parts, adversary=replace(parts.adversary, attacks=tuple(Nothing() for _ in parts.adversary.attacks)))


def detections(happened: StepResult, scene: TinyScene) -> Table:
    """What each vehicle's detector reports, best first: class, box and score."""
    if happened.sensed is None:
        return {}
    found, names = happened.sensed.observed.detections, scene.names
    rows, boxes = np.flatnonzero(found.origin == SENSED), found.boxes
    return {
        (names[found.observer[i]], f"detection {found.detection_index[i]}"): (
            found.label[i], *boxes.xyz_m[i], *boxes.lwh_m[i], boxes.yaw_rad[i], found.score[i],
        )
        for i in rows.tolist()
    }  # fmt: skip


def messages(happened: StepResult, scene: TinyScene) -> Table:
    """What each vehicle transmits: its detections and evaluations, under each of its identities."""
    sensed, names = happened.sensed, scene.names
    if sensed is None:
        return {}
    listed, senders, actor = sensed.listed, sensed.senders, sensed.vehicles.actor
    boxes, sent = listed.boxes, sensed.messages[0]
    of = {
        int(p): f"{names[actor[v]]}{f', identity {i}' if i else ''}"
        for p, v, i in zip(senders.pseudonym, senders.vehicle, senders.identity, strict=True)
    }
    told: Table = {
        (names[listed.observer[i]], f"identity {listed.identity[i]}", f"detection {listed.detection_index[i]}"): (
            listed.label[i], *boxes.xyz_m[i], *boxes.lwh_m[i], boxes.yaw_rad[i], listed.score[i],
            listed.speed_mps[i], listed.transmitted[i],
        )
        for i in range(len(listed))
    }  # fmt: skip
    by = np.repeat(sent.evaluator, np.diff(sent.ptr))
    told |= {
        (of[int(by[i])], f"its evaluation of detection {sent.detection_index[i]} of {of[int(sent.observer[i])]}"): (
            sent.evaluation[i], sent.visibility[i],
        )
        for i in range(len(by))
    }  # fmt: skip
    station, n = np.unique(sensed.rounds[0].station, return_counts=True)
    told |= {(names[actor[s]], "messages sent"): (k,) for s, k in zip(station.tolist(), n.tolist(), strict=True)}
    return told


def receptions(happened: StepResult, scene: TinyScene) -> Table:
    """Who received what from whom: hops, and when."""
    sensed, names = happened.sensed, scene.names
    if sensed is None:
        return {}
    actor, told = sensed.vehicles.actor, {}
    for kind, one in zip(("detections", "evaluations"), sensed.rounds, strict=True):
        got = one.receptions
        sender = one.station[got.message]
        number = got.message - np.searchsorted(one.station, sender)
        for i in range(len(sender)):
            key = names[actor[got.receiver[i]]], f"message {number[i]} of {kind} from {names[actor[sender[i]]]}"
            told[key] = got.hops[i], got.generation_offset_s[i], got.access_delay_s[i], got.latency_s[i]
    return told


def trust(happened: StepResult, scene: TinyScene) -> Table:
    """Trust of each vehicle in those that it received messages from."""
    sensed, names = happened.sensed, scene.names
    if sensed is None:
        return {}
    actor, used, found = sensed.vehicles.actor, sensed.used, sensed.lookups[0]
    sender = actor[sensed.senders.vehicle[used.message]]
    return {
        (names[actor[used.receiver[i]]], f"trust in {names[sender[i]]}"): (found.trust[i],) for i in range(len(sender))
    }


def renewals(happened: StepResult, scene: TinyScene) -> Table:
    """Whose pseudonym came to an end."""
    ended = happened.ended_pseudonyms
    return {
        (scene.names[v], "its pseudonym"): (begin, end)
        for v, begin, end in zip(ended.vehicle, ended.from_step, ended.to_step, strict=True)
    }


def commands(happened: StepResult, scene: TinyScene) -> Table:
    """Which speed each vehicle is told to drive."""
    told = happened.commands
    return {
        (scene.names[a], "speed"): (v,) for a, v in zip(told.actor.tolist(), told.speed_mps.tolist(), strict=True)
    }
