"""The loop of a run: traffic, step, recorder. It starts at the first step or where a resumed run continues."""

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import compress
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.attacks.params import rings_too_large
from cosim.base.codes import OBJECT, PARKED, DetectionFault, labels
from cosim.base.threads import CORES, n_threads, use_threads
from cosim.config.config import Config
from cosim.runs import checkpoint, recording
from cosim.runs.checkpoint import CannotCheckpoint
from cosim.runs.folder import RunFolder
from cosim.runs.manifest import Manifest
from cosim.runs.speed.ahead import Ahead
from cosim.runs.speed.allocator import give_back_freed_memory, keep_freed_memory
from cosim.runs.stop import StopRequest
from cosim.step.cycle import step
from cosim.step.parts import Parts, chosen
from cosim.step.perception import Perception
from cosim.step.precomputed import NOTHING_PRECOMPUTED
from cosim.step.result import StepResult
from cosim.step.state import State
from cosim.step.stopwatch import Stopwatch
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.scenario import Scenario
from cosim.traffic.source import TrafficEnded, TrafficError, TrafficSource
from cosim.world import World
from results.recorder import Recorder
from sensors.scene import Scene, Shape

_log = logging.getLogger(__name__)

Advance = Callable[[str, int, int, str], None]
"""Callback for progress. Its arguments are the phase, the work done, the total and a note."""

OnStep = Callable[[StepResult, Scenario, Scene], None]
"""Sees the result of every recorded step, the scenario and its city, and must not change them."""

Commands = tuple[Int[ndarray, "c"], Float[ndarray, "c"]]
"""Actors and their commanded speeds [m/s]."""
NO_COMMANDS: Commands = (np.zeros(0, np.int64), np.zeros(0))
_MOST_AT_ONCE = 10
"""A signal within the first steps without sensing stops the run at once, and nothing of it is kept."""
STATE_VERSION = 25
"""Increase this number when the code can no longer read the states of earlier versions."""
_EQUIPPED_PER_THREAD = 100
"""With fewer vehicles a step takes about 20 ms, and further threads cost more than they save on busy cores."""


