"""Tables that the functions of this package exchange: detections, object lists, groups, evaluations, trust scores.

In the order of a step: vehicles transmit `SentDetections`. Each vehicle has a list of those that it received
(`ObjectLists`), groups it by object (`Groups`) and evaluates it (`Evaluations`). Evaluations travel as
`EvaluationMessages`. A trust model gets them as `ReceivedEvaluations`, turns them into columns of evidence
(`EvidenceRows`, or sums of these), and answers with `TrustScores`. Vehicles fuse objects from `FusionInput` and
`SenderTrust`.

Many tables have a column `ptr`: item i has the rows ptr[i]:ptr[i + 1] of other columns. The *row* of a thing is its
place in the table of such things. A *position* is a place in `ObjectLists.member`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.ragged import offsets, owner_of_rows, ptr_of, ranges, rows_of
from cosim.base.rows import Rows

SERVER = 1 << 30
"""Holder of the trust scores of a central trust server. No vehicle has this number: actors are numbered from 0."""


def int64(a: ndarray) -> Int[ndarray, "..."]:
    """Integers as contiguous int64, so that each kernel is compiled once."""
    return np.ascontiguousarray(a, np.int64)


def float64(a: ndarray) -> Float[ndarray, "..."]:
    """Numbers as contiguous float64."""
    return np.ascontiguousarray(a, np.float64)


@dataclass(frozen=True, slots=True)
class SentDetections:
    """One step's detections as transmitted, sorted by (message, detection_index)."""

    message: Int[ndarray, "d"]  # message row: one row per message of the step
    detection_index: Int[ndarray, "d"]  # within the message; 0 is the self report
    label: UInt8[ndarray, "d"]  # 0 car, 1 pedestrian, 2 cyclist, 3 truck
    score: Float[ndarray, "d"]  # in [0, 1]
    is_self: Bool[ndarray, "d"]  # the sender's report of itself

    def __len__(self) -> int:
        return self.message.size


@dataclass(frozen=True)  # without slots, so that what follows from the arrays is computed once
class ObjectLists:
    """Detections that each of E vehicles has received: its own first, then the others by (message, detection_index)."""

    ptr: Int[ndarray, "e+1"]  # list v is member[ptr[v]:ptr[v + 1]]
    member: Int[ndarray, "m"]  # row in the detections
    owner: Int[ndarray, "e"]  # message row of the list's vehicle, ascending

    def of_member(self) -> Int[ndarray, "m"]:
        """List to which each position belongs.

        Returns
        -------
        Row of `owner` for each position of `member`.
        """
        return self._of_member

    @cached_property
    def _of_member(self) -> Int[ndarray, "m"]:
        return owner_of_rows(np.diff(self.ptr))

    def of(self, position: Int[ndarray, "p"]) -> Int[ndarray, "p"]:
        """List to which each of some positions belongs.

        Parameters
        ----------
        position
            Positions of `member`, ascending.

        Returns
        -------
        Row of `owner` for each of them.
        """
        return owner_of_rows(np.diff(np.searchsorted(position, self.ptr)))

    def subset(self, keep: Bool[ndarray, "m"]) -> "ObjectLists":
        """The lists with only the members where `keep` is true."""
        rows = np.flatnonzero(keep)
        return ObjectLists(np.searchsorted(rows, self.ptr), self.member[rows], self.owner)

    def part(self, first: int, last: int) -> "ObjectLists":
        """The same lists, of which only those from `first` to `last` have members."""
        begin, end = self.ptr[first], self.ptr[last]
        ptr = np.clip(self.ptr, begin, end) - begin
        return ObjectLists(ptr, self.member[begin:end], self.owner)

    @staticmethod
    def joined(parts: "Sequence[ObjectLists]") -> "ObjectLists":
        """The inverse of `part`, for all parts in their order."""
        ptr = np.sum([part.ptr for part in parts], axis=0)
        return ObjectLists(ptr, np.concatenate([part.member for part in parts]), parts[0].owner)


