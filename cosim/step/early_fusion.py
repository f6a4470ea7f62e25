"""Early fusion: vehicles broadcast their point clouds, and each asks its detector again about all that it has.

A vehicle uses the newest cloud of each partner. What it detects in the merged clouds stands beside its own detections
and its fused objects. Nothing else in the simulation uses it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.ragged import differs_from_last, expand, place_in_group, ptr_of, rows_of
from cosim.base.rows import no_rows
from cosim.config.config import Config
from cosim.messages.cloud_params import EarlyFusionParams
from cosim.messages.content import SENSED
from cosim.radio.link_budget import neighbours
from cosim.radio.message_round import MessageRound
from cosim.radio.segmentation import ENVELOPE_BYTES
from cosim.step.exchange import Exchange
from cosim.step.late import LateMessages
from cosim.step.perception import Observed, detector_draws
from cosim.step.positioning import as_estimated
from cosim.world import World
from sensors import lidar
from sensors.boxes import Boxes, iou_3d
from sensors.merged_clouds import Views, detect
from sensors.statistical_detector import StatisticalDetector

Error = Float[ndarray, "e 3"] | None
"""Errors of the poses of all equipped vehicles, as `Positioned.error`."""


@dataclass(frozen=True, slots=True)
class Clouds:
    """M point clouds, what they hold of actors, and who received them. Vehicles and actors are actor numbers."""

    step: Int[ndarray, "m"] = no_rows(np.int64)
    """Step of the sweep."""
    sender: Int[ndarray, "m"] = no_rows(np.int64)
    xy_m: Float[ndarray, "m 2"] = no_rows(np.float64, 2)
    """Where the sender takes itself to be."""
    cloud: Int[ndarray, "v"] = no_rows(np.int64)
    """Cloud in which each actor has returns, ascending."""
    actor: Int[ndarray, "v"] = no_rows(np.int64)
    n_returns: Int[ndarray, "v"] = no_rows(np.int64)
    n_unoccluded: Int[ndarray, "v"] = no_rows(np.int64)
    range_m: Float[ndarray, "v"] = no_rows()
    """Distance from the sensor to the actor."""
    at_m: Float[ndarray, "v 2"] = no_rows(np.float64, 2)
    """Where the actor was when the sensor looked at it, by the sender's estimate of its own pose."""
    receiver: Int[ndarray, "r"] = no_rows(np.int64)
    received: Int[ndarray, "r"] = no_rows(np.int64)
    """Cloud that this receiver has."""
    untold: Int[ndarray, "u"] = no_rows(np.int64)
    """Senders of clouds that vehicles received after their rounds, of which no row of results tells yet."""

    def and_also(self, later: "Clouds") -> "Clouds":
        """These clouds, then others."""
        n = len(self.step)
        shifted = {"cloud": n + later.cloud, "received": n + later.received}
        joined = {}
        for name in Clouds.__dataclass_fields__:
            more = shifted.get(name, getattr(later, name))
            joined[name] = np.concatenate([getattr(self, name), more])
        return Clouds(**joined)

    def since(self, step: int) -> "Clouds":
        """The clouds of this step and later ones."""
        keep = self.step >= step
        if keep.all():
            return self
        number = np.cumsum(keep) - 1
        v, r = keep[self.cloud], keep[self.received]
        return Clouds(
            step=self.step[keep],
            sender=self.sender[keep],
            xy_m=self.xy_m[keep],
            cloud=number[self.cloud[v]],
            actor=self.actor[v],
            n_returns=self.n_returns[v],
            n_unoccluded=self.n_unoccluded[v],
            range_m=self.range_m[v],
            at_m=self.at_m[v],
            receiver=self.receiver[r],
            received=number[self.received[r]],
            untold=self.untold,
        )

    def with_late(
        self,
        step: Int[ndarray, "l"],
        sender: Int[ndarray, "l"],
        receiver: Int[ndarray, "l"],
    ) -> "Clouds":
        """The clouds of these steps and senders have been received by more vehicles, in rows of their own."""
        kept = self.step << 32 | self.sender
        row, is_kept = rows_of(step << 32 | sender, kept)
        return replace(
            self,
            receiver=np.concatenate([self.receiver, receiver[is_kept]]),
            received=np.concatenate([self.received, row[is_kept]]),
            untold=np.concatenate([self.untold, sender]),
        )


