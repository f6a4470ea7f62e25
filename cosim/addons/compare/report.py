"""Facts beside what cosim computes: a page with figures, the same table as Markdown, and JSON."""

import json
import math
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

from cosim import __version__
from cosim.addons.compare import figure as pictures
from cosim.addons.compare.facts import ComparedFact, Fact, Measured
from cosim.addons.compare.measures import measured
from cosim.addons.compare.runs import GivenRuns, PlannedRuns
from cosim.base import durable
from cosim.runs.drive import Advance
from results.figures import style
from results.report import STYLE

Runs = PlannedRuns | GivenRuns
COLUMNS = ("fact", "quantity", "published", "cosim", "verdict")


def compare(facts: Sequence[Fact], runs: Runs, advance: Advance = lambda *_: None) -> list[ComparedFact]:
    """What cosim computes for each fact. Runs that hold too little leave a fact without a value, with the reason.

    A fact with a condition that our runs cannot have is measured in the user's own runs alone.
    """
    found = []
    for number, fact in enumerate(facts):
        advance("facts", number, len(facts), "")
        if not fact.measure or (fact.verdict == "cannot be set" and isinstance(runs, PlannedRuns)):
            found.append(ComparedFact(fact, None))
            continue
        try:
            ours = measured(fact.measure, [runs.of(name) for name in fact.runs], fact.options)
            unlike = tuple(line for name in fact.runs for line in runs.unlike(name))
            found.append(ComparedFact(fact, ours, unlike=unlike))
        except ValueError as error:
            found.append(ComparedFact(fact, None, str(error)))
    advance("facts", len(facts), len(facts), "")
    return found


def write(compared: Sequence[ComparedFact], runs: Runs, out: Path) -> list[Path]:
    """Write the report into a folder: `compare.html`, `compare.md` and `compare.json`."""
    texts = {
        "compare.html": _page(compared, runs),
        "compare.md": "\n".join(markdown(compared)),
        "compare.json": json.dumps(as_data(compared, runs), indent=1),
    }
    for name, text in texts.items():
        durable.write_output(out / name, f"{text}\n".encode())
    return [out / name for name in texts]


def counts(compared: Sequence[ComparedFact]) -> dict[str, int]:
    """How many facts have each verdict."""
    names = [one.verdict for one in compared]
    return {name: names.count(name) for name in dict.fromkeys(names)}


def summary(compared: Sequence[ComparedFact]) -> str:
    """One sentence with the counts."""
    fitted = sum(one.verdict == "agrees" and one.fact.judges == "fitted" for one in compared)
    words = []
    for verdict, n in counts(compared).items():
        words.append(f"{n} {_WORDS.get(verdict, verdict)}")
    sources = len({one.fact.source.split(",")[0] for one in compared})
    return (
        f"{len(compared)} facts of {sources} sources: {', '.join(words)}. Of those that agree, {fitted} are values to "
        "which a model was fitted."
    )


_WORDS = {"agrees": "agree", "differs": "differ", "undecided": "are undecided"}


def lost(compared: Sequence[ComparedFact]) -> list[str]:
    """A line for each agreement that is stated and lost."""
    lines = []
    for one in compared:
        if one.is_lost:
            values = f"{_ours(one)}, published {_published(one.fact)}"
            reason = one.problem or one.fact.source
            lines.append(f"{one.fact.id}: stated to agree, {one.verdict}: {values}. {reason}")
    return lines


def gained(compared: Sequence[ComparedFact]) -> list[str]:
    """A line for each fact that is stated not to agree and agrees."""
    return [
        f"{one.fact.id}: stated: {one.fact.verdict}, but it agrees. Set its verdict to agrees in facts.toml."
        for one in compared
        if one.fact.verdict != "agrees" and one.verdict == "agrees"
    ]


def as_data(compared: Sequence[ComparedFact], runs: Runs) -> dict[str, Any]:
    """The report as plain data."""
    return {"cosim": __version__, "runs": runs.what, "facts": [_record(one) for one in compared]}


def _record(one: ComparedFact) -> dict[str, Any]:
    fact, ours = one.fact, one.ours
    names = ("id", "group", "quantity", "unit", "compare", "source", "conditions", "how", "judges", "reason")
    record: dict[str, Any] = {name: getattr(fact, name) for name in names}
    record |= {"at": list(fact.at), "published": list(fact.value), "uncertainty": list(fact.uncertainty)}
    if ours is not None:
        record |= {
            "value": _plain(ours.value),
            "low": _plain(ours.low),
            "high": _plain(ours.high),
            "n": ours.n,
        }
    return record | {"problem": one.problem, "unlike": list(one.unlike), "stated": fact.verdict, "verdict": one.verdict}


