"""The report of a run as one HTML page: figures, metrics, dictionary, provenance."""

import json
import math
import re
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.base import durable
from results.columns import Column
from results.figures import style
from results.figures.catalogue import FIGURES
from results.measure import measure
from results.metrics.registry import METRICS, TOPICS
from results.run import Run
from results.tables import SCHEMA_VERSION, TABLES

STYLE = """
:root { --ink: #1b2433; --soft: #5c6675; --line: #dfe3e8; --accent: #16325c; --tint: #f5f7fa; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: var(--ink); margin: 0 auto;
       max-width: 1060px; padding: 24px 28px 80px; }
h1 { font-size: 26px; margin: 8px 0 0; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 40px 0 10px; padding-bottom: 4px; border-bottom: 2px solid var(--accent); }
h3 { font-size: 15px; margin: 22px 0 6px; }
p { margin: 6px 0; } .soft { color: var(--soft); }
nav a { color: var(--accent); margin-right: 18px; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(112px, 1fr)); gap: 8px; margin: 14px 0; }
.facts div { background: var(--tint); border-left: 3px solid var(--accent); padding: 6px 9px; line-height: 1.3; }
.facts b { display: block; font-size: 19px; } .facts span { color: var(--soft); font-size: 13px; }
.figures { columns: 440px 2; column-gap: 36px; } figure { margin: 0; padding: 12px 0; break-inside: avoid; }
figure img { width: 100%; max-width: 640px; height: auto; display: block; }
figcaption { color: var(--soft); font-size: 13.5px; max-width: 76ch; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; }
th, td { text-align: left; padding: 3px 10px 3px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; } td.number { text-align: right; font-variant-numeric: tabular-nums; }
th.number { text-align: right; } .wide { overflow-x: auto; }
.numbers { table-layout: fixed; overflow-wrap: anywhere; } .numbers th:nth-child(1) { width: 21%; }
.numbers th:nth-child(2) { width: 27%; } .numbers th:nth-child(3) { width: 15%; }
.numbers th:nth-child(4) { width: 9%; } .numbers th:nth-child(5) { width: 14%; }
.numbers td { border-top: 1px solid var(--line); border-bottom: 0; }
.numbers .more td { border-top: 0; padding-top: 0; }
.answer { margin: 14px 0; padding: 10px 14px 10px 30px; background: var(--tint); border-left: 3px solid var(--accent); }
.answer li { margin: 4px 0; } select { font: inherit; max-width: 100%; margin: 2px 0 6px; }
.pivot td { white-space: nowrap; } .pivot td:first-child { white-space: normal; min-width: 15ch; }
details { margin: 8px 0; } summary { cursor: pointer; font-weight: 600; }
pre { background: var(--tint); padding: 12px; overflow-x: auto; font-size: 12.5px; }
code { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: 0.93em; }
.missing { color: var(--soft); background: var(--tint); padding: 8px 12px; }
.first { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 320px), 1fr)); gap: 8px 36px; }
.first img { max-width: 420px; } .first figcaption { font-size: 12.5px; }
.section { border-top: 2px solid var(--accent); margin: 14px 0 0; padding-top: 6px; }
.section > summary { font-size: 17px; font-weight: 400; }
@media (max-width: 600px) {
  body { padding: 12px 14px 60px; } h1 { font-size: 21px; } nav a { margin-right: 10px; }
  .facts { grid-template-columns: repeat(2, 1fr); gap: 6px; } .facts b { font-size: 16px; }
  .facts div { padding: 5px 8px; } .facts span { font-size: 12px; }
  .numbers, .numbers tbody { display: block; } .numbers tr:first-child, .numbers td:nth-child(2) { display: none; }
  .numbers tr { display: grid; grid-template-columns: 1fr auto; gap: 0 10px; border-top: 1px solid var(--line); }
  .numbers tr.more { border-top: 0; } .numbers td { border: 0; padding: 1px 0; } .numbers td:empty { display: none; }
  .numbers td:nth-child(1), .numbers td:nth-child(6) { grid-column: 1 / -1; }
  .numbers td:nth-child(3) { color: var(--soft); }
  .numbers td.number { grid-column: 2; white-space: nowrap; }
}
@media print { nav { display: none; } figure, tr { break-inside: avoid; } }
"""


FIRST = ("trust", "encounters")
"""Figures on the first screen."""

DENSE = 20_000
"""Points of one panel above which its lines and marks become a bitmap; axes and text stay vector graphics."""


def write(run: Run, path: str | Path | None = None) -> Path:
    """Write the page; it needs no network and no other file. Left out, `path` is report.html in the run folder."""
    path = run.path / "report.html" if path is None else Path(path)
    durable.write_output(path, page(run).encode())
    return path