@dataclass(frozen=True, slots=True)
class Offered:
    """The clouds that vehicles broadcast in a step: one of each vehicle that senses."""

    n_points: Int[ndarray, "s"]
    length_bytes: Int[ndarray, "s"]


@dataclass(frozen=True, slots=True)
class Early:
    """What vehicles detect in merged clouds, and what became of the clouds that they broadcast in this step."""

    ego: Int[ndarray, "d"]
    """Row of the vehicles that sense, ascending; scores descend."""
    label: UInt8[ndarray, "d"]
    boxes: Boxes
    """Where the ego takes them to be."""
    score: Float[ndarray, "d"]
    n_points: Int[ndarray, "d"]
    """Returns of all sweeps together; of a false positive, those of the own sweep."""
    n_sweeps: Int[ndarray, "d"]
    is_real: Bool[ndarray, "d"]
    actor_row: Int[ndarray, "d"]
    """Row of the actor in the world, if real."""
    iou: Float[ndarray, "d"]
    """With the actor's true box, if real."""
    offered: Offered
    n_frames: Int[ndarray, "s"] | None
    """Frames on the air, of each cloud; None if the radio does not carry them."""
    n_in_range: Int[ndarray, "s"]
    """Vehicles within `early_fusion.range_m` of the sender."""
    n_received: Int[ndarray, "s"]
    """How many of these received the whole cloud in its round."""
    n_received_late: Int[ndarray, "s"]
    """Receptions of earlier clouds of the sender, after their rounds, since the sender last sensed."""