def _plain(values: Any) -> list[float | None]:
    return [float(v) if math.isfinite(v) else None for v in values]


def cells(one: ComparedFact) -> tuple[str, str, str, str, str]:
    """A row of the table of facts, by `COLUMNS`."""
    fact = one.fact
    unit = f" [{fact.unit}]" if fact.unit else ""
    return fact.id, f"{fact.quantity}{unit}", _published(fact), _ours(one), one.verdict


def markdown(compared: Sequence[ComparedFact]) -> Iterator[str]:
    """The table of facts, one line after another."""
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|---" * len(COLUMNS) + "|"
    for one in compared:
        yield f"| {' | '.join(cells(one))} |"


def _page(compared: Sequence[ComparedFact], runs: Runs) -> str:
    """The page as HTML; it needs no network and no other file."""
    parts = [f"<h1>Beside measurements</h1><p>{escape(summary(compared))}</p>", _WHAT.format(escape(runs.what))]
    for group in dict.fromkeys(one.fact.group for one in compared):
        mine = [one for one in compared if one.fact.group == group]
        parts.append(f"<h2>{escape(group)}</h2>")
        if panels := [_panel(one, one.ours) for one in mine if one.ours is not None]:
            url = style.data_url(pictures.draw(panels))
            parts.append(f'<img src="{url}" style="max-width:560px" alt="published values and those of cosim">')
        head = "".join(f"<th>{name}</th>" for name in COLUMNS)
        rows = "".join(map(_row, mine))
        parts.append(f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>')
        parts += [_details(one) for one in mine]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Beside measurements</title>'
        f"<style>{STYLE}</style></head>\n<body>\n" + "\n".join(parts) + "\n</body></html>"
    )


def _row(one: ComparedFact) -> str:
    texts = "".join(f"<td>{escape(cell)}</td>" for cell in cells(one))
    return f"<tr>{texts}</tr>"


_WHAT = (
    f"<p>Written by <code>cosim compare</code> {__version__} from {{}}. <b>agrees</b>: every value of ours lies in the "
    "band of the published one. <b>differs</b>: an interval of ours, 95 % over replicates, misses its band. "
    "<b>undecided</b>: neither. <b>cannot be set</b>: our runs cannot have a condition of the value.</p>"
)


def _details(one: ComparedFact) -> str:
    """What a fact rests on, folded."""
    fact = one.fact
    places = ", ".join(at for at in fact.at if at)
    said = {
        "Values": places,
        "Source": fact.source,
        "Conditions": fact.conditions,
        "Band": fact.uncertainty_why,
        "Ours": fact.how,
        "Replicates": str(one.ours.n) if one.ours is not None and fact.runs else "",
        "Fitted": "a model was fitted to these values" if fact.judges == "fitted" else "",
        "But your runs have": "; ".join(one.unlike),
        "Stated": fact.verdict,
        "Reason": fact.reason,
        "Not computed": one.problem,
    }
    lines = ""
    for name, text in said.items():
        if text:
            lines += f"<li><b>{name}</b>: {escape(text)}</li>"
    return f"<details><summary>{escape(fact.id)}: {one.verdict}</summary><ul>{lines}</ul></details>"


def _panel(one: ComparedFact, ours: Measured) -> pictures.Panel:
    fact = one.fact
    return pictures.Panel(
        fact.id,
        fact.unit,
        fact.at,
        fact.value,
        fact.low,
        fact.high,
        ours.value,
        ours.low,
        ours.high,
        one.verdict,
    )


def _published(fact: Fact) -> str:
    return ", ".join(_value(fact, k) for k in range(len(fact.value))) or "-"


def _value(fact: Fact, k: int) -> str:
    value = f"{fact.value[k]:g}"
    if fact.compare != "within":
        return f"{fact.compare.replace('_', ' ')} {value}"
    half = fact.uncertainty[k if len(fact.uncertainty) > 1 else 0]
    return f"{value} ±{half:g}"


def _ours(one: ComparedFact) -> str:
    if one.ours is None:
        return "-"
    return ", ".join(map(_with_interval, one.ours.value, one.ours.low, one.ours.high))


def _with_interval(value: float, low: float, high: float) -> str:
    """Four digits, and the interval if there is one."""
    if not math.isfinite(value):
        return "-"
    if low == high == value or not math.isfinite(low):
        return f"{value:.4g}"
    return f"{value:.4g} ({low:.4g} to {high:.4g})"
