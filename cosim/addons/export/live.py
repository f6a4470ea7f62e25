"""A run as it is computed, in the Rerun viewer or in a file: the city, trust in vehicles, and ages of evaluations.

Trust in a vehicle is the mean of the values that receivers look up in the acting variant. What is shown is read from
the results of a step; nothing of the run changes. If the file or the viewer fails, the run goes on without
it. Colours are those of `cosim.addons.export.view`.
"""

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Protocol, Self

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.addons.export import ros2, view
from cosim.addons.export.pcap import START_S
from cosim.attacks.params import roles_of
from cosim.base import durable
from cosim.base.codes import Role, labels
from cosim.base.durable import PARTIAL
from cosim.config.config import Config
from cosim.step.result import Sensed, StepResult
from cosim.traffic.scenario import Scenario
from cosim.world import World
from results.figures import style
from sensors.raycast.mesh import city_triangles
from sensors.scene import Scene

_LOG = logging.getLogger(__name__)

VIEWER = "viewer"
SUFFIXES = (".rrd", ".mcap")

TOPICS = {
    "/buildings": "visualization_msgs/msg/Marker",
    "/actors": "visualization_msgs/msg/MarkerArray",
    "/trust": "sensor_msgs/msg/PointCloud2",
}


class KnownTrust:
    """By actor: trust in it and the mean age of the newest evaluation [s], when it was last looked up; NaN before."""

    def __init__(self) -> None:
        self._values = np.full((0, 2), np.nan)

    def of(self, actor: Int[ndarray, "n"]) -> Float[ndarray, "n 2"]:
        """The values of these actors."""
        self._grow(actor)
        return self._values[actor]

    def note(self, actor: Int[ndarray, "n"], values: Float[ndarray, "n 2"]) -> None:
        """Keep the values of these actors, each of which is there once."""
        self._grow(actor)
        self._values[actor] = values

    def _grow(self, actor: Int[ndarray, "n"]) -> None:
        more = int(actor.max(initial=-1)) + 1 - len(self._values)
        if more > 0:
            unknown = np.full((2 * more, 2), np.nan)
            self._values = np.concatenate([self._values, unknown])


RATED = np.dtype([*ros2.POINT.descr, ("trust", "<f4"), ("newest_evaluation_age_s", "<f4"), ("vehicle", "<i4")])


class Shown(Protocol):
    """Where a run is shown."""

    def begin(self, look_m: Float[ndarray, "3"], scenario: Scenario, city: Scene) -> None:
        """Show the city; the first view is around this point [m]."""

    def step(self, now: "Now") -> None:
        """Show a step."""

    def flush(self) -> None:
        """Wait until what was shown is sent or written."""

    def end(self, keep: bool) -> None:
        """Close the connection, or the file, which is removed unless it is to be kept."""


class Now:
    """What is shown of a step."""

    def __init__(self, config: Config, result: StepResult, role: UInt8[ndarray, "a"], known: KnownTrust) -> None:
        self.world: World = result.world
        self.time_s = result.world.step * config.traffic.step_s
        others = len(labels(Role))
        self.role = np.where(self.world.equipped, role[self.world.attack], others)
        """Code of each actor's role; one more than the last for actors that are not equipped."""
        self.age_s = np.nan
        """Mean age of the newest evaluation behind the values that are looked up."""
        if result.sensed is not None:
            self._look_up(result.sensed, known)
        self.trust, self.age_of = known.of(self.world.actor).T
        """Trust in each actor, and the mean age of the newest evaluation behind it [s]; NaN where there is none."""
        self.is_rated = result.sensed is not None

    def _look_up(self, sensed: Sensed, known: KnownTrust) -> None:
        used, lookups = sensed.looked_up.messages, sensed.looked_up.lookups[0]
        there = ~lookups.is_default
        row = sensed.known.vehicle[used.message][there]
        n = np.bincount(row, minlength=len(sensed.vehicles.actor))
        total = np.bincount(row, lookups.trust[there], minlength=len(n))
        heard = np.flatnonzero(n)
        aged = lookups.is_known
        row = sensed.known.vehicle[used.message][aged]
        n_aged = np.bincount(row, minlength=len(n))
        ages = np.bincount(row, lookups.newest_evaluation_age_s[aged], minlength=len(n))
        mean = np.where(n_aged > 0, ages / np.maximum(n_aged, 1), np.nan)
        values = np.column_stack([total / np.maximum(n, 1), mean])
        known.note(sensed.vehicles.actor[heard], values[heard])
        if aged.any():
            self.age_s = float(ages.sum() / n_aged.sum())

    @property
    def inks(self) -> UInt8[ndarray, "n 3"]:
        """Colours (red, green, blue) of the actors by role."""
        return INKS[self.role]


def _inks() -> UInt8[ndarray, "r 3"]:
    inks = [style.role_look(role, labels(Role))["color"] for role in labels(Role)]
    inks.append(style.PALE)
    return np.array([tuple(bytes.fromhex(ink[1:])) for ink in inks], np.uint8)


INKS = _inks()
"""Colours by code of the role; the last for actors that are not equipped."""


