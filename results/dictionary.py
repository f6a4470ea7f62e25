"""The dictionary of a run: every table, column and metric, and the words they use; the text of `results/TABLES.md`."""

import math
from pathlib import Path

from results.columns import LEVELS, Column
from results.glossary import GLOSSARY
from results.metrics.registry import METRICS, TOPICS, Metric
from results.tables import SCHEMA_VERSION, TABLES, kept


def markdown() -> str:
    """The dictionary as Markdown."""
    lines = [
        "# Tables, metrics and words of a run",
        "",
        f"Schema version {SCHEMA_VERSION}. Written from `results/tables.py`, `results/metrics/registry.py` and "
        "`results/glossary.py` by `python -m results.dictionary`.",
        "",
        "[Words](#words), [tables](#tables), [metrics](#metrics).",
        "",
        "# Words",
        "",
        "| word | meaning |",
        "|---|---|",
        *(f"| {word} | {meaning} |" for word, meaning in sorted(GLOSSARY.items(), key=lambda item: item[0].lower())),
        "",
        "# Tables",
        "",
        "Columns marked `key` together name a row. Columns marked `truth` are known to the simulation only: no vehicle",
        "and no server reads them. `to 1/256` says that stored values are rounded to that fraction of the unit.",
        "``by `source` `` says that the column is not in the files: it is that of the row of `detections` with the",
        "same `step` whose `observer` and `detection_index` are `source` and `source_index` (for `pose`: `pose` and",
        "`pose_index` where they are not null); `open_run` fills it in. Labels of `variant` and `role` are those of",
        "the run: its manifest lists them as `variants` and `roles`.",
        "",
        "Each record level keeps more than the one before:",
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
        "As `cosim measure`, `run.measure()` and the report give them. An identifier never changes its meaning; the",
        'group says what a value is of. `run.measure.value("trust.final.median", "malicious")` gives one.',
        "`tests/verification/recompute_metrics.py` computes them again from these definitions and the files alone.",
        "",
        "Of tables with a column `variant`, the rows of the measured trust variant count. Intervals are 95 %,",
        "clustered by what the column of that name says: vehicles, not messages. Shares and means have percentile",
        "intervals of the cluster bootstrap with 1,000 draws (Field and Welsh 2007), shares of 0 or 1 those of",
        "Wilson (1927), AUCs those of Obuchowski (1997) in the logit, medians over subjects those of two order",
        "statistics (Conover 1999), Kaplan-Meier medians those of Brookmeyer and Crowley (1982). Means of",
        "encounters, and of replicates of a study, have Student's t in the logit of quantities with two bounds and",
        "in the logarithm of those with one (Korn and Graubard 1998): no interval leaves the range. Differences of",
        "a quantity between a and b lie between a - b and b - a.",
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
        lines += [
            f"| `{name}` | {metric.label} | {metric.unit} | {_range(metric)} | {metric.group} | {metric.definition} "
            f"| {metric.unit_of_chance} |"
            for name, metric in METRICS.items() if name.startswith(topic + ".")
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _range(metric: Metric) -> str:
    """Bounds of a metric; empty where it has none."""
    low, high = metric.bounds
    if math.isinf(low):
        return ""
    return f"{low:g} or more" if math.isinf(high) else f"{low:g} to {high:g}"


def _levels() -> list[str]:
    """What each record level adds to the one before."""
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
    return f"| `{name}` | {kind} | {column.unit} | {', '.join(notes)} | {column.meaning} |"


if __name__ == "__main__":
    Path(__file__).with_name("TABLES.md").write_text(markdown(), encoding="utf-8")
