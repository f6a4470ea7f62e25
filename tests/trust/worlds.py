"""Random worlds, at once as arrays for the fast code and as dictionaries for the slow one."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from tests.seeds import seeds
from tests.verification.paper import Detection, Name
from trust.tables import ObjectLists, SentDetections

GAMMAS = [(0.0, 100.0), (0.0, 40.0), (0.0, 100.0), (0.0, 100.0)]


@dataclass
class World:
    """A step: detections, overlaps, object lists."""

    table: SentDetections
    pairs: tuple[np.ndarray, np.ndarray, np.ndarray]
    lists: ObjectLists
    points: np.ndarray  # per position of the lists
    plausible: np.ndarray
    distance_m: np.ndarray  # per detection

    @property
    def n_vehicles(self) -> int:
        return self.lists.owner.size

    def names(self) -> list[Name]:
        return list(zip(self.table.message.tolist(), self.table.detection_index.tolist(), strict=True))

    def dictionary(self) -> dict[Name, Detection]:
        t = self.table
        columns = (t.label, t.score, t.is_self, self.distance_m)
        rows = zip(*(c.tolist() for c in columns), strict=True)
        return {name: Detection(*row) for name, row in zip(self.names(), rows, strict=True)}

    def iou(self):
        """IoU by names."""
        names, (i, j, value) = self.names(), self.pairs
        known = {(names[a], names[b]): v for a, b, v in zip(i, j, value.tolist(), strict=True)}
        return lambda a, b: known.get((a, b), known.get((b, a), 0.0))

    def names_in(self, row: int) -> list[list[Name]]:
        """One object list, a list per message, its owner's first (even if empty)."""
        names, out = self.names(), {int(self.lists.owner[row]): []}
        for d in self.lists.member[self.lists.ptr[row] : self.lists.ptr[row + 1]]:
            out.setdefault(names[d][0], []).append(names[d])
        return list(out.values())


def make(seed: int, n_vehicles: int, n_objects: int, all_received: bool = False) -> World:
    """A world in which many IoUs tie, and some equal the threshold exactly; pairs have no order."""
    rng = np.random.default_rng(seed)
    label_of = rng.integers(0, 4, n_objects)
    rows = []  # message, detection_index, label, score, is_self, object
    for v in range(n_vehicles):
        if rng.random() < 0.8:
            rows.append((v, 0, 0, 1.0, True, -1 - v))
        seen = rng.choice(n_objects, rng.integers(0, n_objects + 1))  # one object may be seen twice
        for k, o in enumerate(seen, start=1):
            rows.append((v, k, label_of[o], rng.integers(1, 101) / 100, False, o))
    columns = np.array(rows, float).reshape(-1, 6).T.copy()  # contiguous as in a run: kernels are compiled once
    message, index, label, is_self, actor = columns[[0, 1, 2, 4, 5]].astype(np.int64)
    table = SentDetections(message, index, label.astype(np.uint8), columns[3], is_self == 1)
    d = len(table)
    i, j = np.triu_indices(d, 1)
    same = (label[i] == label[j]) & (message[i] != message[j])
    near = np.where(actor[i] == actor[j], 0.9, 0.15)
    same &= rng.random(i.size) < near
    order = rng.permutation(np.flatnonzero(same))
    pairs = rng.permuted(np.stack([i, j])[:, order], axis=0)
    iou = rng.integers(1, 11, pairs.shape[1]) / 20  # 0.05, 0.1 = tau, ...
    members, ptr = [], [0]
    for v in range(n_vehicles):
        received = np.ones(d, bool) if all_received else rng.random(d) < 0.8
        own = np.flatnonzero((message == v) & received)
        members += [*own, *np.flatnonzero((message != v) & received)]
        ptr.append(len(members))
    lists = ObjectLists(np.array(ptr), np.array(members, np.int64), np.arange(n_vehicles))
    m = len(members)
    points = rng.choice([0, 0, 1, 5, 9, 10, 11, 39, 40, 41, 99, 100, 500], m)
    free, ages = rng.random(m) < 0.7, rng.integers(0, 30, d).astype(float)
    return World(table, (*pairs, iou), lists, points, free, ages)


def worlds(all_received: bool = False) -> st.SearchStrategy[World]:
    """Worlds of up to six vehicles and six objects."""
    return st.builds(make, seeds, st.integers(1, 6), st.integers(1, 6), st.just(all_received))
