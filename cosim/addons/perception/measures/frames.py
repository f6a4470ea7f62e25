"""Frames of a run: what is ahead of an equipped vehicle in a step, what it sees of it, and what it reports."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.addons.perception.kitti import LabelledObjects, Overlap, average_precision
from cosim.addons.perception.kitti_frames import (
    Lists,
    Poses,
    actors_ahead,
    at_steps,
    boxes_ahead,
    pair_keys,
    pairs_ahead,
    posed,
    sampled_steps,
)
from results.run import Run

_VISIBLE, _IGNORED = 0, 3
"""Levels of occlusion of objects that count, and of those that count neither as there nor as wrong."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Objects and boxes ahead of equipped vehicles within a range."""

    truth: LabelledObjects
    """Actors; their occlusion is that of `kitti_frames.actors_ahead`."""
    found: LabelledObjects
    poses: Poses
    """Observers by frame."""
    n_points: Int[ndarray, "t"]
    """Returns of the observer's own sweep from each actor."""

    @staticmethod
    def of(run: Run, which: Lists = "local", range_m: float = 140.0, most: int = 4000) -> "Frames":
        """About `most` frames, evenly spread over a run.

        Parameters
        ----------
        which
            The boxes: detections of the vehicle's own sensor, or its fused objects.
        """
        steps = sampled_steps(run, most)
        truth, poses = actors_ahead(run, steps, range_m)
        _, actors = posed(run, steps)
        i, j, _, _ = pairs_ahead(poses, actors, range_m)
        seen = run.table("observability", ["step", "observer", "actor", "n_points"], at_steps(steps))
        points = seen.set_index(["step", "observer", "actor"]).n_points
        own = points.reindex(pair_keys(poses, actors, i, j)).fillna(0).to_numpy(np.int64)
        return Frames(truth, boxes_ahead(run, which, steps, poses, range_m), poses, own)

    @property
    def range_m(self) -> Float[ndarray, "t"]:
        """Horizontal distance of each actor."""
        return range_of(self.truth)

    def precision(
        self,
        counts: Bool[ndarray, "t"],
        label: str,
        overlap: float,
        edges_m: tuple[float, float] = (0.0, np.inf),
        kind: Overlap = "3d",
    ) -> float:
        """Average precision over 40 recall points of actors within a range [%], whatever their height in the image.

        Parameters
        ----------
        counts
            Actors that count; the others count neither as there nor, where a box is on them, as wrong.
        """
        tall = np.full(len(self.truth), 1e3)
        level = np.where(counts, _VISIBLE, _IGNORED)
        truth = replace(self.truth, occlusion=level, height_px=tall)
        found = replace(self.found, height_px=np.full(len(self.found), 1e3))
        near_m, far_m = edges_m

        def within(objects: LabelledObjects) -> LabelledObjects:
            away_m = range_of(objects)
            return objects.take((away_m >= near_m) & (away_m < far_m))

        return average_precision(within(truth), within(found), label, kind, overlap)["hard"].ap40


def range_of(objects: LabelledObjects) -> Float[ndarray, "n"]:
    """Horizontal distance of objects from their observers [m]."""
    return np.hypot(objects.box[:, 0], objects.box[:, 1])
