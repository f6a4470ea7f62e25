"""Other ways of trusting on the evidence of a run that is on disk, as if they had been its trust variants."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
from numpy import ndarray

from cosim.config.config import Config, of_run, resolve_data
from cosim.config.data import read_toml
from cosim.execution import folder as run_folder
from cosim.execution import recording
from cosim.execution.manifest import toml_text
from cosim.mobility.actors import ActorRegistry
from cosim.step.parts import chosen, sources, variants
from cosim.v2x.trust_hosts import Lookups, TrustHosts, TrustState
from results import inventory
from results.archive import OpenRun, open_run
from results.codes import TrustSource
from results.durable import Damaged
from results.encounters import ENCOUNTER_KEY, Rows
from results.inventory import Inventory
from results.manifest import write_manifest
from results.recorder import Recorder
from results.tables import TABLES
from results.verify import verify
from sensors.scene import Shape
from trust.tables import EvaluationMessages

NEEDED = (
    "actors",
    "vehicles",
    "pseudonyms",
    "encounters",
    "receptions",
    "transmitted_evaluations",
    "transmitted_scores",
)
"""Tables that hold the evidence; a run at record.level = "full" has them all."""

WRITTEN = ("trust", "trust_lookups", "lookup_totals", "server", "encounter_trust")
"""Tables that depend on trust, but for those that depend on fused objects (`NOT_ON_DISK`)."""

NOT_ON_DISK = (
    "fused objects need the unrounded boxes of all detections and each vehicle's sweep, and a run keeps neither"
)
"""Why variants get no fused objects and no attack success afterwards. Boxes in tables are rounded to 1/128 m."""


_UNKNOWN = ("identities", "sending")
"""What attacks do that the tables do not hold."""


def retrust(run: Path, file: Path, out: Path, trust_code: bool = False) -> Path:
    """A copy of a run, with the trust variants of a file (`[[trust_variant]]` sections) beside its own.

    Classes of the user's own that the file names are loaded; those that the run's config names, with `trust_code` only.

    Raises
    ------
    ValueError
        In one line, where the run does not hold the evidence or a variant cannot be had from it.
    Damaged
        Where the run is not what was written.
    """
    found = open_run(run)
    found.require(*NEEDED)
    config = _with_variants(found, file, trust_code)
    run_folder.check(out)
    if problems := verify(run)[1]:
        raise Damaged(f"{run} is damaged: {problems[0]}. Run again.")
    whole = out.resolve()
    folder = run_folder.beside(whole)
    try:
        _write(found, config, folder.path)
    except BaseException:
        folder.remove()
        raise
    folder.release()
    folder.path.replace(whole)
    return out


def _write(run: OpenRun, config: Config, out: Path) -> None:
    """The copy: the tables of the run as they are, and those of trust with all variants."""
    for table in run.tables:
        if table not in WRITTEN and (run.path / table).is_dir():
            shutil.copytree(run.path / table, out / table, copy_function=_link)
    hosts = TrustHosts.of(variants(config), config.server, config.seed, config.sensing_interval_s, run.dt_s)
    names = [variant.name for variant in hosts.variants]
    beside = out / "retrust.partial"
    beside.mkdir()
    with Recorder(beside, config.record.level, config.record.block_steps, variants=names) as recorder:
        _replay(run, config, hosts, recorder)
    merged = _merged(run.inventory, inventory.read(beside))
    for table in WRITTEN:
        if table in run.tables:
            (beside / table).replace(out / table)
    shutil.rmtree(beside)
    inventory.rewrite(out, merged)
    text = toml_text(config.to_dict()).encode()
    (out / "config.toml").write_bytes(text)
    content = run.manifest | {
        "variants": names, "config": config.to_dict(), "config_sha256": hashlib.sha256(text).hexdigest(),
        "choices": {key: asdict(source) for key, source in sources(config).items()},
    }  # fmt: skip
    content["summary"] = run.manifest.get("summary", {}) | {"retrust": not_computed(config)}
    content["inventory"] = inventory.read(out).summary(run.manifest["inventory"]["tables"])
    write_manifest(out, content)
    _check_base(run.path, out, names=run.variants)


def not_computed(config: Config) -> str:
    """What the variants without fused objects lack, and why, in one line; for the summary and the report."""
    names = ", ".join(variant.name for variant in variants(config) if not variant.fused)
    return (
        f"No fused objects and no attack success for {names}: {NOT_ON_DISK}. "
        "To have them, run again with these variants in the config and fused = true."
    )


def _merged(old: Inventory, new: Inventory) -> Inventory:
    """The parts of a run, those of the tables of trust from another inventory with the same blocks."""
    found = {block.number: block.parts for block in new.blocks}
    blocks = []
    for block in old.blocks:
        kept = (p for p in block.parts if p.table not in WRITTEN)
        replaced = (p for p in found.get(block.number, ()) if p.table in WRITTEN)
        parts = sorted((*kept, *replaced), key=lambda p: list(TABLES).index(p.table))
        blocks.append(replace(block, parts=tuple(parts), checkpoint={}))
    return Inventory(tuple(blocks))


def _with_variants(run: OpenRun, file: Path, trust_code: bool) -> Config:
    """The run's config with further trust variants."""
    of_run(run.config, run.path, trust_code)  # refuses code of the folder's own; that of the file is the user's choice
    stated = read_toml(file, "file of trust variants")
    listed = stated.pop("trust_variant", [])
    if stated or not listed:
        raise ValueError(f"{file}: sections [[trust_variant]] are wanted, and nothing else.")
    for number, section in enumerate(listed):
        if isinstance(section, dict) and section.get("fused"):
            raise ValueError(
                f"trust_variant.{number}.fused in {file}: {NOT_ON_DISK}. Leave it out, or run again with this variant."
            )
    data = json.loads(json.dumps(run.config))
    data["trust_variant"] = [*data.get("trust_variant", []), *listed]
    config = resolve_data(data, str(file), file.parent)
    if config.server.uplink == "rsu" and "central" in {v.trust.host for v in variants(config)}:
        raise ValueError(f'{run.path}: server.uplink = "rsu": what roadside units received is not on disk. Run again.')
    if config.pseudonyms.policy != "none":
        raise ValueError(
            f'{run.path}: pseudonyms.policy = "{config.pseudonyms.policy}": retrust needs "none". Run again.'
        )
    if config.pseudonyms.revocation != "none":
        raise ValueError(
            f'{run.path}: pseudonyms.revocation = "{config.pseudonyms.revocation}": retrust needs "none". Run again.'
        )
    for key, choice in chosen(config).items():
        if key.startswith("attacks.") and (hook := next((h for h in _UNKNOWN if hasattr(choice.of, h)), None)):
            raise ValueError(
                f"{run.path}: {key} = {choice.source.name}: its {hook} is not on disk. Run again with these variants."
            )
    return config


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _replay(run: OpenRun, config: Config, hosts: TrustHosts, recorder: Recorder) -> None:
    """Trust, step by step, as `cosim.step.cycle` calls it."""
    dt_s, alone = run.dt_s, config.radio.evaluations == "alone"
    state = hosts.start()
    people = _People.of(run, config)
    met = _Met(run, config, len(hosts.variants))
    carried: tuple[EvaluationMessages, ndarray] | None = None
    evidence = _Evidence(run, "evaluation" if alone else "cpm")
    for step, actor, xy_m in _present(run):
        time_s = step * dt_s
        evaluated_s, fused_s = time_s + config.timeout_s, time_s + 2 * config.timeout_s
        here = people.equipped[actor]
        vehicle, xy_m = actor[here], xy_m[here]
        holder, other = met.begin(step)
        state = hosts.receive(state, vehicle, time_s)
        met.first(step, holder, other, hosts.per_variant(hosts.lookup(state, holder, other, time_s)))
        if step % config.sense_every_steps == 0 and len(vehicle):
            state, published, informed = hosts.publish(state, step, time_s, vehicle, people.name_key[vehicle])
            sent, own = evidence.messages(step, vehicle)
            message, index, score = evidence.scores(step, vehicle)
            state = hosts.add_own(hosts.open_step(state, step, vehicle, message, index, score), own, vehicle)
            carried, before = ((sent, vehicle), carried)
            on_air = carried if alone else before
            receiver, sender = evidence.receptions(step)
            if on_air is not None:
                state = _deliver(hosts, state, *on_air, receiver, sender)
            state, up = hosts.report_by_cellular(state, sent, people.name_key[vehicle], xy_m, evaluated_s)
            state = hosts.receive(state, vehicle, fused_s)
            lookups = hosts.per_variant(hosts.lookup(state, receiver, sender, fused_s))
            met.note(step, receiver, sender, lookups)
            servers = hosts.traffic(up, informed)
            recording.trust(recorder, step, dt_s, hosts.per_variant(published), servers, receiver, sender, lookups)
        met.end(step, recorder)
        recorder.reach(step)
    met.close(run.manifest["steps"], recorder)


