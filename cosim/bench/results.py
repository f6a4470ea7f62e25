"""How fast the room is on this machine: CPU time of the encounter tracker and of the recorder, on made-up traffic."""

import tempfile
from pathlib import Path
from time import process_time

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree

from results.archive import open_run
from results.encounters import EncounterParams, EncounterTracker
from results.manifest import finish
from results.recorder import Recorder

N_VEHICLES, AREA_M, REACH_M = 1000, 2000.0, 236.0
"""Gives each vehicle 40 neighbours."""


def bench(steps: int = 120) -> list[tuple[str, float, str]]:
    """What, figure, unit."""
    rng = np.random.default_rng(0)
    points, speed = rng.uniform(0, AREA_M, (N_VEHICLES, 2)), rng.normal(0, 8, (N_VEHICLES, 2))
    everyone = np.arange(N_VEHICLES)
    tracker = EncounterTracker(EncounterParams(radius_m=REACH_M, pairs="all"), 1.0)
    tracker_s, search_s, n_pairs = [], [], 0
    for step in range(steps):
        points = (points + speed) % AREA_M
        begin = process_time()
        a, b = _near(points)
        metres = np.hypot(*(points[a] - points[b]).T)
        found = process_time()
        tracker.update(step, a, b, metres, metres < 100, everyone)
        tracker.count_messages(np.r_[a, b], np.r_[b, a])
        tracker_s.append(process_time() - found)
        search_s.append(found - begin)
        n_pairs += len(a)
    written_s, read_s, n_rows, n_bytes = _disk(rng, steps)
    return [
        ("vehicles", N_VEHICLES, ""),
        ("neighbours of each, mean", 2 * n_pairs / steps / N_VEHICLES, ""),
        ("pairs within the radius, found", 1e3 * float(np.median(search_s)), "ms per step"),
        ("encounter tracker, messages counted", 1e3 * float(np.median(tracker_s)), "ms per step"),
        ("recorder, table trust_lookups", n_rows / written_s / 1e6, "million rows per second"),
        ("reading it back", n_rows / read_s / 1e6, "million rows per second"),
        ("on disk", n_bytes / n_rows, "bytes per row"),
    ]


def _near(points: ndarray) -> tuple[ndarray, ndarray]:
    pairs = cKDTree(points).query_pairs(REACH_M, output_type="ndarray")
    pair = np.sort((pairs[:, 0] << 32) | pairs[:, 1])
    return pair >> 32, pair & 0xFFFFFFFF


def _disk(rng: np.random.Generator, steps: int) -> tuple[float, float, int, int]:
    """Time to write and to read the table `trust_lookups` of that traffic, its rows and its bytes."""
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