@dataclass(slots=True)
class Drive:
    """A run that is being computed."""

    parts: Parts
    scenario: Scenario
    folder: RunFolder
    warmup_s: float
    traffic: TrafficSource
    registry: ActorRegistry
    recorder: Recorder
    manifest: Manifest
    advance: Advance
    stop: StopRequest
    state: State | None = None
    """State before the first step to record. None in a new run, or if earlier steps must be computed again."""
    expected: dict[str, np.ndarray] | None = None
    """In a resumed run: the rows of the table `actors` of the last recorded step."""
    commands: dict[int, Commands] = field(default_factory=dict)
    """In a resumed run: the drivers' commands in the recorded steps, by step."""
    on_step: OnStep | None = None
    n_on_road: int = 0
    ended: str = ""
    """Why the traffic ended before the requested time."""
    broken: TrafficError | None = None
    """What the traffic broke down with. The steps before it are recorded, as those before an interruption."""
    _of_block: dict[int, Commands] = field(default_factory=dict)
    _keeps_state: bool = True
    _next: World | None = None
    """World of the next step, if it has been read already."""
    _recording: Future[None] | None = None
    """What is fused in the step before, and its rows, if another thread computes and records them."""
    _watch: Stopwatch = field(default_factory=Stopwatch)
    """Of that thread."""

    def run(self) -> None:
        """Warm up, repeat the traffic of the recorded steps, and continue until the end or a signal."""
        keep_freed_memory()
        give_back_freed_memory()  # memory that reading the city took
        c, perception = self.parts.config, self.parts.perception
        has_core = c.compute.threads != 1 and CORES > 1
        if c.driver.model != "none" or not has_core or not isinstance(perception, Perception):
            self._run(None, None)  # the next world depends on the present step, or there is no second core
            return
        with Ahead(self.parts, perception) as ahead, ThreadPoolExecutor(1, "record") as recording_thread:
            self.manifest.timings_ahead_s = ahead.watch.seconds
            self._run(ahead, recording_thread)
            ahead.watch.add(self._watch, 1)

    def _run(self, ahead: Ahead | None, recording_thread: ThreadPoolExecutor | None) -> None:
        config, recorder = self.parts.config, self.recorder
        first = recorder.inventory.end_step
        warm_up(self.warmup_s, self.traffic, self.parts.watch, self.advance)
        recomputes = first > 0 and self.state is None
        state = State.start(self.parts) if self.state is None else self.state
        self.state = None
        for number in range(config.n_steps):
            if number == first > 0:
                self.stop.at_once = False
            if (world := self._world()) is None:
                break
            self.n_on_road += int(((world.shape != Shape.PEDESTRIAN) & ~world.is_roadside).sum())
            if number < first:
                state = self._repeat(number, world, state, recomputes)
                continue
            use_threads(_threads(self.parts, int(world.equipped.sum())))
            self._look_ahead(number, ahead)
            precomputed = NOTHING_PRECOMPUTED if ahead is None else ahead.of(world)
            state, result = step(world, state, self.parts, precomputed)
            if result.sensed is not None or number + 1 >= min(_MOST_AT_ONCE, recorder.block_steps):
                self.stop.at_once = False  # before this, a step may have compiled kernels for a minute
            commands = self._keep(number, result, state, recording_thread)
            if self.on_step is not None:
                with self.parts.watch("show"):
                    self.on_step(result, self.scenario, self.parts.city)
            del result, precomputed  # up to 100 MB for many vehicles, which would exist beside those of the next step
            self.traffic.command(*commands)
            self.advance("run", number + 1, config.n_steps, f"steps, {len(world)} actors")
            if self.stop.signum is not None and self._next is None:
                break
        with self.parts.watch("record"):
            self._wait_for_rows()
        if self.broken is not None and self.manifest.steps == first:  # no step is new
            raise self.broken
        if not self.manifest.steps:
            raise TrafficError(f"traffic.scenario = {self.scenario.name}: there is nothing to record: {self.ended}.")
        with self.parts.watch("record"):
            self._end(state)
        if self.broken is not None:
            raise self.broken

    def _repeat(self, number: int, world: World, state: State, recomputes: bool) -> State:
        """Repeat the traffic of a step that is recorded, and compute its state again if that was not kept."""
        commands = self.commands.get(number, NO_COMMANDS)
        if recomputes:
            state, result = step(world, state, self.parts)
            commands = result.commands.actor, result.commands.speed_mps
        self.traffic.command(*commands)
        n_recorded = self.recorder.inventory.end_step
        if number == n_recorded - 1:
            self._check_repeated(world)
        self.advance("repeat traffic", number + 1, n_recorded, "steps")
        return state

    def _keep(
        self, number: int, result: StepResult, state: State, recording_thread: ThreadPoolExecutor | None
    ) -> Commands:
        """Record a step, in the thread that is given, and commit a block that is complete; the drivers' commands."""
        with self.parts.watch("record"):
            self._wait_for_rows()
        if recording_thread is not None and n_threads() > 1:
            self._recording = recording_thread.submit(self._record, result, self._watch, n_threads())
        else:
            self._record(result, self.parts.watch, n_threads())
        commands = result.commands.actor, result.commands.speed_mps
        if len(result.commands):
            self._of_block[number] = commands
        if self.recorder.is_block_end(number) and number + 1 < self.parts.config.n_steps:
            with self.parts.watch("record"):
                self._wait_for_rows()
                self._commit(state)
        return commands

    def _record(self, result: StepResult, watch: Stopwatch, n: int) -> None:
        """Fuse, and append the rows of a step. Both depend on its result only, so the next step may go on meanwhile."""
        use_threads(n)
        if result.sensed is not None:
            with watch("fuse"):
                result.sensed.fused()
        with watch("record"):
            recording.step(self.recorder, result, self.parts.config.traffic.step_s)
            self.recorder.reach(result.world.step)
        self.manifest.steps = result.world.step + 1

    def _wait_for_rows(self) -> None:
        """Wait until the rows of the step before are appended, and raise what has gone wrong."""
        if self._recording is not None:
            found, self._recording = self._recording, None
            found.result()

    @property
    def is_over(self) -> bool:
        """Whether all requested steps, or all steps of the traffic, are recorded."""
        return bool(self.ended) or self.manifest.steps >= self.parts.config.n_steps

    def _world(self) -> World | None:
        """The world of the next step; None if the traffic has ended or broken down."""
        if (world := self._next) is not None:
            self._next = None
            return world
        if self.ended or self.broken is not None:
            return None
        with self.parts.watch("traffic"):
            try:
                return self.traffic.advance()
            except TrafficEnded as over:
                asked_s = self.parts.config.n_steps * self.parts.config.traffic.step_s
                self.ended = f"the traffic ended before the {asked_s:g} s asked for: {over}"
            except TrafficError as error:
                self.broken = error
        return None

    def _look_ahead(self, number: int, ahead: Ahead | None) -> None:
        """Start to compute the next world's sweeps while this step continues.

        This is not done where recording may end between the two steps, because actors are registered when a world is
        read.
        """
        is_last = number + 1 == self.parts.config.n_steps or self.recorder.is_block_end(number)
        if ahead is None or is_last or self.stop.signum is not None or (world := self._world()) is None:
            return
        self._next = world
        if self.parts.senses(number + 1):
            ahead.expect(world, at_once=not self.parts.senses(number))

    def _commit(self, state: State) -> None:
        """Write a complete block, with the state that a resumed run needs to continue from it."""
        self.folder.check()
        files = {}
        if self._of_block:
            files[f"commands-{self.manifest.steps:07d}.bin"] = checkpoint.encode(self._of_block)
            self._of_block = {}
        if self._keeps_state:
            try:
                files[f"state-{self.manifest.steps:07d}.bin"] = checkpoint.encode(
                    (STATE_VERSION, self.manifest.config_sha256, state), own_modules(self.parts.config)
                )
            except CannotCheckpoint as error:
                self._keeps_state = False
                self.manifest.summary["not_kept_for_resume"] = f"{error}: a resumed run computes all steps again"
        rows = recording.open_rows(state, self.parts, self.registry, self.manifest.steps)
        give_back_freed_memory()  # the last rows of all tables are encoded at the same time
        self.recorder.flush(rows, files)
        give_back_freed_memory()

    def _end(self, state: State) -> None:
        """Write the last block.

        Rows that are still open, such as encounters, go into the tables of a finished run. An interrupted run keeps
        them in separate files.
        """
        self.folder.check()
        rows = recording.open_rows(state, self.parts, self.registry, self.manifest.steps)
        give_back_freed_memory()
        if not self.is_over:
            self.recorder.flush(rows)
        else:
            self.recorder.close(rows)
        self.manifest.summary |= {
            "vehicles_on_road_mean": round((self.n_on_road - self._n_placed()) / self.manifest.steps, 2),
            **self.traffic.report(),
            "detections_dropped": {
                name: int(n) for name, n in zip(labels(DetectionFault), state.n_dropped, strict=True) if n
            },
            "evaluations_rejected": self.parts.trust.rejected(state.trust),
            **_pseudonym_summary(self.parts.config, state),
            **self._incomplete_rings(),
            **({"ended_early": self.ended} if self.ended else {}),
            **({"victims_absent": absent} if (absent := self._absent_victims()) else {}),
            **({"attackers_absent": missing} if (missing := self._absent_attackers()) else {}),
        }

    def _incomplete_rings(self) -> dict[str, Any]:
        """Notes on rings of attackers with fewer attackers than configured; empty before the run is over."""
        found = rings_too_large(self.parts.config.attacks, self.registry.attack) if self.is_over else []
        for line in found:
            _log.warning(line)
        return {"rings_too_large": found} if found else {}

    def _absent_victims(self) -> list[str]:
        """Keys of the config whose victim was never on the road."""
        known = set(self.registry.names)
        absent = []
        for number, attack in enumerate(self.parts.config.attacks):
            if attack.victim == "one" and attack.victim_id not in known:
                absent.append(f'attacks.{number}.victim_id = "{attack.victim_id}"')
        return absent

    def _absent_attackers(self) -> dict[str, list[str]]:
        """By key of the config, the attackers that were never on the road, or not equipped."""
        equipped = set(compress(self.registry.names, self.registry.equipped))
        absent = {}
        for number, attack in enumerate(self.parts.config.attacks):
            if missing := [name for name in attack.ids if name not in equipped]:
                absent[f"attacks.{number}.ids"] = missing
        return absent

    def _n_placed(self) -> int:
        """Parked cars and placed vehicles, which are no traffic, summed over the steps like `n_on_road`."""
        config, actors = self.parts.config, self.registry
        placed = {OBJECT: len(config.objects), PARKED: config.parked.per_100_m}
        prefixes = tuple(prefix for prefix, n in placed.items() if n)
        is_placed = np.array([name.startswith(prefixes) for name in actors.names], bool)
        is_placed &= actors.shape != Shape.PEDESTRIAN
        return int(actors.n_steps[is_placed].sum())

    def _check_repeated(self, world: World) -> None:
        """Raise ValueError if the repeated traffic differs from the recorded one."""
        if (want := self.expected) is None:
            return
        kept, boxes = ~world.is_roadside, world.boxes  # units have no rows in the table of actors
        poses = {"yaw_rad": boxes.yaw_rad, "speed_mps": world.speed_mps} | {
            f"{axis}_m": boxes.xyz_m[:, column] for column, axis in enumerate("xyz")
        }
        is_same = np.array_equal(want["actor"], world.actor[kept])
        for name, values in poses.items():
            stored = values[kept].astype(np.float32)
            is_same = is_same and np.array_equal(want[name], stored)
        if not is_same:
            raise ValueError(
                f"{self.manifest.folder}: the traffic of step {world.step} is not the one recorded: "
                "another SUMO or other files. Run again."
            )