def _deliver(
    hosts: TrustHosts, state: TrustState, messages: EvaluationMessages, author: ndarray, receiver: ndarray,
    sender: ndarray,
) -> TrustState:  # fmt: skip
    at = np.minimum(np.searchsorted(author, sender), len(author) - 1)
    carries = author[at] == sender
    return hosts.add_received(state, messages, receiver[carries], at[carries])


@dataclass(frozen=True, slots=True)
class _People:
    """Actors by number."""

    equipped: ndarray
    name_key: ndarray

    @staticmethod
    def of(run: OpenRun, config: Config) -> "_People":
        table = run.table("vehicles", ["vehicle", "sumo_id", "vehicle_class", "equipped"]).sort_values("vehicle")
        registry = ActorRegistry(config.fleet, config.seed)
        shape = np.array([Shape[name.upper()] for name in table.vehicle_class], np.uint8)
        numbers = registry.register(table.sumo_id.tolist(), shape, np.ones((len(table), 3)), 0)
        return _People(table.equipped.to_numpy(bool), registry.name_key[numbers])


def _present(run: OpenRun) -> Iterator[tuple[int, ndarray, ndarray]]:
    """Actors and positions of every step, empty ones included."""
    following = 0
    for part in run.parts("actors", ["step", "actor", "x_m", "y_m"]):
        for key, rows in part.groupby("step", sort=True):
            step = int(cast(int, key))
            for empty in range(following, step):
                yield empty, np.zeros(0, np.int64), np.zeros((0, 2))
            following = step + 1
            yield step, rows.actor.to_numpy(np.int64), rows[["x_m", "y_m"]].to_numpy(float)
    for empty in range(following, run.manifest["steps"]):
        yield empty, np.zeros(0, np.int64), np.zeros((0, 2))


