"""Runs of a few rows, for figures derived by hand."""

import numpy as np

from results.archive import open_run
from results.manifest import finish
from results.recorder import Recorder
from results.tables import TABLES


def make(folder, steps, config=None, dt_s=1.0, **tables):
    """A run: make(folder, steps, table=[{column: value}]); what is left out is 0, False, the first label or null.

    Without a table of pseudonyms, every equipped vehicle has its own number.
    """
    last = {"vehicles": "last_step", "pseudonyms": "to_step"}  # no one stays longer than the run
    for name, key in last.items():
        if name in tables:
            tables[name] = [{**row, key: min(row[key], steps - 1)} if key in row else row for row in tables[name]]
    for row in tables.get("vehicles", []):
        row.setdefault("n_steps", row.get("last_step", 0) - row.get("first_step", 0) + 1)
    tables.setdefault("pseudonyms", [
        {"pseudonym": v["vehicle"], "vehicle": v["vehicle"], "from_step": v.get("first_step", 0),
         "to_step": v.get("last_step", 0)}
        for v in tables.get("vehicles", []) if v.get("equipped")
    ])  # fmt: skip
    with Recorder(folder, "full", block_steps=10) as record:
        for step in sorted({row.get("step", 0) for rows in tables.values() for row in rows}):
            for name, rows in tables.items():
                if now := [row for row in rows if row.get("step", 0) == step]:
                    record.append(name, step, columns(name, now))
        for name in {"actors"} | {name for name, rows in tables.items() if not rows}:
            record.append(name, steps - 1, columns(name, []))  # the run ends with its last step, rows or not
    finish(folder, {"dt_s": dt_s, "steps": steps, "config": config or {}})
    return open_run(folder)


def columns(table, rows):
    given = {}
    for name, column in TABLES[table].stored.items():
        if column.usual and not any(name in row for row in rows):
            continue
        zero = column.categories[0] if column.categories else "" if column.type == "string" else 0
        values = [row.get(name, None if column.null else zero) for row in rows]
        dtype = object if column.type in ("string", "category") else column.type
        given[name] = np.array([zero if v is None else v for v in values], dtype)
        if column.null:
            given[name + "__valid"] = np.array([v is not None for v in values])
    return given


def fleet(*roles, **more):
    return [
        {"vehicle": i, "sumo_id": str(i), "equipped": True, "role": b, "last_step": 99,
         "length_m": 4, "width_m": 2, "height_m": 1.5, **more} for i, b in enumerate(roles)
    ]  # fmt: skip
