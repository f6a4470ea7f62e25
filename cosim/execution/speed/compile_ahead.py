"""A second process that compiles what a run needs later, while the run compiles and computes what it needs first.

Kernels are compiled where they are called first, one after another: in the first minutes after installation a second
core would be idle. A helper process therefore plays a few steps among forty made-up vehicles, with all parts of the
run's config but its LiDAR: radio, matching, trust and fusion are compiled while the run itself is still busy with the
sweep and the detector, and it finds them in Numba's cache on disk. The helper starts once a run has had to compile
some kernels, and ends with the run at the latest, however that ends. Nothing depends on it but time.

    python -m cosim.execution.speed.compile_ahead CONFIG

for a config as JSON.
"""

import gc
import json
import os
import subprocess
import sys
import threading
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from types import TracebackType

import numba
import numpy as np
from jaxtyping import Int
from numba.core import caching, event
from numpy import ndarray

from cosim import rng
from cosim.config.config import Config, resolve_data
from cosim.driver.driver import DriverParams
from cosim.execution import recording
from cosim.radio.rsu import NO_RSUS, RsuAntennas
from cosim.step.cycle import step
from cosim.step.parts import Parts, chosen, perception_of
from cosim.step.perception import BoxAnswers, BoxQuestions, Observed, Perception, Seen
from cosim.step.state import State
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from results.columns import Level
from results.metrics import lookups
from results.recorder import Recorder
from results.tables import kept
from sensors import evidence, lidar
from sensors.boxes import Boxes
from sensors.detector import DetectedBoxes
from sensors.evidence import Observability
from sensors.scene import Scene, Shape
from trust.params import TrustParams

_COMPILES = "numba:compile"
"""Numba's event of a kernel that is compiled, and not one that is loaded from the cache."""
_FEW = 3
"""Kernels that a run compiles by itself before the helper starts: with a warm cache it compiles none."""
_VEHICLES = 40
"""Enough for tables of evidence to grow."""
_SENSING_STEPS = 5
_PATIENCE_S = 5.0


