"""A study on disk: its points, their runs, and every metric by swept key with its interval."""

import json
import os
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from cosim.base import durable
from cosim.base.file_names import COMMON_STEMS
from results import study_curves, study_notes
from results.archive import OpenRun, open_run
from results.metrics.intervals import FREE, Bounds, around
from results.metrics.registry import METRICS, bounds_of
from results.spreadsheet import csv_of
from results.study_measuring import changed_in, changes, measuring_in


class StudyResults:
    """The folder of a `cosim sweep`."""

    def __init__(self, path: Path, head: Mapping[str, Any], points: pd.DataFrame) -> None:
        self.path = path
        """The folder, as it was named. It is read where it was, even if the working directory changes."""
        self._folder = Path(os.path.abspath(path))
        self.name: str = head["name"]
        self.question: str = head["question"]
        self.keys: tuple[str, ...] = tuple(head["keys"])
        """Swept keys of the config."""
        self.baseline: dict[str, Any] = head["baseline"]
        """Swept keys and values of the points that the others are compared with."""
        self.points = points
        """One row per point: point, run, variant, replicate, state, attempts, wall_s, cpu_s, memory_bytes, disk_bytes,
        and a column per swept key."""

    def run(self, point: str) -> OpenRun:
        """The run of a point, seen as the point's trust variant."""
        found = self.points[self.points.point == point]
        if not len(found):
            raise ValueError(f"{self.path} has no point {point!r}. `study.points` lists them.")
        row = found.iloc[0]
        folder = self._folder / "runs" / str(row["run"])
        return open_run(folder).as_variant(str(row.variant))

    @cached_property
    def measures(self) -> pd.DataFrame:
        """Every metric of every finished point: the swept keys, replicate, metric, group, value, unit, label."""
        frames = []
        ways: list[dict[str, Any]] = []
        for run in self.points["run"].unique():
            path = self._folder / "jobs" / str(run) / "measures.parquet"
            if path.is_file():
                frames.append(_measures(path))
                ways += [measuring_in(path.parent)] if path.with_name("job.json").is_file() else []
        if others := [keys for way in ways[1:] if (keys := changes(ways[0], way))]:
            raise ValueError(
                f"{self.path}: {', '.join(others[0])} changed after some runs were measured, and means over both would "
                f"say nothing. `{again(self.path)}` measures them again."
            )
        if not frames:
            raise ValueError(f"{self.path} has no finished run yet. Run `cosim sweep` on.")
        columns = ["point", "replicate", *self.keys]
        found = self.points[columns].merge(pd.concat(frames, ignore_index=True), on="point", how="inner")
        labels = {name: metric.label for name, metric in METRICS.items()}  # earlier versions had other words
        found["label"] = found.metric.map(labels).fillna(found.label)
        is_defined = ~found.metric.str.endswith(".not_measured") & found.value.notna()
        return found[is_defined].reset_index(drop=True)

    @cached_property
    def curves(self) -> pd.DataFrame:
        """Durations of encounters and ages at lookup of every finished point: the swept keys, point, replicate, and the
        columns of `study_curves.counts`. Runs of earlier versions, whose tables are gone, have none."""
        frames = []
        kinds = {"point": "O", "what": "O", "group": "O", "value_s": "f", "n": "iu", "n_open": "iu"}
        for run, of_run in self.points.groupby("run", sort=False):
            path = self._folder / "jobs" / str(run) / "curves.parquet"
            if path.is_file() or "curves.parquet" in changed_in(path.parent):
                frames.append(_read(path, kinds))
                continue
            if not path.with_name("measures.parquet").is_file():
                continue
            for row in of_run.itertuples():
                try:
                    found = study_curves.counts(self.run(str(row.point)))
                except (ValueError, OSError):  # the run is not there any more
                    continue
                frames.append(found.assign(point=str(row.point)))
        if not frames:
            frames = [pd.DataFrame(columns=["point", *study_curves.COLUMNS])]
        columns = ["point", "replicate", *self.keys]
        found = pd.concat(frames, ignore_index=True)
        return self.points[columns].merge(found, on="point", how="inner")

    @cached_property
    def summary(self) -> pd.DataFrame:
        """Mean over replicates and its 95 % interval: the swept keys, metric, group, n, mean, low, high, unit, label,
        and a note where fewer replicates than asked have a value, or where most of them rest on few subjects.

        Notes
        -----
        The interval is Student's with n - 1 degrees of freedom, in the logit or the logarithm of quantities with bounds
        (`intervals.around`): a share stays within 0 and 1, a time above 0. It is missing for one replicate, and where
        all are at a bound.
        """
        return self._intervals(self.measures, bounds_of)

    @cached_property
    def differences(self) -> pd.DataFrame:
        """Paired differences against the baseline, columns as in `summary`.

        A point's counterpart has the same replicate and keys, but for those that the baseline names: the same traffic
        and, where only trust differs, the same detections. The interval is that of `summary`, of the differences.
        """
        if not self.baseline:
            raise ValueError(f"{self.path}: the study names no baseline. Set study.baseline and sweep again.")
        frame = self.measures
        is_base = np.ones(len(frame), bool)
        for key, value in self.baseline.items():
            is_base &= (frame[key] == as_column(frame[key], value)).to_numpy()
        others = [key for key in self.keys if key not in self.baseline]
        on = [*others, "replicate", "metric", "group"]
        base = frame.loc[is_base, [*on, "value", "note"]]
        pairs = frame[~is_base].merge(base, on=on, suffixes=("", "_base"))
        pairs = pairs.assign(note=pairs.note.where(pairs.note != "", pairs.note_base))
        return self._intervals(pairs.assign(value=pairs.value - pairs.value_base), bounds_of_difference)

    def at(self, where: Mapping[str, str]) -> "StudyResults":
        """The points of the study at which swept keys have these values; ValueError if there are none."""
        self.check_swept(*where)
        points = self.points
        for key, text in where.items():
            points = held_at(points, key, text)
        baseline = {key: value for key, value in self.baseline.items() if key not in where}
        head = {"name": self.name, "question": self.question, "keys": self.keys, "baseline": baseline}
        found = StudyResults(self.path, head, points)
        found._folder = self._folder
        return found

    def held(self, frame: pd.DataFrame, key: str, text: str) -> pd.DataFrame:
        """Rows of a table of the study at which a swept key has this value; ValueError if no point has it."""
        values = held_at(self.points, key, text)[key]
        return frame[frame[key].isin(values)]

    def check_swept(self, *names: str, more: Sequence[str] = ()) -> None:
        """Raise ValueError if one of these names is no swept key, nor one of `more`."""
        known = dict.fromkeys([*self.keys, *more])
        for name in names:
            if name not in known:
                raise ValueError(f"{name} is not swept in {self.name}. Swept: {', '.join(known)}.")

    def _intervals(self, frame: pd.DataFrame, bounds: Callable[[str], Bounds]) -> pd.DataFrame:
        by = [*self.keys, "metric", "group", "unit", "label"]
        found = intervals(frame, by, bounds)
        keys = list(self.keys)
        asked = self.points.groupby(keys, sort=False, dropna=False).replicate.nunique().rename("asked")
        asked_of = found[keys].merge(asked.reset_index(), on=keys, how="left").asked
        notes = []
        said = study_notes.idle(frame, by), study_notes.few(frame, by)
        for n, of, *more in zip(found.n, asked_of, *said, strict=True):
            notes.append("; ".join(filter(None, (study_notes.missing(n, of), *more))))
        columns = [*self.keys, "metric", "group", "n", "mean", "low", "high", "unit", "label"]
        return found[columns].assign(note=notes)

    def write(self, folder: Path | None = None) -> list[Path]:
        """`measures`, `summary` and, with a baseline, `differences` as Parquet and CSV."""
        folder = self.path if folder is None else folder
        tables = {"measures": self.measures, "summary": self.summary}
        if self.baseline:
            tables["differences"] = self.differences
        written = []
        for name, table in tables.items():
            durable.write_output(folder / f"{name}.parquet", table.to_parquet(index=False))
            durable.write_output(folder / f"{name}.csv", csv_of(table))
            written += [folder / f"{name}.parquet", folder / f"{name}.csv"]
        return written

    def __repr__(self) -> str:
        states = self.points.state.value_counts().to_dict()
        swept = ", ".join(self.keys)
        return f"Study({str(self.path)!r}: {len(self.points)} points, {states}, swept {swept})"


