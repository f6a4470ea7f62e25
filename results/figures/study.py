"""A study's metrics over a swept key: mean over replicates with its 95 % interval."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from results.figures import style
from results.metrics.registry import bounds_of
from results.study import (
    EVERYTHING,
    StudyResults,
    apart,
    are_words,
    at_first,
    chosen,
    distinct,
    for_axes,
    held_at,
    one_group,
    said,
    several_groups,
    short_names,
    that_matter,
    with_short_names,
    within_run,
)

SHOWN: Mapping[str, tuple[str, ...]] = {
    "encounters": ("encounters.duration.km_median_s",),
    "trust": ("trust.final.median:honest", "trust.final.median:malicious"),
    "misbehaviour": (
        "misbehaviour.at_lookup.auc:malicious",
        "misbehaviour.at_lookup.time_to_detection.median_s:malicious",
    ),
    "security": ("misbehaviour.at_lookup.auc:malicious", "security.false_exclusions_per_h"),
    "attacks": ("attack.believed.share:0.5, received, malicious",),
    "freshness": (
        "freshness.newest_evaluation_age.mean_s:all",
        "freshness.value_age.mean_s:all",
        "freshness.lookup_state.share:no value, all",
    ),
    "radio": ("radio.pdr.all",),
    "detection": ("detection.awareness_70m.share:fused",),
    "safety": ("safety.hard_braking.per_km",),
}
"""Metrics that a topic shows unless others are asked for."""

BOUNDS: Mapping[str, str] = {
    "misbehaviour.auc": "evidence.auc_bound",
    "misbehaviour.at_lookup.auc": "evidence.auc_bound",
}
"""The ideal observer that stands beside another metric: the first row of its heat map of trust models."""

INSTEAD: Mapping[str, str] = {
    "misbehaviour.at_lookup.auc:malicious": "misbehaviour.auc:malicious",
    "misbehaviour.at_lookup.time_to_detection.median_s:malicious": "misbehaviour.time_to_detection.median_s:malicious",
    "attack.believed.share:0.5, received, malicious": "attack.believed.share",
}
"""What is shown instead where a study has not measured it: runs kept no lookups, or the attacks have other roles."""

LABELS: Mapping[str, str] = {
    "freshness_s": "window [s]",
    "attacks.share_p": "share of attackers",
    "driver.share_p": "share of such drivers",
    "sensing_groups.share_p": "share of the group",
    "per_100_m": "per 100 m",
    "loss_p": "loss per frame",
    "std_m": "error of own position [m]",
    "scale": "demand",
    "scenario": "city",
    "pairs": "pairs",
}
"""Keys whose last word says too little on an axis, by this word, or by section and word."""

_CHANCE = 0.5
"""AUC of trust that says nothing, drawn as a line."""
MOST_PANELS = 4
"""Panels beside one another."""
_MOST_LETTERS = 32
"""Of the words under the axes beside one another; more of them are slanted."""
_MOST_CELLS = 14
"""Cells of a row that numbers fit into."""


@style.styled
def draw(
    study: StudyResults,
    topic: str,
    metrics: Sequence[str] = (),
    over: str | None = None,
    by: str | None = None,
    where: Mapping[str, Any] | None = None,
    lean: bool = False,
) -> Figure:
    """A row of panels per metric; where two keys are words, as attacks and trust models are, a heat map per metric.

    Parameters
    ----------
    metrics
        Identifiers, `identifier:group` for one group; left out, those of the topic in `SHOWN`. Of a metric without a
        named group, the group `all` is shown, or its only one. Groups of encounters are keys of the figure instead.
    over, by
        Swept keys on the axis and as colour; left out, the first and the second, numbers before words. Of encounters,
        `radius_m` and `pairs` of their definition can be named too. A third key gives a column of panels for each of
        its values.
    where
        Values that other keys are held at.
    lean
        Leave out keys that do not change the metrics. They are always left out where more than three keys vary.
    """
    frame = study.summary
    asked = tuple(metrics) or tuple(shown(study, topic))
    if not asked:
        there = ", ".join(sorted(frame.metric.unique()))
        raise ValueError(f"{study.name} measured nothing that shows {topic}. Name metrics with --metric: {there}.")
    keys = list(study.keys)
    if all(name.startswith("encounters.") for name in asked):
        frame = within_run(chosen(frame, asked))
        keys += ["radius_m", "pairs"]
    else:
        asked = tuple(one_group(frame, name) for name in asked)
    here = held(study, chosen(frame, asked), keys, where or {})
    lacking = []
    for name in asked:
        rows = chosen(frame, [name]).index
        if not rows.isin(here.index).any():
            lacking.append(name)
    if metrics and lacking:
        raise ValueError(f"{study.name} has no value of {lacking[0]} where others have one. Leave it out.")
    asked = tuple(name for name in asked if name not in lacking)
    frame = held(study, frame, keys, where or {})
    study.check_swept(*filter(None, (over, by)), more=keys)
    of_metrics = chosen(frame, asked)
    order = list(dict.fromkeys(filter(None, (over, by))))
    varied = apart(of_metrics, list(dict.fromkeys([*order, *keys])))
    if lean or len(varied) > 3:
        matter = _matter(study, asked, where or {})
        varied = [key for key in varied if key in matter or key not in study.keys]
    order += [key for key in for_axes(of_metrics, varied) if key not in order]
    if not over and by:  # the axis is that of the next key
        order[:2] = order[1::-1]
    free = [key for key in apart(of_metrics, study.keys) if key not in order]
    frame = at_first(frame, free, order)
    frame = with_short_names(frame, keys)
    if len(order) > 3:
        raise ValueError(
            f"{study.name} varies {', '.join(order)}: a figure shows three. Hold others with --where {order[3]}=VALUE, "
            "or see all of them with `cosim report`."
        )
    if not order and of_metrics[list(study.keys)].drop_duplicates().shape[0] > 1:
        order = apart(of_metrics, study.keys)[:1]
    if not order:
        many = len(study.points[list(study.keys)].drop_duplicates()) > 1
        why = "one combination of its keys alone has a value" if many else "it has one combination of keys"
        raise ValueError(f"{study.name} has no two points to draw: {why}. Sweep more values, or run longer.")
    for name in asked:
        of_metric = chosen(frame, [name])
        if of_metric.duplicated(order).any():
            raise ValueError(several_groups(name, of_metric.group.unique()))
    x, colour, column = [*order, "", ""][:3]
    at = _held_at(study, asked, where or {})
    if not at and "radius_m" in keys:
        at = _of_one_definition(study, of_metrics)
    if colour and not column and are_words(frame[x]) and are_words(frame[colour]):
        return _heat_maps(frame, asked, x, colour, at)
    columns = distinct(frame[column]) if column else [None]
    if len(columns) > MOST_PANELS:
        raise ValueError(f"{column} has {len(columns)} values: too many panels. Choose with --over, --by and --where.")
    return _draw(frame, asked, x, colour, column, columns, at)


def _held_at(study: StudyResults, asked: Sequence[str], where: Mapping[str, Any]) -> list[Line2D]:
    """An entry of the legend: the values at which keys are held, of those that change these metrics, and the values at
    which alone these have any."""
    matter = _matter(study, asked, {}) if where else []
    texts = []
    for key, value in where.items():
        if key in matter:
            texts.append(f"{label_of(key, study.keys)} = {value}")
    there = with_short_names(chosen(study.summary, asked), study.keys)
    for key in apart(study.points, study.keys):
        if key not in where and there[key].nunique() == 1:
            value = said(there[key].iloc[0])
            texts.append(f"{label_of(key, study.keys)} = {value} alone")
    return [style.held_entry(", ".join(texts))] if texts else []


def _of_one_definition(study: StudyResults, of_metrics: pd.DataFrame) -> list[Line2D]:
    """An entry of the legend: the definition of an encounter that alone has values, where the study has several."""
    groups = of_metrics.group.unique()
    is_of_encounters = study.measures.metric.str.startswith("encounters.")
    if len(groups) != 1 or study.measures.group[is_of_encounters].nunique() < 2:
        return []
    return [style.held_entry(str(groups[0]))]


def held(
    study: StudyResults,
    frame: pd.DataFrame,
    keys: Sequence[str],
    where: Mapping[str, Any],
) -> pd.DataFrame:
    """Rows at which swept keys have these values; ValueError if there are none, with the values that there are."""
    study.check_swept(*where, more=keys)
    for key, value in where.items():
        hold = study.held if key in study.keys else held_at
        rows = hold(frame, key, str(value))
        if rows.empty:
            some = ", ".join(short_names(frame[key]).values())
            raise ValueError(f"{study.name} has no value of these metrics at {key} = {value}. It has some at {some}.")
        frame = rows
    return frame


def _matter(study: StudyResults, asked: Sequence[str], where: Mapping[str, Any]) -> list[str]:
    """The swept keys that change these metrics, at the values at which others are held."""
    swept = {key: value for key, value in where.items() if key in study.keys}
    return that_matter(held(study, chosen(study.measures, asked), study.keys, swept), study.keys)


def shown(study: StudyResults, topic: str) -> list[str]:
    """The metrics that a topic shows unless others are asked for, of those that the study has measured.

    A metric with several groups gets one of them, `all` if it is there. Encounters keep all: their groups are keys of
    the figure.
    """
    groups_of = study.summary.groupby("metric")["group"].unique()
    found = []
    for name in SHOWN.get(topic, ()):
        for one in (name, INSTEAD.get(name, name)):
            metric, _, group = one.partition(":")
            groups = sorted(groups_of.get(metric, ()))
            if group in groups or (groups and not group):
                takes_all = group or len(groups) == 1 or metric.startswith("encounters.")
                first = EVERYTHING if EVERYTHING in groups else groups[0]
                found.append(one if takes_all else f"{one}:{first}")
                break
    return list(dict.fromkeys(found))


def _draw(
    frame: pd.DataFrame,
    asked: Sequence[str],
    x: str,
    colour: str,
    column: str,
    columns: Sequence[Any],
    at: Sequence[Line2D],
) -> Figure:
    """Panels: a row for each metric, a column for each value of a key. `at` are further entries of the legend."""
    across = len(columns)
    height = (2.4 if len(asked) == 1 else 1.8) - (0.0 if across == 1 else 0.3)
    figure, panels = style.sheet(len(asked) * across, height, across)
    if are_words(frame[x]):  # long words reach far below the axis
        longest = max(len(said(value)) for value in frame[x])
        figure.set_figheight(figure.get_figheight() + 0.033 * max(0, longest - 12))
    colours = distinct(frame[colour]) if colour else [None]
    labels = {key: label_of(key, frame) for key in (x, colour, column)}
    for row, name in enumerate(asked):
        of_metric = chosen(frame, [name])
        in_row = panels[row * across : (row + 1) * across]
        for n, (axes, value) in enumerate(zip(in_row, columns, strict=True)):
            part = of_metric if value is None else of_metric[of_metric[column] == value]
            for i, hue in enumerate(colours):
                of_hue = part if hue is None else part[part[colour] == hue]
                _line(axes, of_hue, frame[x], i, len(colours))
            title = ""
            if value is not None and row == 0:
                title = f"{labels[column]} = {said(value)}"
            y = _label_of_metric(of_metric, name) if n == 0 else ""
            is_last = row == len(asked) - 1
            letters = max(16, int(15 * (height - 0.65)))
            x_label = labels[x] if is_last else ""
            style.panel(axes, title, x_label, style.fitted(y, letters))
            axes.tick_params(labelleft=n == 0, labelbottom=is_last or not are_words(frame[x]))
            _height(axes, of_metric)
            if name.partition(":")[0].endswith(".auc"):
                axes.axhline(_CHANCE, color="grey", linewidth=0.6, zorder=0)
            _ticks(axes, frame[x], across)
    entries = []
    for i, hue in enumerate(colours):
        if hue is not None:
            look = style.look(i, are_joined=not are_words(frame[x]))
            entries.append(style.entry(f"{labels[colour]} = {said(hue)}", **look))
    style.legend(figure, [*entries, *at])
    return figure


def _label_of_metric(rows: pd.DataFrame, name: str) -> str:
    """What an axis or a title calls a metric: its label, the group where one is named, and the unit."""
    first = rows.iloc[0]
    group = f", {first.group}" if ":" in name and first.group else ""
    unit = "" if first.unit in ("", "1") else f" [{first.unit}]"
    return f"{first.label}{group}{unit}"


def _heat_maps(frame: pd.DataFrame, asked: Sequence[str], x: str, y: str, at: Sequence[Line2D]) -> Figure:
    """A map per metric, where both keys are words: the mean written into each cell, or a scale where they are many.

    The title has the half width of the widest 95 % interval.
    """
    rows = list(dict.fromkeys(frame[y]))
    columns = list(dict.fromkeys(frame[x]))
    figure, panels = style.sheet(len(asked), 1.6 + 0.16 * len(rows))
    has_room = len(columns) <= _MOST_CELLS
    labels = {key: label_of(key, frame) for key in (x, y)}
    for axes, name in zip(panels, asked, strict=True):
        of_metric = chosen(frame, [name])
        cells, shown_rows = of_metric.set_index([y, x]), rows
        bound = _bound(frame, name).drop_duplicates(x) if y == "trust.model" else frame[:0]
        if len(bound):
            shown_rows = ["ideal observer", *rows]
            of_bound = bound.assign(**{y: "ideal observer"}).set_index([y, x])
            cells = pd.concat([of_bound, cells])
        grid = cells.reindex(pd.MultiIndex.from_product([shown_rows, columns]))
        mean = grid["mean"].to_numpy(float).reshape(len(shown_rows), -1)
        bottom, top = bounds_of(of_metric.metric.iloc[0])
        if top != 1:
            bottom = min(0.0, np.nanmin(mean))
            top = max(0.0, np.nanmax(mean)) or float(bottom == 0)
        middle = bottom + 0.55 * (top - bottom)
        image = axes.imshow(mean, cmap="cividis", vmin=bottom, vmax=top, aspect="auto")
        for i, j in np.argwhere(~np.isnan(mean)) if has_room else ():
            ink = "black" if mean[i, j] > middle else "white"
            told = _short(mean[i, j], top)
            axes.text(j, i, told, ha="center", va="center", fontsize=style.SMALLEST, color=ink)
        axes.set_xticks(
            range(len(columns)), [said(v) for v in columns], rotation=45, ha="right", rotation_mode="anchor"
        )
        axes.set_yticks(range(len(shown_rows)), [said(v) for v in shown_rows])
        axes.grid(visible=False)
        few, many = int(of_metric.n.min()), int(of_metric.n.max())
        n = f"{many} seeds" if few == many else f"{few} to {many} seeds"
        halves = (cells.high - cells.low) / 2
        half = float(halves[cells.n > 2].max())  # that of two seeds says nothing
        told = "" if many < 2 else f": mean of {n}"
        told += f", 95 % intervals up to ±{_short(half, top)}" if half == half else ""
        told += "; blank: no value" if np.isnan(mean).any() else ""
        title = style.fitted(_label_of_metric(of_metric, name) + told, 32)
        style.panel(axes, title, labels[x], labels[y])
        if not has_room:
            figure.colorbar(image, ax=axes, fraction=0.03, pad=0.02)
    style.legend(figure, at)
    return figure


def _short(value: float, top: float) -> str:
    """A number in few letters: two digits, of shares without the zero before the point."""
    if top == 1.0:
        return f"{value:.2f}".removeprefix("0").replace("1.00", "1")
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def _bound(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """The rows of the metric that bounds another one, for the same group; none if it was not measured."""
    metric, _, group = name.partition(":")
    bounds = frame.metric == BOUNDS.get(metric, "")
    return frame[bounds & ((frame.group == group) | (group == ""))]


def _line(axes: Axes, part: pd.DataFrame, values: pd.Series, i: int, n: int) -> None:
    """Line `i` of `n`, a little aside of the others so that their intervals can be told apart."""
    found = distinct(values)
    place = i - (n - 1) / 2
    aside = 0.012 * place
    x = part[values.name].to_numpy()
    if values.dtype.kind != "f":
        wider = 3 if are_words(values) else 1
        step = min(0.012 * max(1, len(found) - 1) * wider, 0.6 / n)  # all lines stay nearer to their word
        at = pd.Index(found).get_indexer(x) + step * place
    elif _is_wide(found):
        at = x * (found[-1] / found[0]) ** aside
    else:
        at = x + aside * (found[-1] - found[0])
    order = np.argsort(at)
    mean = part["mean"]
    ends = np.array([mean - part.low, part.high - mean], float)
    axes.errorbar(
        at[order],
        mean.to_numpy()[order],
        np.nan_to_num(ends[:, order]),
        capsize=1.5,
        elinewidth=0.8,
        **style.look(i, are_joined=not are_words(values)),
    )


def _height(axes: Axes, of_metric: pd.DataFrame) -> None:
    """The vertical axis: as high as the means ask for, and as the intervals do if these are not much wider.

    An interval that leaves the panel ends in an arrow at its edge.
    """
    mean = of_metric["mean"].to_numpy(float)
    high = of_metric[["mean", "high"]].max(axis=1).to_numpy(float)
    low = of_metric[["mean", "low"]].min(axis=1).to_numpy(float)
    top, largest = float(high.max()), float(mean.max())
    if largest:
        top = min(top, _WIDE * largest)
    if bounds_of(of_metric.metric.iloc[0])[1] == 1 and low.min() >= 0:
        style.share_axis(axes, min(1.0, max(0.05, 1.04 * top)))
    else:
        least = max(float(low.min()), _WIDE * float(mean.min()))
        limits = min(0.0, 1.06 * least), max(0.0, 1.06 * top)
        axes.set_ylim(limits if any(limits) else (0.0, 1.0))
    bottom, top = axes.get_ylim()
    for line in axes.containers:
        if not isinstance(line, ErrorbarContainer):
            continue
        ends = line.lines[2][0].get_segments()
        look: dict[str, Any] = {"color": line.lines[0].get_color(), "linestyle": "none", "markersize": 4}
        for segment in ends:
            if not len(segment):
                continue
            (at, start), (_, end) = segment
            if end > top:
                axes.plot([at], [top], marker="^", clip_on=False, **look)
            if start < bottom:
                axes.plot([at], [bottom], marker="v", clip_on=False, **look)


_WIDE = 1.5
"""An interval makes the axis higher up to so many times the largest mean."""


def _is_wide(found: Sequence[Any]) -> bool:
    """Whether the values call for a logarithmic axis: they span a factor of ten."""
    least, most = found[0], found[-1]
    return bool(least > 0 and most / least >= 10)


def _ticks(axes: Axes, values: pd.Series, across: int) -> None:
    """The swept values themselves; on a logarithmic axis where they span a factor of ten. Of many, every second.

    `across` panels stand beside one another.
    """
    found, most = distinct(values), 5 if across < 3 else 3
    places = found if values.dtype.kind == "f" else range(len(found))
    axes.update_datalim([(place, 0.0) for place in places], updatey=False)  # also those without a value in this panel
    axes.autoscale_view(scaley=False)
    if values.dtype.kind != "f":
        words = [said(v) for v in found]
        is_long = across * sum(map(len, words)) > _MOST_LETTERS
        slanted: dict[str, Any] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"} if is_long else {}
        axes.set_xticks(range(len(found)), words, **slanted)
        return
    if _is_wide(found):
        axes.set_xscale("log")
        axes.minorticks_off()
    few = found
    if len(found) > most:
        few = found[(len(found) - 1) % 2 :: 2]  # the last one among them
    along = np.log10 if _is_wide(found) else np.asarray
    least = 0.4 / most * np.ptp(along(found))
    numbers: list[str] = []
    labelled = -np.inf
    for value, place in zip(few, along(few), strict=True):
        is_apart = place >= labelled + least  # else its number would stand on that of the one before
        numbers.append(said(value) if is_apart else "")
        labelled = place if is_apart else labelled
    axes.set_xticks(few, numbers)


def label_of(key: str, among: Iterable[Any] = ()) -> str:
    """A key of the config as an axis says it: its last word, with the unit that its name ends in.

    If one of the keys `among` has the same words, its section stands beside, as in "model (trust)".
    """
    words, unit = _words(key)
    others = [other for other in among if "." in other and other != key]
    if words in [_words(other)[0] for other in others]:
        words += f" ({key.rpartition('.')[0]})"
    return f"{words} [{unit}]" if unit else words


def _words(key: str) -> tuple[str, str]:
    """The words of a key, and its unit, which may be empty."""
    section, _, name = key.rpartition(".")
    first = section.partition(".")[0]
    label = LABELS.get(name, LABELS.get(f"{first}.{name}"))
    if label:
        words, _, unit = label.removesuffix("]").partition(" [")
        return words, unit
    for suffix, unit in (("_mps", "m/s"), ("_s", "s"), ("_m", "m"), ("_p", "")):
        if name.endswith(suffix):
            return name.removesuffix(suffix).replace("_", " "), unit
    return name.replace("_", " "), ""
