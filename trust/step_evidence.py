"""Evidence about the detections of one step.

Evidence is summed in integers, so that no order of arrival, no batching and no thread can change a sum, and a step's
evidence is dropped whole when it leaves the window, so that expiry is exact. A *block* holds the sums of one
(holder, subject): one slot per detection of the subject.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from trust import packed
from trust.kernel import compiled
from trust.packed import Packed
from trust.tables import EvaluationMessages, int64

ONE = float(1 << 44)  # fixed point of the sums: error 3e-14 per evaluation, room for half a million of them
_WORD = 12  # bits for the number of a 64-evaluation word within a message
_MESSAGE = 20  # bits for a message row
MAX_MESSAGES = 1 << _MESSAGE
MAX_DETECTIONS = 1 << (_WORD + 6)


class RejectReason(IntEnum):
    """Why an evaluation has no effect."""

    ACCEPTED = 0
    LATE = 1  # of a step that has left the window
    FUTURE = 2  # of a step that has not begun
    BAD_VALUE = 3  # e outside [-1, 1], Phi outside [0, 1], or not a number
    UNKNOWN_EVALUATOR = 4  # not present in that step
    UNKNOWN_OBSERVER = 5  # its observer was not present in that step
    UNKNOWN_DETECTION = 6  # was not transmitted
    DUPLICATE = 7  # the holder has this evaluator's evaluation of this detection already


class _Read(NamedTuple):
    """Messages translated into rows of the step, a column per evaluation or per message."""

    code: ndarray  # per evaluation: `RejectReason`
    subject: ndarray  # row of its observer
    number: ndarray  # of the detection among those that its evaluator has evaluated; never changes
    weight: ndarray  # Phi, fixed point
    value: ndarray  # Phi e, fixed point
    row: ndarray  # per message: row of the evaluator, -1 if unknown
    need: ndarray  # at most so many new blocks and slots


@compiled
def find_slot(keys, key):
    """Position of a key, or where to insert it, in an open-addressed table (a power of two long, -1 is free)."""
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    i = np.int64(h >> np.uint64(20)) & (keys.size - 1)
    while keys[i] != key and keys[i] != -1:
        i = (i + 1) & (keys.size - 1)
    return i


@compiled
def _moved(keys, values, size):
    """The same table with room for more."""
    new_keys = np.full(size, -1, np.int64)
    new_values = np.zeros(size, values.dtype)
    for i in range(keys.size):
        if keys[i] != -1:
            s = find_slot(new_keys, keys[i])
            new_keys[s] = keys[i]
            new_values[s] = values[i]
    return new_keys, new_values


@compiled
def _translate(ids, first, score, evaluator, ptr, observer, index, e, phi, head, count, known, parts, n_known):
    """Translate messages; each (evaluator, detection) gets a number that never changes."""
    n, n_messages = observer.size, evaluator.size
    code = np.zeros(n, np.uint8)
    subject = np.zeros(n, np.int32)
    number = np.zeros(n, np.int32)
    weight = np.zeros(n, np.int64)
    value = np.zeros(n, np.int64)
    row = np.full(n_messages, -1, np.int32)
    need = np.zeros((n_messages, 2), np.int64)
    number_of = np.zeros(score.size, np.int32)
    stamp = np.full(score.size, -1, np.int64)
    for i in range(n_messages):
        v = np.searchsorted(ids, evaluator[i])
        if v == ids.size or ids[v] != evaluator[i]:
            code[ptr[i] : ptr[i + 1]] = RejectReason.UNKNOWN_EVALUATOR
            continue
        row[i] = v
        part = head[v]
        while part >= 0:
            start, stop, number_0, part = parts[part]
            for x in range(start, stop):
                stamp[known[x]] = i
                number_of[known[x]] = number_0 + x - start
        old, s = n_known[0], -1
        for p in range(ptr[i], ptr[i + 1]):
            if s < 0 or s == ids.size or ids[s] != observer[p]:
                s = np.searchsorted(ids, observer[p])
                if s < ids.size and ids[s] == observer[p]:
                    need[i, 0] += 1
                    need[i, 1] += first[s + 1] - first[s]
            if s == ids.size or ids[s] != observer[p]:
                code[p] = RejectReason.UNKNOWN_OBSERVER
                continue
            d = first[s] + index[p] if 0 <= index[p] < first[s + 1] - first[s] else -1
            if d < 0 or not score[d] >= 0.0:
                code[p] = RejectReason.UNKNOWN_DETECTION
                continue
            if not (e[p] >= -1.0 and e[p] <= 1.0 and phi[p] >= 0.0 and phi[p] <= 1.0):
                code[p] = RejectReason.BAD_VALUE
                continue
            if stamp[d] != i:
                stamp[d] = i
                number_of[d] = count[v]
                known[n_known[0]] = d
                count[v] += 1
                n_known[0] += 1
            subject[p] = s
            number[p] = number_of[d]
            weight[p] = np.int64(np.rint(phi[p] * ONE))
            value[p] = np.int64(np.rint(phi[p] * e[p] * ONE))
        n_new = n_known[0] - old
        if n_new:
            part = n_known[1]
            parts[part, 0], parts[part, 1], parts[part, 2], parts[part, 3] = old, n_known[0], count[v] - n_new, head[v]
            head[v] = part
            n_known[1] += 1
    return _Read(code, subject, number, weight, value, row, need)


@compiled
def _add(
    start,
    holder,
    message_row,
    ptr,
    index,
    read,
    count,
    first,
    block_table,
    blocks,
    dirty,
    mask_table,
    sums,
    made_by,
    n_used,
    rejected,
):
    """Add received messages from `start` on; stops early, between two of them, when a table is full."""
    code, subject, number, weight, value, row, need = read
    block_keys, block_at = block_table
    mask_keys, masks = mask_table
    n_rows = first.size - 1
    base_of = np.zeros(n_rows, np.int64)
    block_of = np.zeros(n_rows, np.int64)
    found = np.full(n_rows, -1, np.int64)
    noted = np.full(n_rows, -1, np.int64)
    for d in range(start, holder.size):
        h, i = np.int64(holder[d]), message_row[d]
        v = np.int64(row[i])
        n_words = 0 if v < 0 else (count[v] + 63) >> 6
        if (
            2 * (n_used[0] + need[i, 0]) > block_keys.size
            or n_used[0] + need[i, 0] > dirty.size
            or n_used[1] + need[i, 1] > sums.shape[0]
            or 2 * (n_used[2] + n_words) > mask_keys.size
            or n_used[3] + need[i, 0] > made_by.shape[0]
        ):
            return d
        word, at = -1, -1
        for p in range(ptr[i], ptr[i + 1]):
            if code[p]:
                rejected[code[p]] += 1
                continue
            if number[p] >> 6 != word:
                word = number[p] >> 6
                key = (h << (_MESSAGE + _WORD)) | (v << _WORD) | word
                at = find_slot(mask_keys, key)
                if mask_keys[at] == -1:
                    mask_keys[at] = key
                    n_used[2] += 1
            bit = np.uint64(1) << np.uint64(number[p] & 63)
            if masks[at] & bit:
                rejected[RejectReason.DUPLICATE] += 1
                continue
            masks[at] |= bit
            s = subject[p]
            if found[s] != h:
                found[s] = h
                key = (h << _MESSAGE) | s
                x = find_slot(block_keys, key)
                if block_keys[x] == -1:
                    b = n_used[0]
                    block_keys[x] = key
                    block_at[x] = b
                    blocks[b, 0] = h
                    blocks[b, 1] = s
                    blocks[b, 2] = n_used[1]
                    n_used[0] += 1
                    n_used[1] += first[s + 1] - first[s]
                block_of[s] = block_at[x]
                base_of[s] = blocks[block_of[s], 2]
                dirty[block_of[s]] = True
            slot = base_of[s] + index[p]
            if s == v:  # an own evaluation marks the detection as evaluated, nothing else
                sums[slot, 2] |= 1
            else:
                sums[slot, 0] += weight[p]
                sums[slot, 1] += value[p]
                sums[slot, 2] |= 1
                sums[slot, 2] += 2 * (weight[p] > 0)
                if weight[p] > 0 and noted[s] != d:
                    noted[s] = d
                    made_by[n_used[3], 0] = block_of[s]
                    made_by[n_used[3], 1] = v
                    n_used[3] += 1
    return holder.size


@compiled
def _aggregate(n_blocks, blocks, dirty, first, score, sums, by_score, skip_unseen, aggregated, n_evaluations):
    """Equations 3 and 4 within the step, for the blocks that have changed."""
    for b in range(n_blocks):
        if not dirty[b]:
            continue
        dirty[b] = False
        s, base = blocks[b, 1], blocks[b, 2]
        top, weight, n = 0.0, 0.0, 0
        for d in range(first[s], first[s + 1]):
            x = base + d - first[s]
            phi = sums[x, 0]
            if sums[x, 2] == 0 or (skip_unseen and phi == 0):
                continue
            w = score[d] if by_score else 1.0
            if phi > 0:
                top += w * (sums[x, 1] / phi)
            weight += w
            n += sums[x, 2] >> 1
        aggregated[b, 0] = top
        aggregated[b, 1] = weight
        n_evaluations[b] = n


def _room(a: ndarray, n: int) -> ndarray:
    """The array with room for n rows, the new ones zero."""
    if a.shape[0] >= n:
        return a
    return np.concatenate([a, np.zeros((max(n, 2 * a.shape[0]) - a.shape[0], *a.shape[1:]), a.dtype)])


def _table_size(n: int) -> int:
    """Room of an open-addressed table in which n keys take half of it at most."""
    return max(64, 1 << (2 * n - 1).bit_length())


def _empty_table(dtype) -> tuple[ndarray, ndarray]:
    return np.full(64, -1, np.int64), np.zeros(64, dtype)


_WAITING = (
    "pseudonyms", "first", "score", "blocks", "dirty", "sums", "made_by", "head", "count", "known", "parts",
)  # fmt: skip
"""Arrays of `StepEvidence` that only evaluations yet to come are looked up in or change, beside its two tables."""


@dataclass(slots=True, repr=False)
class StepEvidence:
    """Pseudonyms present in one step, their detections, and the evaluations of these."""

    pseudonyms: Int[ndarray, "n"]  # present in the step, ascending
    first: Int[ndarray, "n+1"]  # detections of row r are first[r]:first[r + 1], in the order of detection_index
    score: Float[ndarray, "d"]  # NaN where a detection_index was not transmitted
    n_used: Int[ndarray, "4"] = field(default_factory=lambda: np.zeros(4, np.int64))  # blocks, slots, words, made_by
    # per block: holder, row of the subject, first of its slots
    blocks: Int[ndarray, "b 3"] = field(default_factory=lambda: np.zeros((16, 3), np.int64))
    dirty: Bool[ndarray, "b"] = field(default_factory=lambda: np.zeros(16, np.bool_))
    aggregated: Float[ndarray, "b 2"] = field(default_factory=lambda: np.zeros((16, 2)))  # sum s T, sum s
    n_evaluations: Int[ndarray, "b"] = field(default_factory=lambda: np.zeros(16, np.int64))
    pair_row: Int[ndarray, "b"] = field(default_factory=lambda: np.zeros(16, np.int64))
    n_assigned: int = 0  # blocks whose pair row is known
    is_current: bool = False  # sums, pair rows and evaluators are those of all that was added
    # per slot, of the others: Phi, Phi e (fixed point), 2 x their number with Phi > 0, + 1 if evaluated at all
    sums: Int[ndarray, "x 3"] = field(default_factory=lambda: np.zeros((256, 3), np.int64))
    # block and row of the evaluator, for every message with an evaluation by another that could see
    made_by: Int[ndarray, "y 2"] = field(default_factory=lambda: np.zeros((64, 2), np.int32))
    n_noted: int = 0  # of these, those that `EvaluatorTable` has
    block_table: tuple[ndarray, ndarray] = field(default_factory=lambda: _empty_table(np.int32))
    mask_table: tuple[ndarray, ndarray] = field(default_factory=lambda: _empty_table(np.uint64))
    # the detections that each evaluator has evaluated, in the order of their numbers, a part per message
    head: Int[ndarray, "n"] = field(init=False)  # newest part of each evaluator, -1 for none
    count: Int[ndarray, "n"] = field(init=False)  # evaluations of each evaluator
    known: Int[ndarray, "v"] = field(init=False)
    # from and to in `known`, first number, part before
    parts: Int[ndarray, "p 4"] = field(default_factory=lambda: np.zeros((16, 4), np.int64))
    n_known: Int[ndarray, "2"] = field(default_factory=lambda: np.zeros(2, np.int64))  # evaluations, parts
    packed: Packed | None = None  # `_WAITING` and the tables, which are not there meanwhile

    def __post_init__(self) -> None:
        self.head = np.full(self.pseudonyms.size, -1, np.int64)
        self.count = np.zeros(self.pseudonyms.size, np.int64)
        self.known = np.zeros(64, np.uint16 if self.score.size <= 1 << 16 else np.int32)  # the longest array of all

    def add(
        self, messages: EvaluationMessages, holder: Int[ndarray, "m"], message_row: Int[ndarray, "m"], rejected
    ) -> None:
        """Add messages: `message_row[i]` was received by `holder[i]`; rejected evaluations are counted by reason."""
        self.unpack()
        self.is_current = False
        ptr, index = int64(messages.ptr), int64(messages.detection_index)
        n_evaluations, n_parts = self.n_known.tolist()
        self.known = _room(self.known, n_evaluations + index.size)
        self.parts = _room(self.parts, n_parts + messages.evaluator.size)
        read = _translate(
            self.pseudonyms, self.first, self.score,
            int64(messages.evaluator), ptr, int64(messages.observer), index, messages.evaluation, messages.visibility,
            self.head, self.count, self.known, self.parts, self.n_known,
        )  # fmt: skip
        start = 0
        while True:
            start = _add(
                start, holder, message_row, ptr, index, read, self.count, self.first, self.block_table,
                self.blocks, self.dirty, self.mask_table, self.sums, self.made_by, self.n_used, rejected,
            )  # fmt: skip
            if start == holder.size:
                return
            self._grow(read.need[message_row[start]], int(self.count.max()) // 64 + 1)

    def _grow(self, need: Int[ndarray, "2"], n_words: int) -> None:
        n_blocks, n_slots = (self.n_used[:2] + need).tolist()
        self.blocks, self.dirty = _room(self.blocks, n_blocks), _room(self.dirty, n_blocks)
        self.aggregated, self.n_evaluations = _room(self.aggregated, n_blocks), _room(self.n_evaluations, n_blocks)
        self.pair_row = _room(self.pair_row, n_blocks)
        self.sums = _room(self.sums, n_slots)
        self.made_by = _room(self.made_by, int(self.n_used[3] + need[0]))
        for table, n in (("block_table", n_blocks), ("mask_table", int(self.n_used[2]) + n_words)):
            keys, values = getattr(self, table)
            size = _table_size(n)
            if size > keys.size:
                setattr(self, table, _moved(keys, values, 2 * size if keys.size > 64 else size))

    def trim(self, keep_noted: bool) -> None:
        """Give back the memory that no row uses, and evaluators that `EvaluatorTable` has unless they are to be kept;
        more may still be added."""
        if not keep_noted:
            n_left = int(self.n_used[3]) - self.n_noted
            self.made_by[:n_left] = self.made_by[self.n_noted : self.n_used[3]].copy()
            self.n_used[3], self.n_noted = n_left, 0
        n_blocks, n_slots, n_words, n_noted = self.n_used.tolist()
        n_known, n_parts = self.n_known.tolist()
        for n, names in (
            (n_blocks, ("blocks", "dirty", "aggregated", "n_evaluations", "pair_row")),
            (n_slots, ("sums",)),
            (n_noted, ("made_by",)),
            (n_known, ("known",)),
            (n_parts, ("parts",)),
        ):
            for name in names:
                rows = getattr(self, name)
                setattr(self, name, rows[: max(n, 1)].copy() if len(rows) > n else rows)
        for table, n in (("block_table", n_blocks), ("mask_table", n_words)):
            keys, values = getattr(self, table)
            size = _table_size(n)
            if size < keys.size:
                setattr(self, table, _moved(keys, values, size))

    def pack(self) -> None:
        """Compress what only evaluations yet to come would change, if the sums are up to date."""
        if self.packed is not None or not self.is_current:
            return
        self.packed = packed.pack(self._waiting())
        for name in (*_WAITING, "block_table", "mask_table"):
            delattr(self, name)

    def unpack(self) -> None:
        """Have all fields there again."""
        if self.packed is None:
            return
        *plain, block_keys, block_at, mask_keys, masks = packed.unpack(self.packed)
        for name, array in zip(_WAITING, plain, strict=True):
            setattr(self, name, array)
        self.block_table, self.mask_table, self.packed = (block_keys, block_at), (mask_keys, masks), None

    def _waiting(self) -> list[ndarray]:
        return [*(getattr(self, name) for name in _WAITING), *self.block_table, *self.mask_table]

    def aggregate(self, by_score: bool, skip_unseen: bool) -> None:
        """Update sum s T(theta) and sum s of every block that has changed."""
        _aggregate(
            self.n_used[0], self.blocks, self.dirty, self.first, self.score, self.sums,
            by_score, skip_unseen, self.aggregated, self.n_evaluations,
        )  # fmt: skip

    def evaluators(self, start: int = 0) -> tuple[Int[ndarray, "y"], Int[ndarray, "y"]]:
        """Pair row and pseudonym of every evaluator that could see, from the `start`-th on; some stand twice."""
        self.unpack()
        block, v = self.made_by[start : self.n_used[3]].T
        return self.pair_row[block], self.pseudonyms[v]

    @property
    def nbytes(self) -> int:
        """Memory [B]."""
        summed = self.aggregated.nbytes + self.n_evaluations.nbytes + self.pair_row.nbytes
        waiting = self._waiting() if self.packed is None else [self.packed.content]
        return summed + sum(a.nbytes for a in waiting)


def open_step_evidence(
    pseudonyms: Int[ndarray, "n"],
    observer_row: Int[ndarray, "d"],
    detection_index: Int[ndarray, "d"],
    score: Float[ndarray, "d"],
) -> tuple[StepEvidence, int]:
    """Empty evidence of a step with these pseudonyms (ascending) and detections; invalid detections are left out.

    Returns
    -------
    The evidence, and the number of detections rejected: score outside [0, 1], index out of range or given twice.
    """
    assert pseudonyms.size < MAX_MESSAGES
    assert np.all(pseudonyms[1:] > pseudonyms[:-1])
    valid = (score >= 0) & (score <= 1) & (detection_index >= 0) & (detection_index < MAX_DETECTIONS)
    row, index, score = observer_row[valid], detection_index[valid], score[valid]
    n_indices = np.zeros(pseudonyms.size, np.int64)
    np.maximum.at(n_indices, row, index + 1)
    first = np.concatenate([np.zeros(1, np.int64), np.cumsum(n_indices)])
    at = first[row] + index
    kept = np.arange(at.size)
    if np.any(at[1:] <= at[:-1]):
        _, kept = np.unique(at, return_index=True)
    scores = np.full(first[-1], np.nan)
    scores[at[kept]] = score[kept]
    return StepEvidence(int64(pseudonyms), first, scores), int((~valid).sum() + at.size - kept.size)