def warm_up(warmup_s: float, traffic: TrafficSource, watch: Stopwatch, advance: Advance) -> None:
    """Simulate the traffic before the first step.

    Raises
    ------
    TrafficError
        If the traffic ends before the warm-up does.
    """
    with watch("warm-up"):
        try:
            for done_s in traffic.warm_up(warmup_s):
                advance("warm-up", int(done_s), int(warmup_s), "s")
        except TrafficEnded as over:
            raise TrafficError(f"traffic.warmup_s = {warmup_s:g} s outlasts the traffic: {over}. Shorten it.") from None
        advance("warm-up", int(warmup_s), int(warmup_s), "s")


def own_modules(config: Config) -> tuple[str, ...]:
    """Modules of the user's own classes that this config names."""
    return tuple(sorted({choice.of.__module__ for choice in chosen(config).values()}))


def _pseudonym_summary(config: Config, state: State) -> dict[str, Any]:
    """Counts about pseudonyms for the manifest."""
    found: dict[str, Any] = {}
    if (n_changes := int(state.pseudonyms.n_changes.sum())) and config.pseudonyms.linkage == "none":
        n_vehicles = int((state.pseudonyms.current >= 0).sum())
        found["messages_per_pseudonym"] = round(state.pseudonyms.n_sent / (n_changes + n_vehicles), 2)
    if config.pseudonyms.revocation != "none":
        found["revoked"] = len(state.pseudonyms.revoked)
    if config.pseudonyms.linkage == "on_demand":
        found["linked_on_demand"] = int((state.pseudonyms.linked >= 0).sum())
    if config.pseudonyms.linkage == "own":
        known = state.known_senders
        found["relinked"] = {"changes": known.n_changes, "linked": known.n_linked, "right": known.n_right}
    return found


def _threads(parts: Parts, n_equipped: int) -> int:
    """Threads for one step: the number in the config, or one per `_EQUIPPED_PER_THREAD` equipped vehicles."""
    return min(parts.config.compute.threads or max(1, n_equipped // _EQUIPPED_PER_THREAD), CORES)
