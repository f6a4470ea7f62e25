"""The report of a study as one HTML page: the answer in sentences, core figures, core table; the rest folded."""

import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cosim.base import durable
from cosim.base.addons import Choices
from results.figures import study as figure
from results.figures import study_curves as curves
from results.figures import style
from results.report import STYLE, image_url
from results.study import (
    StudyResults,
    apart,
    chosen,
    distinct,
    for_axes,
    short_keys,
    short_names,
    that_matter,
    with_short_names,
)
from results.study_notes import counted
from results.study_table import cautions, core, pivot, together, unpaired

CITY = "traffic.scenario"
_MOST_ROWS = 400
_MOST_SETS = 36
"""Figures of one title, one for each combination of values of the keys that its axes do not show."""

_SCRIPT = """
for (const figure of document.querySelectorAll("figure")) {
  const boxes = [...figure.querySelectorAll("select")];
  const choose = () => {
    const at = boxes.map(box => box.value).join(" ");
    for (const one of figure.querySelectorAll("[data-at]")) one.hidden = one.dataset.at !== at;
  };
  for (const box of boxes) {
    box.addEventListener("change", choose);
    box.parentElement.hidden = false;
  }
  if (boxes.length) choose();
}
"""
"""Shows the figure that the select boxes name. Without scripts, all are shown."""

Draw = Callable[[Mapping[str, str]], Any]
"""Draws a figure at these values of swept keys."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What a study says of one quantity, as a sentence."""

    subject: str
    """The whole sentence without its full stop, or the beginning that its parts go on from."""
    parts: tuple[str, ...] = ()
    """What is said along each swept key."""
    note: str = ""
    city: str = ""
    """The city of which it speaks, where several are swept."""

    def __str__(self) -> str:
        said = f"{self.subject} {'; '.join(self.parts)}".strip()
        note = f" ({self.note})" if self.note else ""
        place = f"{self.city}: " if self.city else ""
        return f"{place}{said}{note}."


def answers(study: StudyResults) -> list[Answer]:
    """What add-ons say of the study."""
    speakers = Choices[Callable[[StudyResults], list[Answer]]]("answer", {}).values()
    return [answer for speaker in speakers for answer in speaker(study)]


def write(study: StudyResults, path: str | Path | None = None, part: str = "") -> Path:
    """Write the page; it needs no network and no other file. Left out, `path` is report.html in the study's folder.

    `part` says in the heading which part of the study it is, such as `fleet.penetration_p=0.1`.
    """
    path = study.path / "report.html" if path is None else Path(path)
    durable.write_output(path, page(study, part).encode())
    return path


def page(study: StudyResults, part: str = "") -> str:
    """The page as HTML."""
    n_points = study.points.state.value_counts()
    states = ", ".join(f"{n} {state}" for state, n in n_points.items())
    replicates = counted(study.points.replicate.nunique(), "replicate")
    points = counted(len(study.points), "point")
    runs = counted(len(set(study.points["run"]) - {""}), "run")
    swept = f" swept: {escape(', '.join(study.keys))};" if study.keys else ""
    parts = [
        f"<h1>{escape(f'{study.name}, {part}' if part else study.name)}</h1>",
        f"<p>{escape(study.question)}</p>",
        *_answers(study),
        f'<p class="soft">{points} ({states}) of {runs};{swept} {replicates}. '
        "Intervals are 95 % intervals of the mean over replicates (Student's t; results/TABLES.md has the "
        "formula). Each holds by itself: of 20 differences that are none, about one excludes 0 by chance.</p>",
        '<h2 id="figures">Figures</h2>',
        '<p class="soft">A band spans the curves of the single replicates, as far as they reach. An arrow '
        "marks an interval that leaves the panel. A key that is not shown changes nothing here.</p>",
        '<div class="figures">',
        *(_figures(study, one.title, one.others, one.draw) for one in _core_figures(study)),
        "</div>",
        '<h2 id="numbers">Core metrics</h2>',
        _pivot(study, study.summary),
        *(f"<p class='soft'>{escape(line)}</p>" for line in together(study)),
    ]
    has_differences = bool(study.baseline) and len(study.differences) > 0
    if has_differences:
        against = ", ".join(f"{key} = {value}" for key, value in study.baseline.items())
        parts += [
            f"<details><summary>Paired differences to {escape(against)}</summary>",
            "<p>Replicate by replicate, with the same intervals.</p>",
            _pivot(study, study.differences),
            "</details>",
        ]
    parts += [f"<p class='soft'>{escape(line)}</p>" for line in unpaired(study, core(study))]
    if others := [topic for topic in figure.SHOWN if _more(study, topic)]:
        parts += [
            "<details><summary>More figures</summary><div class='figures'>",
            *(_figures(study, topic, *_of_metrics(study, _more(study, topic))) for topic in others),
            "</div></details>",
        ]
    parts += ["<details><summary>All means</summary>", _table(study, study.summary, "summary"), "</details>"]
    if has_differences:
        parts += [
            "<details><summary>All paired differences</summary>",
            _table(study, study.differences, "differences"),
            "</details>",
        ]
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(study.name)}</title>"
        f"<style>{STYLE}</style></head><body>\n{body}\n<script>{_SCRIPT}</script></body></html>\n"
    )


