"""Keeps messages of earlier steps for vehicles that sense later than the senders.

A vehicle that senses uses the newest detection message of each sender that is younger than the longest sensing
interval, and the evaluation messages of the same time. If all vehicles sense in the same steps, none is young enough.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.ragged import (
    as_slice,
    differs_from_last,
    distinct,
    expand,
    offsets,
    owner_of_rows,
    ptr_of,
    ranges,
    rows_of,
)
from cosim.base.rows import no_rows
from cosim.messages.content import Detections, velocities
from cosim.radio.message_round import Receptions, RoundKind
from cosim.step.accuracy import aged
from cosim.step.broadcast import Broadcast
from cosim.step.comparing import ObjectGroups
from cosim.step.evaluate import Evaluated
from cosim.step.exchange import Exchange
from cosim.step.ground_truth import GroundTruth
from cosim.step.known import Known, Pairs, Uses, for_trust
from cosim.step.late import LateMessages
from cosim.step.listing import Listed
from cosim.step.parts import Parts
from sensors.boxes import Boxes, extrapolated
from trust.tables import Evaluations, ObjectLists


def _rows() -> Int[ndarray, "0"]:
    return np.zeros(0, np.int64)


def _no_detections() -> Detections:
    nothing, none = np.zeros((0, 3)), _rows()
    score, code = np.zeros(0), np.zeros(0, np.uint8)
    boxes = Boxes(nothing, nothing, np.zeros(0))
    return Detections.perceived(none, none, code, boxes, score, none, code)


def _no_truth() -> GroundTruth:
    no, none = np.zeros(0, bool), np.zeros(0)
    return GroundTruth(no, _rows(), none, none, no, no, no)


@dataclass(frozen=True, slots=True)
class Inbox:
    """M earlier messages with D detections, by step and sender, and who received them.

    Vehicles and actors are actor numbers here, because rows of the world change from step to step.
    """

    step: Int[ndarray, "m"] = no_rows(np.int64)
    sender: Int[ndarray, "m"] = no_rows(np.int64)
    """Actor number and identity in one number, as `Exchange.sender`."""
    pseudonym: Int[ndarray, "m"] = no_rows(np.int64)
    ptr: Int[ndarray, "m+1"] = field(default_factory=lambda: np.zeros(1, np.int64))
    objects: Detections = field(default_factory=_no_detections)
    truth: GroundTruth = field(default_factory=_no_truth)
    withheld: Bool[ndarray, "d"] = no_rows(bool)
    from_own_m: Float[ndarray, "d"] = no_rows()
    """Distance of each detection from the sensor of its sender."""
    pairs: Pairs = field(default_factory=lambda: (_rows(), _rows(), np.zeros(0)))
    evaluated: ObjectLists = field(default_factory=lambda: ObjectLists(np.zeros(1, np.int64), _rows(), _rows()))
    """Detections that the sender of each message evaluated, as rows of `objects`."""
    evaluations: Evaluations = field(default_factory=lambda: Evaluations(np.zeros(0), np.zeros(0)))
    """These evaluations as they were sent; NaN in place of the visibility of those that were not."""
    cpms: Uses = field(default_factory=lambda: Uses(_rows(), _rows()))
    """Receptions of the detection messages: actor number of the receiver, and row of the message."""
    reports: Uses = field(default_factory=lambda: Uses(_rows(), _rows()))
    """Receptions of the evaluation messages."""

    def with_late(self, exchange: Exchange, late: Iterable[LateMessages], carry_evaluations: RoundKind) -> "Inbox":
        """Add receptions of messages of earlier steps that arrived in a round of this step.

        A message that has left the inbox, or that the receiver has already, is left out. `carry_evaluations` is the
        kind of messages that carry evaluations.
        """
        inbox = self
        for messages in late:
            row, is_there = self.rows(messages.step, messages.sender)
            found = messages.links.vehicles
            mine = is_there[found.message]
            receiver, message = found.receiver[mine], found.message[mine]
            more = Uses(exchange.vehicles.actor[receiver], row[message])
            if messages.kind == RoundKind.CPM:
                inbox = replace(inbox, cpms=_with_new(inbox.cpms, more, len(self.step)))
            if messages.kind == carry_evaluations:
                inbox = replace(inbox, reports=_with_new(inbox.reports, more, len(self.step)))
        return inbox

    def rows(
        self,
        step: Int[ndarray, "m"],
        sender: Int[ndarray, "m"],
    ) -> tuple[Int[ndarray, "m"], Bool[ndarray, "m"]]:
        """Rows of messages by their steps and senders, and which of them are there."""
        oldest = int(self.step[0]) if len(self.step) else 0
        held = (self.step - oldest << 48) + self.sender
        asked = (step - oldest << 48) + sender
        row, is_there = rows_of(asked, held)
        return row, is_there & (sender >= 0) & (step >= oldest)

    def known(self, exchange: Exchange, listed: Listed, parts: Parts) -> tuple["Inbox", Known]:
        """The messages of this step, and those of the inbox that can still be used, as if nobody received them.

        Returns
        -------
        The inbox without messages that are too old or whose sender has left, and the messages.
        """
        senders, now = exchange.senders, exchange.now.step
        schedule = parts.schedule
        inbox = self
        if len(self.step):
            is_old = now - self.step >= schedule.longest_steps
            has_left = ~np.isin(self.sender >> 16, exchange.vehicles.actor)
            inbox = self._without(is_old | has_left)
        interval, _ = schedule.of_vehicles(exchange.sensing.name_key)
        known = Known(
            objects=listed.objects,
            truth=listed.truth,
            detections=listed.detections,
            ptr=listed.ptr,
            withheld=listed.withheld,
            vehicle=senders.vehicle,
            pseudonym=senders.pseudonym,
            received=Uses(_rows(), _rows()),
            step=np.full(len(senders), now),
            since=now - interval + 1,
            earlier_m=inbox.from_own_m,
            earlier_pairs=inbox.pairs,
            velocity_mps=velocities(listed.objects),
            moved_m=np.zeros((len(listed.objects), 2)) if parts.config.extrapolate else None,
        )
        if not len(inbox.step):
            return inbox, known
        age_s = (now - inbox.step) * schedule.step_s if parts.config.extrapolate else None
        return inbox, inbox._added(exchange, known, age_s, parts)

    def _added(self, exchange: Exchange, now: Known, age_s: Float[ndarray, "m"] | None, parts: Parts) -> Known:
        """This step's messages with those of the inbox behind them.

        If the ages of the messages are given, their objects are moved by their velocities to the time of the step.
        """
        world, n, d = exchange.world, len(exchange.senders), len(now.objects)
        now_step = exchange.now.step
        row, _ = rows_of(self.objects.observer, world.actor)
        target, there = rows_of(self.objects.target, world.actor)
        actor_row, exists = rows_of(self.truth.actor_row, world.actor)
        old = self.objects.boxes
        boxes, moved_m, velocity_mps = old, None, velocities(self.objects)
        of = owner_of_rows(np.diff(self.ptr))  # message of each detection
        if age_s is not None:
            boxes = extrapolated(old, velocity_mps, age_s[of])
            old_moved_m = boxes.xyz_m[:, :2] - old.xyz_m[:, :2]
            moved_m = np.concatenate([np.zeros((d, 2)), old_moved_m])
        objects = replace(self.objects, observer=row, target=np.where(there, target, row), boxes=boxes)
        if parts.config.trust.matching == "gates":
            since_s = (now_step - self.step) * parts.schedule.step_s
            objects = aged(objects, since_s[of], parts.config.tracking)
        truth = replace(self.truth, actor_row=actor_row, is_real=self.truth.is_real & exists)
        ours, _ = for_trust(objects, n + of, n + len(self.step))
        columns = []
        for name in ("message", "detection_index", "label", "score", "is_self"):
            both = getattr(now.detections, name), getattr(ours, name)
            columns.append(np.concatenate(both))
        pseudonym = np.concatenate([now.pseudonym, self.pseudonym])
        step = np.concatenate([now.step, self.step])
        vehicle, _ = rows_of(self.sender >> 16, exchange.vehicles.actor)
        i, j, iou = self.pairs
        return replace(
            now,
            objects=Detections.concat([now.objects, objects]),
            truth=GroundTruth.concat([now.truth, truth]),
            detections=type(ours)(*columns),
            ptr=np.concatenate([now.ptr, d + self.ptr[1:]]),
            withheld=np.concatenate([now.withheld, self.withheld]),
            vehicle=np.concatenate([now.vehicle, vehicle]),
            pseudonym=pseudonym,
            step=step,
            earlier_pairs=(d + i, d + j, iou),
            velocity_mps=np.concatenate([now.velocity_mps, velocity_mps]),
            moved_m=moved_m,
        )

    def received(self, exchange: Exchange, known: Known, cpms: Broadcast) -> Known:
        """The messages that `known` returned, with who received them: `cpms` in this step, and earlier."""
        uses = _of_sensing(exchange, self.cpms, cpms.accepted.vehicles)
        if len(self.step):
            uses = _newest(uses, known.pseudonym, known.step)
        return replace(known, received=uses)

    def evaluations_used(
        self, exchange: Exchange, evaluated: Evaluated, n_now: int
    ) -> tuple[ObjectLists, Evaluations, Evaluations]:
        """Evaluations of this step, then those of the inbox: what was evaluated, own values, and values as sent.

        Parameters
        ----------
        exchange
            Senders of the step.
        evaluated
            Evaluations of this step.
        n_now
            Number of detections of this step; those of the inbox follow in `Known`.

        Returns
        -------
        One list per message of `Known`. The own values of earlier messages are those that were sent; no vehicle uses
        them.
        """
        lists, own, sent = evaluated.of_detections()
        if not len(self.step):
            return lists, own, sent
        end = lists.ptr[-1]
        joined = ObjectLists(
            np.concatenate([lists.ptr, end + self.evaluated.ptr[1:]]),
            np.concatenate([lists.member, n_now + self.evaluated.member]),
            np.arange(len(exchange.senders) + len(self.step)),
        )
        all_own = Evaluations.concat([own, self.evaluations])
        all_sent = all_own if sent is own else Evaluations.concat([sent, self.evaluations])
        return joined, all_own, all_sent

    def reports_used(self, exchange: Exchange, received: Receptions) -> Uses:
        """The evaluation messages that the vehicles that sense use: `received` in this step, and earlier."""
        return _of_sensing(exchange, self.reports, received)

    def next(self, exchange: Exchange, listed: Listed, groups: ObjectGroups, evaluated: Evaluated) -> "Inbox":
        """The inbox with the messages of this step, as if nobody received these."""
        world, senders = exchange.world, exchange.senders
        n, d = len(self.step), len(self.objects)
        n_now = len(listed.objects)
        objects = replace(
            listed.objects, observer=world.actor[listed.objects.observer], target=world.actor[listed.objects.target]
        )
        truth = replace(listed.truth, actor_row=world.actor[listed.truth.actor_row])

        moved = np.roll(np.arange(d + n_now), n_now)  # rows of `Known` as rows of the new inbox: this step's come last
        old = self.evaluated
        lists, _, sent = evaluated.of_detections()
        return Inbox(
            step=np.concatenate([self.step, np.full(len(senders), world.step)]),
            sender=np.concatenate([self.sender, exchange.sender]),
            pseudonym=np.concatenate([self.pseudonym, senders.pseudonym]),
            ptr=np.concatenate([self.ptr, d + listed.ptr[1:]]),
            objects=Detections.concat([self.objects, objects]),
            truth=GroundTruth.concat([self.truth, truth]),
            withheld=np.concatenate([self.withheld, listed.withheld]),
            from_own_m=np.concatenate([self.from_own_m, groups.from_own_m[:n_now]]),
            pairs=_with_numbers(groups.pairs, moved),
            evaluated=ObjectLists(
                np.concatenate([old.ptr, old.ptr[-1] + lists.ptr[1:]]),
                np.concatenate([old.member, moved[lists.member]]),
                np.arange(n + len(senders)),
            ),
            evaluations=Evaluations.concat([self.evaluations, sent]),
            cpms=self.cpms,
            reports=self.reports,
        )

    def with_received(self, exchange: Exchange, held: "Inbox", cpms: Uses, reports: Receptions | Uses) -> "Inbox":
        """With the receptions that `held`, the inbox before this step's messages, has, and those of these messages."""
        n, actor = len(held.step), exchange.vehicles.actor

        def both(old: Uses, new: Receptions | Uses) -> Uses:
            receiver = np.concatenate([old.receiver, actor[new.receiver]])
            return Uses(receiver, np.concatenate([old.message, n + new.message]))

        return replace(self, cpms=both(held.cpms, cpms), reports=both(held.reports, reports))

    def _without(self, dropped: Bool[ndarray, "m"]) -> "Inbox":
        """The inbox without some messages, their detections, and what refers to these."""
        if not dropped.any():
            return self
        kept = np.flatnonzero(~dropped)
        row = np.cumsum(~dropped) - 1
        size = np.diff(self.ptr)
        detections = ranges(self.ptr[kept], size[kept])
        new_row = np.full(len(self.objects), -1)
        new_row[detections] = np.arange(len(detections))
        held = as_slice(detections)  # mostly the oldest messages go, which are the first
        of = self.evaluated
        rows, by = expand(of.ptr[kept], of.ptr[kept + 1])
        still = new_row[of.member[rows]] >= 0
        rows, by = rows[still], by[still]
        members = new_row[of.member[rows]]

        def used(held: Uses) -> Uses:
            at = np.flatnonzero(~dropped[held.message])
            return Uses(held.receiver[at], row[held.message[at]])

        return Inbox(
            step=self.step[kept],
            sender=self.sender[kept],
            pseudonym=self.pseudonym[kept],
            ptr=offsets(size[kept]),
            objects=self.objects.take(held),
            truth=self.truth.take(held),
            withheld=self.withheld[held],
            from_own_m=self.from_own_m[held],
            pairs=_with_numbers(self.pairs, new_row),
            evaluated=ObjectLists(ptr_of(by, len(kept)), members, np.arange(len(kept))),
            evaluations=self.evaluations.take(rows),
            cpms=used(self.cpms),
            reports=used(self.reports),
        )


