"""Runs a config into a folder, and resumes such a run."""

import hashlib
import re
import shlex
import shutil
from collections.abc import Collection
from contextlib import closing, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cosim.attacks.params import named, shares
from cosim.base.durable import PARTIAL, Damaged, open_regular
from cosim.config.config import Config, of_run
from cosim.door.blame import ExtensionError
from cosim.runs import checkpoint, recording
from cosim.runs import folder as run_folder
from cosim.runs.check import check, roadside_units, rsu_antennas
from cosim.runs.drive import STATE_VERSION, Advance, Commands, Drive, OnStep, own_modules, warm_up
from cosim.runs.folder import RunFolder
from cosim.runs.inputs import provenance
from cosim.runs.manifest import Manifest, versions
from cosim.runs.speed.kernels import compiling
from cosim.runs.stop import NOTHING_WRITTEN, Failed, Stopped, StopRequest
from cosim.step.parts import Parts, sources
from cosim.step.state import State
from cosim.step.stopwatch import Stopwatch
from cosim.step.trackers.attack_start import AttackStartTracker
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.limits import NO_LIMITS
from cosim.traffic.meshes import with_meshes
from cosim.traffic.remarks import traffic_remarks
from cosim.traffic.scenario import Scenario
from cosim.traffic.scene_summary import scene_summary
from cosim.traffic.source import TrafficEnded, TrafficError, TrafficSource
from results import inventory
from results.inventory import CHECKPOINT, Inventory
from results.manifest import check_schema, problems, read_manifest
from results.recorder import Recorder, is_state
from results.run import content_problem
from results.verify import links


def run(
    config: Config,
    out: Path | None,
    advance: Advance,
    traffic_from: Path | None = None,
    on_step: OnStep | None = None,
) -> Path:
    """Run an experiment into a folder.

    Nothing is written before the config has been checked and SUMO has accepted the scenario.

    Parameters
    ----------
    config
        The experiment.
    out
        Folder to write; None for the next free `runs/<city>-N`.
    advance
        Called with progress.
    traffic_from
        Folder that `record_traffic` wrote for the same `[traffic]`. It is replayed instead of running SUMO. The tables
        are the same.
    on_step
        Called with the result of every recorded step, for example to show it.

    Returns
    -------
    The folder that was written.

    Raises
    ------
    ValueError
        In one line, if the config cannot run or the folder cannot be used.
    Stopped
        If a signal interrupted the run; the complete steps are written.
    """
    out = None if out is None else out.expanduser()
    run_folder.check(out)
    with StopRequest() as stop, compiling(config.compute.threads):
        scenario = check(config)
        parts, registry, traffic = load_parts(config, scenario, traffic_from)
        with closing(traffic):
            folder = run_folder.create(out, scenario.name)
            with folder.or_nothing():
                manifest = Manifest(folder.path, config, provenance(config, scenario), sources(config))
                manifest.summary = scene_summary(scenario).lines
                manifest.begin()
                recorder = _recorder(folder.path, parts, 0)
                warmup_s = 0.0 if traffic_from is not None else scenario.warmup_of(config.traffic)
                drive = Drive(parts, scenario, folder, warmup_s, traffic, registry, recorder, manifest, advance, stop)
                drive.on_step = on_step
            _carry_out(drive, folder)
    return folder.path


