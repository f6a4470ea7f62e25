"""What the commands show: tables for people, JSON for machines."""

import json
import sys
from pathlib import Path

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table

screen = Console()
notes = Console(stderr=True)


def print_json(content: object) -> None:
    """JSON on standard output."""
    sys.stdout.write(json.dumps(content, indent=1, ensure_ascii=False, default=str) + "\n")


def conclude(folder: Path, as_json: bool) -> None:
    """What a researcher wants to know when a run ends, and its picture."""
    from results.archive import open_run
    from results.figures import style
    from results.figures.catalogue import FIGURES
    from results.measure import measure as measured

    finished = open_run(folder)
    rows = rows_of(measured(finished, max_frames=200))
    try:
        picture: Path | str = style.save(FIGURES["trust"]([finished]), folder / "trust.png")
    except ValueError as nothing_to_draw:
        picture = f"(no picture) {nothing_to_draw}"
    manifest = finished.manifest
    spent_s = sum(manifest["timings_s"].values())
    simulated_s = manifest["steps"] * finished.dt_s
    if as_json:
        print_json({"run": str(folder), "summary": manifest["summary"], "seconds": spent_s, "measures": rows})
        return
    screen.print(table_of(f"{folder}", rows, HEADLINES))
    slow = sorted(manifest["timings_s"].items(), key=lambda item: -item[1])[:4]
    screen.print(
        f"{simulated_s:g} s of traffic in {spent_s:.1f} s ({_plain(simulated_s / spent_s)} times real time): "
        + ", ".join(f"{stage} {s:.1f} s" for stage, s in slow) + ", ...",
        highlight=False,
    )  # fmt: skip
    screen.print(f"tables and manifest in {folder}", highlight=False, soft_wrap=True)
    screen.print(f"trust over time in {picture}", highlight=False, soft_wrap=True)


HEADLINES = {
    "traffic": ("",),
    "encounters": ("encounters", "duration, mean by", "duration, median by"),
    "trust": ("final trust, median",),
    "liars": ("honest above liars", "suspected", "half are"),
    "freshness": ("trust at use", "age at use, mean"),
    "radio": ("messages", "delivery"),
    "detection": ("awareness",),
    "attack": ("",),
}
"""Of each topic, what the closing summary shows: figures that begin so."""


def rows_of(table) -> list[dict[str, object]]:
    """Measures as plain rows."""
    return [row | {"value": None if row["value"] != row["value"] else row["value"]} for row in table.to_dict("records")]


def _plain(value: float) -> str:
    """Three digits that count, all of a whole number, and no powers of ten."""
    whole = abs(value) >= 100 or (value == int(value) and abs(value) >= 2)
    return f"{value:,.0f}" if whole else f"{value:.3g}"


def table_of(title: str, rows: list[dict], headlines: dict[str, tuple[str, ...]] | None = None) -> Table:
    """Measures as a table for the screen."""
    value_column = Column("value", justify="right")
    table = Table("", "figure", "of", value_column, "unit", title=title, title_justify="left", box=SIMPLE)
    last = ""
    for row in rows:
        if headlines is not None:
            known = row["figure"].startswith(headlines.get(row["topic"], ()))
            if not known or row["value"] is None or ", of " in row["of"]:
                continue
        if row["topic"] != last and last:
            table.add_section()
        value = row["value"]
        number = "" if value is None else _plain(value)
        unit = "" if row["unit"] == "1" else row["unit"]
        table.add_row(row["topic"] if row["topic"] != last else "", row["figure"], row["of"], number, unit)
        last = row["topic"]
    return table