def _with_new(held: Uses, more: Uses, n_messages: int) -> Uses:
    """Held receptions, then those of the others that are not held yet, each once; `n_messages` are in the inbox."""
    is_late = np.zeros(n_messages, bool)
    is_late[more.message] = True
    same = np.flatnonzero(is_late[held.message])  # few of those that are held
    found, _ = distinct(more.key())
    known = Uses(held.receiver[same], held.message[same])
    row, is_held = rows_of(known.key(), found)
    is_new = np.ones(len(found), bool)
    is_new[row[is_held]] = False
    more = Uses.of_key(found[is_new])
    receiver = np.concatenate([held.receiver, more.receiver])
    return Uses(receiver, np.concatenate([held.message, more.message]))


def _of_sensing(exchange: Exchange, held: Uses, received: Receptions) -> Uses:
    """Receptions of this step and held ones, by those vehicles that sense in this step."""
    vehicles, sensing, n = exchange.vehicles, exchange.sensing, len(exchange.senders)
    row = np.full(len(vehicles), -1)
    row[vehicles.senses] = np.arange(len(sensing))
    old, there = rows_of(held.receiver, sensing.actor)
    receiver = np.concatenate([row[received.receiver], np.where(there, old, -1)])
    message = np.concatenate([received.message, n + held.message])
    mine = np.flatnonzero(receiver >= 0)
    mine = mine[np.lexsort((message[mine], receiver[mine]))]
    return Uses(receiver[mine], message[mine])