def _answers(study: StudyResults) -> list[str]:
    """What is said of each city, or of the study, as a list of sentences."""
    parts = []
    for city, said in itertools.groupby(answers(study), lambda answer: answer.city):
        head = f"<h3>{escape(city)}</h3>" if city else ""
        parts.append(f"{head}<ul class='answer'>{''.join(map(_sentence, said))}</ul>")
    return parts


def _sentence(answer: Answer) -> str:
    note = ""
    if answer.note:
        said = answer.note[:1].upper() + answer.note[1:]
        note = f"<div class='soft'>{escape(said)}.</div>"
    if len(answer.parts) > 1:
        parts = "".join(f"<li>{escape(part)}</li>" for part in answer.parts)
        return f"<li>{escape(answer.subject)}<ul>{parts}</ul>{note}</li>"
    said = " ".join([answer.subject, *answer.parts])
    return f"<li>{escape(said)}.{note}</li>"


@dataclass(frozen=True, slots=True)
class _CoreFigure:
    """A figure of the page, or one for each combination of values of some keys."""

    name: str
    title: str
    others: Sequence[str]
    """Keys that its axes do not show."""
    draw: Draw


def _core_figures(study: StudyResults) -> list[_CoreFigure]:
    """The two distributions, and a figure for each core metric; roles of one metric share a figure."""
    found = []
    for what, name, title in (
        (curves.ENCOUNTERS, "durations", "How long encounters last"),
        (curves.AGES, "ages", "How old trust is"),
    ):
        frame = study.curves[study.curves.what == what]
        if np.isfinite(frame.value_s.astype(float)).any():
            others = _beside_axes(curves.keys_of(study, what), 2)
            if frame.group.nunique() > 1:
                others = ["group", *others]
            found.append(_CoreFigure(name, title, others, _drawn_curves(study, what)))
    by_metric: dict[str, list[str]] = {}
    for name in core(study, whole=False):
        by_metric.setdefault(name.partition(":")[0], []).append(name)
    for metric, names in by_metric.items():
        found.append(_CoreFigure(metric, _label(study, names[0]), *_of_metrics(study, names)))
    return found


def save_figures(study: StudyResults, folder: Path) -> list[Path]:
    """Write the core figures of the page as PDF files, named by what they show and by the values of keys at which."""
    written = []
    names = short_keys(["group", *study.keys])
    for one in _core_figures(study):
        values = [_values(study, key) for key in one.others]
        for at in itertools.islice(itertools.product(*values), _MOST_SETS):
            where = dict(zip(one.others, at, strict=True))
            words = [f"{names[key]}={value}" for key, value in where.items()]
            stem = re.sub(r"[^\w.=-]+", "_", "-".join([one.name, *words]))
            try:
                drawn = one.draw(where)
            except ValueError:  # the page says why there is none
                continue
            written.append(style.save(drawn, folder / f"{stem}.pdf"))
    return written


def _drawn_curves(study: StudyResults, what: str) -> Draw:
    return lambda where: curves.draw(study, what, where=where)


def _of_metrics(study: StudyResults, names: Sequence[str]) -> tuple[list[str], Draw]:
    """The keys beyond those on the axes of a figure of these metrics, and what draws it at values of them."""
    matter = for_axes(study.points, that_matter(chosen(study.measures, names), study.keys))
    n_values = [study.points[key].nunique() for key in _axes(matter)]
    shown = 3 if max(n_values[2:3], default=1) <= figure.MOST_PANELS else 2

    def draw(where: Mapping[str, str]) -> Any:
        return figure.draw(study, "", _there(study, names, where), where=where, lean=True)

    return _beside_axes(matter, shown), draw


def _axes(matter: Sequence[str]) -> list[str]:
    """Keys for the axes of a figure, of those that change it. Each city has figures of its own, if other keys do."""
    return [key for key in matter if key != CITY] or list(matter)


def _beside_axes(matter: Sequence[str], shown: int) -> list[str]:
    """Of the keys that change a figure, those that its axes do not show."""
    on_axes = _axes(matter)[:shown]
    return [key for key in matter if key not in on_axes]


def _there(study: StudyResults, names: Sequence[str], where: Mapping[str, str]) -> list[str]:
    """Those of some metrics that have a value at these values of keys."""
    frame = figure.held(study, study.summary, study.keys, where)
    there = {name: chosen(study.summary, [name]).index for name in names}
    found = [name for name, rows in there.items() if rows.isin(frame.index).any()]
    if not found:
        raise ValueError("no value here")
    return found


