"""Judges facts, and writes the report: a page and a picture for each group of facts, an overview, and JSON."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cosim import __version__
from cosim.addons.compare import figure as pictures
from cosim.addons.compare.facts import Fact, Judged
from cosim.addons.compare.measures import measured
from cosim.addons.compare.runs import Runs
from cosim.base import durable
from results.figures import style

Advance = Callable[[str, int, int], None]

MARKS = {"agrees": "agrees", "differs": "**differs**", "undecided": "undecided", "not computed": "**not computed**"}


def judge(facts: Sequence[Fact], runs: Runs, advance: Advance = lambda *_: None) -> list[Judged]:
    """What cosim computes for each fact. Runs that hold too little leave a fact without a value, with the reason."""
    found = []
    for number, fact in enumerate(facts):
        advance("facts", number, len(facts))
        try:
            behind = [run for name in fact.runs for run in runs.of(name)]
            found.append(Judged(fact, measured(fact.measure, behind, fact.options)))
        except ValueError as error:
            found.append(Judged(fact, None, str(error)))
    advance("facts", len(facts), len(facts))
    return found


def write(judged: Sequence[Judged], runs: Runs, out: Path) -> list[Path]:
    """Write the report into a folder.

    Returns
    -------
    The files: `index.md`, `validation.json`, and a page and a picture per group.
    """
    groups = list(dict.fromkeys(one.fact.group for one in judged))
    files = []
    for group in groups:
        mine = [one for one in judged if one.fact.group == group]
        picture = style.save(pictures.draw([_panel(one) for one in mine]), out / f"{group}.png")
        page = out / f"{group}.md"
        durable.write_output(page, "\n".join(_page(group, mine, picture.name)).encode())
        files += [page, picture]
    index, plain = out / "index.md", out / "validation.json"
    durable.write_output(index, "\n".join(_index(judged, runs)).encode())
    durable.write_output(plain, (json.dumps(as_data(judged, runs), indent=1) + "\n").encode())
    return [index, plain, *files]


def summary(judged: Sequence[Judged]) -> str:
    """One sentence with the counts."""
    n = {verdict: sum(one.verdict == verdict for one in judged) for verdict in MARKS}
    fitted = sum(one.verdict == "agrees" and one.fact.judges == "fitted" for one in judged)
    words = [f"{count} {verdict}" for verdict, count in n.items() if count]
    sources = len({one.fact.source.split(",")[0] for one in judged})
    return (
        f"{len(judged)} facts of {sources} sources: {', '.join(words)}. Of those that agree, {fitted} are "
        "values to which a model was fitted."
    )


def lost(judged: Sequence[Judged]) -> list[str]:
    """A line for each agreement that is stated and lost."""
    return [
        f"{one.fact.id}: stated to agree, {one.verdict}: {_ours(one)}, published {_published(one.fact)}. "
        + (one.problem or one.fact.source)
        for one in judged if one.is_lost
    ]  # fmt: skip


def gained(judged: Sequence[Judged]) -> list[str]:
    """A line for each fact that is stated to differ and agrees."""
    return [
        f"{one.fact.id}: stated to differ, but agrees. Set its verdict to agrees in facts.toml."
        for one in judged if one.fact.verdict == "differs" and one.verdict == "agrees"
    ]  # fmt: skip


def as_data(judged: Sequence[Judged], runs: Runs) -> dict[str, Any]:
    """The report as plain data."""
    return {
        "cosim": __version__, "form": "full" if runs.is_full else "quick", "facts": [_record(one) for one in judged]
    }  # fmt: skip


def _record(one: Judged) -> dict[str, Any]:
    fact = one.fact
    ours = None if one.ours is None else {
        "value": _plain(one.ours.value), "low": _plain(one.ours.low), "high": _plain(one.ours.high), "n": one.ours.n,
    }  # fmt: skip
    return {
        "id": fact.id, "group": fact.group, "quantity": fact.quantity, "unit": fact.unit, "at": list(fact.at),
        "published": list(fact.value), "uncertainty": list(fact.uncertainty), "compare": fact.compare,
        "source": fact.source, "conditions": fact.conditions, "how": fact.how, "judges": fact.judges, "ours": ours,
        "problem": one.problem, "stated": fact.verdict, "verdict": one.verdict, "reason": fact.reason,
    }  # fmt: skip


def _plain(values: Any) -> list[float | None]:
    return [float(v) if math.isfinite(v) else None for v in values]


def _panel(one: Judged) -> pictures.Panel:
    fact, ours = one.fact, one.ours
    empty = [math.nan] * len(fact.value)
    value, low, high = (empty, empty, empty) if ours is None else (ours.value, ours.low, ours.high)
    return pictures.Panel(fact.id, fact.unit, fact.at, fact.value, fact.low, fact.high, value, low, high, one.verdict)


def _index(judged: Sequence[Judged], runs: Runs) -> list[str]:
    form = "full" if runs.is_full else "quick"
    lines = [
        "# Validation", "",
        f"`cosim validate{' --full' if runs.is_full else ''}` wrote these pages with cosim {__version__}. "
        f"{summary(judged)}", "",
        f"Runs behind the facts are of the {form} form. `agrees`: every value of ours lies in the band of "
        "the published one. `differs`: an interval of ours, 95 % over replicates, misses its band. "
        "`undecided`: neither.", "",
        "| fact | quantity | published | ours | verdict | stated |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for one in judged:
        fact = one.fact
        lines.append(
            f"| [{fact.id}]({fact.group}.md#{_anchor(fact.id)}) | {fact.quantity}{_unit(fact)} | {_published(fact)} | "
            f"{_ours(one)} | {MARKS[one.verdict]} | {fact.verdict} |"
        )
    lines += ["", "## Runs", "", "| name | what | replicates | seconds |", "|---|---|---|---|"]
    for name in dict.fromkeys(name for one in judged for name in one.fact.runs):
        plan = runs.plans[name]
        n, duration_s = plan.full if runs.is_full else plan.quick
        lines.append(f"| {name} | {plan.what} | {n} | {duration_s:g} |")
    return [*lines, ""]


def _page(group: str, judged: Sequence[Judged], picture: str) -> list[str]:
    lines = [f"# {group.capitalize()}", "", f"![published values and ours]({picture})", ""]
    for one in judged:
        fact = one.fact
        n = 0 if one.ours is None else one.ours.n
        lines += [
            f"## {fact.id}", "", f"{fact.quantity[0].upper()}{fact.quantity[1:]}{_unit(fact)}.", "",
            "| | published | ours | |", "|---|---|---|---|",
        ]  # fmt: skip
        for k, at in enumerate(fact.at):
            ours = "-" if one.ours is None else _with_interval(one.ours.value[k], one.ours.low[k], one.ours.high[k])
            mark = "" if one.ours is None else "in" if one.inside[k] else "out"
            lines.append(f"| {at} | {_value(fact, k)} | {ours} | {mark} |")
        lines += [
            "", f"- Verdict: {MARKS[one.verdict]} (stated: {fact.verdict}).",
            f"- Source: {fact.source}.", f"- Conditions: {fact.conditions}.",
            *([f"- Uncertainty: {fact.uncertainty_why}."] if fact.uncertainty_why else []),
            f"- Ours: {fact.how}. " + (f"{n} replicates." if fact.runs else "No chance between runs."),
            *(["- A model was fitted to these values: agreement says that the fit is good."]
              if fact.judges == "fitted" else []),
            *([f"- Why it differs: {fact.reason}."] if fact.reason else []),
            *([f"- Not computed: {one.problem}"] if one.problem else []), "",
        ]  # fmt: skip
    return lines


def _anchor(id: str) -> str:
    """The anchor that Markdown makes of a heading."""
    return "".join(c for c in id.lower() if c.isalnum() or c in "-_")


def _unit(fact: Fact) -> str:
    return f" [{fact.unit}]" if fact.unit else ""


def _published(fact: Fact) -> str:
    return ", ".join(_value(fact, k) for k in range(len(fact.value)))


def _value(fact: Fact, k: int) -> str:
    value = f"{fact.value[k]:g}"
    if fact.compare != "within":
        return f"{fact.compare.replace('_', ' ')} {value}"
    half = fact.uncertainty[k if len(fact.uncertainty) > 1 else 0]
    return f"{value} ±{half:g}"


def _ours(one: Judged) -> str:
    if one.ours is None:
        return "-"
    return ", ".join(
        _with_interval(*three) for three in zip(one.ours.value, one.ours.low, one.ours.high, strict=True)
    )  # fmt: skip


def _with_interval(value: float, low: float, high: float) -> str:
    """Four digits, and the interval if there is one."""
    if not math.isfinite(value):
        return "-"
    if low == high == value or not math.isfinite(low):
        return f"{value:.4g}"
    return f"{value:.4g} ({low:.4g} to {high:.4g})"