def _newest(uses: Uses, pseudonym: Int[ndarray, "m"], step: Int[ndarray, "m"]) -> Uses:
    """The newest message of each pseudonym at each receiver."""
    by = pseudonym[uses.message]
    order = np.lexsort((-step[uses.message], by, uses.receiver))
    receiver, by = uses.receiver[order], by[order]
    first = differs_from_last(receiver) | differs_from_last(by)
    rows = np.sort(order[first])
    return Uses(uses.receiver[rows], uses.message[rows])


def _with_numbers(pairs: Pairs, number: Int[ndarray, "d"]) -> Pairs:
    """Pairs of detections by other numbers of these, without the pairs of detections whose number is negative."""
    i, j, value = pairs
    rows = (np.ascontiguousarray(column, np.int32) for column in (i, j, number))
    return _renumbered(*rows, np.ascontiguousarray(value))  # type: ignore[no-any-return]


@compiled
def _renumbered(i, j, number, value):
    """Numbers of both ends in one pass, and the values of the pairs that stay."""
    a, b = np.empty_like(i), np.empty_like(j)
    kept, n = np.empty_like(value), 0
    for k in range(len(i)):
        a[n] = number[i[k]]
        b[n] = number[j[k]]
        kept[n] = value[k]
        n += a[n] >= 0 and b[n] >= 0
    return a[:n], b[:n], kept[:n]