@dataclass(frozen=True)  # as `ObjectLists`
class Groups:
    """Positions of the object lists partitioned into groups, one per object; each group has one seed."""

    seed: Int[ndarray, "m"]  # position of the group's seed; its own position for a seed
    ego_detected: Bool[ndarray, "m"]  # the seed is a detection of the list's owner

    @staticmethod
    def joined(parts: "Sequence[Groups]") -> "Groups":
        """Groups of the lists that `ObjectLists.joined` returns, from those of the parts."""
        begins = offsets(np.array([part.seed.size for part in parts]))
        seeds = [part.seed + begin for part, begin in zip(parts, begins, strict=False)]
        ego_detected = [part.ego_detected for part in parts]
        return Groups(np.concatenate(seeds), np.concatenate(ego_detected))

    def seeds(self) -> Int[ndarray, "g"]:
        """Positions of the seeds, ascending: the canonical order of groups."""
        return self._seeds

    def numbers(self) -> Int[ndarray, "m"]:
        """Group of each position: its number in the order of `seeds`, from 0."""
        return self._numbers

    @cached_property
    def _seeds(self) -> Int[ndarray, "g"]:
        return np.flatnonzero(self.seed == np.arange(self.seed.size))

    @cached_property
    def _numbers(self) -> Int[ndarray, "m"]:
        number = np.empty(self.seed.size, np.int32)
        number[self._seeds] = np.arange(self._seeds.size)
        return number[self.seed]


@dataclass(frozen=True, slots=True)
class Evaluations(Rows):
    """Evaluation of each detection in the object lists by the list's owner."""

    evaluation: Float[ndarray, "m"]  # e in [-1, 1]
    visibility: Float[ndarray, "m"]  # Phi in [0, 1]


@dataclass(frozen=True, slots=True)
class FusionInput:
    """What all egos of a step fuse, whatever they trust: grouped detections, and the evaluations of these."""

    lists: ObjectLists  # of the egos; not cut to the sensor's area
    groups: Groups  # of the lists
    detections: SentDetections
    evaluated: ObjectLists  # detections that were evaluated, a list per evaluator
    own: Evaluations  # rows of `evaluated`, as each vehicle made them: an ego's contribution to its own fusion
    reported: Evaluations  # the same as transmitted: the others' contribution; the same object if none was altered


@dataclass(frozen=True, slots=True)
class SenderTrust:
    """Messages that each ego has received, and its trust in their senders; sorted within an ego."""

    ptr: Int[ndarray, "e+1"]  # ego x received message[ptr[x]:ptr[x + 1]]
    message: Int[ndarray, "h"]  # message row
    trust: Float[ndarray, "h"]  # the value that the ego uses for the sender
    has_evaluations: Bool[ndarray, "h"] | None = None  # whether its evaluations of this step arrived too; None: all did
    own: Float[ndarray, "e"] | None = None
    """Trust of each ego in itself, as `ego_trust_from = "computed"` uses it; None if it knows none."""

    def canonical(self) -> "SenderTrust":
        """Each ego's messages in ascending order, each message once: of repeated ones, the first row stays."""
        ego = owner_of_rows(np.diff(self.ptr))
        key = ego << 32 | self.message  # in the order of (ego, message)
        if np.all(key[1:] > key[:-1]):
            return self
        key, first = np.unique(key, return_index=True)
        ptr = np.searchsorted(key >> 32, np.arange(self.ptr.size))
        arrived = None if self.has_evaluations is None else self.has_evaluations[first]
        return SenderTrust(ptr, self.message[first], self.trust[first], arrived, self.own)

    def of_egos(self, ego_trust: float | None) -> Float[ndarray, "e"]:
        """Trust of each ego in itself: this value, or for None what it knows; NaN where it knows nothing."""
        n = self.ptr.size - 1
        if ego_trust is not None:
            return np.full(n, float(ego_trust))
        return np.full(n, np.nan) if self.own is None else self.own

    def arrived(self) -> Bool[ndarray, "h"]:
        """Whether the evaluations of each message arrived too; all true where `has_evaluations` is None."""
        return np.ones(self.message.size, bool) if self.has_evaluations is None else self.has_evaluations


