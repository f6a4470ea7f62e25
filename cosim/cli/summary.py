"""The summary of a run: a few lines, one per topic, which begin with numbers."""

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cosim.cli.console import plain, print_facts, print_json, rows_of
from results.archive import open_run
from results.figures import style, trust
from results.measure import measure
from results.metrics.registry import METRICS
from results.run import Run

Rows = Mapping[str, Mapping[str, Any]]
"""Rows of `measure` of one metric by group: value, low, high, note."""
Get = Callable[[str], Rows]
"""Rows of a metric by its name; empty if the metric has no value."""

TOPICS = ("traffic", "encounters", "trust", "misbehaviour", "freshness", "radio")
"""Topics of the metrics that the summary uses."""


def print_run_summary(folder: Path, as_json: bool) -> Run:
    """Print a summary of a run in a few lines, and draw trust over time into its folder.

    Returns
    -------
    The run. Its attribute `damage` lists what could not be shown.
    """
    run = open_run(folder)
    try:
        picture = f"picture {style.save(trust.draw([run]), folder / 'trust.png')}"
    except ValueError:  # there is no trust to draw
        picture = "no picture of trust"
    manifest = run.manifest
    spent_s = sum(manifest["timings_s"].values())
    if as_json:
        measures = rows_of(measure(run, max_frames=200))
        print_json({"run": str(folder), "summary": manifest["summary"], "seconds": spent_s, "measures": measures})
        return run
    get = _rows_by_metric(run)
    first_step, since = 0, ""
    if resumed_at := manifest.get("resumed_at"):
        first_step = resumed_at[-1]
        since = f" since step {first_step:,}, where it was resumed"
    simulated_s = (manifest["steps"] - first_step) * run.dt_s
    times = f"{plain(simulated_s / spent_s)} times real time"
    given = shlex.quote(str(folder))
    facts = _summary(get, manifest.get("net", {}).get("name", "the network"), run.config["sensing"])
    facts["time"] = [f"{spent_s:.1f} s of computing{since}, {times}; wrote {folder}, {picture}"]
    facts["next"] = [f"cosim report {given}   cosim measure {given}" + _plot(get, given)]
    print_facts(facts)
    return run


def _rows_by_metric(run: Run) -> Get:
    """Metrics of a run by name."""
    found: dict[str, dict[str, Any]] = {}
    for row in measure(run, topics=TOPICS).to_dict("records"):
        found.setdefault(row["metric"], {})[row["group"]] = row

    def get(metric: str) -> Rows:
        assert metric in METRICS and metric.startswith(TOPICS), metric
        return found.get(metric, {})

    return get


def _plot(get: Get, given: str) -> str:
    """A command that draws a figure of this run; empty if the run has nothing to draw."""
    for picture, metric in (("radio", "radio.pdr.all"), ("encounters", "encounters.n")):
        if any(_values(get(metric)).values()):
            return f"   cosim plot {picture} {given}"
    return ""


def _summary(get: Get, city: str, has_sensing: bool) -> dict[str, list[str]]:
    """Sentences of the summary by topic."""
    facts = {"traffic": _traffic(get, city), "encounters": _encounters(get)}
    if not has_sensing:
        return facts | {"sensing": ["false: no vehicle senses or sends, and no trust is computed"]}
    facts["trust"] = _trust(get)
    if apart := _told_apart(get):
        facts["told apart"] = apart
    return facts | {"freshness": _freshness(get), "radio": _radio(get)}


def _values(rows: Rows) -> dict[str, float]:
    """The value of each group."""
    return {group: row["value"] for group, row in rows.items()}


def _whole(get: Get, metric: str) -> float | None:
    """The value of a metric that has no groups; None if there is none."""
    row = get(metric).get("")
    return None if row is None else row["value"]


def _traffic(get: Get, city: str) -> list[str]:
    actors, roles = _values(get("traffic.actors.mean")), _values(get("traffic.equipped.n"))
    n_actors = _counted(round(actors.get("all", 0.0)), "actor")
    lasts_s = get("traffic.duration_s")[""]["value"]
    line = f"{n_actors} on the road of {city} for {plain(lasts_s)} s"
    n_equipped = sum(roles.values())
    if not n_equipped:
        return [f"{line}; no vehicle with LiDAR and radio"]
    by_role = [f"{plain(n)} {role}" for role, n in roles.items()]
    return [f"{line}; {_counted(n_equipped, 'vehicle')} with LiDAR and radio ({', '.join(by_role)})"]


