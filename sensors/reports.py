"""Keys of a detector's random draws, and the reports that it returns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.base.hash_rng import mix_rows, normals, uniforms
from cosim.base.rows import Rows
from sensors.boxes import Boxes
from sensors.evidence import Observability

_OBJECT = np.uint64(1 << 40)
"""Extends the key of sites to one of objects; sites use small numbers."""


@dataclass(frozen=True, slots=True)
class DetectorDraws:
    """Keys of the noise draws of one step, for m observers and n actors.

    `cosim.base.hash_rng` makes uniforms and normals of keys. Equal keys give equal draws, so a draw depends neither on
    the order of the rows nor on who else is present.
    """

    time_s: float
    actor: UInt64[ndarray, "n"]
    """Identity of each actor, the same in every step."""
    observer_step: UInt64[ndarray, "m"]
    """Per observer, new in every step."""
    observer: UInt64[ndarray, "m"]
    """Per observer, the same in every step."""
    site: np.uint64
    """Common to all observers, the same in every step: false positives that several observers share."""
    site_step: UInt64[ndarray, "m"]
    """Per observer, new in every step: false positives."""
    site_observer: UInt64[ndarray, "m"]
    """Per observer, the same in every step: false positives that persist."""

    def pair_step(self, seen: Observability) -> UInt64[ndarray, "s"]:
        """A key for each row of `seen`: one per (observer, actor), new in every step."""
        return mix_rows(self.observer_step[seen.observer], self.actor[seen.actor])

    def pair(self, seen: Observability) -> UInt64[ndarray, "s"]:
        """A key for each row of `seen`: one per (observer, actor), the same in every step."""
        return mix_rows(self.observer[seen.observer], self.actor[seen.actor])

    def object(self, seen: Observability) -> UInt64[ndarray, "s"]:
        """A key for each row of `seen`: one per actor, the same for all observers and in every step."""
        prefix = mix_rows(np.array([self.site]), np.array([_OBJECT]))
        return mix_rows(prefix, self.actor[seen.actor])

    def uniforms(self, seen: Observability, n: int = 1) -> Float[ndarray, "s n"]:
        """Uniform draws for each (observer, actor), new in every step.

        Returns
        -------
        `n` uniforms in [0, 1) for each row of `seen`. The first columns do not depend on `n`.
        """
        return uniforms(self.pair_step(seen), n)

    def normals(self, seen: Observability, n: int = 1) -> Float[ndarray, "s n"]:
        """Standard normal draws for each (observer, actor), new in every step.

        Returns
        -------
        `n` standard normals for each row of `seen`. Column j is a function of column j of `uniforms`.
        """
        return normals(self.pair_step(seen), n)


@dataclass(frozen=True, slots=True)
class Reports(Rows):
    """Boxes that a detector reports, in any order; world frame."""

    observer: Int[ndarray, "r"]
    """Row of the sweep."""
    label: UInt8[ndarray, "r"]
    """Reported `ObjectClass`."""
    boxes: Boxes
    score: Float[ndarray, "r"]
    """Confidence in [0, 1]."""
    actor: Int[ndarray, "r"]
    """Ground truth: row of the detected actor; not used if `is_false_positive`."""
    is_false_positive: Bool[ndarray, "r"]
    """Ground truth: the box belongs to no actor."""

    @staticmethod
    def of_actors(
        seen: Observability,
        rows: Int[ndarray, "r"],
        label: UInt8[ndarray, "r"],
        boxes: Boxes,
        score: Float[ndarray, "r"],
    ) -> Reports:
        """Reports of actors; none is a false positive.

        Parameters
        ----------
        seen
            The observers and actors to which `rows` refers.
        rows
            Row of `seen` of each report. A row may occur several times.
        label, boxes, score
            Reported `ObjectClass`, box (world frame) and confidence in [0, 1], in the order of `rows`.
        """
        is_false_positive = np.zeros(len(rows), bool)
        return Reports(seen.observer[rows], label, boxes, score, seen.actor[rows], is_false_positive)

    @staticmethod
    def of_false_positives(
        observer: Int[ndarray, "r"],
        label: UInt8[ndarray, "r"],
        boxes: Boxes,
        score: Float[ndarray, "r"],
    ) -> Reports:
        """Reports that belong to no actor.

        Parameters
        ----------
        observer
            Row of the sweep of each report.
        label, boxes, score
            Reported `ObjectClass`, box (world frame) and confidence in [0, 1].
        """
        no_actor = np.zeros(len(observer), int)
        is_false_positive = np.ones(len(observer), bool)
        return Reports(observer, label, boxes, score, no_actor, is_false_positive)

    def moved(self, by_m: Float[ndarray, "r 3"]) -> Reports:
        """The reports with each box displaced by this vector, world frame [m]."""
        return replace(self, boxes=replace(self.boxes, xyz_m=self.boxes.xyz_m + by_m))