def intervals(
    frame: pd.DataFrame,
    by: Sequence[str],
    bounds: Callable[[str], Bounds] = lambda _: FREE,
) -> pd.DataFrame:
    """Mean of the column `value` in each group, with its 95 % interval (`intervals.around`).

    Parameters
    ----------
    frame
        Rows with a column `value`.
    by
        Columns whose values name a group.
    bounds
        Bounds of a metric, used if `metric` is one of these columns; by default no metric has bounds.

    Returns
    -------
    The columns `by`, n, mean, low and high.
    """
    values = frame.groupby(list(by), sort=False, dropna=False).value
    found = values.agg(n="count", mean="mean", s="std").reset_index()
    names = found.metric if "metric" in by else [""] * len(found)
    means = found["mean"]
    ends = []
    for mean, s, n, name in zip(means, found.s, found.n, names, strict=True):
        error = s / n**0.5 if n > 1 else float("nan")
        estimate = around(mean, error, max(n - 1, 1), bounds(name))
        ends.append(estimate[1:3])
    low, high = np.array(ends, float).reshape(-1, 2).T
    return found.assign(low=low, high=high).drop(columns="s")


def bounds_of_difference(metric: str) -> Bounds:
    """Smallest and largest difference of two values of a metric."""
    low, high = bounds_of(metric)
    return low - high, high - low