def _counted(n: float, noun: str) -> str:
    return f"{plain(n)} {noun}" if n == 1 else f"{plain(n)} {noun}s"


def _encounters(get: Get) -> list[str]:
    median_s, mean_s = _values(get("encounters.duration.km_median_s")), get("encounters.duration.km_mean_s")
    lines = []
    for definition, n in _values(get("encounters.n")).items():
        said = f"{plain(n)} ({definition})"
        if definition in median_s:
            said += f": half of them last longer than {plain(median_s[definition])} s"
        elif definition in mean_s and mean_s[definition]["note"]:
            said += f": {mean_s[definition]['note']}"
        lines.append(said)
    return lines or ["none: the config defines no [[encounters]]"]


def _trust(get: Get) -> list[str]:
    final = get("trust.final.median")
    if not final:
        return ["no trust was computed; `cosim measure RUN --metric trust` says why"]
    medians = [f"{row['value']:.2f} {role}" for role, row in final.items()]
    return [f"{', '.join(medians)}: medians of last values, from 0 to 1"]


def _told_apart(get: Get) -> list[str]:
    """How often an honest vehicle has more trust than one of another role, in one line."""
    at_lookup = get("misbehaviour.at_lookup.auc")
    found = at_lookup or get("misbehaviour.auc")
    parts: list[str] = []
    for role, row in found.items():
        parts.append(_comparison(role, row, is_first=not parts))
    if parts:
        parts[-1] += ", when trust is looked up" if at_lookup else ", over the run"
    final = get("trust.final.median")
    idle = [role for role, row in final.items() if row["note"].startswith("has not attacked")]
    if idle:
        parts.append(f"no {' or '.join(idle)} vehicle has attacked: until then they behave as honest ones")
    return ["; ".join(parts)] if parts else []


def _a(word: str) -> str:
    """A role with its article: an honest vehicle, a malicious one."""
    return f"{'an' if word.startswith(('a', 'e', 'i', 'o', 'u', 'honest')) else 'a'} {word}"


def _comparison(role: str, row: Mapping[str, Any], is_first: bool) -> str:
    """The area under the ROC curve in words. If its interval contains 0.5, it may be chance."""
    low, high = row["low"], row["high"]
    known = low == low and high == high
    chance = ": may be chance" if known and low <= 0.5 <= high else ""
    interval = f" ({'95 % interval ' if is_first else ''}{low:.0%} to {high:.0%}{chance})" if known else ""
    who = "an honest vehicle has more trust than " if is_first else "than "
    return f"{row['value']:.0%} of the time {who}{_a(role)} one{interval}"


def _freshness(get: Get) -> list[str]:
    state = _values(get("freshness.lookup_state.share"))
    if not state:
        return ["no vehicle looked up a trust value"]
    parts = []
    if (mean := get("freshness.newest_evaluation_age.mean_s").get("all")) is not None:
        said = f"{mean['value']:.1f} s old on average is the newest evaluation behind a trust value that is used"
        if (p90 := get("freshness.newest_evaluation_age.p90_s").get("all")) is not None:
            said += f", and one in ten is older than {p90['value']:.1f} s"
        parts.append(said)
    evaluated = state["evaluated, all"]
    parts.append(f"{evaluated:.0%} of lookups find a value that rests on evaluations that still count")
    return ["; ".join(parts)]


def _radio(get: Get) -> list[str]:
    delivered = _whole(get, "radio.pdr.all")
    if delivered is None:
        return ["nothing was sent within range of another vehicle"]
    parts = [f"{delivered:.0%} of frames received by vehicles in range"]
    expired = _whole(get, "radio.lost.expired")
    if expired is not None and expired > 0.01:
        parts.append(f"{expired:.0%} expired before they could be sent")
    if (complete := _whole(get, "radio.clouds_complete.share")) is not None:
        parts.append(f"{complete:.0%} of point clouds arrive whole")
    if (busy := _whole(get, "radio.cbr.mean")) is not None:
        parts.append(f"{busy:.1%} of the time the channel is busy")
    if (between_s := _whole(get, "radio.pir.mean_s")) is not None:
        parts.append(f"{between_s:.1f} s between messages of a pair")
    return ["; ".join(parts)]
