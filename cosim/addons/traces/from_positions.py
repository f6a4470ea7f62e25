"""Makes a trace that a run can drive from positions of vehicles: logs, drone recordings, output of other simulators."""

import os
from collections.abc import Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.traces.positions import Fixes
from cosim.addons.traces.tracks import Positions, PositionTracks, TrackParams, steps, tracks
from cosim.base import durable
from cosim.base.durable import PARTIAL
from cosim.traffic.fcd import OBSERVED, OBSERVED_COLUMN, PROJECTION, Timestep
from cosim.traffic.frame import TrafficError
from cosim.traffic.source import class_counts

_TURNS_M = 0.2
"""A vehicle that has moved less keeps its direction: noise would turn one that stands."""
_ROWS_AT_ONCE = 1 << 16


def write_trace(fixes: Fixes, params: TrackParams, out: Path) -> dict[str, Any]:
    """Write a trace in Parquet, with the columns of SUMO's floating car data.

    Parameters
    ----------
    fixes
        Positions of vehicles.
    params
        Steps of the trace, and where a track is cut.
    out
        File to write, which must not exist.

    Returns
    -------
    What was found, as `PositionTracks.report`, and `actors`, `tracks`, `steps`, `classes` and `read_as`.

    Raises
    ------
    TrafficError
        In one line, if no position falls on a step, or if the file cannot be written.
    """
    try:
        found = tracks(fixes, params)
    except ValueError as error:
        raise TrafficError(f"{fixes.source}: {error}" if fixes.source else str(error)) from None
    partial = out.with_name(out.name + PARTIAL)
    try:
        os.close(durable.new_file(partial))
        _write(timesteps(fixes, found, params.step_s), partial, fixes)
        partial.rename(out)
    except OSError as error:
        raise TrafficError(f"{out} cannot be written: {error.strerror or error}.") from None
    finally:
        partial.unlink(missing_ok=True)
    actors = sorted(set(found.actor.tolist()))
    return {
        "actors": len(actors),
        "tracks": len(found.names),
        "steps": found.n_steps,
        **found.report,
        "classes": class_counts(fixes.shape[actors]),
        "read_as": list(fixes.read_as),
    }


def timesteps(fixes: Fixes, found: PositionTracks, step_s: float) -> Iterator[Timestep]:
    """All tracks, step by step, with directions and speeds from the positions of the steps before and after.

    A vehicle that stands keeps its direction; one that has not moved yet has that of its first motion, and north if it
    never moves. A slow one turns whenever it has come far enough from where it had its direction. Sizes are those of
    the positions, or those of the class.
    """
    names = np.array(found.names, object)
    kinds = np.array(fixes.kinds, object)[found.actor]
    lwh_m = np.array([kind.lwh_m for kind in fixes.types])[found.actor]
    vclass = np.array([kind.vclass for kind in fixes.types], object)[found.actor]
    is_person = vclass == "pedestrian"
    direction = _first_direction(fixes, found)
    before_m = np.full((len(kinds), 2), np.nan)
    after_m, turned_m = before_m.copy(), before_m.copy()
    last = np.zeros(0, np.int64)
    empty = Positions(found.n_steps, np.zeros(0, np.int64), np.zeros((0, 2)))
    for here, then in pairwise(chain(steps(fixes, found, step_s), [empty])):
        after_m[then.track] = then.xy_m
        a_m, b_m = before_m[here.track], after_m[here.track]
        has_before = np.isfinite(a_m[:, :1])
        has_after = np.isfinite(b_m[:, :1])
        to_m = np.where(has_after, b_m, here.xy_m)
        moved_m = to_m - np.where(has_before, a_m, here.xy_m)
        distance_m = np.hypot(*moved_m.T)
        took_s = step_s * (has_before.sum(axis=1) + has_after.sum(axis=1))
        is_new = np.isnan(turned_m[here.track, 0])
        turned_m[here.track[is_new]] = here.xy_m[is_new]
        since_m = here.xy_m - turned_m[here.track]
        turns = distance_m > _TURNS_M
        creeps = ~turns & (np.hypot(*since_m.T) > _TURNS_M)
        for some, way_m in ((turns, moved_m[turns]), (creeps, since_m[creeps])):
            of = here.track[some]
            direction[of] = way_m / np.hypot(*way_m.T)[:, None]
            turned_m[of] = here.xy_m[some]
        ahead = direction[here.track]
        half_m = 0.0 if fixes.is_front else lwh_m[here.track, :1] / 2
        front_m = here.xy_m + ahead * half_m
        yield Timestep(
            here.step * step_s,
            names[here.track].tolist(),
            kinds[here.track].tolist(),
            np.column_stack([front_m, np.zeros(len(front_m))]),
            np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1])) % 360.0,
            np.divide(distance_m, took_s, out=np.zeros(len(took_s)), where=took_s > 0),
            is_person[here.track],
            vclass[here.track].tolist(),
            lwh_m[here.track],
        )
        after_m[then.track], before_m[last] = np.nan, np.nan
        before_m[here.track] = here.xy_m
        last = here.track


def _first_direction(fixes: Fixes, found: PositionTracks) -> Float[ndarray, "s 2"]:
    """Unit vector from the first position of each track to the first one that is far enough; north where none is."""
    fix = found.link_fix
    after = fix + found.is_joined
    first = np.full(len(found.names), len(fixes.time_s))
    np.minimum.at(first, found.link_track, fix)
    moved_m = fixes.xy_m[after] - fixes.xy_m[first[found.link_track]]
    distance_m = np.hypot(*moved_m.T)
    moves = np.flatnonzero(distance_m > _TURNS_M)[::-1]  # the first of each track is written last
    direction = np.tile([0.0, 1.0], (len(found.names), 1))
    direction[found.link_track[moves]] = moved_m[moves] / distance_m[moves, None]
    return direction


def _write(of: Iterator[Timestep], path: Path, fixes: Fixes) -> None:
    writer, rows, n_rows = None, list[pa.Table](), 0
    at = fixes.projection
    about = {OBSERVED: b""}
    if at is not None:
        about[PROJECTION] = f"{at.latitude_deg!r} {at.longitude_deg!r}".encode()
    try:
        for timestep in chain(of, [None]):
            if timestep is not None and timestep.names:
                rows.append(_table(timestep))
                n_rows += len(timestep.names)
            if rows and (timestep is None or n_rows > _ROWS_AT_ONCE):
                schema = rows[0].schema.with_metadata(about)
                writer = writer or pq.ParquetWriter(path, schema, compression="zstd")
                writer.write_table(pa.concat_tables(rows).cast(schema))
                rows, n_rows = [], 0
    finally:
        if writer is not None:
            writer.close()


def _table(timestep: Timestep) -> pa.Table:
    assert timestep.lwh_m is not None and timestep.vclasses is not None
    return pa.table(
        {
            "timestep_time": np.full(len(timestep.names), timestep.time_s),
            "vehicle_id": pa.array(timestep.names, pa.string()),
            "vehicle_x": timestep.front_m[:, 0],
            "vehicle_y": timestep.front_m[:, 1],
            "vehicle_angle": timestep.compass_deg,
            "vehicle_type": pa.array(timestep.types, pa.string()),
            "vehicle_speed": timestep.speed_mps,
            "vehicle_vClass": pa.array(timestep.vclasses, pa.string()),
            "vehicle_length": timestep.lwh_m[:, 0],
            "vehicle_width": timestep.lwh_m[:, 1],
            "vehicle_height": timestep.lwh_m[:, 2],
            OBSERVED_COLUMN: np.ones(len(timestep.names), bool),
        }
    )