class CompileAhead(event.Listener):
    """A helper process for the run that is made while this is entered, where its kernels are not compiled yet.

    None without a second core, and none where parts are a user's own: these are not tried out on made-up vehicles.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        alone = config.compute.threads == 1 or numba.get_num_threads() == 1
        own = any(choice.is_own for choice in chosen(config).values())
        self._may = config.sensing and not alone and not own
        self._n_compiled = 0
        self._helper: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "CompileAhead":
        if self._may:
            event.register(_COMPILES, self)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if self._may:
            event.unregister(_COMPILES, self)
        if (helper := self._helper) is not None:
            assert helper.stdin is not None
            helper.stdin.close()
            try:
                helper.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                helper.kill()
                helper.wait()

    def on_start(self, happened: event.Event) -> None:
        """A kernel was not in the cache."""
        self._n_compiled += 1
        if self._n_compiled == _FEW:
            with suppress(OSError):  # no more processes, a config too long for a command line: then without
                self._start()

    def on_end(self, happened: event.Event) -> None:
        """Nothing to do."""

    def _start(self) -> None:
        """In a group of its own, which Ctrl-C does not reach; in the session of the run, within which its low priority
        counts."""
        config = json.dumps(self._config.to_dict(), default=str)
        self._helper = subprocess.Popen(
            [sys.executable, "-P", "-m", "cosim.execution.speed.compile_ahead", config],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            process_group=0,
        )


@dataclass(slots=True)
class _Told:
    """Perception without sweeps: every vehicle reports all others, wherever they are, and something that is not there.

    What range images say of free space is asked of real ones, which hold a wall.
    """

    own: Perception

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """As `Perceives`."""
        n, m = len(observers), len(world)
        o, actor = np.nonzero(observers[:, None] != np.arange(m))
        o, actor, many = o.astype(np.int32), actor.astype(np.int32), np.full(len(o), 50, np.int32)
        on = lidar.scanners(world.boxes, observers, self.own.lidar)
        away_m = np.linalg.norm(world.boxes.xyz_m[actor] - on.poses.origin_m[o], axis=1)
        found = DetectedBoxes(
            o, world.label[actor], world.boxes.take(actor), np.full(len(o), 0.8), many, actor, actor % 5 == 4
        )
        step = lidar.step_of(self.own.lidar)
        images = lidar.with_ranges(on, np.full((n, *lidar.n_rays(self.own.lidar)), 40.0 / step, np.uint16), step)
        seen = Seen(Observability(o, actor, many, 2 * many, away_m), found)
        return self.own.observed(world, observers, images, [seen])

    def answers(self, sweeps: lidar.Scanners, asked: BoxQuestions) -> BoxAnswers:
        """As `Perceives`; returns are not counted, because the detector counts them first."""
        assert isinstance(sweeps, lidar.RangeImages)
        counts = np.full(len(asked.counting), 20, np.int32)
        return counts, evidence.plausible(sweeps, asked.testing, asked.boxes, asked.tested, asked.area)


class _Nowhere(Recorder):
    """A recorder that keeps nothing."""

    def __init__(self, level: Level) -> None:
        self.tables = kept(level)

    def append(self, table: str, step: int, columns: Mapping[str, ndarray | None]) -> None:
        """As `Recorder`."""


def compile_all(config: Config) -> None:
    """Play some steps of a made-up scene with the parts of a config, and add up lookups as the summary does."""
    c = _soon(config)
    city = Scene.from_footprints([[np.array([[20.0, 10], [40, 10], [40, 30], [20, 30]])]], [0.0], [12.0])
    rsus = NO_RSUS if not (c.rsu.at or c.rsu.n_at_junctions) else _one_rsu()
    parts = replace(Parts.of(c, city, rsus), perception=_Told(perception_of(c, city)))
    state, nowhere = State.start(parts), _Nowhere(c.record.level)
    for number in range(_SENSING_STEPS * c.sense_every_steps):
        state, result = step(_world(number, c), state, parts)
        recording.step(nowhere, result, c.traffic.step_s)
    parts.trust.rejected(state.trust)
    lookups.compile_kernels()


def _soon(config: Config) -> Config:
    """The same config with all that happens at all happening within a few steps, and without its driver."""
    interval_s = config.sensing_interval_s

    def hurried(trust: TrustParams) -> TrustParams:
        freshness_s = trust.freshness_s if trust.freshness_s == "off" else 2 * interval_s
        return replace(trust, server_period_s=interval_s, freshness_s=freshness_s)

    return replace(
        config,
        driver=DriverParams(),
        attacks=tuple(replace(attack, start_s=0.0) for attack in config.attacks),
        trust=hurried(config.trust),
        trust_variant=tuple(replace(variant, trust=hurried(variant.trust)) for variant in config.trust_variant),
    )


def _one_rsu() -> RsuAntennas:
    return RsuAntennas(np.array([[30.0, 0.0, 6.0]]), np.array([rng.name_key("rsu")], np.uint64), np.array([6.0]))


def _world(number: int, config: Config) -> World:
    """Two files of cars that meet: far apart before the first sweep, so that nothing is compiled for encounters until
    the run itself has done that; some of them attack."""
    i = np.arange(_VEHICLES)
    apart_m = 110.0 if number < config.sense_every_steps else 12.0
    x, y = i * apart_m, (i % 2) * 4.0
    yaw = np.where(i % 2 == 0, 0.0, np.pi)
    lwh_m = np.tile([4.5, 1.8, 1.5], (_VEHICLES, 1))
    return World(
        step=number,
        actor=i.astype(np.int32),
        name_key=np.array([rng.name_key(str(k)) for k in i], np.uint64),
        shape=np.full(_VEHICLES, Shape.CAR, np.uint8),
        boxes=Boxes(np.column_stack([x, y, np.full(_VEHICLES, 0.75)]), lwh_m, yaw),
        speed_mps=np.full(_VEHICLES, 10.0),
        equipped=np.ones(_VEHICLES, bool),
        attack=(i % (2 + len(config.attacks)) % (1 + len(config.attacks))).astype(np.uint8),
    )


_SAVING = threading.Lock()
"""Held while a kernel is written to the cache."""


def _save(self: caching.IndexDataCacheFile, key: tuple, data: object) -> None:
    """As Numba's own, but safe beside another process that saves the same kernel for other types: the content is there
    before the index says so, and its name belongs to this key alone, where Numba counts from 1."""
    with _SAVING:
        name = self._data_name(1000 + zlib.crc32(repr(key).encode()))
        self._save_data(name, data)
        self._save_index(self._load_index() | {key: name})


def _end_with_run() -> None:
    """The other end of standard input is closed when the run ends, or is killed."""
    while os.read(0, 4096):
        pass
    with _SAVING:
        os._exit(0)


def main() -> None:
    threading.Thread(target=_end_with_run, daemon=True).start()
    os.nice(19)
    caching.IndexDataCacheFile.save = _save  # type: ignore[method-assign]
    numba.set_num_threads(1)
    gc.disable()  # the process is short, and looking for garbage takes 5 % of its time
    compile_all(resolve_data(json.loads(sys.argv[1]), "the run", None))


if __name__ == "__main__":
    main()