class _Evidence:
    """Messages of every step, read a block at a time."""

    def __init__(self, run: OpenRun, message_type: str) -> None:
        self._message_type = message_type
        self._tables = {
            name: _Steps(run.parts(name, columns))
            for name, columns in (
                ("transmitted_evaluations", None),
                ("transmitted_scores", None),
                ("receptions", ["step", "message_type", "sender", "receiver"]),
            )
        }

    def messages(self, step: int, vehicle: ndarray) -> tuple[EvaluationMessages, EvaluationMessages]:
        """As transmitted, and as evaluators keep them."""
        rows = self._tables["transmitted_evaluations"].of(step)
        evaluator = rows["evaluator"].to_numpy(np.int64)
        ptr = np.concatenate([np.searchsorted(evaluator, vehicle), [len(evaluator)]])
        observer, index = (rows[name].to_numpy(np.int64) for name in ("observer", "detection_index"))
        sent, own = (
            EvaluationMessages(
                step, vehicle, ptr, observer, index, rows[f"{who}evaluation"].to_numpy(float),
                rows[f"{who}visibility"].to_numpy(float),
            )
            for who in ("", "own_")
        )  # fmt: skip
        return sent, own

    def scores(self, step: int, vehicle: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Message, number and score of every detection transmitted."""
        rows = self._tables["transmitted_scores"].of(step)
        message = np.searchsorted(vehicle, rows.observer.to_numpy(np.int64))
        return message, rows.detection_index.to_numpy(np.int64), rows.score.to_numpy(float)

    def receptions(self, step: int) -> tuple[ndarray, ndarray]:
        """Receivers and senders of the messages that carry evaluations."""
        rows = self._tables["receptions"].of(step)
        rows = rows[rows.message_type == self._message_type].sort_values(["receiver", "sender"])
        return rows.receiver.to_numpy(np.int64), rows.sender.to_numpy(np.int64)


class _Steps:
    """Rows of a table step by step; asked for in ascending order."""

    def __init__(self, parts: Iterator[pd.DataFrame]) -> None:
        self._parts = parts
        self._now: dict[int, pd.DataFrame] = {}
        self._last = -1
        self._empty: pd.DataFrame | None = None

    def of(self, step: int) -> pd.DataFrame:
        while self._last < step:
            part = next(self._parts, None)
            if part is None:
                break
            self._empty = part.iloc[:0]
            self._now = {int(cast(int, s)): rows for s, rows in part.groupby("step")}
            self._last = max(self._now, default=self._last)
        found = self._now.get(step)
        if found is None:
            assert self._empty is not None, "the table has no rows at all"
            return self._empty
        return found


class _Met:
    """Trust at encounters: those of the run, with the trust of every variant."""

    def __init__(self, run: OpenRun, config: Config, n_variants: int) -> None:
        self._n, self._dt_s = n_variants, run.dt_s
        frame = run.table("encounters").reset_index(drop=True)
        equipped = set(run.roles.index)
        self._both = (frame.a.isin(equipped) & frame.b.isin(equipped)).to_numpy()
        patience = np.maximum(1, np.ceil(frame.hysteresis_s.to_numpy(float) / run.dt_s - 1e-9)).astype(int)
        end = frame.end_step.to_numpy(np.int64)
        over = np.where(frame.departed.to_numpy(bool), end, end + patience - 1)
        self._over = np.where(frame.censored_right.to_numpy(bool), np.iinfo(np.int64).max, over)
        self._frame = frame
        self._start = frame.start_step.to_numpy(np.int64)
        self._pair = frame.a.to_numpy(np.int64) << 32 | frame.b.to_numpy(np.int64)
        shape = (len(frame), n_variants)
        self._columns: dict[str, ndarray] = {}
        for way in ("ab", "ba"):
            self._columns |= {
                f"trust_{way}": np.zeros(shape, np.float32), f"source_{way}": np.zeros(shape, np.int8),
                f"state_{way}": np.zeros(shape, np.int8), f"age_{way}": np.zeros(shape, np.float32),
                f"known_{way}": np.zeros(len(frame), bool), f"after_{way}": np.full(shape, -1),
            }  # fmt: skip
        self._live = np.zeros(0, np.int64)

    def begin(self, step: int) -> tuple[ndarray, ndarray]:
        """Holders and others of the equipped pairs that meet now, both ways."""
        self._live = self._live[self._over[self._live] > step]
        new = np.flatnonzero((self._start == step) & self._both)
        self._live = np.concatenate([self._live, new])
        pair = np.unique(self._pair[new])
        a, b = pair >> 32, pair & 0xFFFFFFFF
        return np.concatenate([a, b]), np.concatenate([b, a])

    def first(self, step: int, holder: ndarray, other: ndarray, known: Sequence[Lookups]) -> None:
        """What holders know of others when they meet."""
        new = self._live[self._start[self._live] == step]
        for row, at, way in self._rows(new, holder, other):
            c = self._columns
            c[f"known_{way}"][at] = True
            for v, found in enumerate(known):
                default = found.source[row] == TrustSource.DEFAULT
                c[f"trust_{way}"][at, v], c[f"source_{way}"][at, v] = found.trust[row], found.source[row]
                c[f"age_{way}"][at, v] = np.where(default, 0, found.age_s[row])
                c[f"state_{way}"][at, v] = found.state[row]
                c[f"after_{way}"][at[found.is_known[row]], v] = step

    def note(self, step: int, holder: ndarray, other: ndarray, lookups: Sequence[Lookups]) -> None:
        """Which holders looked up a value that rests on an evaluation."""
        for row, at, way in self._rows(self._live, holder, other):
            for v, found in enumerate(lookups):
                after = self._columns[f"after_{way}"]
                rows = at[found.is_known[row] & (after[at, v] < 0)]
                after[rows, v] = step

    def _rows(self, live: ndarray, holder: ndarray, other: ndarray) -> Iterator[tuple[ndarray, ndarray, str]]:
        """Rows of the lookups and the encounters that each belongs to, by direction."""
        order = np.argsort(self._pair[live], kind="stable")
        live, pair = live[order], self._pair[live][order]
        wanted = np.minimum(holder, other) << 32 | np.maximum(holder, other)
        low, high = np.searchsorted(pair, wanted), np.searchsorted(pair, wanted, "right")
        row = np.repeat(np.arange(len(holder)), high - low)
        offset = np.arange(len(row)) - np.repeat(np.cumsum(high - low) - (high - low), high - low)
        at = live[np.repeat(low, high - low) + offset] if len(row) else np.zeros(0, np.int64)
        ab = holder[row] < other[row]
        yield row[ab], at[ab], "ab"
        yield row[~ab], at[~ab], "ba"

    def end(self, step: int, recorder: Recorder) -> None:
        """Write the encounters that were over in this step."""
        self._write(np.flatnonzero(self._over == step), step, recorder)

    def close(self, n_steps: int, recorder: Recorder) -> None:
        """Write the encounters that were under way at the end."""
        self._write(np.flatnonzero(self._over >= n_steps), n_steps - 1, recorder)

    def _write(self, rows: ndarray, step: int, recorder: Recorder) -> None:
        if self._n == 1 or not len(rows):
            return
        frame, c = self._frame.iloc[rows], self._columns
        others = range(1, self._n)
        found: Rows = {"variant": np.repeat(np.arange(1, self._n), len(rows))}
        for name in ENCOUNTER_KEY:
            values = frame[name].cat.codes.to_numpy() if name == "pairs" else frame[name].to_numpy()
            found[name] = np.tile(values, self._n - 1)
        for way in ("ab", "ba"):
            source = np.concatenate([c[f"source_{way}"][rows, v] for v in others])
            known = np.tile(c[f"known_{way}"][rows], self._n - 1)
            after = np.concatenate([c[f"after_{way}"][rows, v] for v in others])
            start = np.tile(self._start[rows], self._n - 1)
            found |= {
                f"trust_{way}": np.concatenate([c[f"trust_{way}"][rows, v] for v in others]),
                f"trust_{way}__valid": known,
                f"source_{way}": source,
                f"source_{way}__valid": known,
                f"state_{way}": np.concatenate([c[f"state_{way}"][rows, v] for v in others]),
                f"state_{way}__valid": known,
                f"age_{way}_s": np.concatenate([c[f"age_{way}"][rows, v] for v in others]),
                f"age_{way}_s__valid": known & (source != TrustSource.DEFAULT),
                f"trusted_after_{way}_s": (after - start) * self._dt_s,
                f"trusted_after_{way}_s__valid": after >= 0,
            }
        recorder.append("encounter_trust", step, found)


def _check_base(run: Path, out: Path, names: Sequence[str]) -> None:
    """The variants that the run had must come out as they are in it."""
    for table in ("trust", "trust_lookups", "lookup_totals", "server"):
        before, after = (
            found[found.variant.isin(names)].reset_index(drop=True)
            for found in (open_run(folder).table(table).astype({"variant": str}) for folder in (run, out))
        )
        if not before.equals(after):
            raise ValueError(
                f"{run}: table {table} does not come out as it is on disk: another cosim made the run, or an attack "
                "acts on what the tables do not hold. Run it again with these variants in its config."
            )
