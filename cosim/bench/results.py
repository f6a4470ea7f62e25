"""Measures the speed of writing and reading the largest table, with synthetic content."""

import tempfile
from pathlib import Path
from time import process_time

import numpy as np

from results.archive import open_run
from results.manifest import finish
from results.recorder import Recorder

N_VEHICLES = 1000
"""Each looks up 40 others in every step."""


def bench(steps: int = 120) -> list[tuple[str, float, str]]:
    """Measure writing and reading. Rows of (what, figure, unit)."""
    rng = np.random.default_rng(0)
    written_s, read_s, n_rows, n_bytes = _disk(rng, steps)
    return [
        ("recorder, table trust_lookups", n_rows / written_s / 1e6, "million rows per second"),
        ("reading it back", n_rows / read_s / 1e6, "million rows per second"),
        ("on disk", n_bytes / n_rows, "bytes per row"),
    ]


def _disk(rng: np.random.Generator, steps: int) -> tuple[float, float, int, int]:
    """Seconds to write and to read the table `trust_lookups`, its rows and its bytes."""
    receiver, subject = np.divmod(np.sort(rng.choice(N_VEHICLES**2, 40 * N_VEHICLES, replace=False)), N_VEHICLES)
    trust = rng.random(N_VEHICLES)
    with tempfile.TemporaryDirectory() as folder:
        begin = process_time()
        with Recorder(Path(folder), "standard") as recorder:
            for step in range(steps):
                recorder.append("trust_lookups", step, {
                    "variant": np.zeros(len(subject), np.int8),
                    "receiver": receiver, "subject": subject, "trust": trust[subject],
                    "source": np.zeros(len(subject), np.int8), "age_s": np.full(len(subject), step % 5 + 0.2),
                    "state": np.zeros(len(subject), np.int8), "n_evaluations": np.full(len(subject), step % 7),
                    "n_evaluators": None, "newest_evaluation_age_s": None, "oldest_evaluation_age_s": None,
                })  # fmt: skip
        written = process_time()
        finish(Path(folder), {"dt_s": 1.0, "config": {}})
        n_rows = len(open_run(folder).trust_lookups)
        read = process_time()
        n_bytes = sum(part.stat().st_size for part in (Path(folder) / "trust_lookups").iterdir())
    return written - begin, read - written, n_rows, n_bytes