def page(run: Run) -> str:
    """The page as HTML."""
    numbers = measure(run)
    first = [name for name in FIRST if name in FIGURES]
    rest = [name for name in FIGURES if name not in first]
    parts = [
        f"<h1>{escape(run.name)}</h1>",
        f'<p class="soft">{escape(_span(run))}</p>',
        "<nav>" + "".join(f'<a href="#{name.lower()}">{name}</a>' for name in _SECTIONS) + "</nav>",
        _facts(numbers),
        f'<div class="first">{"".join(_figure(name, run) for name in first)}</div>',
        _folded(
            "Figures", f"{len(rest)} more", f'<div class="figures">{"".join(_figure(name, run) for name in rest)}</div>'
        ),
        _folded(
            "Numbers",
            f"{len(numbers)} values of {len(TOPICS)} topics",
            "".join(_topic(topic, numbers) for topic in TOPICS),
        ),
        _folded("Tables", f"{len(run.tables)} in this run", _dictionary(run)),
        _folded("Provenance", "versions, sources, the complete config", _provenance(run)),
    ]
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(run.name)}</title><style>{STYLE}</style></head>\n<body>\n{body}\n"
        f"<script>{_SCRIPT}</script></body></html>\n"
    )


def _folded(title: str, about: str, content: str) -> str:
    """A section of the page that is closed at first."""
    head = f'<b>{escape(title)}</b> <span class="soft">{escape(about)}</span>'
    return f'<details class="section" id="{title.lower()}"><summary>{head}</summary>{content}</details>'


_SCRIPT = """
const open = () => { const at = document.querySelector(location.hash || "#none"); if (at) at.open = true; };
addEventListener("hashchange", open);
open();
for (const link of document.querySelectorAll("nav a")) link.addEventListener("click", () => setTimeout(open));
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((one) => { one.open = true; }));
"""
"""Opens the section that a link names, and all for print. Without scripts a reader opens them."""

_SECTIONS = ("Figures", "Numbers", "Tables", "Provenance")


def _span(run: Run) -> str:
    net = run.manifest.get("net", {}).get("name", "a network")
    seed = run.manifest.get("seed", "unknown")
    steps, dt_s = run.manifest["steps"], run.dt_s
    time = f"{steps * dt_s:g} s in {steps} steps of {dt_s:g} s"
    return f"Co-simulation of {net}: {time}, seed {seed}."


def _facts(numbers: pd.DataFrame) -> str:
    """The few numbers to read first."""
    wanted = [
        ("traffic.actors.mean", "all", "actors on the road, mean"),
        ("traffic.actors.mean", "equipped", "equipped vehicles among them"),
        ("encounters.duration.km_median_s", None, "median encounter (Kaplan-Meier)"),
        ("trust.final.median", "honest", "final trust, honest"),
        ("trust.final.median", "malicious", "final trust, malicious"),
        ("misbehaviour.at_lookup.auc", "malicious", "AUC at lookup, honest against malicious"),
        ("radio.pdr.all", None, "packet delivery ratio"),
        ("freshness.newest_evaluation_age.mean_s", "all", "age of the newest evaluation at lookup, mean"),
    ]
    boxes = []
    for metric, group, text in wanted:
        is_group = (numbers.group == group) | (group is None)
        rows = numbers[is_group & (numbers.metric == metric)]
        if len(rows) and rows.value.notna().iloc[0]:
            row = rows.iloc[0]
            where = f" ({row.group})" if group is None and row.group else ""
            where += f", {row.note}" if row.note else ""
            where += ", may be chance" if metric.endswith("auc") and row.low <= 0.5 <= row.high else ""
            value = _number(row.value, row.unit)
            boxes.append(f"<div><b>{value}</b><span>{escape(text + where)}</span></div>")
    return f'<div class="facts">{"".join(boxes)}</div>'


def _figure(name: str, run: Run) -> str:
    try:
        picture = image_url(FIGURES[name]([run]))
    except ValueError as reason:
        return f'<p class="missing">No figure of {name}: {escape(str(reason))}</p>'
    caption = " ".join((FIGURES[name].__doc__ or "").split("\n\n")[0].split())
    alt = escape(f"Figure of {name}")
    return f'<figure><img alt="{alt}" src="{picture}"><figcaption>{_code(caption)}</figcaption></figure>'


def image_url(figure: Any) -> str:
    """A figure as an SVG image inside the page. Dense panels hold a bitmap, so that the page stays small."""
    for axes in figure.axes:
        artists = *axes.lines, *axes.collections, *axes.patches
        drawn = [artist for artist in artists if not artist.get_rasterized()]
        if sum(map(_n_points, drawn)) > DENSE:
            for artist in drawn:
                artist.set_rasterized(True)
    return style.data_url(figure)


