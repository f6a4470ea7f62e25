"""The answer of a study in four sentences.

They say how long vehicles meet, how old trust is, how often it comes too late, and how well it tells apart.

Each sentence has a part for every swept key that changes its metric: the values along the key, and what the paired
interval of the difference to the first of them says, replicate by replicate: of the last number, or of each word, of
which that of the baseline is the first. The other keys are held at their reference: the value of the baseline, or else
the first of the study. Each city has sentences of its own, because replicates of different cities share no traffic. The
last sentences name keys that change together with a key that is named.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd

from results.figures.study import label_of
from results.metrics.registry import METRICS, bounds_of
from results.metrics.trust import HONEST
from results.study import (
    EVERYTHING,
    StudyResults,
    apart,
    are_words,
    as_column,
    at_first,
    bounds_of_difference,
    chosen,
    distinct,
    intervals,
    said,
    short_names,
    that_matter,
)
from results.study_report import Answer
from results.study_table import cautions, core, number, together


@dataclass(frozen=True, slots=True)
class _Quantity:
    """A core metric in words."""

    metric: str
    subject: str
    """What has the value; `{group}` is the group of the metric: a definition of an encounter, or a role."""
    more: str
    less: str
    missing: str
    group: str = ""
    """The group of which the sentence speaks; empty: the first that the study has."""


_QUANTITIES = (
    _Quantity(
        "encounters.duration.km_median_s",
        "The median encounter ({group}) lasts",
        "longer",
        "shorter",
        "No median duration of encounters: in no run did half of them end while they were watched",
    ),
    _Quantity(
        "freshness.newest_evaluation_age.mean_s",
        "The newest evaluation behind trust that a vehicle looks up has a mean age of",
        "older",
        "fresher",
        "No age of trust: no value that was looked up rests on an evaluation by another vehicle",
    ),
    _Quantity(
        "freshness.encounters_without_trust.share",
        "The share of encounters of equipped vehicles ({group}) that are over before trust is known is",
        "higher",
        "lower",
        "No share of encounters without trust: no two vehicles met that look up trust",
    ),
    _Quantity(
        "misbehaviour.at_lookup.auc",
        "When it is looked up, an honest vehicle has more trust than {group} one in a share of comparisons (AUC) of",
        "higher",
        "lower",
        "No comparison of honest with malicious vehicles: no run has looked up trust of both since an attack",
    ),
)
_UNDER_ATTACK = _Quantity(
    "trust.final.median",
    "Trust in the median honest vehicle ends at",
    "higher",
    "lower",
    "No trust in honest vehicles: no run has such a value",
    HONEST,
)
"""Said too if the study sweeps a key of attacks: what they do to honest vehicles."""

_SAME = 1e-9
"""Values that differ by less are the same but for rounding."""
_ALIKE_P = 0.01
"""A difference whose interval lies within this share of the first value is negligible."""

_CITY = "traffic.scenario"
_WINDOW = "trust.freshness_s"
_MOST_VALUES = 4
"""Of a key with more values, the first and the last are said, and those with the smallest and the largest mean of
numbers."""


def sentences(study: StudyResults) -> list[Answer]:
    """Four sentences with numbers, intervals and, where they hold, differences; a fifth if attacks are swept.

    If cities are swept, as many for each of them. The last ones say where keys are held that others do not name, and
    which keys change with a named one.
    """
    held: list[str] = []
    if _CITY not in study.keys or study.measures[_CITY].nunique() < 2:
        found = _of_one_city(study, held)
    else:
        found = []
        for city in short_names(study.measures[_CITY]).values():
            there = study.at({_CITY: city})
            found += [replace(one, city=city) for one in _of_one_city(there, held)]
    if held:
        places = ", ".join(dict.fromkeys(held))
        found.append(Answer(f"Keys that a line does not name are held at {places}"))
    return found + list(map(Answer, together(study)))


def _of_one_city(study: StudyResults, held: list[str]) -> list[Answer]:
    """The sentences of one city. What keys are held at is added to `held`."""
    asked = core(study, whole=False)
    found = []
    attacks = [_UNDER_ATTACK] if any(key.startswith("attacks.") for key in study.keys) else []
    for of in (*_QUANTITIES, *attacks):
        names = [name for name in asked if _speaks_of(of, name)]
        if names:
            found.append(_answer(study, of, names[0], held))
        else:
            found.append(Answer(of.missing + _not_asked(study, of)))
    return found


def _subject(of: _Quantity, group: str) -> str:
    if of.metric.startswith("misbehaviour."):  # a role
        group = f"an {group}" if group[:1] in "aeiou" else f"a {group}"
    return of.subject.format(group=group)


def _speaks_of(of: _Quantity, name: str) -> bool:
    metric, _, group = name.partition(":")
    return metric == of.metric and of.group in ("", group)


def _not_asked(study: StudyResults, of: _Quantity) -> str:
    topic = of.metric.partition(".")[0]
    is_measured = study.measures.metric.str.startswith(topic + ".").any()
    return "" if is_measured else f", or the study did not measure the topic {topic}"


def _answer(study: StudyResults, of: _Quantity, name: str, held: list[str]) -> Answer:
    metric, _, group = name.partition(":")
    frame = chosen(study.measures, [name])
    matter = that_matter(frame, study.keys)
    free = [key for key in apart(frame, study.keys) if key not in matter]
    frame = at_first(frame, free, matter)
    reference = {key: _reference(study, frame, key) for key in matter}
    parts: list[str] = []
    for key in matter:
        at_reference = frame
        for other, value in reference.items():
            at_reference = at_reference if other == key else at_reference[at_reference[other] == value]
        if len(at_reference):
            parts.append(_along(of, at_reference, key, reference[key]))
    subject = _subject(of, group)
    if len(parts) > 1:
        held += [_at(frame, key, value) for key, value in reference.items()]
    notes = [
        _alone(study, frame),
        *(_without_effect(frame, matter) if _is_age(of) else ()),
        _inverted(study, frame),
        _censored(study, of, group),
        _of_fewer(study, of, frame),
        _left_out(study, of),
        _of_value(study, of),
        _beyond(of, frame),
        _not_over(frame),
        _in_the_open(study, of),
        *cautions(study, chosen(study.summary, [name]), [name], are_named=False),
    ]
    note = "; ".join(filter(None, notes))
    if not parts:
        return Answer(f"{subject} {_value(frame, metric)}", note=note)
    return Answer(subject, tuple(parts), note)


def _without_effect(frame: pd.DataFrame, matter: Sequence[str]) -> list[str]:
    """Words, such as trust models, with which another key changes nothing, such as a window that they do not read."""
    found = []
    words = [key for key in matter if are_words(frame[key])]
    for word in words:
        idle: dict[str, list[str]] = {}
        values = distinct(frame[word])
        for value in values:
            there = that_matter(frame[frame[word] == value], matter)
            for key in matter:
                if key not in (word, *there):
                    idle.setdefault(key, []).append(_said(frame, word, value))
        for key, names in idle.items():
            if len(names) < len(values):
                found.append(f"the {_named(frame, key)} changes nothing with {_listed(names)}")
    return found


def _alone(study: StudyResults, frame: pd.DataFrame) -> str:
    """Values of keys outside of which the metric has no value, such as the share of attackers of an AUC."""
    row = frame.iloc[0]
    frame = chosen(study.measures, [f"{row.metric}:{row.group}"])
    only = []
    for key in apart(study.points, study.keys):
        values = frame[key]
        if values.nunique() == 1:
            only.append(_at(study.points, key, values.iloc[0]))
    return f"there is a value at {' and '.join(only)} alone" if only else ""


def _inverted(study: StudyResults, frame: pd.DataFrame) -> str:
    """What an AUC below one half means."""
    if not str(frame.metric.iloc[0]).endswith("auc"):
        return ""
    means = frame.groupby(list(study.keys), dropna=False).value.mean()
    if not (means < 0.5).any():
        return ""
    return f"below 0.5, {frame.group.iloc[0]} vehicles are trusted more than honest ones"


def _reference(study: StudyResults, frame: pd.DataFrame, key: str) -> Any:
    """The value of a key at which it is held: that of the baseline where the metric has it, else the first."""
    values = distinct(frame[key])
    wanted = as_column(frame[key], study.baseline.get(key))
    return next((value for value in values if value == wanted), values[0])


def _along(of: _Quantity, frame: pd.DataFrame, key: str, reference: Any) -> str:
    """The values along a key, and what paired differences to the first say: of the last number, or of each word.

    The first word is the reference.
    """
    values = distinct(frame[key])
    if are_words(frame[key]):
        values.sort(key=lambda value: bool(value != reference))
    shown = values
    if len(values) > _MOST_VALUES:
        ends = [values[0], values[-1]]
        means = frame.groupby(key).value.mean()
        beyond = [] if are_words(frame[key]) else [means.idxmin(), means.idxmax()]
        shown = [value for value in values if value in (*ends, *beyond)]
    where = "with" if are_words(frame[key]) else "at"
    there: list[str] = []
    for value in shown:
        mean = _value(frame[frame[key] == value], of.metric)
        named = "" if there else f"{_named(frame, key)} "
        there.append(f"{mean} {where} {named}{_said(frame, key, value)}")
    text = _listed(there)
    if len(values) < 2:
        return f"{text}, its only value"
    if are_words(frame[key]) and len(shown) < len(values):
        text += f", {len(values) - len(shown)} others in the table below"
    compared = shown[1:] if are_words(frame[key]) else shown[-1:]
    verdicts = [_compared(of, frame, key, values[0], value) for value in compared]
    return f"{text}: {', '.join(dict.fromkeys(verdicts))}"


def _compared(of: _Quantity, frame: pd.DataFrame, key: str, first: Any, last: Any) -> str:
    """What the paired differences between two values of a key say."""
    of_first = frame[frame[key] == first]
    of_last = frame[frame[key] == last]
    pairs = of_first.merge(of_last, on="replicate", suffixes=("_first", "_last"))
    pairs = pairs.drop_duplicates("replicate").assign(value=pairs.value_last - pairs.value_first)
    where = "with" if are_words(frame[key]) else "at"
    return verdict(of, pairs, _said(frame, key, first), _said(frame, key, last), where)


def _listed(texts: Sequence[str]) -> str:
    *others, last = texts
    return f"{', '.join(others)} and {last}" if others else last


def verdict(of: _Quantity, pairs: pd.DataFrame, first: str, last: str, where: str = "at") -> str:
    """What paired differences of the last to the first say: a direction only if their 95 % interval excludes 0."""
    if not len(pairs):
        return f"no replicate has both {first} and {last}"
    (row,) = intervals(pairs.assign(metric=of.metric), ["metric"], bounds_of_difference).to_dict("records")
    n, mean = int(row["n"]), float(row["mean"])
    low, high = float(row["low"]), float(row["high"])
    if n < 2:
        return "one replicate cannot compare them"
    if low != low:
        return "the difference has no interval"
    unit = METRICS[of.metric].unit
    word = of.more if mean > 0 else of.less
    if high - low < _SAME * max(1.0, abs(mean)):
        apart = f"{word} by {_one(abs(mean), unit)}" if abs(mean) > _SAME else "the same"
        of_which = "" if where == "at" else f" {where} {last} as against {first}"  # several words are compared
        return f"{apart}{of_which} in each of the {n} replicates, which leaves no spread for an interval"
    span = f"difference {_one(mean, unit)} {_span(low, high)}"
    alike = _ALIKE_P * abs(float(pairs.value_first.mean()))
    if -alike < low and high < alike:
        return f"{last} is the same as {first} within {100 * _ALIKE_P:g} % ({span})"
    if low <= 0 <= high:
        return f"{n} replicates cannot tell {last} from {first} ({span})"
    return f"{word} {where} {last} than {where} {first} ({span})"


def _value(frame: pd.DataFrame, metric: str) -> str:
    """Mean over replicates with its interval, bounded as the metric is."""
    (row,) = intervals(frame, ["metric"], bounds_of).to_dict("records")
    unit, n = METRICS[metric].unit, int(row["n"])
    spread = float(frame.value.max() - frame.value.min())
    if n > 1 and spread < _SAME:
        return f"{_one(row['mean'], unit)} (the same in all {n} replicates)"
    if row["low"] != row["low"]:
        return f"{_one(row['mean'], unit)} ({'one replicate' if n == 1 else f'{n} replicates, no interval'})"
    return f"{_one(row['mean'], unit)} {_span(row['low'], row['high'])}"


def _censored(study: StudyResults, of: _Quantity, group: str) -> str:
    """How many encounters a run has, and how many had not ended when recording ended."""
    n = _of_runs(study, "encounters.n", group)
    open_p = _of_runs(study, "encounters.censored_right.share", group)
    if n.empty or open_p.empty or not of.metric.startswith("encounters.duration."):
        return ""
    count = _between(f"{n.min():,.0f}", f"{n.max():,.0f}")
    return f"a run has {count} encounters, and {_range(open_p)} of them had not ended when recording ended"


def _of_fewer(study: StudyResults, of: _Quantity, frame: pd.DataFrame) -> str:
    """That some means leave out replicates, and which way they err if those have no median."""
    of_points = frame.groupby(list(study.keys), dropna=False)
    n, asked = of_points.value.count().min(), study.points.replicate.nunique()
    if n == asked:
        return ""
    has_median = of.metric.startswith("encounters.duration.")
    why = ", and too short if in the others most encounters outlast the run" if has_median else ""
    return f"some means are of {n} of {asked} replicates{why}"


def _left_out(study: StudyResults, of: _Quantity) -> str:
    """Of a mean age, how many lookups it is of: those without an evaluation have none."""
    of_all = (study.summary.metric == "freshness.evaluation_within.share") & (study.summary.group == EVERYTHING)
    rows = study.summary[of_all]
    if rows.empty or not _is_age(of):
        return ""
    is_swept = _WINDOW in apart(study.points, study.keys)
    where = " at equal windows" if is_swept else ""
    return (
        f"a lookup that finds no evaluation has no age, so what is fresher is told by freshness.capped_age{where} and "
        f"by the share that finds a fresh one, {_range(rows['mean'])} on average"
    )


def _of_value(study: StudyResults, of: _Quantity) -> str:
    """How much of an age has passed since the server computed the value."""
    found = _of_runs(study, "freshness.value_age.mean_s", EVERYTHING)
    if found.empty or not _is_age(of) or not found.max() > 0:
        return ""
    span = _between(number(found.min()), number(found.max()))
    return f"{span} s of an age have passed since the server computed the value (trust.server_period_s)"


def _is_age(of: _Quantity) -> bool:
    return of.metric.startswith("freshness.newest_evaluation_age.")


def _of_runs(study: StudyResults, metric: str, group: str) -> pd.Series:
    """Values of a metric in all runs, not their means."""
    measures = study.measures
    return measures.value[(measures.metric == metric) & (measures.group == group)]


def _beyond(of: _Quantity, frame: pd.DataFrame) -> str:
    """Why a mean age can exceed the window of trust."""
    if not _is_age(of) or _WINDOW not in frame:
        return ""
    window_s = pd.to_numeric(frame[_WINDOW], errors="coerce")  # of "off" there is none
    means = frame.value.groupby(window_s).mean()
    if not (means > means.index).any():
        return ""
    return "ages exceed a short window because a vehicle uses a value until the next one arrives"


def _not_over(frame: pd.DataFrame) -> str:
    """That a share counts encounters that outlast the run, if they are many in one (`freshness.without_trust`)."""
    are_many = frame.note.str.contains("are not over").any()
    return "encounters that go on at the end of a run count as over then" if are_many else ""


def _in_the_open(study: StudyResults, of: _Quantity) -> str:
    """A city without buildings, in which ages are those of open country."""
    if not _is_age(of):
        return ""
    try:
        run = study.run(study.points.point.iloc[0])
    except (ValueError, OSError):  # a study can outlive its runs
        return ""
    buildings = str(run.manifest["summary"].get("buildings", ""))
    return "there are no buildings to block lines of sight" if buildings.startswith("none") else ""


def _range(shares: pd.Series) -> str:
    """From the smallest to the largest share, in per cent."""
    span = _between(f"{shares.min():.0%}", f"{shares.max():.0%}")
    return span.replace("%", " %")


def _between(low: str, high: str) -> str:
    return low if low == high else f"{low} to {high}"


def _named(frame: pd.DataFrame, key: str) -> str:
    """A key in the middle of a sentence, told apart from the other keys, which are columns."""
    return label_of(key, frame).partition(" [")[0]


def _at(frame: pd.DataFrame, key: str, value: Any) -> str:
    return f"{_named(frame, key)} {_said(frame, key, value)}"


def _said(frame: pd.DataFrame, key: str, value: Any) -> str:
    text = short_names(frame[key]).get(value, said(value))
    unit = label_of(key).partition(" [")[2].removesuffix("]")
    return f"{text} {unit}".strip() if _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _one(value: float, unit: str) -> str:
    return f"{number(value)} {'' if unit in ('', '1') else unit}".strip()


def _span(low: float, high: float) -> str:
    return f"[{number(low)}, {number(high)}]"
