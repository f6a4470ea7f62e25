"""What cooperation adds to average precision, and what delays and errors take from it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.validation.facts import Measured
from cosim.validation.measures.frames import Frames
from results.metrics.kitti_frames import Lists
from results.run import Run

_FRAMES = 2500


def late_gain(
    runs: Sequence[Run], *, overlaps: Sequence[float], range_m: float, partners_m: float, label: str = "car"
) -> Measured:
    """Average precision of fused objects minus that of the ego's own detections, over 40 recall points [points]."""
    found = [
        _precision(run, "fused", overlaps, range_m, partners_m, label)
        - _precision(run, "local", overlaps, range_m, partners_m, label)
        for run in runs
    ]
    return Measured.of_replicates(found)


def change_between_runs(
    runs: Sequence[Run], *, overlaps: Sequence[float], range_m: float, partners_m: float, label: str = "car"
) -> Measured:
    """Average precision of fused objects in the second half of the runs minus that in the first half [points].

    Run i of one half belongs to run i of the other one: they share seeds.
    """
    values = [_precision(run, "fused", overlaps, range_m, partners_m, label) for run in runs]
    half = len(values) // 2
    return Measured.of_replicates([after - before for before, after in zip(values[:half], values[half:], strict=True)])


def gain_left(
    runs: Sequence[Run], *, overlaps: Sequence[float], range_m: float, partners_m: float, label: str = "car"
) -> Measured:
    """As `late_gain`, but of the second half of the runs against the ego's own detections in the first half [points]."""
    half = len(runs) // 2
    found = [
        _precision(disturbed, "fused", overlaps, range_m, partners_m, label)
        - _precision(exact, "local", overlaps, range_m, partners_m, label)
        for exact, disturbed in zip(runs[:half], runs[half:], strict=True)
    ]
    return Measured.of_replicates(found)


def _precision(
    run: Run, which: Lists, overlaps: Sequence[float], range_m: float, partners_m: float, label: str
) -> Float[ndarray, "o"]:
    """Average precision of the objects that the ego or another equipped vehicle near it has a return of [%]."""
    frames = Frames.of(run, which, range_m, partners_m, _FRAMES)
    return np.array([frames.precision(frames.n_points_of_any > 0, label, one) for one in overlaps])