@dataclass(frozen=True, slots=True)
class EvaluationMessages:
    """Evaluations made in one step, a message per evaluator; pseudonyms instead of rows.

    Trust models get evaluations of the detections of one step at a time (`of_one_step`).
    """

    step: int  # in which they were made; of the detections, unless `detection_step` is given
    evaluator: Int[ndarray, "v"]  # pseudonym
    ptr: Int[ndarray, "v+1"]  # message i is rows ptr[i]:ptr[i + 1]
    observer: Int[ndarray, "n"]  # pseudonym of the detection's sender
    detection_index: Int[ndarray, "n"]
    evaluation: Float[ndarray, "n"]  # e in [-1, 1], if the evaluator complies
    visibility: Float[ndarray, "n"]  # Phi in [0, 1], if the evaluator complies
    detection_step: Int[ndarray, "n"] | None = None
    """Step of each detection; None if all are of `step`."""

    def rows(self, keep: Bool[ndarray, "n"]) -> "EvaluationMessages":
        """All messages, with only these of their evaluations."""
        at = np.flatnonzero(keep)
        return self.with_rows(at, self.evaluator, np.searchsorted(at, self.ptr))

    def taken(self, message: Int[ndarray, "k"]) -> "EvaluationMessages":
        """These messages, in this order."""
        n = np.diff(self.ptr)[message]
        at = ranges(self.ptr[:-1][message], n)
        return self.with_rows(at, self.evaluator[message], offsets(n))

    def with_rows(
        self,
        at: Int[ndarray, "m"],
        evaluator: Int[ndarray, "k"],
        ptr: Int[ndarray, "k+1"],
    ) -> "EvaluationMessages":
        """Messages of these evaluators, with the evaluations in the rows `at`."""
        columns = {name: getattr(self, name)[at] for name in _OF_EVALUATIONS}
        step = None if self.detection_step is None else self.detection_step[at]
        return replace(self, evaluator=evaluator, ptr=ptr, detection_step=step, **columns)

    def and_also(self, earlier: "EvaluationMessages") -> "EvaluationMessages":
        """These messages, then those of an earlier step."""
        steps = [
            np.full(one.observer.size, one.step) if one.detection_step is None else one.detection_step
            for one in (self, earlier)
        ]
        return replace(EvaluationMessages.joined([self, earlier]), detection_step=np.concatenate(steps))

    @staticmethod
    def joined(parts: "Sequence[EvaluationMessages]") -> "EvaluationMessages":
        """The messages of all parts, one part after another, as messages of the step of the first part."""
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in ("evaluator", *_OF_EVALUATIONS)
        }
        n = np.concatenate([np.diff(part.ptr) for part in parts])
        return EvaluationMessages(step=parts[0].step, ptr=offsets(n), **columns)

    def of_one_step(self) -> "list[EvaluationMessages]":
        """All messages once for each step of which they evaluate detections, oldest step first.

        Each copy has only the evaluations of that step's detections, and that step as its `step`.
        """
        if self.detection_step is None:
            return [self]
        return [
            replace(self.rows(self.detection_step == step), step=step, detection_step=None)
            for step in np.unique(self.detection_step).tolist()
        ]


_OF_EVALUATIONS = ("observer", "detection_index", "evaluation", "visibility")
"""Columns of `EvaluationMessages` with a row per evaluation."""


def as_messages(
    step: int,
    pseudonyms: Int[ndarray, "messages"],
    lists: ObjectLists,
    detections: SentDetections,
    evaluations: Evaluations,
    detection_step: Int[ndarray, "m"] | None = None,
) -> EvaluationMessages:
    """The step's evaluations as messages, one per list. They are valid beyond the step.

    Parameters
    ----------
    pseudonyms
        Pseudonym of the sender of each message row.
    lists, detections, evaluations
        As `evaluation.evaluate` takes and returns them.
    detection_step
        Step of each evaluated detection. None if all are of this step.
    """
    return EvaluationMessages(
        step=step,
        evaluator=pseudonyms[lists.owner],
        ptr=lists.ptr,
        observer=pseudonyms[detections.message[lists.member]],
        detection_index=detections.detection_index[lists.member],
        evaluation=evaluations.evaluation,
        visibility=evaluations.visibility,
        detection_step=detection_step,
    )