def resume(path: str | Path, advance: Advance, traffic_from: Path | None = None, trust_code: bool = False) -> Path:
    """Continue a run that was killed or interrupted, from its last complete block.

    The tables equal those of a run without interruption. The traffic is simulated again from its beginning, because
    SUMO's saved state is not exact. Everything else continues from the state that was kept with the block.

    Parameters
    ----------
    path
        Folder of the run.
    advance
        Called with progress.
    traffic_from
        As in `run`.
    trust_code
        Load the user's own classes that the run's config names. Without it, the run is refused, because the author of
        a folder can compute its checksums again after a change. Nothing else in the folder can name code.

    Returns
    -------
    The folder of the run.

    Raises
    ------
    ValueError
        In one line, if the run cannot be resumed, for example because its inputs have changed.
    Damaged
        If the files of the run differ from what was written.
    """
    path = Path(path)
    manifest = read_manifest(path)
    config = resumable(path, trust_code)
    scenario = check(config)
    before, now = manifest["net"], provenance(config, scenario)
    if now != before:
        keys = sorted(now.keys() | before.keys())
        changed = [key for key in keys if now.get(key) != before.get(key)]
        raise ValueError(f"{path}: its inputs have changed since: {', '.join(changed)}. Run again.")
    with StopRequest() as stop:
        folder = run_folder.reopen(path)
        try:
            if read_manifest(path)["status"] == "finished":
                folder.release()  # a kill may have come between the last manifest and the release of the lock
                return path
            found = inventory.read(path).to_go_on()
            closed = [part for block in found.blocks for part in block.parts]
            if problem := next((p for part in closed if (p := content_problem(path, part))), ""):
                raise Damaged(f"{path} is damaged: {problem}. Run again.")
            parts, registry, traffic = load_parts(config, scenario, traffic_from)
            with closing(traffic):
                went = Manifest(path, config, manifest["net"], sources(config), steps=found.end_step)
                went.keep_config(manifest)
                went.summary = scene_summary(scenario).lines
                recorder = _recorder(path, parts, found.end_step)
                went.resumed_at = [*manifest.get("resumed_at", []), found.end_step]
                warmup_s = 0.0 if traffic_from is not None else scenario.warmup_of(config.traffic)
                drive = Drive(parts, scenario, folder, warmup_s, traffic, registry, recorder, went, advance, stop)
                drive.state = _kept_state(path, found, config, went.config_sha256)
                drive.expected = _last_poses(path, found)
                drive.commands = _kept_commands(path, found)
                went.write("running")
                _carry_out(drive, folder)
        except BaseException:
            folder.release()
            raise
    return path


def record_traffic(config: Config, path: Path, advance: Advance) -> Path:
    """Simulate and record the traffic of a config without equipped vehicles.

    Returns
    -------
    The folder `path`, for `run(..., traffic_from=path)`.
    """
    own = {section: values for section, values in config.own.items() if not section.startswith("attacks.")}
    config = replace(config, attacks=(), trust_variant=(), own=own)
    scenario, watch = check(config), Stopwatch()
    registry = ActorRegistry(replace(config.fleet, penetration_p=0.0), config.seed)
    traffic = scenario.traffic(config.traffic, registry)
    try:
        folder = run_folder.create(path, scenario.name)
        manifest = Manifest(path, config, provenance(config, scenario), sources(config))
        manifest.begin()
        warm_up(scenario.warmup_of(config.traffic), traffic, watch, advance)
        recorder = Recorder(path, "standard", config.record.block_steps)
        for number in range(config.n_steps):
            try:
                world = traffic.advance()
            except TrafficEnded:
                break
            recording.actors(recorder, world)
            recorder.reach(number)
            manifest.steps = number + 1
            advance("traffic", number + 1, config.n_steps, f"steps, {len(world)} actors")
        vehicles = recording.vehicle_rows(registry, np.zeros(1, np.uint8), AttackStartTracker(), config.schedule)
        recorder.close({"vehicles": [vehicles]})
        manifest.timings_s, manifest.summary = watch.seconds, traffic.report()
    finally:
        traffic.close()
    manifest.write("finished", recorder.inventory)
    folder.release()
    return path


def resumable(path: Path, trust_code: bool) -> Config:
    """The config of a run that can be resumed.

    Raises
    ------
    ValueError
        In one line, if the run cannot be resumed.
    Damaged
        If the folder contradicts its manifest.
    """
    manifest = read_manifest(path)
    check_schema(path, manifest)
    lidar = manifest["config"].get("lidar")
    now = versions(str(lidar.get("engine")) if isinstance(lidar, dict) else "")
    begun_with = manifest.get("versions", {})
    other = []
    for package, version in now.items():
        before = begun_with.get(package)
        if before != version:
            other.append(f"{package} {before} (now {version})")
    if other:
        raise ValueError(f"{path} was begun with {', '.join(other)}: the tables would be of two kinds. Run again.")
    if linked := links(path):
        raise ValueError(f"{path}: {linked[0]} is a symbolic link, through which nothing is written.")
    if problem := next(problems(path, manifest, inventory.read(path)), ""):
        raise Damaged(f"{path} cannot go on: {problem}. Run again.")
    config = of_run(manifest["config"], path, trust_code)
    found = {key: asdict(source) for key, source in sources(config).items()}
    chosen = manifest.get("choices")
    if found != chosen:
        known = chosen if isinstance(chosen, dict) else {}
        changed = []
        for key, source in found.items():
            if known.get(key) != source:
                changed.append(f"{key} names {source['file'] or source['name']}")
        names = ", ".join(changed) or "choices"
        raise ValueError(f"{path}: {names}, which was changed since. Run again.")
    return config