def open_study(path: str | Path) -> StudyResults:
    """Open the folder of a `cosim sweep`, finished or not. Open it again to see the points that finish afterwards."""
    path = Path(path)
    if not is_study(path):
        raise ValueError(f"{path} is not a study: it holds no index.parquet. Give the folder of a `cosim sweep`.")
    try:
        table = pq.read_table(path / "index.parquet", partitioning=None)
        head = json.loads((table.schema.metadata or {})[b"study"])
        points = table.to_pandas()
        _check(head, points)
        points.loc[_has_finished(path, points), "state"] = "finished"
        return StudyResults(path, head, points)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(
            f"{path}/index.parquet is damaged ({reason}). `cosim status {shlex.quote(str(path))}` writes it anew."
        ) from error


def _has_finished(path: Path, points: pd.DataFrame) -> pd.Series:
    """Whether each point's run is measured. A sweep writes the index at its beginning and its end, if it gets there."""
    ended = {"": False}
    for run in set(points["run"]) - {""}:
        files = path / "jobs" / run / "measures.parquet", path / "runs" / run / "manifest.json"
        ended[run] = all(map(Path.is_file, files))
    return points["run"].map(ended)


def _check(head: Mapping[str, Any], points: pd.DataFrame) -> None:
    """Raise ValueError if an index is not what a sweep writes: anybody can have changed it."""
    kinds = {"name": str, "question": str, "keys": list, "baseline": dict}
    for name, kind in kinds.items():
        if not isinstance(head[name], kind):
            raise ValueError(f"{name} is of another kind")
    for column in (*_POINTS, *head["keys"], *head["baseline"]):
        if column not in points.columns:
            raise ValueError(f"it has no column {column}")
    if len(points.columns) != len(set(points.columns)):
        raise ValueError("it has a column twice")
    for name in ("point", "run", "variant", "state"):
        for text in points[name]:
            if not isinstance(text, str) or Path(text).name != text:
                raise ValueError(f"{name} holds something else than names")
    if points.replicate.dtype.kind not in "iu" or not points.point.is_unique:
        raise ValueError("replicate holds something else than numbers, or a point is there twice")


def _measures(path: Path) -> pd.DataFrame:
    """Metrics of a run's points. Damaged, in one line, if the file holds something else."""
    found = _read(path, {"point": "O", "metric": "O", "group": "O", "value": "fiu", "unit": "O", "label": "O"})
    return found if "note" in found else found.assign(note="")


