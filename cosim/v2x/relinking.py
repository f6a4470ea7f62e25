"""Receivers that link a new pseudonym to one that has fallen silent, by place and speed.

A receiver expects every sender that it no longer receives at a certain place by now. If a sender that it receives for
the first time is at that place, the receiver takes the two for one. It then uses what it knows of the old pseudonym as
long as it knows nothing of the new one.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.ragged import expand
from cosim.v2x.pseudonyms import PseudonymParams
from cosim.v2x.trust_hosts import Lookups
from results.codes import TrustSource


@dataclass(frozen=True, slots=True)
class KnownSenders:
    """What receivers remember of senders: a row per receiver (actor number) and pseudonym, sorted."""

    receiver: Int[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    pseudonym: Int[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    xy_m: Float[ndarray, "n 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    velocity_mps: Float[ndarray, "n 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    time_s: Float[ndarray, "n"] = field(default_factory=lambda: np.zeros(0))
    linked: Int[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Earlier pseudonym of which the receiver knew a trust value; -1 for none."""
    rated: Bool[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, bool))
    """Whether the receiver knew a trust value of this pseudonym itself."""
    n_changes: int = 0
    """Changes so far of senders that the receiver had received just before; ground truth, read by nothing."""
    n_linked: int = 0
    n_right: int = 0
    """Of those linked, pairs of one sender; ground truth, which no vehicle reads."""

    @property
    def key(self) -> Int[ndarray, "n"]:
        return self.receiver << 31 | self.pseudonym

    def take(self, rows: ndarray) -> "KnownSenders":
        """These rows."""
        columns = {f.name: getattr(self, f.name)[rows] for f in fields(self) if not f.name.startswith("n_")}
        return replace(self, **columns)

    def rows_of(self, receiver: Int[ndarray, "q"], pseudonym: Int[ndarray, "q"]) -> Int[ndarray, "q"]:
        """Row of each pair; all of them are remembered."""
        return np.searchsorted(self.key, receiver.astype(np.int64) << 31 | pseudonym)


@dataclass(frozen=True, slots=True)
class ReceivedSenders:
    """R pairs of a receiver and a sender whose message it received in one round, each pair once."""

    receiver: Int[ndarray, "r"]
    """Actor number."""
    pseudonym: Int[ndarray, "r"]
    xy_m: Float[ndarray, "r 2"]
    """Position of the sender, as its message says."""
    velocity_mps: Float[ndarray, "r 2"]


def update_senders(
    before: KnownSenders, received: ReceivedSenders, time_s: float,
    owner_of: Callable[[Int[ndarray, "k"]], Int[ndarray, "k"]], params: PseudonymParams,
) -> KnownSenders:  # fmt: skip
    """Remember the senders of one round, and link those that are new.

    Parameters
    ----------
    owner_of
        Vehicles behind pseudonyms: ground truth, for counting alone.
    """
    order = np.lexsort((received.pseudonym, received.receiver))
    n = len(order)
    now = KnownSenders(
        receiver=received.receiver[order].astype(np.int64),
        pseudonym=received.pseudonym[order].astype(np.int64),
        xy_m=received.xy_m[order],
        velocity_mps=received.velocity_mps[order],
        time_s=np.full(n, time_s),
        linked=np.full(n, -1),
        rated=np.zeros(n, bool),
        n_changes=before.n_changes,
        n_linked=before.n_linked,
        n_right=before.n_right,
    )
    owner, owner_before = owner_of(now.pseudonym), owner_of(before.pseudonym)
    there = np.isin(now.key, before.key)
    was = np.searchsorted(before.key, now.key[there])
    now.linked[there], now.rated[there] = before.linked[was], before.rated[was]
    silent = ~np.isin(before.key, now.key) & (time_s - before.time_s <= params.own_gap_s + 1e-9)
    lost, new = np.flatnonzero(silent), np.flatnonzero(~there)
    begin, end = (np.searchsorted(before.receiver[lost], now.receiver[new], side) for side in ("left", "right"))
    at, which = expand(begin, end)
    a, b = new[which], lost[at]
    expected = before.xy_m[b] + before.velocity_mps[b] * (time_s - before.time_s[b])[:, None]
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
    now.linked[a] = np.where(before.rated[b], before.pseudonym[b], before.linked[b])
    n_right = int((owner[a] == owner_before[b]).sum())
    now = replace(
        now, n_changes=now.n_changes + n_changes, n_linked=now.n_linked + len(a), n_right=now.n_right + n_right
    )
    return _joined(now, before.take(lost[~np.isin(lost, b)]))


def _joined(one: KnownSenders, other: KnownSenders) -> KnownSenders:
    columns = {
        f.name: np.concatenate([getattr(one, f.name), getattr(other, f.name)])
        for f in fields(one) if not f.name.startswith("n_")
    }  # fmt: skip
    joined = replace(one, **columns)  # type: ignore[arg-type]
    return joined.take(np.argsort(joined.key, kind="stable"))


def noted(memory: KnownSenders, rows: Int[ndarray, "q"], known: Bool[ndarray, "q"]) -> KnownSenders:
    """Remember of which pseudonyms a trust value was known when it was looked up."""
    rated = memory.rated.copy()
    rated[rows] = known
    return replace(memory, rated=rated)


def fallen_back(found: Lookups, rows: Int[ndarray, "k"], of_old: Lookups) -> Lookups:
    """Look-ups with the default replaced, in these rows, by what is known of the old pseudonym."""
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
