def _row(name: str, column: Column) -> str:
    kind = f"category: {', '.join(column.categories)}" if column.categories else column.type
    notes = [
        *(["key"] if column.key else []),
        *(["may be null"] if column.null else []),
        *(["truth"] if column.truth else []),
        *([f"to 1/{2**column.bits}"] if column.bits else []),
        *([f"by `{column.via}`"] if column.via else []),
    ]
    return f"| `{name}` | {kind} | {column.unit} | {', '.join(notes)} | {column.meaning} |"


def markdown() -> str:
    """The dictionary as Markdown, the text of `results/TABLES.md`."""
    lines = [
        "# Tables of a run",
        "",
        f"Schema version {SCHEMA_VERSION}. Written from `results/tables.py` by `python -m results.tables`.",
        "",
        "`key` columns together name a row. `truth` columns are known to the simulation only. `to 1/256` says",
        "that stored values are rounded to that fraction of the unit. ``by `source` `` says that the column is not in",
        "the files: it is that of the row of `detections` with the same `step` whose `observer` and `k` are `source` and",
        "`source_index` (for `pose`: `pose` and `pose_index` where they are not null); `open_run` puts it in place.",
        "",
        "Levels contain one another:",
        *(
            f"`{level}` keeps {', '.join(f'`{name}`' for name in kept(level))}{'.' if level == 'full' else ';'}"
            for level in LEVELS
        ),
    ]
    for name, table in TABLES.items():
        lines += [
            "",
            f"## {name}",
            f"{table.meaning} Kept from level `{table.level}` up. Key: {', '.join(table.key)}.",
            "",
            "| column | type | unit | notes | meaning |",
            "|---|---|---|---|---|",
            *(_row(label, column) for label, column in table.columns.items()),
        ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("TABLES.md").write_text(markdown())
