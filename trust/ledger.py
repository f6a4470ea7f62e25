"""The ledger: object trust and vehicle trust over an exact freshness window."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from numpy import ndarray

from trust.page import Page, Refusal, open_page
from trust.params import TrustParams, window_steps
from trust.tables import Told, int64

SERVER = 0
"""Holder of the central ledger."""


@dataclass(frozen=True, slots=True)
class Standing:
    """Vehicle trust at one step: a row per (holder, subject) with fresh evidence, sorted."""

    step: int
    holder: Int[ndarray, "n"]  # vehicle id; `SERVER` in a central ledger
    subject: Int[ndarray, "n"]  # vehicle id
    trust: Float[ndarray, "n"]  # in [0, 1]
    weight: Float[ndarray, "n"]  # of the detections behind it: sum of their scores
    n_verdicts: Int[ndarray, "n"]  # of others who could see what they judged
    newest_step: Int[ndarray, "n"]  # of the detections behind it
    oldest_step: Int[ndarray, "n"]

    def rows_of(
        self, holder: Int[ndarray, "q"], subject: Int[ndarray, "q"]
    ) -> tuple[Int[ndarray, "q"], Bool[ndarray, "q"]]:
        """Row of each (holder, subject), and whether there is one (else the row means nothing)."""
        if not self.subject.size:
            return np.zeros(subject.shape, np.int64), np.zeros(subject.shape, bool)
        keys, wanted = _key(self.holder, self.subject), _key(holder, subject)
        at = np.minimum(np.searchsorted(keys, wanted), keys.size - 1)
        return at, keys[at] == wanted

    def trust_of(self, holder: Int[ndarray, "q"], subject: Int[ndarray, "q"], default: float) -> Float[ndarray, "q"]:
        """Trust of each subject as its holder knows it; `default` where it knows nothing."""
        at, found = self.rows_of(holder, subject)
        out = np.full(subject.shape, default)
        out[found] = self.trust[at[found]]
        return out


@njit(cache=True)
def _tally(step, account, settled, n_verdicts, total, count, newest, oldest):
    """Add a page to the accounts; pages come in the order of time."""
    for b in range(account.size):
        if settled[b, 1] > 0.0:
            a = account[b]
            if count[a, 0] == 0:
                oldest[a] = step
            newest[a] = step
            total[a, 0] += settled[b, 0]
            total[a, 1] += settled[b, 1]
            count[a, 0] += 1
            count[a, 1] += n_verdicts[b]


class Ledger:
    """Evidence about vehicles, and the trust that follows from it.

    The same class is the server's ledger (every delivery has the holder `SERVER`) and the ledgers of all
    vehicles (the holder is the vehicle's id). Vehicle ids and steps are non-negative integers below 2^31.

    Notes
    -----
    Equations 3 and 4 of [1]_: object trust T(theta) = sum Phi e / sum Phi over the evaluators other than the
    detector; vehicle trust = sum s T(theta) / sum s over its detections of the window, at least 0.

    Deviations: an unseen detection, 0/0 in the paper, counts as 0 with weight s (`unseen`); the window has
    f steps, not f + 1 (`window`). Of two contradicting verdicts of one evaluator on one detection the first
    to arrive counts.
    """

    def __init__(self, params: TrustParams, dt_s: float) -> None:
        self.params = params
        self.window = window_steps(params, dt_s)
        self.pages: dict[int, Page] = {}
        self.refused = np.zeros(len(Refusal), np.int64)
        """Verdicts refused so far, by `Refusal`."""
        self.n_entered = 0
        """Verdicts delivered so far, refused ones included."""
        self.n_bad_detections = 0
        """Announced detections refused so far: score outside [0, 1], or a number given twice."""
        self._now = -1
        self._keys = np.empty(0, np.int64)  # accounts that live, ascending, and the row of each
        self._rows = np.empty(0, np.int64)
        self._n_pages = np.zeros(16, np.int64)  # pages that use a row

    def announce(
        self,
        step: int,
        ids: Int[ndarray, "n"],
        row: Int[ndarray, "d"],
        k: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> None:
        """Open the step: the vehicles that are there, and what they detected; the oldest step is forgotten.

        Parameters
        ----------
        ids
            Vehicle ids, ascending, those without detections included.
        row
            Row in `ids` of each detection's vehicle.
        """
        assert step >= self._now and step not in self.pages, "steps are announced once and in order"
        self.forget(step)
        self.pages[step], n_bad = open_page(ids, row, k, score)
        self.n_bad_detections += n_bad

    def forget(self, now: int) -> None:
        """Let time pass: drop the evidence that is older than the window."""
        self._now = max(self._now, now)
        for step in [s for s in self.pages if s <= now - self.window]:
            page = self.pages.pop(step)
            self._n_pages[page.account[: page.n_accounts]] -= 1
        alive = self._n_pages[self._rows] > 0
        self._keys, self._rows = self._keys[alive], self._rows[alive]

    def enter(self, told: Told, holder: Int[ndarray, "m"], voice: Int[ndarray, "m"]) -> None:
        """Book deliveries of messages, however late: message `voice[i]` reached the ledger of `holder[i]`.

        What cannot be booked is counted in `refused` and changes nothing.
        """
        page = self.pages.get(told.step)
        n = int(np.diff(told.ptr)[voice].sum())
        self.n_entered += n
        if page is None:
            self.refused[Refusal.FUTURE if told.step > self._now else Refusal.LATE] += n
            return
        page.enter(told, int64(holder), int64(voice), self.refused)

    def standing(self, now: int | None = None) -> Standing:
        """Trust of everybody about whom there is fresh evidence, at step `now` (default: the last one)."""
        if now is not None:
            assert now >= self._now, "evidence that is forgotten does not come back"
            self.forget(now)
        p = self.params
        steps = sorted(self.pages)
        for step in steps:
            page = self.pages[step]
            page.settle(p.weighting == "score", p.unseen == "skip")
            self._assign(page)
        n = self._n_pages.size
        total, count = np.zeros((n, 2)), np.zeros((n, 2), np.int64)
        newest, oldest = np.zeros(n, np.int64), np.zeros(n, np.int64)
        for step in steps:
            page = self.pages[step]
            _tally(
                step, page.account[: page.n_accounts], page.settled, page.n_verdicts,
                total, count, newest, oldest,
            )  # fmt: skip
        has = count[self._rows, 0] > 0
        keys, rows = self._keys[has], self._rows[has]
        weight = total[rows, 1]
        trust = np.maximum(0.0, total[rows, 0] / weight)
        return Standing(
            self._now, keys >> 31, keys & (1 << 31) - 1, trust, weight,
            count[rows, 1], newest[rows], oldest[rows],
        )  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Memory of the ledger [B]."""
        own = self._keys.nbytes + self._rows.nbytes + self._n_pages.nbytes
        return own + sum(page.nbytes for page in self.pages.values())

    def _assign(self, page: Page) -> None:
        """Give the page's new blocks their accounts."""
        n = int(page.n_used[0])
        if n == page.n_accounts:
            return
        new = page.blocks[page.n_accounts : n]
        keys = _key(new[:, 0], page.ids[new[:, 1]])
        at = np.searchsorted(self._keys, keys)
        there = at < self._keys.size
        there[there] = self._keys[at[there]] == keys[there]
        fresh = np.sort(keys[~there])
        if fresh.size:
            free = np.flatnonzero(self._n_pages == 0)
            if free.size < fresh.size:
                size = max(2 * self._n_pages.size, self._n_pages.size + fresh.size)
                self._n_pages = np.concatenate([self._n_pages, np.zeros(size - self._n_pages.size, np.int64)])
                free = np.flatnonzero(self._n_pages == 0)
            at = np.searchsorted(self._keys, fresh)
            self._keys = np.insert(self._keys, at, fresh)
            self._rows = np.insert(self._rows, at, free[: fresh.size])
        rows = self._rows[np.searchsorted(self._keys, keys)]
        page.account[page.n_accounts : n] = rows
        self._n_pages[rows] += 1
        page.n_accounts = n


def _key(holder: Int[ndarray, "n"], subject: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    return holder.astype(np.int64) << 31 | subject.astype(np.int64)