@dataclass(frozen=True, slots=True)
class EarlyFusion:
    """The component of a step that shares and merges clouds."""

    params: EarlyFusionParams
    detector: StatisticalDetector
    s_per_rad: float
    """As `sensors.lidar.Beams`."""
    seed: int
    dt_s: float
    oldest_steps: int
    """Largest age of a cloud that is merged."""

    @staticmethod
    def of(c: Config) -> "EarlyFusion | None":
        """The component of a config; None if no clouds are shared."""
        if c.early_fusion.share == "none":
            return None
        detector = StatisticalDetector(c.detector)
        s_per_rad = lidar.beams(c.lidar).s_per_rad
        oldest_steps = math.floor(c.early_fusion.max_age_s / c.traffic.step_s + 1e-9)
        return EarlyFusion(c.early_fusion, detector, s_per_rad, c.seed, c.traffic.step_s, oldest_steps)

    def offered(self, observed: Observed) -> Offered:
        """The clouds that the vehicles broadcast that sense in this step."""
        seen, sweeps = observed.observability, observed.sweeps
        if self.params.share == "objects":
            of_objects = np.bincount(seen.observer, seen.n_returns, len(sweeps.poses.origin_m))
            n_points = of_objects.astype(np.int64)
        else:
            n_points = sweeps.n_returns()
        content = np.ceil(n_points * self.params.bytes_per_return).astype(np.int64)
        return Offered(n_points, np.where(n_points > 0, ENVELOPE_BYTES + content, 0))

    def fuse(
        self,
        kept: Clouds,
        exchange: Exchange,
        observed: Observed,
        error: Error,
        offered: Offered,
        sent: MessageRound | None,
        late: Sequence[LateMessages],
    ) -> tuple[Clouds, Early]:
        """Detect in the clouds that each vehicle has.

        Parameters
        ----------
        kept
            Clouds of earlier steps.
        exchange
            Vehicles of the step.
        observed
            What they perceive, at their true poses.
        error
            Errors of their poses.
        offered, sent
            The clouds of this step, and what the radio made of them, in the order of the vehicles that sense; None if
            it does not carry them.
        late
            What became of clouds of earlier rounds.

        Returns
        -------
        The clouds for later steps, and the result.
        """
        world, vehicles, sensing = exchange.world, exchange.vehicles, exchange.sensing
        of_senses = None if error is None else error[vehicles.senses]
        xy_m = world.boxes.xyz_m[vehicles.row, :2]
        sender, receiver, _ = neighbours(xy_m, self.params.range_m)
        row = np.full(len(vehicles), -1)
        row[vehicles.senses] = np.arange(len(sensing))
        near = row[sender] >= 0
        sender, receiver = row[sender[near]], receiver[near]
        got = np.ones(len(sender), bool)
        if sent is not None:
            found = sent.receptions
            received = found.message.astype(np.int64) << 32 | found.receiver
            got = np.isin(sender << 32 | receiver, received)
        is_valid = exchange.senders.is_valid[exchange.senders.own[sender]]
        got &= is_valid & (offered.length_bytes[sender] > 0)
        views, at_m = self._own_views(world, sensing.row, observed, of_senses)
        own_xy_m = world.boxes.xyz_m[sensing.row, :2]
        if of_senses is not None:
            own_xy_m = own_xy_m + of_senses[:, :2]
        now = Clouds(
            step=np.full(len(sensing), world.step),
            sender=sensing.actor.astype(np.int64),
            xy_m=own_xy_m,
            cloud=views.observer,
            actor=world.actor[views.actor].astype(np.int64),
            n_returns=views.n_returns,
            n_unoccluded=views.n_unoccluded,
            range_m=views.range_m,
            at_m=at_m,
            receiver=vehicles.actor[receiver[got]].astype(np.int64),
            received=sender[got],
        )
        kept = kept.since(world.step - self.oldest_steps)
        clouds = self._with_late(kept.and_also(now), exchange, late)
        told, is_told = rows_of(clouds.untold, sensing.actor.astype(np.int64))
        n_late = np.bincount(told[is_told], minlength=len(sensing))
        is_waiting = ~is_told & np.isin(clouds.untold, vehicles.actor)
        clouds = replace(clouds, untold=clouds.untold[is_waiting])
        theirs = self._received_views(clouds, world, sensing.row, own_xy_m, of_senses)
        views = Views.concat([views, theirs])
        n = len(sensing)
        return clouds, Early(
            **self._detected(views, world, sensing.row, observed, of_senses),
            offered=offered,
            n_frames=None if sent is None else sent.frames.n_transmissions,
            n_in_range=np.bincount(sender, minlength=n),
            n_received=np.bincount(sender[got], minlength=n),
            n_received_late=n_late,
        )

    def _with_late(self, clouds: Clouds, exchange: Exchange, late: Sequence[LateMessages]) -> Clouds:
        """The clouds, with what vehicles within range have received of them after their rounds."""
        vehicles = exchange.vehicles
        xy_m = exchange.world.boxes.xyz_m[vehicles.row, :2]
        for messages in late:
            found = messages.links.vehicles
            accepted = np.flatnonzero(messages.sender[found.message] >= 0)
            message, receiver = found.message[accepted], found.receiver[accepted]
            sender = messages.sender[message] >> 16
            row, is_there = rows_of(sender, vehicles.actor.astype(np.int64))
            x_m, y_m = (xy_m[row] - xy_m[receiver]).T
            is_there &= np.hypot(x_m, y_m) <= self.params.range_m
            step = messages.step[message[is_there]]
            actor = vehicles.actor[receiver[is_there]].astype(np.int64)
            clouds = clouds.with_late(step, sender[is_there], actor)
        return clouds

    def _own_views(
        self, world: World, row: Int[ndarray, "s"], observed: Observed, error: Error
    ) -> tuple[Views, Float[ndarray, "v 2"]]:
        """What the vehicles' own sweeps hold of actors, and where by their estimates of their own poses."""
        seen = observed.observability.take(np.flatnonzero(observed.observability.n_returns > 0))
        moved_m = lidar.moved_m(
            observed.sweeps.poses, self.s_per_rad, seen.observer, world.boxes, seen.actor, world.speed_mps
        )
        there = world.boxes.take(seen.actor)
        there = Boxes(there.xyz_m + moved_m, there.lwh_m, there.yaw_rad)
        if error is not None:
            there = as_estimated(there, seen.observer, world.boxes.xyz_m[row], error)
        whole = (seen.observer, seen.actor, seen.n_returns, seen.n_unoccluded)
        observer, actor, n_returns, n_unoccluded = (column.astype(np.int64) for column in whole)
        views = Views(observer, actor, n_returns, n_unoccluded, seen.range_m, moved_m[:, :2])
        return views, there.xyz_m[:, :2]

    def _received_views(
        self, clouds: Clouds, world: World, row: Int[ndarray, "s"], own_xy_m: Float[ndarray, "s 2"], error: Error
    ) -> Views:
        """What the clouds hold that each vehicle that senses merges with its own."""
        ego, is_ego = rows_of(clouds.receiver, world.actor[row])
        ego, cloud = ego[is_ego], clouds.received[is_ego]
        order = np.lexsort((-clouds.step[cloud], clouds.sender[cloud], ego))
        ego, cloud = ego[order], cloud[order]
        pair = ego << 32 | clouds.sender[cloud]
        dx, dy = (clouds.xy_m[cloud] - own_xy_m[ego]).T
        away_m = np.hypot(dx, dy)
        newest = differs_from_last(pair)
        newest &= away_m <= self.params.range_m
        ego, cloud, away_m = ego[newest], cloud[newest], away_m[newest]
        order = np.lexsort((clouds.sender[cloud], away_m, ego))
        ego, cloud = ego[order], cloud[order]
        few = place_in_group(ego) < self.params.partners
        ego, cloud = ego[few], cloud[few]
        begin = ptr_of(clouds.cloud, len(clouds.step))
        at, of = expand(begin[cloud], begin[cloud + 1])
        actor, there = rows_of(clouds.actor[at], world.actor)
        there &= actor != row[ego[of]]  # returns from the ego itself
        at, ego = at[there], ego[of[there]]
        actor = actor[there]
        xyz_m = np.column_stack([clouds.at_m[at], np.zeros(len(at))])
        if error is not None:
            held = Boxes(xyz_m, np.ones_like(xyz_m), np.zeros(len(at)))
            xyz_m = as_estimated(held, ego, world.boxes.xyz_m[row], error, back=True).xyz_m
        off_m = xyz_m[:, :2] - world.boxes.xyz_m[actor, :2]
        return Views(
            observer=ego,
            actor=actor,
            n_returns=clouds.n_returns[at],
            n_unoccluded=clouds.n_unoccluded[at],
            range_m=clouds.range_m[at],
            off_m=off_m,
        )

    def _detected(
        self, views: Views, world: World, row: Int[ndarray, "s"], observed: Observed, error: Error
    ) -> dict[str, Any]:
        """Detections in the merged clouds, and the false positives of the own sweeps, at the estimated poses."""
        draws = detector_draws(self.seed, self.dt_s, world.step, world.name_key, world.name_key[row])
        found = detect(self.detector, views, world.boxes, world.label, observed.sweeps.poses.origin_m, draws)
        own = observed.detections.take(np.flatnonzero(observed.detections.origin == SENSED))
        own = own.take(np.flatnonzero(~observed.is_real))
        n_false = len(own.observer)
        ego = np.concatenate([found.reports.observer, np.searchsorted(row, own.observer)])
        boxes = Boxes.concat([found.reports.boxes, own.boxes])
        is_real = np.repeat([True, False], [len(ego) - n_false, n_false])
        actor_row = np.append(found.reports.actor, np.zeros(n_false, np.int64))
        score = np.concatenate([found.reports.score, own.score])
        x_m, y_m, _ = boxes.xyz_m.T
        order = np.lexsort([y_m, x_m, -score, ego])
        if error is not None:
            boxes = as_estimated(boxes, ego, world.boxes.xyz_m[row], error)
        iou = np.zeros(len(ego))
        true_boxes = world.boxes.take(actor_row[is_real])
        iou[is_real] = iou_3d(boxes.take(np.flatnonzero(is_real)), true_boxes)
        columns = {
            "ego": ego,
            "label": np.concatenate([found.reports.label, own.label]),
            "score": score,
            "n_points": np.append(found.n_returns, own.n_points),
            "n_sweeps": np.append(found.n_sweeps, np.ones(n_false, np.int64)),
            "is_real": is_real,
            "actor_row": actor_row,
            "iou": iou,
        }
        ordered = {name: column[order] for name, column in columns.items()}
        return {"boxes": boxes.take(order), **ordered}