def _n_points(artist: Any) -> int:
    """Points of a line, a collection or a patch."""
    if hasattr(artist, "get_xdata"):
        return len(artist.get_xdata())
    if hasattr(artist, "get_paths"):
        n_vertices = sum(len(path.vertices) for path in artist.get_paths())
        return max(len(artist.get_offsets()), n_vertices)
    return len(artist.get_path().vertices)


def _topic(topic: str, numbers: pd.DataFrame) -> str:
    frame = numbers[numbers.metric.str.startswith(topic + ".")]
    is_lost = frame.metric == f"{topic}.not_measured"
    head = f"<h3>{escape(topic)}</h3><p class='soft'>{_code(TOPICS[topic])}</p>"
    gap = "".join(f'<p class="missing">Not measured: {escape(reason)}</p>' for reason in frame.group[is_lost])
    frame = frame[~is_lost]
    if frame.empty:
        return head + gap
    is_first = frame.metric != frame.metric.shift()
    rows = "".join(map(_row, frame.itertuples(index=False), is_first))
    names = (
        '<tr><th>metric</th><th>identifier</th><th>group</th><th class="number">value</th>'
        '<th class="number">95 % interval</th><th>note</th></tr>'
    )
    return f"{head}<table class='numbers'>{names}{rows}</table>{gap}"


def _row(row: Any, is_first: bool) -> str:
    """A value of a metric; the first one has the metric's name."""
    metric = METRICS[row.metric]
    label = escape(metric.label) if is_first else ""
    identifier = f"<code>{row.metric}</code>" if is_first else ""
    more = "" if is_first else " class=more"
    return (
        f"<tr{more}><td title='{escape(metric.definition)}'>{label}</td>"
        f'<td>{identifier}</td><td>{escape(row.group)}</td><td class="number">{_number(row.value, row.unit)}</td>'
        f'<td class="number soft">{_interval(row.low, row.high)}</td><td class="soft">{escape(row.note)}</td></tr>'
    )


def _dictionary(run: Run) -> str:
    parts = []
    for name, table in TABLES.items():
        rows = ""
        for label, column in table.columns.items():
            is_key = "key" if column.key else ""
            may_be = " May be null." if column.null else ""
            meaning = _code(column.meaning + may_be + _virtual(column))
            rows += (
                f"<tr><td><code>{escape(label)}</code></td><td>{column.type}</td>"
                f"<td>{escape(column.unit)}</td><td>{is_key}</td><td>{meaning}</td></tr>"
            )
        here = "" if name in run.tables else f" (not in this run: kept from record level {table.level} up)"
        parts.append(
            f"<details><summary>{name}{here}</summary><p>{_code(table.meaning)}</p><div class='wide'><table>"
            "<tr><th>column</th><th>type</th><th>unit</th><th>key</th><th>meaning</th></tr>"
            f"{rows}</table></div></details>"
        )
    return "".join(parts)


def _virtual(column: Column) -> str:
    return f" That of the row of `detections` named by `{column.via}`." if column.via else ""


def _provenance(run: Run) -> str:
    manifest = {**run.manifest, "folder": str(run.path), "schema_version": SCHEMA_VERSION}
    names = ("folder", "status", "seed", "schema_version", "net", "versions", "source", "timings_s", "summary")
    rows = ""
    for name in names:
        if name in manifest:
            rows += f"<tr><td>{name}</td><td>{_value(manifest[name])}</td></tr>"
    config = escape(json.dumps(run.config, indent=2, ensure_ascii=False))
    return f"<table>{rows}</table><details open><summary>Resolved configuration</summary><pre>{config}</pre></details>"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        lines = [f"{escape(name)}: {_value(item)}" for name, item in value.items()]
        return "<br>".join(lines) or "none"
    return escape(f"{value:g}" if isinstance(value, float) else str(value))


def _number(value: float, unit: str) -> str:
    if pd.isna(value):
        return "-"
    is_whole = float(value).is_integer() and abs(value) < 1e15
    text = f"{value:,.0f}" if is_whole else f"{value:.3g}"
    return text if unit in ("", "1") else f"{text} {escape(unit)}"


def _interval(low: float, high: float) -> str:
    if pd.isna(low):
        return ""
    until = f"to {_number(high, '1')}" if high < math.inf else "or more"
    return f"{_number(low, '1')} {until}"


def _code(text: str) -> str:
    """Text with `names` set as code."""
    return re.sub("`(.*?)`", r"<code>\1</code>", escape(text), flags=re.DOTALL)
