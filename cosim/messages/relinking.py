"""Receivers that link a new pseudonym to one that they no longer receive, by position and speed.

A receiver predicts the position of every sender that it no longer receives: that has been silent for the shortest time
that lay between two of its messages, or for the longest of any sender where it heard one message only. If a new sender
is at that position, the receiver links the two pseudonyms. It then uses what it knows about the old pseudonym until it
knows something about the new one.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.codes import TrustSource
from cosim.base.ragged import expand, rows_of
from cosim.base.rows import Rows, no_rows
from cosim.messages.pseudonyms import PseudonymParams
from cosim.messages.trust_hosts import Lookups


@dataclass(frozen=True, slots=True)
class KnownSenders(Rows):
    """What receivers store about senders: one row per receiver (actor number) and pseudonym, sorted."""

    receiver: Int[ndarray, "n"] = no_rows(np.int64)
    pseudonym: Int[ndarray, "n"] = no_rows(np.int64)
    xy_m: Float[ndarray, "n 2"] = no_rows(np.float64, 2)
    velocity_mps: Float[ndarray, "n 2"] = no_rows(np.float64, 2)
    time_s: Float[ndarray, "n"] = no_rows()
    gap_s: Float[ndarray, "n"] = no_rows()
    """Shortest time between two of its messages that the receiver heard; infinite after the first one."""
    linked: Int[ndarray, "n"] = no_rows(np.int64)
    """Earlier pseudonym whose trust value the receiver knew; -1 if there is none."""
    rated: Bool[ndarray, "n"] = no_rows(bool)
    """Whether the receiver knew a trust value of this pseudonym itself."""
    n_changes: int = 0
    """Number of pseudonym changes so far of senders that the receiver had just received. This is ground truth."""
    n_linked: int = 0
    n_right: int = 0
    """Number of links so far whose two pseudonyms belong to one sender. This is ground truth."""

    @property
    def key(self) -> Int[ndarray, "n"]:
        return self.receiver << 31 | self.pseudonym

    def rows_of(
        self,
        receiver: Int[ndarray, "q"],
        pseudonym: Int[ndarray, "q"],
    ) -> tuple[Int[ndarray, "q"], Bool[ndarray, "q"]]:
        """Row of each pair, and whether it is stored. Where it is not, the row is meaningless."""
        return rows_of(receiver.astype(np.int64) << 31 | pseudonym, self.key)


@dataclass(frozen=True, slots=True)
class ReceivedSenders:
    """R pairs of a receiver and a sender whose message it received in one round, each pair once."""

    receiver: Int[ndarray, "r"]
    """Actor number."""
    pseudonym: Int[ndarray, "r"]
    xy_m: Float[ndarray, "r 2"]
    """Position of the sender according to its message."""
    velocity_mps: Float[ndarray, "r 2"]


def update_senders(
    before: KnownSenders,
    received: ReceivedSenders,
    time_s: float,
    interval_s: float,
    owner_of: Callable[[Int[ndarray, "k"]], Int[ndarray, "k"]],
    params: PseudonymParams,
) -> KnownSenders:
    """Store the senders of one round, and link the new ones.

    Parameters
    ----------
    before
        Senders of earlier rounds.
    received
        Senders of this round.
    interval_s
        Longest time between two messages of a sender that goes on sending.
    owner_of
        Vehicles of pseudonyms. This is ground truth and is used for counting only.
    """
    order = np.lexsort((received.pseudonym, received.receiver))
    n = len(order)
    now = KnownSenders(
        receiver=received.receiver[order].astype(np.int64),
        pseudonym=received.pseudonym[order].astype(np.int64),
        xy_m=received.xy_m[order],
        velocity_mps=received.velocity_mps[order],
        time_s=np.full(n, time_s),
        gap_s=np.full(n, np.inf),
        linked=np.full(n, -1),
        rated=np.zeros(n, bool),
        n_changes=before.n_changes,
        n_linked=before.n_linked,
        n_right=before.n_right,
    )
    owner, owner_before = owner_of(now.pseudonym), owner_of(before.pseudonym)
    there = np.isin(now.key, before.key)
    was = np.searchsorted(before.key, now.key[there])
    now.linked[there] = before.linked[was]
    now.rated[there] = before.rated[was]
    since_s = time_s - before.time_s[was]
    now.gap_s[there] = np.minimum(before.gap_s[was], since_s)
    silent_s = time_s - before.time_s
    unheard = ~np.isin(before.key, now.key)
    unheard &= silent_s <= params.own_gap_s + 1e-9
    usual_s = np.minimum(before.gap_s, interval_s)
    lost = np.flatnonzero(unheard & (silent_s >= usual_s - 1e-9))
    new = np.flatnonzero(~there)
    of_lost, of_new = before.receiver[lost], now.receiver[new]
    begin = np.searchsorted(of_lost, of_new, "left")
    end = np.searchsorted(of_lost, of_new, "right")
    at, which = expand(begin, end)
    a, b = new[which], lost[at]
    moved_m = before.velocity_mps[b] * silent_s[b, None]
    expected = before.xy_m[b] + moved_m
    off_m = np.hypot(*(now.xy_m[a] - expected).T)
    fits = off_m <= params.own_gate_m
    n_changes = int((owner[a] == owner_before[b]).sum())
    a, b, off_m = a[fits], b[fits], off_m[fits]
    order = np.lexsort((b, a, off_m))
    a, b = a[order], b[order]
    best = np.zeros(len(a), bool)
    best[np.unique(a, return_index=True)[1]] = True
    mutual = np.zeros(len(a), bool)
    mutual[np.unique(b, return_index=True)[1]] = True
    a, b = a[best & mutual], b[best & mutual]
    now.gap_s[a] = before.gap_s[b]
    known, linked = before.pseudonym[b], before.linked[b]
    now.linked[a] = np.where(before.rated[b], known, linked)
    n_right = int((owner[a] == owner_before[b]).sum())
    now = replace(
        now,
        n_changes=now.n_changes + n_changes,
        n_linked=now.n_linked + len(a),
        n_right=now.n_right + n_right,
    )
    unheard[b] = False
    joined = KnownSenders.concat([now, before.take(unheard)])
    return joined.take(np.argsort(joined.key, kind="stable"))


def noted(memory: KnownSenders, rows: Int[ndarray, "q"], known: Bool[ndarray, "q"]) -> KnownSenders:
    """Store for these rows of `memory` whether the receiver's look-up of the pseudonym found a trust value."""
    rated = memory.rated.copy()
    rated[rows] = known
    return replace(memory, rated=rated)


def fallen_back(found: Lookups, rows: Int[ndarray, "k"], of_old: Lookups) -> Lookups:
    """The look-ups, with the values of old pseudonyms in some rows.

    Parameters
    ----------
    found
        Look-ups of the new pseudonyms.
    rows
        Rows of `found` in which the value is a default.
    of_old
        For each of `rows`, the look-up of the old pseudonym. If this is a default too, the row stays as it is.
    """
    better = of_old.source != TrustSource.DEFAULT
    columns: dict[str, ndarray | None] = {}
    for f in fields(Lookups):
        new, old = getattr(found, f.name), getattr(of_old, f.name)
        if new is None or old is None:  # the trust model does not count it
            columns[f.name] = None
            continue
        columns[f.name] = new.copy()
        columns[f.name][rows[better]] = old[better]  # type: ignore[index]
    return replace(found, **columns)  # type: ignore[arg-type]