def load_parts(
    config: Config, scenario: Scenario, traffic_from: Path | None = None
) -> tuple[Parts, ActorRegistry, TrafficSource]:
    """The components of a run, its actors and its traffic; arguments as in `run`. The caller closes the traffic."""
    watch = Stopwatch()
    with watch("city"):
        city = with_meshes(scenario.city(config.trees, config.seed), config.meshes, config.vehicle_meshes)
        parked = scenario.parked(config.parked, city, config.seed)
        limits = scenario.limits() if config.tracking.model != "none" else NO_LIMITS
    units = roadside_units(config, scenario)
    parts = Parts.of(config, city, rsu_antennas(config, scenario), watch, units, limits)
    parts = replace(parts, near_pairs=parts.near_pairs.without(parked))
    registry = ActorRegistry(config.fleet, config.seed, shares(config.attacks), named(config.attacks))
    recorded = scenario if traffic_from is None else replace(scenario, trace=traffic_from, warmup_s=0.0)
    params = config.traffic if traffic_from is None else replace(config.traffic, begin_s=None, warmup_s=0.0)
    has_driver = config.driver.model != "none"
    return parts, registry, recorded.traffic(params, registry, has_driver, config.objects, parked, units)


def _recorder(folder: Path, parts: Parts, resume_at: int) -> Recorder:
    variants = [variant.name for variant in parts.trust.variants]
    record = parts.config.record
    return Recorder(folder, record.level, record.block_steps, resume_at, variants=variants)


def _kept_commands(path: Path, found: Inventory) -> dict[int, Commands]:
    """Speeds that drivers commanded in the recorded steps, by step. The repeated traffic must obey them again."""
    commands: dict[int, Commands] = {}
    for block in found.blocks:
        for name in block.checkpoint:
            if not is_state(name):
                commands |= _decoded(path, name, block.checkpoint[name], ())
    return commands


def _decoded(path: Path, name: str, digest: str, own: Collection[str]) -> Any:
    """The content of a file of a checkpoint; Damaged if it is not what was written."""
    with open_regular(path / name) as file:
        content = file.read()
    if hashlib.sha256(content).hexdigest() != digest:
        raise Damaged(f"{path} is damaged: {name} is not what was written. Run again.")
    try:
        return checkpoint.decode(content, own)
    except ValueError as error:
        raise Damaged(f"{path}/{name}: {error}. Run again.") from None


def _kept_state(path: Path, found: Inventory, config: Config, config_sha256: str) -> State | None:
    """The state at the end of the last complete block; None if no state was kept and all steps are computed again."""
    checkpoint = found.blocks[-1].checkpoint if found.blocks else {}
    names = [name for name in checkpoint if is_state(name)]
    if not names:
        return None
    kept = _decoded(path, names[0], checkpoint[names[0]], own_modules(config))
    is_known = isinstance(kept, tuple) and len(kept) == 3 and kept[0] == STATE_VERSION
    if not is_known or not isinstance(kept[2], State):
        raise ValueError(f"{path} was begun with another cosim. Run again.")
    if kept[1] != config_sha256:
        raise Damaged(f"{path}: {names[0]} is of a run with another config. Run again.")
    return kept[2]


