"""The report of a study as one HTML page: what was asked, figures, table of means, paired differences, points."""

from html import escape
from pathlib import Path

import pandas as pd

from cosim.base import durable
from results.figures import study as figure
from results.report import STYLE, image_url
from results.study import StudyResults, with_short_names

_MOST_ROWS = 400


def write(study: StudyResults, path: str | Path | None = None) -> Path:
    """Write the page; it needs no network and no other file. Left out, `path` is report.html in the study's folder."""
    path = study.path / "report.html" if path is None else Path(path)
    durable.write_output(path, page(study).encode())
    return path


def page(study: StudyResults) -> str:
    """The page as HTML."""
    states = ", ".join(f"{n} {state}" for state, n in study.points.state.value_counts().items())
    parts = [
        f"<h1>{escape(study.name)}</h1>",
        f"<p>{escape(study.question)}</p>",
        f'<p class="soft">{len(study.points)} points ({states}) of {study.points["run"].nunique()} runs; '
        f"swept: {escape(', '.join(study.keys))}; {study.points.replicate.nunique()} replicates.</p>",
        '<h2 id="figures">Figures</h2>',
        '<div class="figures">',
        *(_figure(study, topic) for topic in figure.SHOWN if _measured(study, topic)),
        "</div>",
        '<h2 id="numbers">Means over replicates</h2>',
        "<p>With 95 % intervals: Student's t, in the logit or logarithm of quantities with bounds.</p>",
        _table(study, study.summary),
    ]
    if study.baseline:
        said = ", ".join(f"{key} = {value}" for key, value in study.baseline.items())
        parts += [
            '<h2 id="differences">Paired differences</h2>',
            f"<p>Against {escape(said)}, replicate by replicate, with the same intervals.</p>",
            _table(study, study.differences),
        ]
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(study.name)}</title>'
        f"<style>{STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def _measured(study: StudyResults, topic: str) -> bool:
    return bool(figure.shown(study, topic))


def _figure(study: StudyResults, topic: str) -> str:
    try:
        drawn = figure.draw(study, topic)
    except ValueError as reason:
        return f'<h3>{escape(topic)}</h3><p class="missing">{escape(str(reason))}</p>'
    url = image_url(drawn)
    return f'<figure><h3>{escape(topic)}</h3><img src="{url}" alt="{escape(topic)} by swept key"></figure>'


def _table(study: StudyResults, frame: pd.DataFrame) -> str:
    shown = with_short_names(frame.head(_MOST_ROWS), study.keys)
    names = [*study.keys, "metric", "group", "n", "mean", "low", "high", "unit", "note"]
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    rows = "".join(
        "<tr>" + "".join(_cell(value) for value in row) + "</tr>" for row in shown[names].itertuples(index=False)
    )
    more = len(frame) - len(shown)
    note = f'<p class="soft">{more} more rows in summary.csv.</p>' if more > 0 else ""
    return f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>{note}'


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f'<td class="number">{"" if value != value else f"{value:.4g}"}</td>'
    return f"<td>{escape(str(value))}</td>"