def _read(path: Path, columns: Mapping[str, str]) -> pd.DataFrame:
    """A table with these columns, each of one of these kinds. Damaged, in one line, if it was changed or has others."""
    if changed := changed_in(path.parent):
        study = path.parents[2]
        again = shlex.join(["cosim", "sweep", str(study / "study.toml"), "--out", str(study)])
        raise durable.Damaged(
            f"{path.parent}: {', '.join(changed)} changed after the run was measured. `{again}` measures it again."
        )
    try:
        found = pq.read_table(path, partitioning=None).to_pandas()
        for name, kinds in columns.items():
            is_right = found[name].dtype.kind in kinds
            if kinds == "O":
                is_right = all(isinstance(text, str) for text in found[name])
            if not is_right:
                raise ValueError(f"{name} is of another kind")
        return found
    except (OSError, ValueError, KeyError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise durable.Damaged(f"{path} is damaged ({reason}). Sweep the study in another --out.") from None


_POINTS = ("point", "run", "variant", "replicate", "state")
"""Columns of an index that say what a point is."""


def again(path: Path) -> str:
    """The command that continues a study."""
    return "cosim " + shlex.join(["sweep", f"{path}/study.toml", "--out", str(path)])


def is_study(path: Path) -> bool:
    """Whether a folder is a study's."""
    return (path / "index.parquet").is_file()


def runs_of(folder: Path) -> list[Path]:
    """The run folders of a study; the folder itself if it is no study. A run killed before its manifest is none."""
    if not is_study(folder):
        return [folder]
    return sorted(path.parent for path in folder.glob("runs/*/manifest.json"))


def missing_in(folder: Path) -> list[str]:
    """What is missing of the finished points of a study, or was changed, one line each."""
    try:
        points = open_study(folder).points
    except ValueError as error:
        return [str(error)]
    found = []
    for run in points["run"][points.state == "finished"].unique():
        names = (f"runs/{run}/manifest.json", f"jobs/{run}/measures.parquet")
        missing = [f"{name} is missing" for name in names if not (folder / name).is_file()]
        changed = changed_in(folder / "jobs" / run)
        found += missing or [f"jobs/{run}/{name} changed after the run was measured" for name in changed]
    return found


def within_run(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows of encounter metrics with what their group says, as columns: radius_m and pairs."""
    parts = frame.group.str.extract(r"^(?P<pairs>\w+), (?P<radius_m>[\d.]+) m")
    return frame.assign(radius_m=parts.radius_m.astype(float), pairs=parts.pairs)


def apart(frame: pd.DataFrame, keys: Sequence[str]) -> list[str]:
    """Swept keys with more than one value, without those that another one determines, as keys that change together."""
    n = {key: frame[key].nunique(dropna=False) for key in keys}
    varied = [key for key in keys if n[key] > 1]
    found: list[str] = []
    for key in sorted(varied, key=lambda key: -n[key]):
        n_pairs = {one: len(frame[[one, key]].drop_duplicates()) for one in found}
        if all(n_pairs[one] > n[one] for one in found):
            found.append(key)
    return [key for key in keys if key in found]


def is_grid(points: pd.DataFrame, keys: Sequence[str]) -> bool:
    """Whether each value of a swept key occurs with each value of the others."""
    varied = apart(points, keys)
    n_values = points[varied].nunique(dropna=False)
    return len(points[varied].drop_duplicates()) == n_values.prod()


def at_first(frame: pd.DataFrame, keys: Sequence[str], beside: Sequence[str]) -> pd.DataFrame:
    """Rows with the first values of keys that change nothing: they stand for all.

    First for each combination of the columns `beside`, of replicate, metric and group: some runs of a study may fail.
    """
    if not keys:
        return frame
    same = [name for name in dict.fromkeys([*beside, "replicate", "metric", "group"]) if name in frame]
    return frame.merge(frame.drop_duplicates(same)[[*same, *keys]])


def that_matter(measures: pd.DataFrame, keys: Sequence[str]) -> list[str]:
    """Of the swept keys, those that change a value: encounters, for example, do not depend on the window of trust.

    Parameters
    ----------
    measures
        Rows with the swept keys, replicate, and value, of the metrics in question; metric and group where there are
        several.
    """
    varied = apart(measures, keys)
    beside = [name for name in ("replicate", "metric", "group") if name in measures]
    found = []
    for key in varied:
        others = [one for one in varied if one != key]
        groups = measures.groupby([*others, *beside], dropna=False)
        is_nowhere_twice = (groups[key].nunique(dropna=False) < 2).all()  # its values cannot be compared
        if is_nowhere_twice or (groups.value.nunique(dropna=False) > 1).any():
            found.append(key)
    return found


def for_axes(frame: pd.DataFrame, keys: Iterable[str]) -> list[str]:
    """Keys in the order in which a figure shows them: numbers first, because lines join them; then words."""
    return sorted(keys, key=lambda key: frame[key].dtype.kind not in "fiu")


def chosen(frame: pd.DataFrame, metrics: Sequence[str]) -> pd.DataFrame:
    """Rows of these metrics: an identifier, `identifier:group`, or how identifiers begin, such as a topic."""
    kept = np.zeros(len(frame), bool)
    for name in metrics:
        metric, _, group = name.partition(":")
        rows = frame.metric == metric
        if not rows.any():
            rows = frame.metric.str.startswith(f"{metric}.")
        if group:
            rows = rows & (frame.group == group)
        if not rows.any():
            raise ValueError(f"The study has no value of {name!r}. {_there(frame, metric)}")
        kept |= rows.to_numpy()
    return frame[kept]


def one_group(frame: pd.DataFrame, name: str) -> str:
    """A metric with the one group that a line of a figure can show: `identifier:group`.

    Where no group is named, it is the only one, or `all`, which stands for everything.

    Raises
    ------
    ValueError
        In one line, if a metric has several groups and none of them stands for everything, or if several begin so.
    """
    metric, _, group = name.partition(":")
    rows = chosen(frame, [name])
    if metric not in set(rows.metric):
        raise ValueError(f"{metric} stands for several metrics: name one of {', '.join(rows.metric.unique())}.")
    groups = list(rows.group.unique())
    if group or groups == [""]:
        return name
    if len(groups) > 1 and EVERYTHING not in groups:
        raise ValueError(several_groups(name, groups))
    return f"{name}:{groups[0] if len(groups) == 1 else EVERYTHING}"


EVERYTHING = "all"
"""The group of a metric that stands for everything, beside those of single roles."""


def several_groups(name: str, groups: Iterable[str]) -> str:
    """What is said of a metric whose groups would be joined in one line."""
    return f"{name} has several groups: {'; '.join(groups)}. Choose one as {name}:GROUP."


def _there(frame: pd.DataFrame, metric: str) -> str:
    """The groups of a metric that is there, else the metrics of its topic, else all."""
    if metric in set(frame.metric):
        groups = frame.group[frame.metric == metric].unique()
        if groups.tolist() == [""]:
            return f"It has no groups: write {metric}."
        return f"Its groups are {'; '.join(groups)}: write {metric}:{groups[0]}."
    names = sorted(frame.metric.unique())
    alike = [name for name in names if name.startswith(metric.partition(".")[0] + ".")]
    return f"It has {', '.join(alike or names) or 'no values at all'}."


def are_words(values: pd.Series) -> bool:
    """Whether a swept key has words as values: they have no order, and nothing lies between them."""
    return bool(values.dtype.kind not in "fiub")


def distinct(values: pd.Series) -> list[Any]:
    """The values of a swept key: numbers ascending, words in the order of the study."""
    found = list(dict.fromkeys(values))
    return found if are_words(values) else sorted(found)


def short_names(values: Iterable[Any]) -> dict[Any, str]:
    """Values of a swept key as figures and tables say them: files by the shortest names that tell them apart."""
    texts = {value: said(value) for value in dict.fromkeys(values)}
    files = [value for value, text in texts.items() if text.startswith("/")]
    longest = max((text.count("/") for text in texts.values()), default=0)
    ways: list[Callable[[str], str]] = [_stem]
    ways += [partial(_end, n) for n in range(1, longest + 1)]
    for name in ways:
        short = texts | {value: name(value) for value in files}
        if len(set(short.values())) == len(short):
            return short
    return texts


def short_keys(keys: Iterable[str]) -> dict[str, str]:
    """Swept keys as tables say them: their last word, or the whole key if another one ends in this word."""
    last = {key: key.rsplit(".", 1)[-1] for key in keys}
    n = Counter(last.values())
    return {key: word if n[word] == 1 else key for key, word in last.items()}


def said(value: Any) -> str:
    """A value of a swept key as text: numbers without digits that say nothing."""
    is_number = isinstance(value, float | np.floating) and not np.isnan(value)
    return f"{value:g}" if is_number else str(value)


def _stem(path: str) -> str:
    """The name of a file without its endings, or of its folder if that says nothing, or that of a class."""
    *folders, name = path.split("/")
    if ":" in name:
        return name
    stem = name.split(".")[0] or name
    says_nothing = stem.lower() in COMMON_STEMS
    return (folders[-1] if says_nothing else "") or stem


def _end(n: int, path: str) -> str:
    return "/".join(path.split("/")[-n:])


def with_short_names(frame: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Rows with short names in place of the files that swept keys name."""
    words = [key for key in keys if are_words(frame[key])]
    short = {key: frame[key].map(short_names(frame[key])) for key in words}
    return frame.assign(**short)


def held_at(frame: pd.DataFrame, key: str, text: str) -> pd.DataFrame:
    """Rows in which a swept key has the value that a text says: a number, a word, a file or its short name.

    Raises
    ------
    ValueError
        In one line, with the values that there are.
    """
    short = short_names(frame[key])
    wanted = [value for value, name in short.items() if _is_said(value, name, text)]
    if not wanted:
        raise ValueError(f"no point has {key} = {text}. There are {', '.join(map(str, short.values()))}.")
    return frame[frame[key].isin(wanted)]


def _is_said(value: Any, name: str, text: str) -> bool:
    plain = str(value)
    if plain.lower() in ("true", "false"):
        return text.lower() == plain.lower()
    try:
        return text in (plain, name) or float(plain) == float(text)
    except ValueError:
        return False


def as_column(column: pd.Series, value: Any) -> Any:
    """A value of a swept key as its column holds it, such as the text of a number beside words."""
    if column.dtype.kind in "fb":
        return value
    return value if isinstance(value, str) else json.dumps(value)