def _last_poses(path: Path, found: Inventory) -> dict[str, np.ndarray] | None:
    """Rows of the table `actors` of the last recorded step; None if the run does not keep that table."""
    last = found.end_step - 1
    parts = [part for part in found.of("actors") if part.first_step <= last <= part.last_step]
    if not parts:
        return None
    columns = ["actor", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps"]
    is_last = pc.field("step") == last
    table = pq.read_table(path / parts[0].name, columns=columns, filters=is_last, partitioning=None)
    return {name: table.column(name).to_numpy() for name in columns}


_RUN_AGAIN = "The steps before it are kept. Correct the class, and run again: no run goes on with changed code."


def _carry_out(drive: Drive, folder: RunFolder) -> None:
    """Carry out a run, and write its status into the manifest in every case."""
    manifest, recorder = drive.manifest, drive.recorder
    with_code = " --trust-code" if own_modules(drive.parts.config) else ""
    again = f"cosim resume {shlex.quote(str(folder.path))}{with_code}"
    try:
        drive.run()
    except Stopped as error:
        if not recorder.inventory.blocks:
            _fail(drive, folder, "")
            raise
        manifest.write("interrupted", recorder.inventory)
        folder.release()
        message = f"interrupted before anything was added. Continue with: {again}"
        raise Stopped(error.signum, message) from None
    except Failed:
        raise
    except Damaged as error:
        _fail(drive, folder, str(error))
        raise
    except TrafficError as error:
        if not _fail(drive, folder, str(error)):
            raise
        raise TrafficError(f"{error} The steps before it are kept: {again}.") from error.__cause__
    except ExtensionError as error:
        kept = _fail(drive, folder, str(error))
        then = f" {_RUN_AGAIN}" if kept else " Nothing is kept."
        raise ExtensionError(str(error) + then) from error.__cause__
    except OSError as error:
        message = f"{folder.path}: {error.strerror or error}, at step {manifest.steps}"
        kept = _fail(drive, folder, message)
        raise Failed(message + (f". Continue with: {again}" if kept else ". Nothing is kept.")) from None
    except MemoryError:
        message = f"{folder.path}: out of memory at step {manifest.steps}"
        _fail(drive, folder, message)
        raise Failed(message + ".") from None
    except Exception as error:
        if drive.stop.signum is not None and not recorder.inventory.blocks:  # the signal came out of compiled code
            _fail(drive, folder, "")
            raise Stopped(drive.stop.signum, NOTHING_WRITTEN) from None
        _fail(drive, folder, f"{type(error).__name__}: {error}")
        raise RuntimeError(f"{folder.path}: the run failed at step {manifest.steps}") from error
    _measured(drive)
    if not drive.is_over:
        manifest.write("interrupted", recorder.inventory)
        folder.release()
        assert drive.stop.signum is not None
        raise Stopped(
            drive.stop.signum,
            f"interrupted after {manifest.steps} of {drive.parts.config.n_steps} steps, all written. "
            f"Continue with: {again}",
        )
    manifest.write("finished", recorder.inventory)
    shutil.rmtree(folder.path / CHECKPOINT, ignore_errors=True)
    folder.release()


def _fail(drive: Drive, folder: RunFolder, message: str) -> bool:
    """Write the status "failed" into the manifest, or remove a folder without steps; return whether steps are kept."""
    manifest, recorder = drive.manifest, drive.recorder
    if not folder.lock.is_held():
        return False
    if not recorder.inventory.blocks:
        with suppress(OSError):
            folder.remove()
        return False
    manifest.error = message
    _measured(drive)
    with suppress(OSError):  # on a full disk the manifest stays "running"; without a lock this means the same
        for leftover in folder.path.rglob("*" + PARTIAL):
            leftover.unlink()
        manifest.write("failed", recorder.inventory)
    with suppress(OSError):
        folder.release()
    return True


def _measured(drive: Drive) -> None:
    """Note in the manifest what the run cost."""
    drive.manifest.timings_s = drive.parts.watch.seconds


_FEWEST_MESSAGES = 3.0
"""A run with fewer messages per pseudonym, on average, gets a note."""
_NAMED = 5
"""Absent attackers that a note names."""


def remarks(folder: Path) -> list[str]:
    """Notes that a user should read before they rely on the figures of a run; empty for most runs."""
    summary = read_manifest(folder)["summary"]
    absent = [f"note: {key}: no vehicle of that id was on the road." for key in summary.get("victims_absent", ())]
    for key, missing in summary.get("attackers_absent", {}).items():
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        few = ", ".join(missing[:_NAMED])
        absent.append(f"note: {key}: {few}{more} did not attack: no equipped vehicle of that id was on the road.")
    return traffic_remarks(summary) + absent + _dropped(summary) + pseudonym_remarks(summary)


def _dropped(summary: dict[str, Any]) -> list[str]:
    """A note if attacks made detections that no message can contain."""
    if not (causes := summary.get("detections_dropped")):
        return []
    return [
        f"note: {sum(causes.values()):,} detections that attacks changed or added were not sent, because no message "
        f"can contain them ({', '.join(causes)}). The table dropped_detections counts them by step."
    ]


def new_remarks(folder: Path, said: dict[str, str]) -> list[str]:
    """Of the `remarks` on a run, those that are not in `said`, where they are then. Numbers make no difference."""
    kinds = ((re.sub(r"[\d.,]+", "", remark), remark) for remark in remarks(folder))
    return [remark for kind, remark in kinds if said.setdefault(kind, remark) is remark]


def pseudonym_remarks(summary: dict[str, Any]) -> list[str]:
    """A note if pseudonyms change so often that there is hardly any evidence about them."""
    if (mean := summary.get("messages_per_pseudonym", _FEWEST_MESSAGES)) >= _FEWEST_MESSAGES:
        return []
    return [
        f"note: vehicles sent {mean:g} messages under each pseudonym on average: hardly any evidence about a pseudonym "
        "exists when it is looked up. Let the policy in [pseudonyms] change them less often, or set "
        "pseudonyms.linkage."
    ]
