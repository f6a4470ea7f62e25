"""Evidence about a box from an observer's own sweep: visibility, points inside, and free space at its place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge
from jaxtyping import Bool, Float, Int, Int32, UInt8
from numpy import ndarray

from cosim.base.bounds import NotNegative100, Positive100, Positive1000, Share
from cosim.base.codes import ObjectClass
from cosim.base.rows import Rows
from sensors import box_points, evidence_kernels, range_image
from sensors.boxes import Boxes
from sensors.lidar import RangeImages, Sweeps
from sensors.neighbours import Neighbours, neighbours
from sensors.pairs import ViewPairs
from sensors.scene import Prisms, prisms


@dataclass(frozen=True, kw_only=True, slots=True)
class AreaParams:
    """The area in which an observer evaluates boxes."""

    range_m: Positive1000 = 70.0
    """Largest distance of the box's bottom centre from the sensor [m]; vehicles evaluate nothing beyond
    lidar.max_range_m."""
    slack_m: NotNegative100 = 2.0
    """Tolerance in range and beside the field of view [m]; 0 is the paper's strict area."""
    height_m: Positive100 = 3.0
    """Largest height of the bottom above or below the road under the sensor [m]."""
    own_radius_m: NotNegative100 = 1.5
    """A car this near to the observer's own box counts even outside the field of view: it is a report about the
    observer [m]."""
    gaps: Literal["free", "below", "unknown"] = "free"
    """What a place is that no ray passes. `free`: free space, as in the paper's code. `below`: the sweep says nothing
    of what is below the lowest beam, such as a pedestrian beside a bus; between two beams there is free space.
    `unknown`: it says nothing of either."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlausibilityParams:
    """When free space contradicts a box."""

    margin_m: Annotated[float, Ge(0)] = 0.25
    """Returns up to this far behind the bottom centre still count as closer [m]."""
    min_share: Share = 0.1
    """A box is plausible if its share of closer returns is larger than this."""


def in_evaluation_area(
    sweeps: RangeImages,
    o: Int[ndarray, "n"],
    boxes: Boxes,
    params: AreaParams,
    b: Int[ndarray, "n"] | None = None,
    label: UInt8[ndarray, "boxes"] | None = None,
    own: Boxes | None = None,
) -> Bool[ndarray, "n"]:
    """Whether box b[k] lies in the area in which observer o[k] evaluates boxes.

    Parameters
    ----------
    sweeps
        Range images of all observers.
    o
        Row of the sweep, for each pair k.
    boxes
        Boxes in the world frame.
    params
        Size of the area.
    b
        Row of `boxes`, for each pair k; by default all rows in order.
    label, own
        Class of each box, and box of each observer. If both are given, cars within `own_radius_m` of the observer's own
        box are exempt from the test of the field of view. The evaluation of messages uses this.

    Returns
    -------
    One boolean per pair.

    Notes
    -----
    Area filter of TruPercept: |left| <= forward + slack for its 90 degrees.   Deviations: other fields of view keep
    the slack at their edges; 360 degrees have no edge. Heights are those above the road, because sensors of vans and
    roadside units are higher than that of the paper's car.
    """
    exempt = np.zeros(0, bool)
    near = boxes.take(slice(0, 0))
    if label is not None and own is not None:
        exempt = label == ObjectClass.CAR
        near = sweeps.poses.to_sensor(np.arange(len(own)), own)
    fov_rad = sweeps.beams.fov_rad
    pairs = sweeps.poses.pairs(o, boxes, b)
    reach_m = params.range_m + params.slack_m
    return evidence_kernels.in_area(
        pairs,
        sweeps.road_z_m(),
        exempt,
        near.xyz_m,
        near.lwh_m,
        reach_m,
        params.height_m,
        fov_rad,
        edge_slope(fov_rad),
        params.slack_m,
        params.own_radius_m,
    )


def edge_slope(fov_rad: float) -> float:
    """Slope of the edge of the field of view: sideways over lengthwise distance.

    It is measured from straight ahead, and from straight behind if the field of view is wider than half a turn.
    """
    half_rad = 0.5 * fov_rad
    edge_rad = half_rad if fov_rad <= np.pi else np.pi - half_rad
    return float(np.tan(edge_rad))


def points_in_boxes(
    sweeps: RangeImages,
    o: Int[ndarray, "n"],
    boxes: Boxes,
    b: Int[ndarray, "n"] | None = None,
    velocity_mps: Float[ndarray, "boxes 2"] | None = None,
) -> Int32[ndarray, "n"]:
    """Number of returns of observer o[k] strictly inside box b[k].

    The arguments are those of `in_evaluation_area`. Boxes with a velocity are where they are when the sensor looks
    there.

    Notes
    -----
    This is p(θ) of TruPercept, from which visibility is computed.   Deviations: none. Only the window of the range
    image that the box can fill is searched.
    """
    pairs = _moving_pairs(sweeps, o, boxes, b, velocity_mps)
    return box_points.points_in_boxes(sweeps.range_steps, sweeps.step_m, sweeps.beams, pairs, pairs.runs())


def plausible(
    sweeps: RangeImages,
    o: Int[ndarray, "n"],
    boxes: Boxes,
    b: Int[ndarray, "n"] | None = None,
    area: AreaParams = AreaParams(),
    params: PlausibilityParams = PlausibilityParams(),
    velocity_mps: Float[ndarray, "boxes 2"] | None = None,
) -> Bool[ndarray, "n"]:
    """Whether the sweep of observer o[k] allows that an object stands in box b[k].

    The arguments are those of `points_in_boxes`; `params` are the limits of the test.

    Notes
    -----
    Plausibility check of TruPercept, with a narrow pyramid through the middle of the box. The result is false if no
    return lies in the pyramid, or if at most 10 % of its returns are nearer than the box. It is true where the test
    does not apply (outside the area or field of view, or box centre above the sensor).   Deviations: we follow the code
    where the paper gives no rule (early exits, bottom centre as distance, margin, empty pyramid). The sensor takes the
    place of the camera, and the field of view is the sensor's. `gaps = "below"` and
    `"unknown"` are ours.
    """
    pairs = _moving_pairs(sweeps, o, boxes, b, velocity_mps)
    limits = area.range_m, area.height_m, edge_slope(sweeps.beams.fov_rad), sweeps.road_z_m()
    return evidence_kernels.free_space(
        sweeps.range_steps,
        sweeps.step_m,
        sweeps.beams,
        pairs,
        pairs.runs(),
        limits,
        params.margin_m,
        (params.min_share, area.gaps != "free", area.gaps == "unknown"),
    )


def _moving_pairs(
    sweeps: RangeImages,
    o: Int[ndarray, "n"],
    boxes: Boxes,
    b: Int[ndarray, "n"] | None,
    velocity_mps: Float[ndarray, "boxes 2"] | None,
) -> ViewPairs:
    """Pairs of sensors and boxes, which move if they have velocities."""
    motion = None if velocity_mps is None else (velocity_mps, sweeps.beams.s_per_rad)
    return sweeps.poses.pairs(o, boxes, b, motion)


@dataclass(frozen=True, slots=True)
class Observability(Rows):
    """Actors that each observer could have detected, and their returns; sorted by (observer, actor)."""

    observer: Int32[ndarray, "s"]
    """Row of the sweep."""
    actor: Int32[ndarray, "s"]
    """Actor row."""
    n_returns: Int32[ndarray, "s"]
    """Returns of the observer's sweep from the actor."""
    n_unoccluded: Int32[ndarray, "s"]
    """Returns if nothing stood in front; at least 1."""
    range_m: Float[ndarray, "s"]
    """Distance from the sensor to the centre of the box [m]."""

    @property
    def occlusion(self) -> Float[ndarray, "s"]:
        """Share of the unoccluded returns that are missing, in [0, 1]."""
        return 1.0 - self.n_returns / self.n_unoccluded