class EvidenceRows(NamedTuple):
    """Received evaluations by others than the subject that could see the detection; flat, one row each."""

    holder: Int[ndarray, "n"]
    evaluator: Int[ndarray, "n"]  # pseudonym
    observer: Int[ndarray, "n"]  # pseudonym: the subject whose trust the row concerns
    detection_index: Int[ndarray, "n"]
    evaluation: Float[ndarray, "n"]  # e in [-1, 1]
    visibility: Float[ndarray, "n"]  # Phi in (0, 1]
    pos: Float[ndarray, "n"]  # positive evidence in [0, 1]
    neg: Float[ndarray, "n"]  # negative evidence in [0, 1]


class DetectionRows(NamedTuple):
    """Received evaluations one by one; `ObserverRows` has their sums."""

    row: Int[ndarray, "k"]  # of the `ObserverRows`: holder, evaluator and observer
    detection_index: Int[ndarray, "k"]
    pos: Float[ndarray, "k"]  # positive evidence in [0, 1]
    neg: Float[ndarray, "k"]  # negative evidence in [0, 1]


class ObserverRows(NamedTuple):
    """Received evaluations, summed over the detections of one observer in one message."""

    holder: Int[ndarray, "n"]
    evaluator: Int[ndarray, "n"]  # pseudonym
    observer: Int[ndarray, "n"]  # pseudonym: the subject whose trust the row concerns
    pos: Float[ndarray, "n"]  # sum of the positive evidence
    neg: Float[ndarray, "n"]  # sum of the negative evidence
    n: Int[ndarray, "n"]  # evaluations


QUANTUM = float(1 << 32)
"""Evidence is rounded to multiples of 1 / QUANTUM, so that sums are exact in any order of summation."""


@compiled
def _evidence(ptr, evaluator, observer, evaluation, visibility, eta):
    """Rows of the evaluations that are evidence, the message of each, and its positive and negative evidence."""
    kept = np.empty(observer.size, np.int64)
    sent_by = np.empty(observer.size, np.int64)
    pos = np.empty(observer.size)
    neg = np.empty(observer.size)
    n = 0
    for message in range(evaluator.size):
        for k in range(ptr[message], ptr[message + 1]):
            e, phi = evaluation[k], visibility[k]
            is_valid = abs(e) <= 1.0 and 0.0 < phi <= 1.0
            if not is_valid or observer[k] == evaluator[message]:
                continue
            if eta == 0.0:
                denies = 1.0 if e <= 0.0 else 0.0
            else:
                denies = min(max(e / eta, 0.0), 1.0)
            pos[n] = np.rint(phi * max(e, 0.0) * QUANTUM) / QUANTUM
            neg[n] = np.rint(phi * denies * QUANTUM) / QUANTUM
            if pos[n] > 0.0 or neg[n] > 0.0:
                kept[n] = k
                sent_by[n] = message
                n += 1
    return kept[:n], sent_by[:n], pos[:n], neg[:n]


