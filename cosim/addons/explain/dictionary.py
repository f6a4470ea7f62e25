"""The text of `results/TABLES.md`: every word, table, column and metric of a run."""

import math
from pathlib import Path

from cosim.addons.explain.glossary import GLOSSARY
from results import tables
from results.columns import LEVELS, Column
from results.metrics.registry import METRICS, TOPICS, Metric
from results.tables import SCHEMA_VERSION, TABLES, kept


def markdown() -> str:
    """The dictionary as Markdown."""
    lines = [
        "# Tables, metrics and words of a run",
        "",
        f"Schema version {SCHEMA_VERSION}. Written from `results/schema.toml`, `results/metrics/metrics.toml` (and "
        "those of add-ons) and "
        "`cosim/addons/explain/glossary.toml` by `python -m cosim.addons.explain.dictionary`.",
        "",
        "[Words](#words), [tables](#tables), [metrics](#metrics).",
        "",
        "# Words",
        "",
        "| word | meaning |",
        "|---|---|",
        *(f"| {word} | {GLOSSARY[word]} |" for word in sorted(GLOSSARY, key=str.lower)),
        "",
        "# Tables",
        "",
        "The columns marked `key` together identify a row. Columns marked `truth` hold ground truth, which only the",
        "simulation knows: no vehicle and no server reads them. `to 1/256` means that values are rounded to that",
        "fraction of the unit.",
        "",
        "``by `source` `` means that the column is not in the files. `open_run` copies it from the row of `detections`",
        "with the same `step` whose `observer` and `detection_index` are `source` and `source_index`. For `pose`, they",
        "are `pose` and `pose_index` where they are not null.",
        "",
        "The labels of `variant` and `role` differ between runs: the manifest lists them as `variants` and `roles`.",
        "",
        "Each record level keeps the tables of the level before and adds:",
        *_levels(),
    ]
    for name, table in TABLES.items():
        lines += [
            "",
            f"## {name}",
            f"{table.meaning} Kept from level `{table.level}` up. Key: {', '.join(table.key)}.",
            "",
            "| column | type | unit | notes | meaning |",
            "|---|---|---|---|---|",
            *(_row(label, column) for label, column in table.columns.items()),
        ]
    lines += [
        "",
        "# Metrics",
        "",
        "`cosim measure`, `run.measure()` and the report give these metrics. An identifier never changes its meaning.",
        "The group tells what a value belongs to, for example a role:",
        '`run.measure.value("trust.final.median", "malicious")` gives one value.',
        "`tests/verification/recompute_metrics.py` computes all metrics again from these definitions and the files.",
        "",
        "In tables with a column `variant`, only the rows of the measured trust variant count.",
        "",
        "Intervals are 95 % intervals. They are clustered by the units in the column `clustered by`, for example",
        "vehicles, not messages. The methods are:",
        "",
        "- shares and means: percentile intervals of the cluster bootstrap with 1,000 draws (Field and Welsh 2007),",
        "  expanded for few units (Hesterberg 2015); none for fewer than five units, or if the units are all alike;",
        "- shares of 0 or 1: intervals of Wilson (1927);",
        "- AUCs: intervals of Obuchowski (1997) on the logit scale, with Student's t;",
        "- medians over subjects: intervals between two order statistics (Conover 1999; Woodruff 1952 where pseudonyms",
        "  of one vehicle are among them);",
        "- Kaplan-Meier medians: intervals of Brookmeyer and Crowley (1982), of encounters as if all were independent,",
        "  of times to detection with the variance of Williams (1995);",
        "- means of encounters: Student's t, on the logit scale for quantities with two bounds and on the logarithmic",
        "  scale for quantities with one (Korn and Graubard 1998);",
        "- means over the replicates of a study: the same. Let m be the arithmetic mean of n replicates, s their",
        "  standard deviation (divisor n - 1), t the 97.5 % quantile of Student's t with n - 1 degrees of freedom, and",
        "  h = t s / sqrt(n). The interval of a quantity of 0 or more is m exp(-h / m) to m exp(h / m). That of a",
        "  quantity from L to U is L + (U - L) x at both ends x of expit(logit(p) - w) to expit(logit(p) + w), with",
        "  p = (m - L) / (U - L) and w = h / ((U - L) p (1 - p)). For n = 1, or m at a bound, there is none;",
        "- paired differences of replicates: the same, with the differences as values. A quantity from L to U has",
        "  differences from L - U to U - L. Those of a quantity with one bound have none: m - h to m + h.",
        "",
        "No interval leaves the range of its metric. Differences of a quantity between a and b lie between a - b and",
        "b - a.",
    ]
    for topic, about in TOPICS.items():
        lines += [
            "",
            f"## {topic}",
            about,
            "",
            "| metric | label | unit | range | group | definition | clustered by |",
            "|---|---|---|---|---|---|---|",
        ]
        for name, metric in METRICS.items():
            if name.startswith(topic + "."):
                lines.append(
                    f"| `{name}` | {metric.label} | {metric.unit} "
                    f"| {_range(metric)} | {metric.group} | {metric.definition} "
                    f"| {metric.unit_of_chance} |"
                )
    return "\n".join(lines) + "\n"


def _range(metric: Metric) -> str:
    """Bounds of a metric as text; empty if it has none."""
    low, high = metric.bounds
    if math.isinf(low):
        return ""
    return f"{low:g} or more" if math.isinf(high) else f"{low:g} to {high:g}"


def _levels() -> list[str]:
    """The tables that each record level adds to the level before."""
    lines, before = [], set[str]()
    for level in LEVELS:
        more = [f"`{name}`" for name in kept(level) if name not in before]
        lines += ["", f"- `{level}`: {', '.join(more)}."]
        before |= set(kept(level))
    return lines


def _row(name: str, column: Column) -> str:
    kind = f"category: {', '.join(column.categories)}" if column.categories else column.type
    notes = [
        *(["key"] if column.key else []),
        *(["may be null"] if column.null else []),
        *(["truth"] if column.truth else []),
        *(["labels of the run"] if column.labels_of_run else []),
        *([f"to 1/{2**column.bits}"] if column.bits else []),
        *([f"by `{column.via}`"] if column.via else []),
    ]
    cells = [f"`{name}`", kind, column.unit, ", ".join(notes), column.meaning]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    Path(tables.__file__).with_name("TABLES.md").write_text(markdown(), encoding="utf-8")