def observability(
    sweeps: Sweeps,
    boxes: Boxes,
    shape: UInt8[ndarray, "n"],
    near: Neighbours | None = None,
    bodies: Prisms | None = None,
) -> Observability:
    """Every (observer, actor) with at least one ray that would meet the actor if nothing stood in front.

    Parameters
    ----------
    sweeps
        Sweeps of all observers.
    boxes, shape
        Box (world frame) and `Shape` of every actor.
    near, bodies
        `neighbours` of the sensors among these boxes, and the `prisms` of the actors, if they are already known.

    Returns
    -------
    One row per such pair, sorted by (observer, actor).

    Notes
    -----
    In the unoccluded count the road hides nothing. Dropouts of the sweep count as occlusion.
    """
    poses = sweeps.poses
    ptr, row = neighbours(poses.origin_m, boxes, sweeps.max_range_m) if near is None else near
    assert len(ptr) == len(sweeps.observers) + 1, "neighbours of other sweeps"
    bodies = prisms(shape, boxes, sweeps.speed_mps) if bodies is None else bodies
    n_returns, n_unoccluded = range_image.unoccluded_returns(
        sweeps.hit,
        poses.origin_m,
        poses.yaw_rad,
        sweeps.beams,
        float(sweeps.max_range_m),
        boxes.xyz_m,
        boxes.circumradius_m,
        boxes.lwh_m[:, 2],
        ptr,
        row,
        sweeps.observers,
        bodies,
    )
    n_unoccluded = np.maximum(n_unoccluded, n_returns)  # bodies from meshes may reach beyond their prisms
    keep = n_unoccluded > 0
    sweep = np.arange(len(sweeps.observers), dtype=np.int32)
    o = np.repeat(sweep, np.diff(ptr))[keep]
    actor = row[keep].astype(np.int32)
    apart = boxes.xyz_m.take(actor, axis=0) - poses.origin_m.take(o, axis=0)
    range_m = np.sqrt((apart * apart).sum(axis=1))
    return Observability(o, actor, n_returns[keep], n_unoccluded[keep], range_m)
