"""The results of an experiment as Markdown: the tables of `cosim/PAPER.md`."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.addons.paper.published import METHODS
from results.manifest import read_manifest
from results.metrics.kitti import LEVELS

Row = dict[Any, Any]

POINTS = {"average precision": "11 recall points", "average precision, 40 points": "40 recall points"}
BETWEEN = "average precision, minus the method before it"


def markdown(rows: pd.DataFrame, name: str, runs: Sequence[Path]) -> str:
    """The page of an experiment.

    Parameters
    ----------
    rows
        Rows of `experiments.Outcome`.
    name
        Name of the experiment in `cosim reproduce`.
    runs
        Folders of its runs. Their manifests say which code made them.
    """
    lines = [f"`cosim reproduce {name}` wrote these tables. {_made_by(runs)}", "", _intervals(rows), ""]
    for what, points in POINTS.items():
        for label in dict.fromkeys(rows[rows.what == what]["class"]):
            lines += [*_precision(rows[(rows.what == what) & (rows["class"] == label)], label, points), ""]
    between = rows[rows.what == BETWEEN]
    if len(between):
        lines += [*_between(between), ""]
    others = rows[~rows.what.isin([*POINTS, BETWEEN])]
    return "\n".join([*lines, *_others(others)]) + "\n"


def _made_by(runs: Sequence[Path]) -> str:
    sources = [read_manifest(run).get("source", {}) for run in runs]
    made = sorted({str(source.get("commit", source.get("code", "an unknown version"))) for source in sources})
    return f"They rest on {len(runs)} runs of commit {', '.join(f'`{commit[:12]}`' for commit in made)}."


def _intervals(rows: pd.DataFrame) -> str:
    drives = sorted({int(n) for n in rows[rows.what == "average precision"].n})
    each = f"{drives[0]}" if len(drives) == 1 else f"{drives[0]} to {drives[-1]}"
    return (
        f"Every figure is the mean over {each} drives per city. The number after &plusmn; is half of its 95 %\n"
        "interval over drives. Changes are paired, drive by drive, and stand in brackets."
    )


def _precision(rows: pd.DataFrame, label: str, points: str) -> Iterator[str]:
    """Average precision by method and source, a column per level."""
    yield f"| {label}, {points} | | {' | '.join(LEVELS)} |"
    yield f"|---|---|{'---|' * len(LEVELS)}"
    for setting, method in dict.fromkeys(zip(rows.setting, rows.method, strict=True)):
        mine = rows[(rows.setting == setting) & (rows.method == method)]
        said = METHODS[method] + ("" if setting == "trustworthy" else f", {setting}")
        if mine.paper.notna().any():
            yield _line(said, "paper", {row["level"]: f"{row['paper']:.1f}" for row in mine.to_dict("records")})
            said = ""
        lines: dict[tuple[str, str], str] = {}
        for city, self_reports in dict.fromkeys(zip(mine.city, mine.self_reports, strict=True)):
            some = mine[(mine.city == city) & (mine.self_reports == self_reports)].to_dict("records")
            cells = {row["level"]: _with_change(row) for row in some}
            source = city + ("" if self_reports else ", no self-reports")
            lines.setdefault((city, str(cells)), _line(said, source, cells))
            said = ""
        yield from lines.values()  # the ego alone has the same figures without self-reports


def _between(rows: pd.DataFrame) -> Iterator[str]:
    """Paired differences between methods, for the paper's order."""
    yield f"| 11 recall points, paired difference | | | {' | '.join(LEVELS)} |"
    yield f"|---|---|---|{'---|' * len(LEVELS)}"
    key = ["method", "class", "city", "self_reports"]
    for (method, label, city, self_reports), some in rows.groupby(key, sort=False):
        before = METHODS[before_of(str(method))]
        source = f"{city}" + ("" if self_reports else ", no self-reports")
        cells = {row["level"]: _signed(row["mean"], row["low"], row["high"]) for row in some.to_dict("records")}
        yield _line(f"{METHODS[str(method)]} minus {before} | {label}", source, cells)


def before_of(method: str) -> str:
    """The method that comes before this one in the paper's tables."""
    names = list(METHODS)
    return names[names.index(method) - 1]


def _others(rows: pd.DataFrame) -> Iterator[str]:
    """Trust, encounters, time to detection."""
    yield "| what | setting | city | method | paper | here |"
    yield "|---|---|---|---|---|---|"
    for row in rows.to_dict("records"):
        paper = "" if pd.isna(row["paper"]) else f"{row['paper']:g}"
        method = METHODS[row["method"]] + ("" if row["self_reports"] else ", no self-reports")
        unit = "" if row["unit"] in ("", "1") else f" {row['unit']}"
        here = f"{row['mean']:.2f}{_half(row['low'], row['high'], '.2f')}{unit}"
        yield f"| {row['what']} | {row['setting']} | {row['city']} | {method} | {paper} | {here} |"


def _line(first: str, source: str, cells: dict[str, str]) -> str:
    return f"| {first} | {source} | {' | '.join(cells.get(level, '-') for level in LEVELS)} |"


def _with_change(row: Row) -> str:
    said = f"{row['mean']:.1f}"
    if pd.isna(row["change"]) or (row["change"], row["change_high"]) == (0, 0):
        return said + _half(row["low"], row["high"])
    return f"{said} ({_signed(row['change'], row['change_low'], row['change_high'])})"


def _signed(mean: float, low: float, high: float) -> str:
    return f"{mean:+.1f}{_half(low, high)}"


def _half(low: float, high: float, form: str = ".1f") -> str:
    return "" if pd.isna(high) else f" ±{(high - low) / 2:{form}}"