def _more(study: StudyResults, topic: str) -> list[str]:
    """Metrics of a topic that no core figure shows; encounters of several definitions are shown once more, together."""
    there, found = core(study), []
    for name in figure.shown(study, topic):
        same = [one for one in there if one == name or one.startswith(f"{name}:")]
        found += [name] if len(same) != 1 else []
    return found


def _label(study: StudyResults, name: str) -> str:
    return str(chosen(study.summary, [name]).label.iloc[0])


def _figures(study: StudyResults, title: str, others: Sequence[str], draw: Draw) -> str:
    """A figure, or one for each combination of values of the other keys, with a select box for each of these."""
    if not others:
        return f"<figure><h3>{escape(title)}</h3>{_image(draw, {}, title)}</figure>"
    values = [_values(study, key) for key in others]
    all_sets = list(itertools.product(*map(range, map(len, values))))
    shown = all_sets[:_MOST_SETS]
    labels = {key: figure.label_of(key, study.keys) for key in others}
    boxes = "".join(map(_box, labels.values(), values))
    images = ""
    for at in shown:
        shown_values = map(getitem, values, at)
        where = dict(zip(others, shown_values, strict=True))
        images += _at_values(title, " ".join(map(str, at)), where, labels, draw)
    rest = len(all_sets) - len(shown)
    note = f"<p class='soft'>{rest} more combinations: `cosim plot` with --where draws them.</p>" if rest else ""
    return f"<figure><h3>{escape(title)}</h3><p>{boxes}</p>{images}{note}</figure>"


def _at_values(
    title: str,
    numbers: str,
    where: Mapping[str, str],
    labels: Mapping[str, str],
    draw: Draw,
) -> str:
    """The figure at one value of each of these keys, with the numbers of the values in their select boxes."""
    words = [f"{name} = {where[key]}" for key, name in labels.items()]
    name = ", ".join(words)
    image = _image(draw, where, f"{title}, {name}")
    return f"<div data-at='{numbers}'><p class='soft'>{escape(name)}</p>{image}</div>"


def _box(name: str, values: Sequence[str]) -> str:
    options = "".join(map(_option, range(len(values)), values))
    return f"<label hidden>{escape(name)} <select>{options}</select> </label>"


def _option(number: int, value: str) -> str:
    return f"<option value='{number}'>{escape(value)}</option>"


def _values(study: StudyResults, key: str) -> list[str]:
    """Values of a swept key by their short names; of `group`, the definitions of an encounter."""
    if key == "group":
        return list(dict.fromkeys(study.curves.group[study.curves.what == curves.ENCOUNTERS]))
    short = short_names(study.points[key])
    return [short[value] for value in distinct(study.points[key])]


def _image(draw: Draw, where: Mapping[str, str], alt: str) -> str:
    try:
        return f'<img src="{image_url(draw(where))}" alt="{escape(alt, quote=True)}">'
    except ValueError as reason:
        return f'<p class="missing">{escape(str(reason))}</p>'


def _pivot(study: StudyResults, frame: pd.DataFrame) -> str:
    """The core metrics by the first swept key that varies."""
    there = set(zip(frame.metric, frame.group, strict=True))
    names = [name for name in core(study) if name.partition(":")[::2] in there]
    found = pivot(study, frame, names)
    over = (apart(frame, study.keys) or [study.keys[0]])[0]
    labels = {key: figure.label_of(key, study.keys) for key in study.keys}
    heads = [labels.get(str(name), str(name)) for name in found]
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    rows = "".join(map(_row, found.to_numpy(object)))
    few = "".join(f"<p class='soft'>{escape(line)}</p>" for line in cautions(study, frame, names))
    return (
        f"<p class='soft'>Columns: {escape(labels[over])}. Mean and 95 % interval.</p>"
        f'<div class="wide"><table class="pivot"><tr>{head}</tr>{rows}</table></div>{few}'
    )


def _table(study: StudyResults, frame: pd.DataFrame, name: str) -> str:
    """The first rows of a table of the study, which is the CSV file of this name, too."""
    shown = with_short_names(frame.head(_MOST_ROWS), study.keys)
    keys = apart(frame, study.keys)
    names = [*keys, "mean", "low", "high", "unit", "metric", "group", "n", "note"]
    constant = [name for name in names if frame[name].nunique(dropna=False) < 2]
    names = [name for name in names if name in keys or name not in constant]
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    rows = "".join(map(_row, shown[names].to_numpy(object)))
    more = len(frame) - len(shown)
    note = f'<p class="soft">{more} more rows: `cosim measure` writes {name}.csv.</p>' if more > 0 else ""
    return f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>{note}'


def _row(values: Iterable[Any]) -> str:
    return f"<tr>{''.join(map(_cell, values))}</tr>"


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f'<td class="number">{"" if value != value else f"{value:.4g}"}</td>'
    return f"<td>{escape(str(value))}</td>"