@dataclass(frozen=True)
class ReceivedEvaluations:
    """Messages as they were received: message `message_row[i]` reached the holder `holder[i]`."""

    messages: EvaluationMessages
    holder: Int[ndarray, "m"]  # who keeps the trust scores: an actor number, or `SERVER`
    message_row: Int[ndarray, "m"]  # row of `messages.evaluator`
    eta: float = -1.0
    """Evaluation of an unmatched detection in this run (`params.eta_of`): tells `neg` from `evaluation`."""
    is_own: bool = False
    """Whether the holders made these evaluations themselves, by their own sweeps."""

    def __len__(self) -> int:
        """Number of received evaluations, including those without effect."""
        return int(np.diff(self.messages.ptr)[self.message_row].sum())

    @staticmethod
    def joined(parts: "Sequence[ReceivedEvaluations]") -> "list[ReceivedEvaluations]":
        """All receptions in their order, with as few objects as possible.

        Parameters
        ----------
        parts
            Evaluations of the detections of one step. Those of successive parts that have `eta` and `is_own` in common
            are joined.
        """
        alike = groupby(parts, lambda part: (part.eta, part.is_own))
        return [ReceivedEvaluations._as_one(list(some)) for _, some in alike]

    @staticmethod
    def _as_one(parts: "list[ReceivedEvaluations]") -> "ReceivedEvaluations":
        if len(parts) == 1:
            return parts[0]
        first = np.cumsum([0, *(part.messages.evaluator.size for part in parts)])  # message row of each part
        shifted = [part.message_row + begin for part, begin in zip(parts, first, strict=False)]
        return replace(
            parts[0],
            messages=EvaluationMessages.joined([part.messages for part in parts]),
            holder=np.concatenate([part.holder for part in parts]),
            message_row=np.concatenate(shifted),
        )

    def rows(self) -> EvidenceRows:
        """The evaluations that are evidence, flat.

        Evaluations of one's own detections, with visibility 0, with evidence neither for nor against, or with values
        out of range are left out.

        Notes
        -----
        pos = Phi max(e, 0); neg = Phi min(1, e / eta) for e < 0, and Phi for e <= 0 where eta = 0. Both are rounded to
        multiples of 2^-32, so that sums of up to two million rows are exact in any order of summation. Rows in which
        both are 0 are left out: an evaluator that answers "neither" has given no evidence.
        """
        messages = self.messages
        kept, message, pos, neg = self._evidence()
        at, n = self._received_rows(message)
        row = kept[at]
        return EvidenceRows(
            holder=np.repeat(int64(self.holder), n),
            evaluator=np.repeat(int64(messages.evaluator)[self.message_row], n),
            observer=int64(messages.observer)[row],
            detection_index=int64(messages.detection_index)[row],
            evaluation=messages.evaluation[row],
            visibility=messages.visibility[row],
            pos=pos[at],
            neg=neg[at],
        )

    def by_observer(self) -> ObserverRows:
        """The evaluations of `rows`, summed per message and observer: an order of magnitude fewer rows."""
        return self.by_observer_and_detection()[0]

    def by_observer_and_detection(self) -> tuple[ObserverRows, DetectionRows]:
        """The evaluations of `rows`, summed and one by one.

        Returns
        -------
        The rows of `by_observer`, and single evaluations, each with the row of the first table to which it belongs.
        """
        messages = self.messages
        kept, message, pos, neg = self._evidence()
        keys = pair_key(message, int64(messages.observer)[kept])
        order = np.argsort(keys, kind="stable")  # in time proportional to their number where lists are by observer
        kept, keys = kept[order], keys[order]
        pos, neg = pos[order], neg[order]
        begins = np.flatnonzero(np.diff(keys, prepend=-1))  # of each group: one message and one observer
        size = np.diff(np.append(begins, keys.size))
        group = owner_of_rows(size)
        message, observer = unpaired(keys[begins])
        at, n = self._received_rows(message)  # groups, once for every holder that received their message
        summed = ObserverRows(
            holder=np.repeat(int64(self.holder), n),
            evaluator=np.repeat(int64(messages.evaluator)[self.message_row], n),
            observer=observer[at],
            pos=np.bincount(group, pos, size.size).astype(float)[at],
            neg=np.bincount(group, neg, size.size).astype(float)[at],
            n=size[at],
        )
        single = ranges(begins[at], size[at])
        return summed, DetectionRows(
            row=owner_of_rows(size[at]),
            detection_index=int64(messages.detection_index)[kept[single]],
            pos=pos[single],
            neg=neg[single],
        )

    def _evidence(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Row, message, pos and neg of each evaluation that is evidence, by message."""
        messages = self.messages
        return _evidence(
            int64(messages.ptr),
            int64(messages.evaluator),
            int64(messages.observer),
            float64(messages.evaluation),
            float64(messages.visibility),
            float(self.eta),
        )

    def _received_rows(
        self,
        message: Int[ndarray, "n"],
    ) -> tuple[Int[ndarray, "k"], Int[ndarray, "m"]]:
        """Rows of a table of messages' contents as holders received them, reception after reception.

        Parameters
        ----------
        message
            Message to which each row of the table belongs, ascending.

        Returns
        -------
        The rows, and their number for each reception.
        """
        ptr = ptr_of(message, self.messages.evaluator.size)
        n = np.diff(ptr)[self.message_row]
        return ranges(ptr[:-1][self.message_row], n), n


@dataclass(frozen=True, slots=True)
class TrustScores(Rows):
    """Trust at one step: a row per (holder, subject) with evidence, sorted.

    All steps are steps of detections. The columns `*_evaluation_step` concern only those evaluations behind the value
    that have visibility above 0 and come from others than the subject. They are valid only where `is_evaluated`. The
    oldest steps are -1 where the model does not keep them.
    """

    step: int
    holder: Int[ndarray, "n"]  # actor number; `SERVER` for a central trust server
    subject: Int[ndarray, "n"]  # pseudonym
    trust: Float[ndarray, "n"]  # expectation, in [0, 1]
    uncertainty: Float[ndarray, "n"]  # in [0, 1]; NaN where the model has none
    weight: Float[ndarray, "n"]  # of the evidence behind the value, in the model's own unit
    n_evaluations: Int[ndarray, "n"]  # with visibility above 0, by others than the subject
    newest_step: Int[ndarray, "n"]  # of the detections behind the value
    oldest_step: Int[ndarray, "n"]
    newest_evaluation_step: Int[ndarray, "n"]
    oldest_evaluation_step: Int[ndarray, "n"]
    is_evaluated: Bool[ndarray, "n"]  # n_evaluations > 0
    n_evaluators: Int[ndarray, "n"] | None = None  # different evaluators of these; None where the model counts none

    @staticmethod
    def of(
        now_step: int,
        holder: Int[ndarray, "n"],
        subject: Int[ndarray, "n"],
        trust: Float[ndarray, "n"],
        *,
        newest_step: Int[ndarray, "n"],
        oldest_step: Int[ndarray, "n"] | None = None,
        n_evaluations: Int[ndarray, "n"] | int = 1,
        uncertainty: Float[ndarray, "n"] | None = None,
        weight: Float[ndarray, "n"] | None = None,
        n_evaluators: Int[ndarray, "n"] | None = None,
    ) -> "TrustScores":
        """Trust scores from rows in any order, with defaults for what a model does not keep.

        Parameters
        ----------
        now_step
            Step that the scores are of.
        holder, subject
            Each pair once. A pair without evidence has no row.
        trust
            In [0, 1].
        newest_step
            Newest step of the detections behind each value: the ages of trust are counted from it.
        oldest_step
            Oldest one; not kept if not given.
        n_evaluations
            Behind each value, with visibility above 0, by others than the subject; one number for all rows will do.
        uncertainty
            In [0, 1]; NaN, for none, if not given.
        weight
            Of the evidence, in the model's own unit; `n_evaluations` if not given.
        n_evaluators
            Different evaluators behind each value; not counted if not given.

        Returns
        -------
        Scores sorted by (holder, subject). The steps of the evaluations are those of the detections.
        """
        order, n = np.lexsort((subject, holder)), len(subject)
        counts = np.broadcast_to(n_evaluations, n)[order].astype(np.int64)
        newest = newest_step[order]
        oldest = np.full(n, -1) if oldest_step is None else oldest_step[order]
        return TrustScores(
            step=now_step,
            holder=holder[order],
            subject=subject[order],
            trust=trust[order],
            uncertainty=np.full(n, np.nan) if uncertainty is None else uncertainty[order],
            weight=counts.astype(float) if weight is None else weight[order],
            n_evaluations=counts,
            newest_step=newest,
            oldest_step=oldest,
            newest_evaluation_step=newest,
            oldest_evaluation_step=oldest,
            is_evaluated=counts > 0,
            n_evaluators=None if n_evaluators is None else n_evaluators[order],
        )

    def rows_of(
        self, holder: Int[ndarray, "q"], subject: Int[ndarray, "q"]
    ) -> tuple[Int[ndarray, "q"], Bool[ndarray, "q"]]:
        """Find rows of some pairs.

        Returns
        -------
        Row of each (holder, subject), and whether there is one. Where there is none, the row is meaningless.
        """
        return rows_of(pair_key(holder, subject), pair_key(self.holder, self.subject))


def pair_key(
    holder: Int[ndarray, "n"],
    subject: Int[ndarray, "n"],
) -> Int[ndarray, "n"]:
    """Each (holder, subject) as one integer.

    Parameters
    ----------
    holder, subject
        Numbers in [0, 2^31).

    Returns
    -------
    int64 keys whose order is that of (holder, subject); `unpaired` is the inverse.
    """
    return holder.astype(np.int64) << 31 | subject.astype(np.int64)


def unpaired(
    keys: Int[ndarray, "n"],
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Holder and subject of each `pair_key`."""
    return keys >> 31, keys & (1 << 31) - 1