class Live:
    """Shows each step of a run; use it as `on_step` of `cosim.runs.run.run`, inside a `with` statement.

    Parameters
    ----------
    config
        The config of the run.
    target
        `viewer` opens the Rerun viewer. A path that ends in .rrd or .mcap is a file to write.

    Raises
    ------
    ValueError
        In one line: the path has another ending or cannot be written, or a package is not installed.
    """

    def __init__(self, config: Config, target: str) -> None:
        if target != VIEWER and Path(target).suffix not in SUFFIXES:
            raise ValueError(f"--watch-file {target}: it must end in {' or '.join(SUFFIXES)}.")
        self._config = config
        self._role = roles_of(config.attacks)
        self._known = KnownTrust()
        self._begun = False
        self._stopped = ""
        """Why nothing is shown any more."""
        self._shown: Shown = _Mcap(Path(target)) if target.endswith(".mcap") else _Rerun(target)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._shown.end(self._begun and not self._stopped)
        except (OSError, RuntimeError) as failure:
            self._stopped = self._stopped or str(failure)
        if self._stopped:
            _LOG.warning("the run was not shown to its end: %s", self._stopped)

    def __call__(self, result: StepResult, scenario: Scenario, city: Scene) -> None:
        if self._stopped:
            return
        now = Now(self._config, result, self._role, self._known)
        try:
            if not self._begun:
                self._begun = True
                self._shown.begin(first_look(now.world), scenario, city)
            self._shown.step(now)
        except (OSError, RuntimeError) as failure:  # a full disk, a viewer that was closed
            self._stopped = str(failure) or type(failure).__name__

    def flush(self) -> None:
        """Wait until what was shown is sent or written."""
        self._shown.flush()


def first_look(world: World) -> Float[ndarray, "3"]:
    """The first attacker, if there is one on the road, otherwise the middle of the traffic, otherwise the origin."""
    attackers = np.flatnonzero(world.attack > 0)
    if len(attackers):
        return world.boxes.xyz_m[attackers[0]]
    return np.median(world.boxes.xyz_m, axis=0) if len(world) else np.zeros(3)


def _opened(path: Path) -> IO[bytes]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return open(durable.new_file(path.with_name(path.name + PARTIAL)), "wb")
    except OSError as error:
        raise ValueError(f"--watch-file {path} cannot be written: {error.strerror or error}.") from None


def _finish(path: Path, keep: bool) -> None:
    partial = path.with_name(path.name + PARTIAL)
    if keep:
        partial.replace(path)
    else:
        partial.unlink(missing_ok=True)


class _Rerun:
    """The Rerun viewer, or a recording for it."""

    def __init__(self, target: str) -> None:
        view.sdk()
        import rerun

        self._path = None if target == VIEWER else Path(target)
        self._recording = rerun.RecordingStream("cosim")
        self._thread, self._city = ThreadPoolExecutor(1), Future[None]()
        """Draws the city while the run computes its first step; time does not matter to what is static."""
        self._city.set_result(None)
        if self._path is None:
            view.show(self._recording, "--watch", "Use --watch-file")
        else:
            _opened(self._path).close()
            self._recording.save(self._path.with_name(self._path.name + PARTIAL))

    def begin(self, look_m: Float[ndarray, "3"], scenario: Scenario, city: Scene) -> None:
        view.send_layout(self._recording, look_m, ages=True)
        self._city = self._thread.submit(view.surroundings, self._recording, scenario, city)

    def step(self, now: Now) -> None:
        import rerun

        recording, boxes = self._recording, now.world.boxes
        recording.set_time("time", duration=now.time_s)
        inks, rated = now.inks, view.colours(now.trust)
        view.log_actors(recording, boxes, inks, rated)
        for code, role in enumerate(labels(Role)):
            values = now.trust[(now.role == code) & ~np.isnan(now.trust)]
            if len(values) and now.is_rated:
                recording.log(f"trust/{role}", rerun.Scalars(float(np.median(values))))
        if not np.isnan(now.age_s):
            recording.log("ages/newest_evaluation", rerun.Scalars(now.age_s))

    def flush(self) -> None:
        self._city.result()
        self._recording.flush(timeout_sec=60.0)

    def end(self, keep: bool) -> None:
        self._thread.shutdown()
        failure = self._city.exception()
        with suppress(RuntimeError):  # the viewer was closed meanwhile
            self._recording.flush(timeout_sec=60.0)
        self._recording.disconnect()
        if self._path is not None:
            _finish(self._path, keep and failure is None)
        if failure is not None:
            raise failure


class _Mcap:
    """An MCAP file for Foxglove, with messages of ROS 2."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = _opened(path)
        try:
            self._writing = ros2.Writing(self._file)
        except ValueError:
            self._file.close()
            path.with_name(path.name + PARTIAL).unlink()
            raise
        for topic, kind in TOPICS.items():
            self._writing.register(topic, kind)

    def begin(self, look_m: Float[ndarray, "3"], scenario: Scenario, city: Scene) -> None:
        nanos = START_S * 10**9
        self._writing.add(nanos, "/buildings", ros2.buildings(nanos, city_triangles(city)))

    def step(self, now: Now) -> None:
        nanos = START_S * 10**9 + round(now.time_s * 1e9)
        boxes = now.world.boxes
        opaque = np.ones(len(now.world))
        ink = np.column_stack([now.inks / 255, opaque]).astype(np.float32)
        box = np.column_stack([boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad])
        self._writing.add(nanos, "/actors", ros2.boxes(nanos, "actors", now.world.actor, box, ink))
        rated = np.flatnonzero(~np.isnan(now.trust))
        rows = np.zeros(len(rated), RATED)
        for axis, name in enumerate("xyz"):
            rows[name] = boxes.xyz_m[rated, axis]
        rows["trust"] = now.trust[rated]
        rows["vehicle"] = now.world.actor[rated]
        rows["newest_evaluation_age_s"] = now.age_of[rated]
        self._writing.add(nanos, "/trust", ros2.points(nanos, "map", rows))

    def flush(self) -> None:
        self._file.flush()

    def end(self, keep: bool) -> None:
        try:
            if keep:
                self._writing.finish()
        finally:
            self._file.close()
            _finish(self._path, keep)
