"""Every metric by its identifier, as `metrics.toml` declares it: label, unit, definition, bounds, and its source.

An identifier is `<topic>.<name>` or `<topic>.<name>.<statistic>` and never changes its meaning. A metric may be split
by role, message type or definition of an encounter. `measure` then has one row per group.
"""

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.addons import data_files


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """A number that summarizes a run."""

    label: str
    unit: str = ""
    """Unit; "1" for shares and ratios, empty for counts."""
    definition: str
    group: str = ""
    """What the group of a value stands for; empty if the metric has no groups."""
    unit_of_chance: str = ""
    """Units by which the interval is clustered; empty if the metric has no interval."""
    range: Sequence[float] | None = None
    """Smallest and largest possible value. None means that the unit determines them: 0 to 1 for shares, 0 to 100 for
    per cent, and 0 or more for other units."""
    source: str = ""
    """Address of the function whose result has the values; `module.function` is one of `results.metrics`."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments of this function."""
    needs: Sequence[str] = ()
    """Tables without which a run simply has no such value. Without rows in others, its topic is not measured."""
    counts: bool = False
    """Whether a table of `needs` that is there without rows is a count of 0. Otherwise the run has no such value."""
    where: Mapping[str, str] = field(default_factory=dict)
    """Values by which rows of the result are chosen."""
    column: str = ""
    """Column of the result that has the values."""
    named: str = ""
    """Name of the group of a row; `{column}` stands for what the row has in a column."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest possible value."""
        largest = {"1": 1.0, "%": 100.0}.get(self.unit, math.inf)
        low, high = self.range or (0.0, largest)
        return low, high


def bounds_of(metric: str) -> tuple[float, float]:
    """Bounds of a metric; (-inf, inf) for an unknown metric, such as a user's own."""
    return METRICS[metric].bounds if metric in METRICS else (-math.inf, math.inf)


def _read() -> tuple[dict[str, str], dict[str, Metric]]:
    """Topics and metrics of the core's file and of those of add-ons."""
    topics: dict[str, str] = {}
    metrics: dict[str, Metric] = {}
    for path in (Path(__file__).with_name(FILE), *data_files(FILE)):
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        topics |= document.pop("topics", {})
        texts = document.pop("texts", {})
        metrics |= {name: _metric(keys, texts) for name, keys in document.items()}
    for topic in topics:
        metrics[f"{topic}.not_measured"] = Metric(label="not measured", definition=_NOT_MEASURED, group="reason")
    return topics, metrics


def _metric(keys: dict[str, Any], texts: Mapping[str, str]) -> Metric:
    """A section of a file. `{name}` in a definition stands for a sentence of the file's section `texts`."""
    definition = re.sub(r"\{(\w+)\}", lambda word: texts[word[1]], keys["definition"])
    source = keys.get("source", "")
    if source and ":" not in source:
        source = "results.metrics." + source.replace(".", ":")
    return Metric(**keys | {"definition": definition, "source": source})


FILE = "metrics.toml"
_NOT_MEASURED = "The run does not contain the data; the group gives the reason."
TOPICS, METRICS = _read()

CORE: tuple[str, ...] = (
    "encounters.duration.km_median_s",
    "encounters.per_vehicle_h",
    "freshness.newest_evaluation_age.mean_s:all",
    "freshness.evaluation_within.share:all",
    "freshness.encounters_without_trust.share",
    "trust.final.median",
    "misbehaviour.at_lookup.auc:malicious",
    "radio.pdr.all",
)
"""The eight metrics to read first, each as `identifier` or `identifier:group`.

How long equipped vehicles meet, and how often. How old the trust is that they use, how often it is fresh, and how often
an encounter is over before there is any. What honest and malicious vehicles are trusted, and how well trust tells them
apart. How much of what is sent arrives. The age is a mean, because ages move in whole steps: the medians of replicates
are often equal, and leave no spread to judge by.
"""
